"""Settings of a configuration of kind ``pec_study``."""

from typing import Annotated, Literal

from pydantic import BeforeValidator, Field

from holotorch.experiments.config.settings import Count, Number, Settings, number, several
from holotorch.experiments.pec.config import Picture

METHODS = (
    "IPEC: iterative proximity effect correction (thesis Algorithm 1; in the near field IFPEC), basic IPEC: the same "
    "without deconvolution; PPEC: proximal proximity effect correction (Algorithm 2; in the near field FPEC); ours: "
    "L-BFGS in stages (solver.kind lbfgs)"
)


class StudySettings(Settings):
    """A comparison of methods over several photographs.

    ``sweep``: sigmas in pixels, or cut-offs in cycles per pixel for the study ``lowpass``; ``targets`` does not use it.
    """

    experiment: Literal["pec_study"]
    study: Literal["reproduction", "lowpass", "multiplexing", "iterations", "time", "focus", "limits", "targets"]
    images: Annotated[tuple[Picture, ...], BeforeValidator(several), Field(min_length=1)]
    size: Annotated[Count, Field(ge=24, le=1024)] = 128
    sweep: Annotated[tuple[Annotated[Number, Field(gt=0, le=3)], ...], BeforeValidator(several), Field(min_length=1)]
    max_steps: Count = 400
    seed: Annotated[int, BeforeValidator(number), Field(ge=0, lt=2**63)] = 7
