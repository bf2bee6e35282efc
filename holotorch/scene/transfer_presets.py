"""Transfer functions for common materials, and import of transfer functions that ParaView or 3D Slicer save as JSON."""

import json
import sys
from typing import Any

import numpy as np

from holotorch.core import checks
from holotorch.scene.transfer import TransferFunction

UNIT_DISTANCE = 0.01  # default unit distance of the opacities, as a fraction of the longest side of the volume
_STEP = 1e-6  # width of the ramp that replaces a jump of colour or opacity, as a fraction of the range of positions

# Rows of the tables: position from 0 (the value ``low``) to 1 (the value ``high``), red, green, blue, opacity.
_BONE = [
    (0.00, 0.50, 0.10, 0.08, 0.00),
    (0.32, 0.60, 0.22, 0.16, 0.00),
    (0.40, 0.84, 0.62, 0.45, 0.04),
    (0.55, 0.95, 0.88, 0.75, 0.45),
    (1.00, 1.00, 1.00, 0.96, 0.85),
]
_SOFT_TISSUE = [
    (0.00, 0.40, 0.10, 0.08, 0.00),
    (0.12, 0.55, 0.22, 0.15, 0.00),
    (0.22, 0.88, 0.58, 0.45, 0.03),
    (0.34, 0.80, 0.35, 0.28, 0.08),
    (0.60, 0.98, 0.90, 0.80, 0.30),
    (1.00, 1.00, 1.00, 0.95, 0.60),
]
_SKIN = [
    (0.00, 0.80, 0.55, 0.45, 0.00),
    (0.06, 0.90, 0.68, 0.56, 0.90),
    (1.00, 1.00, 0.90, 0.80, 0.95),
]
_VESSELS = [
    (0.00, 0.30, 0.00, 0.00, 0.00),
    (0.25, 0.45, 0.02, 0.02, 0.00),
    (0.40, 0.80, 0.10, 0.08, 0.30),
    (0.70, 1.00, 0.35, 0.20, 0.70),
    (1.00, 1.00, 0.80, 0.60, 0.90),
]
_INDUSTRIAL = [
    (0.00, 0.20, 0.22, 0.25, 0.00),
    (0.12, 0.30, 0.33, 0.38, 0.00),
    (0.30, 0.52, 0.56, 0.62, 0.20),
    (0.65, 0.75, 0.77, 0.80, 0.60),
    (1.00, 0.95, 0.95, 0.97, 0.90),
]


def bone(low: float, high: float, *, unit_distance: float = UNIT_DISTANCE) -> TransferFunction:
    """Ivory bone in computed tomography; soft tissue is transparent. ``low`` is air, ``high`` the densest bone."""
    return _scaled(_BONE, low, high, unit_distance)


def soft_tissue(low: float, high: float, *, unit_distance: float = UNIT_DISTANCE) -> TransferFunction:
    """Translucent skin and muscle over bone; ``low`` is air, ``high`` the densest bone."""
    return _scaled(_SOFT_TISSUE, low, high, unit_distance)


def skin(low: float, high: float, *, unit_distance: float = UNIT_DISTANCE) -> TransferFunction:
    """Opaque skin, whose shape needs :class:`Lighting`; ``low`` is air, ``high`` the densest bone."""
    return _scaled(_SKIN, low, high, unit_distance)


def vessels(low: float, high: float, *, unit_distance: float = UNIT_DISTANCE) -> TransferFunction:
    """Vessels filled with contrast agent, red; ``low`` is the surrounding tissue, ``high`` the brightest vessel."""
    return _scaled(_VESSELS, low, high, unit_distance)


def industrial(low: float, high: float, *, unit_distance: float = UNIT_DISTANCE) -> TransferFunction:
    """Grey metal and plastics in industrial tomography; ``low`` is air, ``high`` the densest part."""
    return _scaled(_INDUSTRIAL, low, high, unit_distance)


