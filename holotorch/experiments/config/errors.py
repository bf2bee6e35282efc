"""The error for mistakes that a user can correct."""

from typing import Any


class ConfigError(ValueError):
    """Mistakes in the input, one line each; a mistake in a file reads ``file:line:column: key: what is wrong``."""

    def __init__(self, mistakes: list[str]):
        super().__init__("\n".join(mistakes))
        self.mistakes = mistakes


def short(value: Any) -> str:
    """``repr`` of a value for a message, cut off after 200 characters."""
    text = repr(value)
    return text if len(text) <= 200 else f"{text[:200]}... ({len(text)} characters)"
