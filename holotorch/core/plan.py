"""Plan: what a planned operation will do and cost, decided before it runs."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Plan:
    """The cheapest adequate method of an operation, and the runner-up.

    Attributes:
        method: Name of the method.
        pad: Padding factor (y, x) actually used.
        padded: Samples (y, x) of the transforms.
        precision: Of the fields that the plan is for, "complex64" or "complex128".
        window: Samples (y, x), pitch and centre of the result, in metres.
        predicted_error: Expected relative L2 error of the result for the described content.
        memory_bytes: Largest extra memory of one call with its kernel, for one channel.
        flops: Arithmetic of one call with the kernel at hand, for one channel.
        reason: One sentence that says why this method was chosen.
        runner_up: One sentence that says which method came next and why it was not chosen.
        adequate: Whether ``predicted_error`` is within the tolerance; False only if that of no method is.
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
