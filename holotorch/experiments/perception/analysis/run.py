"""A run of the analysis: reads logs or simulates participants, and writes tables, pictures and the summary."""

import math
import time
from collections.abc import Iterator
from dataclasses import asdict
from typing import Any

import numpy as np
import torch
from pydantic import ValidationError
from tqdm import tqdm

from holotorch.experiments.config.errors import ConfigError
from holotorch.experiments.perception.analysis import figures, statistics
from holotorch.experiments.perception.analysis.cells import cell_tests
from holotorch.experiments.perception.analysis.config import AnalysisSettings
from holotorch.experiments.perception.analysis.curves import (
    Curves,
    Responses,
    Times,
    equal_efficiency,
    fit_curves,
    perception_times,
    read_responses,
)
from holotorch.experiments.perception.analysis.factors import level_effects, model_effects
from holotorch.experiments.perception.analysis.finding import Finding, in_json, in_words
from holotorch.experiments.perception.analysis.power import needed, power_rows, with_slope
from holotorch.experiments.perception.analysis.simulation import MIDDLE_DEG, simulate, true_line
from holotorch.experiments.perception.study.frames import quantisation
from holotorch.experiments.runs.folder import RunFolder, conclude
from holotorch.experiments.runs.saving import Results
from holotorch.experiments.runs.tables import write_table
from holotorch.io.files import save_array, write_bytes, write_json


def analyse(settings: AnalysisSettings, times: Times, curves: Curves) -> list[Finding]:
    """Analyse all target times. ConfigError for a target that was not shown, or if statsmodels is missing."""
    eccentricities, (low, high) = curves.eccentricities, settings.range_deg
    inside = (eccentricities >= low) & (eccentricities <= high)
    findings = []
    repeated = _uses_repeated_measures(settings)
    for k, target in enumerate(settings.targets):
        scales = equal_efficiency(curves, times.of(target), settings.limits_deg)
        line = statistics.fit_line(
            eccentricities,
            scales.degrees,
            np.random.default_rng([settings.seed, 2, k]),
            inside=inside,
            limits=settings.limits_deg,
            resamples=settings.resamples,
            confidence=settings.confidence,
        )
        defined, measured = scales.defined_degrees[:, inside], np.isfinite(scales.degrees[:, inside])
        findings.append(
            Finding(
                str(target),
                scales,
                line,
                statistics.one_way(defined),
                statistics.repeated_measures(defined) if repeated else None,
                statistics.mixed_model(eccentricities[inside], defined, settings.confidence) if repeated else None,
                int((measured & ~scales.defined[:, inside]).sum()),
                int(scales.limited[:, inside].sum()),
                int((~measured).sum()),
            )
        )
    return findings


def _uses_repeated_measures(settings: AnalysisSettings) -> bool:
    """Whether a repeated-measures analysis and a mixed model are computed."""
    return statistics.has_statsmodels() if settings.repeated_measures is None else settings.repeated_measures


def on_frames(responses: Responses) -> float:
    """Share of the reaction times within 0.1 frames of a whole number of frames; 0.2 is expected by chance."""
    answered = np.isfinite(responses.reaction_s)
    frames = responses.reaction_s[answered] / responses.frame_s[answered]
    return float((np.abs(frames - np.round(frames)) <= 0.1).mean()) if len(frames) else math.nan


def prepare_analysis(settings: AnalysisSettings) -> None:
    """Raise ConfigError for settings with which the analysis would fail later."""
    if settings.repeated_measures:
        statistics.need_statsmodels()
    if settings.power:
        for alpha in settings.power.slopes:
            try:
                with_slope(settings.simulation, alpha, sum(settings.range_deg) / 2)
            except ValidationError as error:
                raise ConfigError([f"power.slopes: {alpha:g}: {error.errors()[0]['msg']}"]) from None


