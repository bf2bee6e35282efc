"""What the solver is compared with: holograms without correction, and the methods before it."""

import torch

from holotorch.core.complex import wrapped
from holotorch.correction import Solution, deconvolve, gerchberg_saxton, inverse, iterative_pec
from holotorch.correction.run import Callback
from holotorch.experiments.pec.experiment import PECExperiment
from holotorch.optics import DepthStack

PASSES = 100  # of Gerchberg-Saxton and of basic IPEC, as in the thesis's comparison
IPEC_PASSES = 30  # each with 30 steps of deconvolution


def baseline(experiment: PECExperiment, name: str, callback: Callback | None = None) -> Solution:
    """Heater phases [C, H, W] of the lit colours, one frame, by a method of the thesis's comparisons.

    "none": Gerchberg-Saxton, shown on the coupled array. "chopping", "shifting", "nonnegative": the same phases
    deconvolved by the matrix inverse with negative entries set to 0 or lifted by their least one, or by non-negative
    least squares. "basic_ipec": the crosstalk in the loop. "ipec": with its deconvolution (Algorithm 1; IFPEC at a
    distance).

    All begin with the image that the solver's own start forms, so that they have the same light to work with.
    ValueError for a crosstalk that has no inverse.
    """
    propagator, crosstalk = experiment.propagator, experiment.array.crosstalk
    assert not isinstance(propagator, DepthStack)
    start = experiment.frames_of(experiment.start_phase())[0]
    with torch.no_grad():
        begin = torch.angle(propagator(experiment.array(start)))
    target = experiment.target.to(start)
    mask = None if experiment.mask is None else experiment.mask.to(start)
    if name == "ipec":
        return iterative_pec(propagator, crosstalk, target, begin, max_steps=IPEC_PASSES, mask=mask, callback=callback)
    spread = crosstalk if name == "basic_ipec" else None
    found = gerchberg_saxton(
        propagator, target, begin, max_steps=PASSES, crosstalk=spread, mask=mask, callback=callback
    )
    phase = wrapped(found.x)
    if name in ("chopping", "shifting"):
        phase = inverse(crosstalk, phase)
        least = phase.amin((-2, -1), keepdim=True).clamp(max=0)
        phase = phase.clamp(min=0) if name == "chopping" else phase - least
    elif name == "nonnegative":
        phase = deconvolve(crosstalk, phase, max_steps=300)
    return Solution(phase, found.losses, found.steps, found.converged, found.stalled, found.evaluations)
