"""Names of the pictures that need no file. Free of torch, so that a configuration is checked before torch loads."""

import difflib

# Photographs that scikit-image carries inside its package, so that no network is needed.
BUNDLED_IMAGES = ("astronaut", "brick", "camera", "chelsea", "coffee", "coins", "grass", "moon", "page", "text")


def no_such_picture(source: str) -> str:
    """Message for a picture that is neither bundled nor a file, with the nearest name."""
    near = difflib.get_close_matches(source, BUNDLED_IMAGES, 1)
    hint = f"did you mean {near[0]!r}? " if near else ""
    return f"no such picture: {source!r}; {hint}give a path, or one of {', '.join(BUNDLED_IMAGES)}"