def run_analysis(settings: AnalysisSettings, opened: RunFolder) -> bool:
    """Run the analysis and write all files of the run folder. Returns whether the run is complete."""
    started = time.perf_counter()
    folder, files = opened.path, Results()
    generator = np.random.default_rng([settings.seed, 0])
    responses = read_responses(settings.logs) if settings.logs else simulate(settings.simulation, generator)
    times = perception_times(responses, settings.cleaning)
    curves = fit_curves(times, settings.range_deg[0], settings.cleaning.sizes)
    shown = int(times.participants[0]) if settings.shown is None else settings.shown
    if shown not in times.participants:
        raise ConfigError([f"shown: no participant {shown}; there are {', '.join(map(str, times.participants))}"])
    findings = analyse(settings, times, curves)
    frames = quantisation(responses.frame_s.tolist())
    assert frames is not None  # there is at least one trial
    truths = [None if settings.logs else true_line(settings.simulation, target) for target in settings.targets]
    rows = [finding.row(truth) for finding, truth in zip(findings, truths, strict=True)]
    whole_frames = on_frames(responses)
    cells = cell_tests(times, settings.range_deg[0])
    factors, factor_words = _factors(times, settings.confidence)
    words = in_words(settings, times, curves, findings, frames, whole_frames)
    text = "\n".join([words, *cells.in_words(), *factor_words])
    if settings.repeated_measures is None and not _uses_repeated_measures(settings):
        text += "\nLeft out   repeated measures and the mixed model, which need statsmodels: pip install "
        text += "'holotorch[stats]' and run it again; the one-way ANOVA takes the answers of one participant as "
        text += "independent"
    print(text, flush=True)
    (folder / "arrays").mkdir(exist_ok=True)
    files.write(write_json, folder / "plan.json", {"rule": settings.cleaning.model_dump(), "counts": times.counts})
    files.write(save_array, folder / "arrays" / "times.npy", torch.from_numpy(times.seconds))
    scales = np.stack([finding.scales.degrees for finding in findings])
    files.write(save_array, folder / "arrays" / "scales.npy", torch.from_numpy(scales))
    files.write(write_table, folder / "metrics.csv", rows)
    files.write(write_table, folder / "conditions.csv", list(_conditions(times)))
    files.write(write_table, folder / "curves.csv", _curves(times, curves))
    if factors:
        files.write(write_table, folder / "factors.csv", factors)
    lines = [(finding.name, finding.line) for finding in findings]
    images = {
        "time_surface": figures.time_surface(times),
        "time_map": figures.time_map(times, lines, settings.range_deg, settings.tested_deg),
        "participant": figures.single_participant(times, curves, int(np.flatnonzero(times.participants == shown)[0])),
        "time_slices": figures.time_slices(times),
        "scale_lines": figures.scale_lines(times, lines, settings.range_deg, settings.tested_deg, settings.confidence),
    }
    power: list[dict[str, Any]] = []
    if settings.power:
        total = len(settings.power.slopes) * len(settings.power.participants)
        power = list(tqdm(power_rows(settings, settings.power), total=total, desc="power", dynamic_ncols=True))
        files.write(write_table, folder / "power.csv", power)
        images["power"] = figures.power_curves(power, settings.confidence)
        power_text = needed(power)
        text += "\n" + "\n".join(f"Power      {line}" for line in power_text)
        print("\n".join(power_text), flush=True)
    for key, data in images.items():
        files.write(write_bytes, folder / "images" / f"{key}.png", data)
    summary = {
        "experiment": "perception_analysis",
        "status": "",
        "simulated": times.simulated,
        "repeated_measures": _uses_repeated_measures(settings),
        "participants": len(times.participants),
        "counts": times.counts,
        "quantisation": asdict(frames) | {"on_frames": in_json(whole_frames)},
        "rows": rows,
        "cells": cells.to_json(),
        "factors": factors,
        "power": power,
        "lines": text.splitlines(),
        "seconds": round(time.perf_counter() - started, 2),
    }
    return conclude(opened, summary, files, done=True)


def _factors(times: Times, confidence: float) -> tuple[list[dict[str, Any]], list[str]]:
    """Rows and words of the effects of contrast and motion; none if all patterns have the same."""
    levels, model = level_effects(times, confidence), model_effects(times, MIDDLE_DEG, confidence)
    contrast, speed = times.variants[0]
    lines = [f"Factors    {effect.in_words()}, beside contrast {contrast:g} at {speed:g} deg/s" for effect in levels]
    lines += [f"Factors    model at {MIDDLE_DEG:g} deg: {effect.in_words()}" for effect in model]
    return [effect.row() for effect in (*levels, *model)], lines


def _conditions(times: Times) -> Iterator[dict[str, Any]]:
    for e, s in zip(*np.nonzero(np.isfinite(times.seconds).any(0)), strict=True):
        low, middle, high = np.nanquantile(times.seconds[:, e, s], (0.25, 0.5, 0.75))
        yield {
            "eccentricity_deg": times.eccentricities[e],
            "size_deg": times.sizes[s],
            "participants": int(np.isfinite(times.seconds[:, e, s]).sum()),
            "answers": int(times.kept[:, e, s].sum()),
            "quartile_25_s": low,
            "median_s": middle,
            "quartile_75_s": high,
        }


def _curves(times: Times, curves: Curves) -> list[dict[str, Any]]:
    return [
        {
            "participant": int(times.participants[p]),
            "eccentricity_deg": float(curves.eccentricities[k]),
            "a_s": in_json(curves.a[p, k]),
            "a_deviation_s": in_json(curves.a_deviation[p, k]),
            "b_s": in_json(curves.b[p, k]),
        }
        for p in range(len(times.participants))
        for k in range(len(curves.eccentricities))
    ]
