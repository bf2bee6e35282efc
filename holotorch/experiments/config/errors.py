"""The error for mistakes that a user can correct."""

from typing import Any

_LONGEST = 200  # characters of a value that a message repeats


class ConfigError(ValueError):
    """Mistakes in the input, one line each; those in a file read ``file:line:column: key: what is wrong``."""

    def __init__(self, mistakes: list[str]):
        super().__init__("\n".join(mistakes))
        self.mistakes = mistakes


def short(value: Any) -> str:
    """A value as a message repeats it, cut off after 200 characters."""
    text = repr(value)
    return text if len(text) <= _LONGEST else f"{text[:_LONGEST]}... ({len(text)} characters)"
