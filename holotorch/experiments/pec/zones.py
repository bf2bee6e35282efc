"""Scores by zones of the visual field, as a table of a report."""

from collections.abc import Sequence
from typing import Any


def zone_rows(methods: dict[str, dict[str, Any]]) -> tuple[list[str], list[list[str]]]:
    """Head and cells of a table of the zones' scores, a row for each method; empty without zones."""
    scored = {name: numbers["zones"] for name, numbers in methods.items() if "zones" in numbers}
    if not scored:
        return [], []
    zones: Sequence[dict[str, Any]] = next(iter(scored.values()))
    limits = [f"{zone['from_deg']} to {zone['to_deg']} deg" for zone in zones[:-1]] + [
        f"from {zones[-1]['from_deg']} deg"
    ]
    head = ["method"] + [f"{z['zone']}, {words}" for z, words in zip(zones, limits, strict=True)]
    return head, [[name, *map(_cell, row)] for name, row in scored.items()]


def _cell(zone: dict[str, Any]) -> str:
    parts = [] if zone["ssim"] is None else [f"SSIM {zone['ssim']:.3f}"]
    parts += [] if zone["psnr"] is None else [f"{zone['psnr']:.1f} dB"]
    return ", ".join([*parts, f"{100 * zone['error']:.0f} % of the error"])
