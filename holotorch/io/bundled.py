"""Names of bundled pictures, configurations and similar paths; without torch, which takes seconds to import."""

import contextlib
import difflib
from pathlib import Path

# Photographs that the scikit-image package contains.
BUNDLED_IMAGES = ("astronaut", "brick", "camera", "chelsea", "coffee", "coins", "grass", "moon", "page", "text")


def no_such_picture(source: str) -> str:
    """Error message for a picture that is neither bundled nor a file; it suggests the most similar name.

    That is one of a bundled picture, or else of a file in the same folder.
    """
    near = difflib.get_close_matches(source, BUNDLED_IMAGES, 1)
    suggested = near[0] if near else similar_path(source)
    hint = f"did you mean {str(suggested)!r}? " if suggested else ""
    shown = repr(source) if len(source) < 200 else f"{source[:200]!r}... ({len(source)} characters)"
    return f"no such picture: {shown}; {hint}give a path, or one of {', '.join(BUNDLED_IMAGES)}"


def similar_path(path: str | Path) -> Path | None:
    """The neighbour of ``path``, which does not exist, with the most similar name; None if none is similar."""
    path = Path(path)
    with contextlib.suppress(OSError, ValueError):  # no such folder, or a name that no file can have
        names = [each.name for each in path.parent.iterdir()]
        return next((path.with_name(near) for near in difflib.get_close_matches(path.name, names, 1, cutoff=0.8)), None)
    return None


def find_config(name: str | Path) -> Path | None:
    """Path of a configuration: the file ``name``, or else the bundled file of that name; None if there is neither.

    A bundled configuration is named with or without the folder, such as "configs/demo.yaml". In an installed package
    ``configs`` lies inside the package, and in a checkout beside it.
    """
    return next((candidate for candidate in _candidates(Path(name)) if candidate.is_file()), None)


def similar_config(path: Path) -> Path | None:
    """The configuration most similar to ``path``, which is no file; None if there is none.

    It is one of the neighbours, or else a bundled one with this name in another folder.
    """
    names = {each.stem: each.name for candidate in _candidates(path) for each in candidate.parent.glob("*.yaml")}
    near = difflib.get_close_matches(path.stem, sorted(names), 1)  # with the suffix, any two names would be similar
    if near:
        return path.with_name(names[near[0]])
    for folder in (package / "configs" for package in Path(__file__).parents[1:3]):
        for same in folder.rglob("*.yaml"):
            if same.stem == path.stem:
                return "configs" / same.relative_to(folder)
    return None


def _candidates(path: Path) -> tuple[Path, ...]:
    package = Path(__file__).parents[1]
    inside = Path(*path.parts[1:]) if path.parts[:1] == ("configs",) else path
    return path, package / "configs" / inside, package.parent / "configs" / inside