def transfer_from_json(text: str, *, unit_distance: float = UNIT_DISTANCE) -> TransferFunction:
    """Transfer function from the JSON text of ParaView or 3D Slicer.

    From a ParaView file, ``RGBPoints`` [x, r, g, b, ...] and ``Points`` [x, opacity, midpoint, sharpness, ...] of the
    first colour map are read. From a 3D Slicer file (volume property, schema 1), ``rgbTransferFunction`` and
    ``scalarOpacity`` of its only component are read. The positions are those of the colours and of the opacities. A
    jump becomes a linear ramp over a millionth of the range of positions. Lighting is ignored.

    Args:
        text: Content of the file.
        unit_distance: Unit distance of the opacities, as a fraction of the longest side of the volume. It is not read
            from the file: ParaView does not save it, and Slicer saves it in millimetres, without the volume's size.

    Raises:
        ValueError: Another format, or a feature that a piecewise-linear function of one scalar cannot represent; the
            message names the field.
    """
    try:
        content = json.loads(text)
    except (ValueError, RecursionError) as error:  # deeply nested brackets raise RecursionError
        raise ValueError(f"a transfer function must be JSON text, got {text[:40]!r}: {error}") from None
    first = content[0] if isinstance(content, list) and content else content
    if isinstance(first, dict) and "RGBPoints" in first:
        colours, opacities = _paraview(first)
    elif isinstance(first, dict) and "volumeProperties" in first:
        colours, opacities = _slicer(first)
    else:
        raise ValueError(
            "a transfer function must be a ParaView colour map with 'RGBPoints' or a 3D Slicer file with "
            f"'volumeProperties', got {_kind(first)}"
        )
    positions = np.union1d(colours[0], opacities[0])
    colour = np.stack([np.interp(positions, colours[0], channel) for channel in colours[1].T], -1)
    opacity = np.interp(positions, opacities[0], opacities[1][:, 0])
    return TransferFunction(positions.tolist(), colour.tolist(), opacity.tolist(), unit_distance=unit_distance)


Curve = tuple[np.ndarray, np.ndarray]  # rising positions [K] and their values [K, n]
Point = tuple[str, float, list[float], float, float]  # name in error messages, position, n values, midpoint, sharpness


def _paraview(content: dict[str, Any]) -> tuple[Curve, Curve]:
    space = content.get("ColorSpace", "RGB")
    if space != "RGB":
        raise ValueError(f"ColorSpace must be RGB, in which colours are mixed linearly, got {space!r}; convert the map")
    if content.get("UseLogScale"):
        raise ValueError("UseLogScale must be off: positions are interpolated linearly")
    colours = [(name, x, [r, g, b], 0.5, 0.0) for name, (x, r, g, b) in _fours("RGBPoints", content)]
    opacities = [(name, x, [y], middle, sharp) for name, (x, y, middle, sharp) in _fours("Points", content)]
    return _curve("RGBPoints", colours), _curve("Points", opacities)


def _slicer(content: dict[str, Any]) -> tuple[Curve, Curve]:
    where = "volumeProperties[0].components"
    components = _objects(where, _objects("volumeProperties", content["volumeProperties"])[0].get("components"))
    if len(components) > 1:
        raise ValueError(f"{where} must be one, for a volume of one scalar, got {len(components)}")
    component, where = components[0], where + "[0]"
    steep = _points(f"{where}.gradientOpacity", component, "y") if component.get("gradientOpacity") else []
    if not component.get("disableGradientOpacity") and any(value != [1.0] for _, _, value, _, _ in steep):
        raise ValueError(f"{where}.gradientOpacity must be 1 throughout: opacity here depends on the value alone")
    colours, opacities = f"{where}.rgbTransferFunction", f"{where}.scalarOpacity"
    return _curve(colours, _points(colours, component, "color")), _curve(opacities, _points(opacities, component, "y"))


