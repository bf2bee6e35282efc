"""Baselines: a hologram without correction, and earlier methods of correction."""

from dataclasses import replace

import torch

from holotorch.core.complex import wrapped
from holotorch.correction import Solution, deconvolve, gerchberg_saxton, inverse, iterative_pec
from holotorch.experiments.pec.experiment import PECExperiment

PASSES = 100  # of Gerchberg-Saxton, basic IPEC and IPEC alike; the thesis states no number


def baseline(experiment: PECExperiment, name: str) -> Solution:
    """Solution whose ``x`` are heater phases [C, H, W] of the lit colours, one frame, by a method of the thesis.

    "none": phases of Gerchberg-Saxton, without any correction. "chopping" and "shifting": these phases deconvolved by
    the matrix inverse, with negative entries set to 0, or with the smallest entry subtracted. "nonnegative": these
    phases deconvolved by non-negative least squares. "basic_ipec": Gerchberg-Saxton with the crosstalk in its loop.
    "ipec": iterative proximity effect correction, which also deconvolves in the loop (Algorithm 1).

    With several depths, phase retrieval constrains the images at all of them (thesis Sec. 4.4.5.4); "nonnegative" is
    then its naive baseline, the deconvolved hologram of the scene.

    Every method starts with the phase of the image that is formed by the solver's start phases; the share of the light
    in the window is then the same. ValueError for a crosstalk that has no inverse.
    """
    propagator, crosstalk = experiment.propagator, experiment.array.crosstalk
    first = experiment.heater_phases(experiment.start_phase())[0]
    with torch.no_grad():
        start = torch.angle(propagator(experiment.array(first)))
    target = experiment.target.to(start)
    mask = None if experiment.mask is None else experiment.mask.to(start)
    if name == "ipec":
        return iterative_pec(propagator, crosstalk, target, start, max_steps=PASSES, mask=mask)
    spread = crosstalk if name == "basic_ipec" else None
    solution = gerchberg_saxton(propagator, target, start, max_steps=PASSES, crosstalk=spread, mask=mask)
    phase = wrapped(solution.x)
    if name in ("chopping", "shifting"):
        phase = inverse(crosstalk, phase)
        least = phase.amin((-2, -1), keepdim=True).clamp(max=0)
        phase = phase.clamp(min=0) if name == "chopping" else phase - least
    elif name == "nonnegative":
        phase = deconvolve(crosstalk, phase, max_steps=300)
    return replace(solution, x=phase)
