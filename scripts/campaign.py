"""Random cases in the thousands, judged by plain sums: is every error that was not announced as small as was asked?

Usage: python scripts/campaign.py propagate [--cases N] [--seed S] [--measure]
       python scripts/campaign.py holograms [--cases N] [--seed S]
"""

import argparse
import sys
import time
import warnings
from collections import Counter
from pathlib import Path

import numpy as np
import torch

from holotorch import Grid
from holotorch.hologram import plan_hologram
from holotorch.optics import propagate

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from oracles import holograms  # noqa: E402
from oracles.propagation import PropagationCase, random_case  # noqa: E402

SILENT = 10  # times the tolerance: a greater error without a word is a failure


def propagated(case: PropagationCase, *, measure: bool) -> tuple[str, float]:
    """What became of a case, and its true error relative to the light that arrives (NaN if it was refused)."""
    field = torch.from_numpy(case.field)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            got = propagate(
                field,
                Grid(case.field.shape[-2:], case.pitch),
                case.wavelength,
                case.distance,
                tolerance=case.tolerance,
                band=case.band,
                measure=measure,
                out_grid=Grid(case.out_shape, case.out_pitch),
                offset=case.offset,
                tilt=case.tilt,
            )
        except ValueError:
            return "refused", float("nan")
    wanted = case.exact()
    error = float(np.linalg.norm(got.numpy() - wanted) / max(np.linalg.norm(wanted), 1e-300))
    if caught:
        return "warned", error
    if error <= case.tolerance:
        return "honest", error
    return ("within 10x" if error <= SILENT * case.tolerance else "silent"), error


def propagate_campaign(cases: int, seed: int, *, measure: bool) -> bool:
    """Judge ``cases`` propagations, print the counts, and say whether no error was silent."""
    counts, begun = Counter(), time.monotonic()
    for number in range(seed, seed + cases):
        case = random_case(number)
        verdict, error = propagated(case, measure=measure)
        counts[verdict] += 1
        if verdict == "silent":
            print(
                f"seed {number}: {case.kind}, {case.field.shape} at {case.pitch}, {case.distance:.3g} m, error "
                f"{error:.2g} for {case.tolerance:g}; onto {case.out_shape} at {case.out_pitch}, offset {case.offset}, "
                f"tilt {case.tilt}",
                flush=True,
            )
    words = ("refused", "warned", "honest", "within 10x", "silent")
    print(
        f"propagate, measure={measure}, seeds {seed} to {seed + cases - 1}: {cases} cases, "
        + ", ".join(f"{counts[word]} {word}" for word in words)
        + f" ({time.monotonic() - begun:.0f} s)"
    )
    return counts["silent"] == 0


def planned_hologram(case: holograms.HologramCase) -> tuple[str, float, str]:
    """What became of a case, its true error against the definition that was asked for, and the method."""
    grid, layers = Grid(case.shape, case.pitch), torch.from_numpy(case.layers)
    layers = layers.to(torch.complex64 if case.tolerance > 1e-5 else torch.complex128)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            plan = plan_hologram(
                grid, case.wavelength, case.depths, case.layers.shape[-2:],
                stride=case.stride, tolerance=case.tolerance, dtype=layers.dtype,
                cone=case.cone,  # type: ignore[arg-type]
            )  # fmt: skip
        except ValueError:
            return "refused", float("nan"), ""
        got = plan.operator(layers).numpy()
    # Where the plan says that definitions do not differ, the plain sum is one of them.
    wanted = case.exact("full" if not plan.near and plan.cone != "band" else plan.cone)
    # Rounding is relative to the light that is sent, of which sharp cones may let nothing reach a pixel.
    rounding = 1e-6 * np.linalg.norm(case.layers) / min(case.depths)
    error = max(0.0, float(np.linalg.norm(got - wanted)) - rounding) / max(float(np.linalg.norm(wanted)), 1e-300)
    where = f"{plan.method}, cone={plan.cone}, near={plan.near}, predicted {plan.predicted_error:.1g}"
    if case.cone not in (None, plan.cone):
        return "silent", error, f"asked for {case.cone}: {where}"
    if caught:
        return "warned", error, where
    if error <= case.tolerance:
        return "honest", error, where
    return ("within 10x" if error <= SILENT * case.tolerance else "silent"), error, where


def hologram_campaign(cases: int, seed: int) -> bool:
    """Judge ``cases`` planned holograms, print the counts, and say whether no error was silent."""
    counts, begun = Counter(), time.monotonic()
    for number in range(seed, seed + cases):
        case = holograms.random_case(number)
        verdict, error, where = planned_hologram(case)
        counts[verdict] += 1
        if verdict == "silent":
            print(
                f"seed {number}: {case.shape} at {case.pitch}, {case.wavelength:.3g} m, {len(case.depths)} planes from "
                f"{min(case.depths):.3g} m, error {error:.2g} for {case.tolerance:g}; {where}",
                flush=True,
            )
    words = ("refused", "warned", "honest", "within 10x", "silent")
    print(
        f"holograms, seeds {seed} to {seed + cases - 1}: {cases} cases, "
        + ", ".join(f"{counts[word]} {word}" for word in words)
        + f" ({time.monotonic() - begun:.0f} s)"
    )
    return counts["silent"] == 0


def main() -> int:
    """Run the campaign that the command line names; 1 if there was a silent error."""
    parser = argparse.ArgumentParser(description="Random cases judged by plain sums.")
    parser.add_argument("subject", choices=["propagate", "holograms"])
    parser.add_argument("--cases", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=0, help="of the first case; the others follow")
    parser.add_argument("--measure", action="store_true", help="plan propagation for each very field")
    options = parser.parse_args()
    torch.set_num_threads(1)
    if options.subject == "holograms":
        return 0 if hologram_campaign(options.cases, options.seed) else 1
    return 0 if propagate_campaign(options.cases, options.seed, measure=options.measure) else 1


if __name__ == "__main__":
    sys.exit(main())
