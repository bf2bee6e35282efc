"""Pictures and configurations that come with the package. Free of torch: configurations are checked before it loads."""

import difflib
from pathlib import Path

# Photographs that scikit-image carries inside its package, so that no network is needed.
BUNDLED_IMAGES = ("astronaut", "brick", "camera", "chelsea", "coffee", "coins", "grass", "moon", "page", "text")


def no_such_picture(source: str) -> str:
    """Message for a picture that is neither bundled nor a file, with the nearest name."""
    near = difflib.get_close_matches(source, BUNDLED_IMAGES, 1)
    hint = f"did you mean {near[0]!r}? " if near else ""
    shown = repr(source) if len(source) < 200 else f"{source[:200]!r}... ({len(source)} characters)"
    return f"no such picture: {shown}; {hint}give a path, or one of {', '.join(BUNDLED_IMAGES)}"


def find_config(name: str | Path) -> Path | None:
    """A configuration by its path, or one of the project such as "configs/demo.yaml" from wherever it is called.

    That is inside an installed package, or beside the package in a checkout; None where there is none of that name.
    """
    path, package = Path(name), Path(__file__).parents[1]
    below = Path(*path.parts[1:]) if path.parts[:1] == ("configs",) else path
    places = (path, package / "configs" / below, package.parent / "configs" / below)
    return next((place for place in places if place.is_file()), None)
