"""The error that a user can mend."""

from typing import Any

_LONGEST = 200  # characters that a message repeats of a value


class ConfigError(ValueError):
    """One or more mistakes in what the user gave, a line each; in a file ``file:line:column: key: what is wrong``."""

    def __init__(self, mistakes: list[str]):
        super().__init__("\n".join(mistakes))
        self.mistakes = mistakes


def short(value: Any) -> str:
    """What came, as a message repeats it: without what no line has room for."""
    text = repr(value)
    return text if len(text) <= _LONGEST else f"{text[:_LONGEST]}... ({len(text)} characters)"
