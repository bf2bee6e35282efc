"""Plan: the method, cost and error of an operation, determined before it runs."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Plan:
    """The cheapest method of a propagation that is within its tolerance, and the runner-up.

    Attributes:
        method: Name of the method.
        pad: Padding factor (y, x).
        padded: Number of samples (y, x) of the transforms.
        precision: Dtype of the fields, "complex64" or "complex128".
        window: Number of samples, pitch in metres and centre in metres of the result, each (y, x).
        predicted_error: Expected relative L2 error of the result.
        memory_bytes: Peak of the extra memory of one call, including the kernel, for one channel.
        flops: Arithmetic operations of one call without those for the kernel, for one channel.
        reason: One sentence that says why this method was chosen.
        runner_up: One sentence that says which method came next and why it was not chosen.
        adequate: Whether ``predicted_error`` is within the tolerance; False only if no method is adequate.
        sampled: Per axis (y, x), whether the transfer function is sampled in frequency.
        paraxial: Whether the method neglects the factor beyond Fresnel.
    """

    method: str
    pad: tuple[float, float]
    padded: tuple[int, int]
    precision: str
    window: tuple[tuple[int, int], tuple[float, float], tuple[float, float]]
    predicted_error: float
    memory_bytes: int
    flops: float
    reason: str
    runner_up: str
    adequate: bool = True
    sampled: tuple[bool, bool] = (True, True)
    paraxial: bool = False
