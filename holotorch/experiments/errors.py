"""The error that a user can mend."""


class ConfigError(ValueError):
    """One or more mistakes in what the user gave, a line each; in a file ``file:line:column: key: what is wrong``."""

    def __init__(self, mistakes: list[str]):
        super().__init__("\n".join(mistakes))
        self.mistakes = mistakes
