"""Settings of a configuration of kind ``pec_study``."""

import os
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field

from holotorch.experiments.config.settings import Count, Number, Settings, number, several
from holotorch.experiments.pec.config import Picture

_PICTURES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp")


def _photographs(value: Any) -> Any:
    """The entries; a folder is replaced by its pictures in the order of their names."""
    entries: list[Any] = []
    for entry in several(value):
        if isinstance(entry, str) and os.path.isdir(entry):  # unlike Path.is_dir, False for a name that is too long
            entries += [str(path) for path in sorted(Path(entry).iterdir()) if path.suffix.lower() in _PICTURES]
        else:
            entries.append(entry)
    return tuple(entries)


METHODS = (
    "IPEC: iterative proximity effect correction (thesis Algorithm 1; in the near field IFPEC), basic IPEC: the same "
    "without deconvolution; PPEC: proximal proximity effect correction (Algorithm 2; in the near field FPEC); ours: "
    "L-BFGS in stages (solver.kind lbfgs)"
)


class StudySettings(Settings):
    """A comparison of methods over several photographs.

    ``images``: photographs, or folders of them. ``size``: pixels of the array from left to right. ``sweep``: sigmas in
    pixels, or cut-offs in cycles per pixel for the study ``lowpass``; ``targets`` does not use it.
    """

    experiment: Literal["pec_study"]
    study: Literal[
        "reproduction",
        "photographs",
        "photographs_fresnel",
        "lowpass",
        "multiplexing",
        "iterations",
        "starts",
        "time",
        "focus",
        "limits",
        "targets",
    ]
    images: Annotated[tuple[Picture, ...], BeforeValidator(_photographs), Field(min_length=1)]
    size: Annotated[Count, Field(ge=24, le=1024)] = 128
    sweep: Annotated[tuple[Annotated[Number, Field(gt=0, le=3)], ...], BeforeValidator(several), Field(min_length=1)]
    max_steps: Annotated[Count, Field(le=100000)] = 400
    seed: Annotated[int, BeforeValidator(number), Field(ge=0, lt=2**63)] = 7
