"""Random cases in the thousands, judged by plain sums: is every error that was not announced as small as was asked?

Usage: python scripts/campaign.py propagate [--cases N] [--seed S] [--measure]
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
from holotorch.optics import propagate

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
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


def main() -> int:
    """Run the campaign that the command line names; 1 if there was a silent error."""
    parser = argparse.ArgumentParser(description="Random cases judged by plain sums.")
    parser.add_argument("subject", choices=["propagate"])
    parser.add_argument("--cases", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=0, help="of the first case; the others follow")
    parser.add_argument("--measure", action="store_true", help="plan for each very field")
    options = parser.parse_args()
    torch.set_num_threads(1)
    return 0 if propagate_campaign(options.cases, options.seed, measure=options.measure) else 1


if __name__ == "__main__":
    sys.exit(main())
