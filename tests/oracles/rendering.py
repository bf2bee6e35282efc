"""Direct volume rendering with loops, float64, without holotorch: Algorithm 3 of the thesis, ray by ray."""

import numpy as np


def trilinear(values, index):
    """``values`` [D, H, W] at fractional ``index`` (z, y, x), held constant beyond the outermost samples."""
    total = 0.0
    for corner in range(8):
        weight, place = 1.0, []
        for axis in range(3):
            at = min(max(index[axis], 0.0), values.shape[axis] - 1.0)
            low = min(int(np.floor(at)), max(0, values.shape[axis] - 2))
            upper = (corner >> axis) & 1
            weight *= at - low if upper else 1 - (at - low)
            place.append(min(low + upper, values.shape[axis] - 1))
        total += weight * values[tuple(place)]
    return total


def classify(value, positions, colours, opacities):
    """Colour [3] and opacity of a value."""
    return np.array([np.interp(value, positions, c) for c in np.asarray(colours).T]), np.interp(
        value, positions, opacities
    )


def box_depths(start, direction, half):
    """Where start + t direction is within the box +-half, as (t in, t out); None if nowhere."""
    near, far = -np.inf, np.inf
    for s, d, h in zip(start, direction, half, strict=True):
        if abs(d) < 1e-15:
            if abs(s) > h * (1 + 1e-9):
                return None
            continue
        ends = sorted(((-h - s) / d, (h - s) / d))
        near, far = max(near, ends[0]), min(far, ends[1])
    return (near, far) if near < far else None


def march(values, spacing, table, unit, points, depths, edges, distance, rotation=None, eye=None):
    """Contributions [D, n, 3] and transmittance [n] of rays through ``points`` [n, 2] (y, x) at depths[0].

    The volume, of ``spacing`` (z, y, x) in metres, has its centre on the axis at ``distance``. ``edges`` [D + 1] of the
    slabs, ``unit`` distance of the opacities in metres. Samples half-way through the part of a slab that the volume
    reaches into, paths cut by the faces of the volume.
    """
    rotation = np.eye(3) if rotation is None else rotation
    half = np.array(values.shape) * np.array(spacing) / 2
    reach = np.abs(rotation[0]) @ half
    found = np.zeros((len(depths), len(points), 3))
    left = np.ones(len(points))
    for r, point in enumerate(points):
        # Offset from the centre per depth from the centre: start + t direction.
        rate = np.zeros(2) if eye is None else np.array(point) / (depths[0] - eye)
        start = np.array([0.0, *(np.array(point) + (distance - depths[0]) * rate)])
        start, direction = rotation.T @ start, rotation.T @ np.array([1.0, *rate])
        crossed = box_depths(start, direction, half)
        opacity = 0.0
        for j in range(len(depths)):
            low, high = sorted(edges[j : j + 2])
            low, high = max(low - distance, -reach), min(high - distance, reach)
            if crossed is None or low >= high:
                continue
            path = max(0.0, min(high, crossed[1]) - max(low, crossed[0])) * np.sqrt(1 + rate @ rate)
            place = (start + (low + high) / 2 * direction) / spacing + (np.array(values.shape) - 1) / 2
            colour, alpha = classify(trilinear(values, place), *table)
            alpha = 1 - (1 - alpha) ** (path / unit)
            found[j, r] = (1 - opacity) * alpha * colour
            opacity = min(opacity + (1 - opacity) * alpha, 1)
        left[r] = 1 - opacity
    return found, left
