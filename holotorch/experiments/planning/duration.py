"""A predicted duration in words."""


def duration(seconds: float) -> str:
    """Predicted seconds, rounded, in seconds, minutes or hours."""
    for unit, length in (("s", 1), ("min", 60)):
        if seconds < 99.5 * length:
            return f"{seconds / length:.2g} {unit}"
    return f"{seconds / 3600:.{1 if seconds < 36_000 else 0}f} h"