def _points(where: str, component: dict[str, Any], key: str) -> list[Point]:
    """Points of the Slicer function at ``where``; ``key`` is the name of their values, "color" or "y"."""
    function = component.get(where.rsplit(".", 1)[1])
    if not isinstance(function, dict):
        raise ValueError(f"{where} must be an object with 'points', got {_kind(function)}")
    points: list[Point] = []
    for k, point in enumerate(_objects(f"{where}.points", function.get("points"))):
        name = f"{where}.points[{k}]"
        value = point.get(key) if key == "color" else [point.get(key)]
        if not isinstance(value, list) or len(value) != (3 if key == "color" else 1):
            raise ValueError(f"{name}.{key} must be red, green and blue, got {_kind(value)}")
        x, middle, sharp = (
            _number(f"{name}.{part}", point.get(part, usual))
            for part, usual in (("x", None), ("midpoint", 0.5), ("sharpness", 0.0))
        )
        points.append((name, x, [_number(f"{name}.{key}", part) for part in value], middle, sharp))
    return points


def _curve(where: str, points: list[Point]) -> Curve:
    """Rising positions and their values, with an additional point between two points whose midpoint is not 0.5."""
    positions, values = list[float](), list[list[float]]()
    for k, (name, x, value, middle, sharp) in enumerate(points):
        # The transfer function stores positions as float32, and they must still differ.
        x = float(np.float32(x))
        if k and x < float(np.float32(points[k - 1][1])):
            raise ValueError(f"{name} must not lie below the one before, got {points[k - 1][1]:g} before {x:g}")
        if min(value) < 0 or max(value) > 1:
            raise ValueError(f"{name} must hold colours and opacities in [0, 1], got {value}")
        positions.append(x)
        values.append(value)
        if k + 1 == len(points):
            break
        if sharp != 0:
            raise ValueError(f"{name} must have sharpness 0, which is piecewise linear, got {sharp:g}")
        if not 0 < middle < 1:
            raise ValueError(f"{name} must have its midpoint between 0 and 1, got {middle:g}")
        if middle != 0.5:
            _, following, other, _, _ = points[k + 1]
            positions.append(float(np.float32(x + middle * (following - x))))
            values.append([(one + two) / 2 for one, two in zip(value, other, strict=True)])
    span = positions[-1] - positions[0]
    if span == 0:
        raise ValueError(f"{where} must hold at least two different positions, got {positions[0]:g} only")
    for k in range(1, len(positions)):
        least = np.float32(positions[k - 1] + _STEP * span)
        if positions[k] < least:
            positions[k] = float(max(least, np.nextafter(np.float32(positions[k - 1]), np.float32(np.inf))))
    return np.array(positions), np.array(values)


def _fours(name: str, content: dict[str, Any]) -> list[tuple[str, list[float]]]:
    """Groups of four numbers from the ParaView list ``name``, each with its name in error messages."""
    numbers = _list(name, content.get(name))
    if len(numbers) % 4:
        raise ValueError(f"{name} must hold four numbers per point, got {len(numbers)} in all")
    values = [_number(f"{name}[{k}]", number) for k, number in enumerate(numbers)]
    return [(f"{name}[{k}:{k + 4}]", values[k : k + 4]) for k in range(0, len(values), 4)]


def _list(name: str, value: Any) -> list[Any]:
    if not isinstance(value, list) or not value:
        raise ValueError(f"{name} must be a list that is not empty, got {_kind(value)}")
    return value


def _objects(name: str, value: Any) -> list[dict[str, Any]]:
    for k, item in enumerate(_list(name, value)):
        if not isinstance(item, dict):
            raise ValueError(f"{name}[{k}] must be an object, got {_kind(item)}")
    return value


def _number(name: str, value: Any) -> float:
    # ``abs(value) <= max`` is False for infinity, for integers too large for a float, and for NaN.
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= sys.float_info.max:
        raise ValueError(f"{name} must be a number, got {value!r}")
    return float(value)


def _kind(value: Any) -> str:
    return "nothing" if value is None else f"{type(value).__name__} {str(value)[:40]!r}"


def _scaled(
    rows: list[tuple[float, float, float, float, float]], low: float, high: float, unit_distance: float
) -> TransferFunction:
    low, high = checks.finite("low", low), checks.finite("high", high)
    if not low < high:
        raise ValueError(f"low must be below high, got {low:g} and {high:g}")
    table = np.array(rows)
    positions = (low + (high - low) * table[:, 0]).tolist()
    return TransferFunction(positions, table[:, 1:4].tolist(), table[:, 4].tolist(), unit_distance=unit_distance)
