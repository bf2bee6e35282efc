"""What the configuration of a study of proximity effect correction may say."""

from typing import Annotated, Literal

from pydantic import BeforeValidator, Field

from holotorch.experiments.config.settings import Count, Number, Settings, number, several
from holotorch.experiments.pec.config import Picture


class StudySettings(Settings):
    """A comparison of methods over several photographs; ``sweep`` are sigmas in pixels, or cut-offs for lowpass."""

    experiment: Literal["pec_study"]
    study: Literal["reproduction", "lowpass", "multiplexing", "iterations", "time", "focus", "limits", "targets"]
    images: Annotated[tuple[Picture, ...], BeforeValidator(several), Field(min_length=1)]
    size: Annotated[Count, Field(ge=24, le=1024)] = 128
    sweep: Annotated[tuple[Annotated[Number, Field(gt=0, le=3)], ...], BeforeValidator(several), Field(min_length=1)]
    max_steps: Count = 400
    seed: Annotated[int, BeforeValidator(number), Field(ge=0, lt=2**63)] = 7
