"""Estimate of a camera's tone curve from several exposures of a still scene."""

import torch
from torch import Tensor

from holotorch.core import checks

_CLIPPED = 3  # number of levels at each end of the range that count as clipped


def tone_curve(frames: Tensor, exposures: Tensor) -> Tensor:
    """Estimate the light of each 8-bit level from frames of a still scene at known exposure times.

    Gain and white balance must be fixed. Averaging several frames of each exposure beforehand reduces noise.

    Args:
        frames: uint8 [E, 3, H, W] or [E, H, W], E >= 3 exposures that together cover the range of levels. All three
            colours have the same curve.
        exposures: [E] exposure times in any unit; only their ratios count.

    Returns:
        float64 [256], increasing from 0 to 1, for ``Camera.tone``. Levels below 3 and above 252 are extrapolated.

    Raises:
        TypeError, ValueError: Wrong shapes or types, too few exposures or levels, exposure times that do not fit the
            frames, or a curve that does not increase.

    Source: Debevec and Malik (1997), Eq. 3. Departure from it: instead of a few hundred pixels with unknown radiances,
    the equations compare the levels of every pixel in successive exposures, in which its radiance cancels.
    """
    counts, steps = _pairs(*_checked(frames, exposures))
    level = torch.arange(256, dtype=torch.float64)
    inside = (level >= _CLIPPED) & (level <= 255 - _CLIPPED)
    occurring = (counts.sum((0, 1)) + counts.sum((0, 2)) > 0) & inside
    if occurring.sum() < 0.8 * inside.sum():
        raise ValueError(
            f"only {int(occurring.sum())} of {int(inside.sum())} levels occur in two exposures that are not clipped; "
            "add exposures between the others, or a scene with more shades"
        )
    # The hat-shaped weights of the paper, one for each level of a pair.
    hat = torch.minimum(level, 255 - level).clamp(min=0) * inside
    weights = counts * hat[:, None] * hat
    weights = weights / weights.sum()
    # Least squares for the curve g, the logarithm of the light: g(j) - g(i) = step for each pair of levels (i, j).
    first, second = weights.sum(2), weights.sum(1)
    normal = (torch.diag_embed(second + first) - weights - weights.mT).sum(0)
    right = (steps[:, None] * (second - first)).sum(0)
    # Regularisation by the curvature of g over the logarithm of the level; a power law has none.
    logarithm = level.clamp(min=0.5).log()
    curvature = torch.zeros(254, 256, dtype=torch.float64)
    rows = torch.arange(254)
    before, after = logarithm.diff()[:-1], logarithm.diff()[1:]
    curvature[rows, rows], curvature[rows, rows + 2] = 1 / before, 1 / after
    curvature[rows, rows + 1] = -(1 / before + 1 / after)
    curvature *= (2 * (before + after)).sqrt()[:, None]
    normal += 1 / 254 * curvature.mT @ curvature
    normal[255, 255] += 1.0  # g(255) = 0 fixes the scale of the light
    curve = torch.linalg.solve(normal, right)
    misfit = float((weights * (curve[None] - curve[:, None] - steps[:, None, None]).square()).sum())
    if not misfit**0.5 < 0.1:  # exposure times that are wrong by 10 %, or a moving scene, exceed this
        raise ValueError(
            f"the frames do not fit their exposures, by {100 * misfit**0.5:.0f} % of the light; was the scene still, "
            "the light steady, gain and white balance fixed, the exposure times true?"
        )
    light = (curve - curve[255]).exp()
    light[:_CLIPPED] = light[_CLIPPED] * level[:_CLIPPED] / _CLIPPED
    if not bool((light.diff() > 0).all()):
        at = int((light.diff() <= 0).nonzero()[0])
        raise ValueError(f"the curve does not rise at level {at}; average several frames of each exposure")
    return light


def _checked(frames: Tensor, exposures: Tensor) -> tuple[Tensor, Tensor]:
    if not isinstance(frames, Tensor) or frames.dtype != torch.uint8:
        raise TypeError(f"frames must be a uint8 tensor, got {getattr(frames, 'dtype', type(frames).__name__)}")
    if frames.ndim not in (3, 4) or (frames.ndim == 4 and frames.shape[1] != 3) or frames.numel() == 0:
        raise ValueError(f"frames must be of shape [E, 3, H, W] or [E, H, W], got {list(frames.shape)}")
    times = torch.as_tensor(exposures, dtype=torch.float64).cpu()
    if times.shape != frames.shape[:1]:
        raise ValueError(f"exposures must be of shape [{len(frames)}], one for each frame, got {list(times.shape)}")
    checks.all_finite("exposures", times)
    times, order = times.sort()
    if len(times) < 3 or bool((times <= 0).any()) or bool((times[1:] / times[:-1] < 1.05).any()):
        raise ValueError(f"exposures must be 3 or more, above zero, 5 % apart or more, got {times.tolist()}")
    return frames.cpu()[order].flatten(1).long(), times


def _pairs(levels: Tensor, times: Tensor) -> tuple[Tensor, Tensor]:
    """Pairs of levels in successive exposures, from levels [E, n] and exposure times [E].

    Returns the counts [E - 1, 256, 256] of the pixels with level i in one exposure and j in the next, without clipped
    levels, and the logarithms [E - 1] of the ratios of successive exposure times.
    """
    pairs = 256 * levels[:-1] + levels[1:]
    counts = torch.stack([torch.bincount(row, minlength=65536).view(256, 256) for row in pairs])
    inside = slice(_CLIPPED, 256 - _CLIPPED)
    kept = torch.zeros_like(counts)
    kept[:, inside, inside] = counts[:, inside, inside]
    if not bool(kept.sum((1, 2)).gt(0).all()):
        raise ValueError("two successive exposures share no pixel that is clipped in neither; take smaller steps")
    return kept.to(torch.float64), times.log().diff()
