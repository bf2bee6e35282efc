"""The error for mistakes that a user can correct."""

from typing import Any

MOST_MISTAKES = 50  # limit for the number of mistakes that are listed


class ConfigError(ValueError):
    """Mistakes in the input, one line each; a mistake in a file reads ``file:line:column: key: what is wrong``.

    The message lists the first of them, and counts the others and ``more`` that are not given.
    """

    def __init__(self, mistakes: list[str], more: int = 0):
        more += max(0, len(mistakes) - MOST_MISTAKES)
        super().__init__("\n".join([*mistakes[:MOST_MISTAKES], *([f"and {more} more mistakes"] if more > 0 else [])]))
        self.mistakes = mistakes


def short(value: Any) -> str:
    """``repr`` of a value for a message, cut off after 200 characters."""
    text = repr(value)
    return text if len(text) <= 200 else f"{text[:200]}... ({len(text)} characters)"
