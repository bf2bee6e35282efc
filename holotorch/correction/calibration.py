"""Calibration with a camera: parameters of a model of a display, fitted to images of a few known patterns."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.func import functional_call, jvp

from holotorch.core import checks

Values = dict[str, Tensor]
_DAMPING, _DOWN, _UP = 1e-3, 0.2, 4.0  # initial damping of Levenberg-Marquardt, and its changes by a factor
_MOST_DAMPED = 1e9  # damping at which the search ends: no step in any direction improves the fit


@dataclass(frozen=True)
class Calibration:
    """Result of :func:`calibrate`; the model holds the fitted parameters.

    Attributes:
        losses: Mean squared difference to the images at the start and after each step.
        gain: Ratio of the images to the intensity that the model predicts.
        deviations: Standard deviation of each parameter, shaped like it, as the residuals indicate; it states the noise
            of the images only, and not errors of the model.
        converged: Whether the last step changed the loss by less than the tolerance.
    """

    losses: tuple[float, ...]
    gain: float
    deviations: dict[str, Tensor]
    converged: bool


def calibrate(
    model: nn.Module,
    patterns: Tensor,
    images: Tensor,
    *,
    units: Mapping[str, float] | None = None,
    max_steps: int = 30,
    tolerance: float = 1e-6,
    callback: Callable[[float], None] | None = None,
) -> Calibration:
    """Fit all parameters of ``model`` that require a gradient to images of known patterns, by Levenberg-Marquardt.

    The squared difference of ``gain`` times ``model(patterns)`` to ``images`` is minimised over the parameters and the
    gain, which an unknown exposure makes necessary. There is one forward-mode derivative for each number that is
    learned, so the method suits up to about a hundred of them; train larger models with an optimiser of torch.

    Args:
        model: From patterns to intensities, for instance heater phases to the image of a phased array.
        patterns: Such as a handful of random phases, [N, C, H, W].
        images: Images by the camera, one for each pattern, real, shaped as the result of the model.
        units: For some parameters by name, a change that matters, such as 1e-5 m of a distance; 1 % of its largest
            value by default.
        max_steps: Largest number of steps.
        tolerance: The fit ends when a step lowers the loss by less than this fraction.
        callback: Called with the loss after each step.

    Raises:
        ValueError: No parameter to fit, an unknown name in ``units``, images of another shape than the model's result
            or not finite, or a model that predicts no light.
    """
    learned = {name: p for name, p in model.named_parameters() if p.requires_grad}
    if not learned:
        raise ValueError("model must have a parameter that requires a gradient; build its modules with learnable=True")
    unknown = set(units or {}) - set(learned)
    if unknown:
        raise ValueError(f"units must name parameters of the model, {', '.join(learned)}; got {', '.join(unknown)}")
    checks.real("images", images)
    checks.all_finite("images", images)
    sizes = {
        name: (units or {}).get(name) or 0.01 * p.detach().abs().max().item() or 1.0 for name, p in learned.items()
    }
    values: Values = {name: p.detach().clone() for name, p in learned.items()}
    damping, converged = _DAMPING, False
    residual, jacobian, gain = _linearised(model, patterns, images, values, sizes)
    losses = [residual.square().mean().item()]
    for _ in range(max_steps):
        normal, slope = jacobian @ jacobian.T, jacobian @ residual
        while damping < _MOST_DAMPED:
            step = -torch.linalg.solve(normal + damping * normal.diagonal().diag(), slope)
            trial = _moved(values, sizes, step)
            change = _residual(model, patterns, images, trial)[0]
            if change.square().mean().item() <= losses[-1]:
                break
            damping *= _UP
        else:
            converged = True
            break
        values, damping = trial, damping * _DOWN
        residual, jacobian, gain = _linearised(model, patterns, images, values, sizes)
        losses.append(residual.square().mean().item())
        if callback:
            callback(losses[-1])
        if losses[-2] - losses[-1] <= tolerance * losses[-2]:
            converged = True
            break
    with torch.no_grad():
        for name, parameter in learned.items():
            parameter.copy_(values[name])
    variance = residual.square().sum() / max(1, residual.numel() - len(jacobian) - 1)
    spread = (torch.linalg.pinv(jacobian @ jacobian.T).diagonal() * variance).clamp(min=0).sqrt()
    deviations = {name: sizes[name] * part for name, part in _split(spread, values).items()}
    return Calibration(tuple(losses), gain, deviations, converged)


def scan(model: nn.Module, name: str, values: Tensor, patterns: Tensor, images: Tensor) -> Tensor:
    """Set a parameter to that of ``values`` [K] whose images fit best; returns the losses [K].

    Use it before :func:`calibrate` for a distance with an error above about wavelength / NA^2: speckles are then
    unrelated to those in the images, and gradients do not lead to the right distance.

    Raises ValueError for a name that is no parameter, and as :func:`calibrate`.
    """
    parameters = dict(model.named_parameters())
    if name not in parameters:
        raise ValueError(f"name must be a parameter of the model, one of {', '.join(parameters)}; got {name!r}")
    parameter, losses = parameters[name], []
    for value in values:
        fitted = _residual(model, patterns, images, {name: value.to(parameter).expand(parameter.shape)})[0]
        losses.append(fitted.square().mean())
    stacked = torch.stack(losses)
    with torch.no_grad():
        parameter.fill_(values[stacked.argmin()].item())
    return stacked


@torch.no_grad()
def _residual(model: nn.Module, patterns: Tensor, images: Tensor, values: Values) -> tuple[Tensor, Tensor, float]:
    """Residual [M] in float64 with the best gain, the predicted intensity [M], and the gain."""
    predicted = functional_call(model, values, (patterns,))
    if predicted.shape != images.shape:
        raise ValueError(f"images must have the shape of model(patterns), {tuple(predicted.shape)}, got "
                         f"{tuple(images.shape)}")  # fmt: skip
    predicted, measured = predicted.double().flatten(), images.double().flatten()
    power = predicted.square().sum().item()
    if not (math.isfinite(power) and power > 0):
        raise ValueError("the model must predict light that is finite and not 0 everywhere")
    gain = (predicted @ measured).item() / power
    return gain * predicted - measured, predicted, gain


def _linearised(
    model: nn.Module, patterns: Tensor, images: Tensor, values: Values, sizes: Mapping[str, float]
) -> tuple[Tensor, Tensor, float]:
    """Residual [M], its derivatives [P, M] by the parameters in units of ``sizes``, and the gain.

    The part of each derivative along the predicted intensity is removed, since the gain takes its place.
    """
    residual, predicted, gain = _residual(model, patterns, images, values)
    direction = predicted / predicted.norm()
    rows = []
    for name, value in values.items():
        for k in range(value.numel()):
            tangent = torch.zeros_like(value)
            tangent.view(-1)[k] = sizes[name]

            def predict(x: Tensor, name: str = name) -> Tensor:
                return functional_call(model, {**values, name: x}, (patterns,))

            with torch.no_grad():
                row = gain * jvp(predict, (value,), (tangent,))[1].double().flatten()  # type: ignore[arg-type]
            rows.append(row - (row @ direction) * direction)
    return residual, torch.stack(rows), gain


def _split(numbers: Tensor, like: Values) -> Values:
    """One number for each element of the parameters, shaped as these."""
    parts = numbers.split([value.numel() for value in like.values()])
    return {name: part.reshape(value.shape).to(value) for (name, value), part in zip(like.items(), parts, strict=True)}


def _moved(values: Values, sizes: Mapping[str, float], step: Tensor) -> Values:
    return {name: values[name] + sizes[name] * part for name, part in _split(step, values).items()}
