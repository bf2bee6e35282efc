"""Perception in the far periphery (thesis chapter 2): perception time, content size over eccentricity, and displays.

Angles are in degrees, and their names end in ``_deg``; times are in seconds.
"""

from holotorch.perception.anova import one_way_from_summary, two_way_from_summary
from holotorch.perception.cortical import (
    COWEY_ROLLS,
    DOUGHERTY,
    HORTON_HOYT,
    INFERIOR,
    NASAL,
    SUPERIOR,
    TEMPORAL,
    LinearMagnification,
    LinearSize,
    RovamoVirsu,
    StrasburgerLetters,
    TolhurstLing,
    cortical_scale,
    peripheral_weight,
)
from holotorch.perception.display import TABLE_2_1, WideDisplay, check_display
from holotorch.perception.geometry import CurvedScreen, FlatScreen, Headset, eccentricity_of, separation
from holotorch.perception.layout import ScaledLayout, overlaps, scale_layout
from holotorch.perception.scale import FITTED_DEG, TESTED_DEG, EqualEfficiencyScale
from holotorch.perception.table import TABLE_2_2
from holotorch.perception.time import PerceptionTime

__all__ = [
    "COWEY_ROLLS",
    "DOUGHERTY",
    "FITTED_DEG",
    "HORTON_HOYT",
    "INFERIOR",
    "NASAL",
    "SUPERIOR",
    "TABLE_2_1",
    "TABLE_2_2",
    "TEMPORAL",
    "TESTED_DEG",
    "CurvedScreen",
    "EqualEfficiencyScale",
    "FlatScreen",
    "Headset",
    "LinearMagnification",
    "LinearSize",
    "PerceptionTime",
    "RovamoVirsu",
    "ScaledLayout",
    "StrasburgerLetters",
    "TolhurstLing",
    "WideDisplay",
    "check_display",
    "cortical_scale",
    "eccentricity_of",
    "one_way_from_summary",
    "overlaps",
    "peripheral_weight",
    "scale_layout",
    "separation",
    "two_way_from_summary",
]
