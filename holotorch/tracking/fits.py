"""Where an edge lies between two colours, and where the middle of a strip, to hundredths of a pixel, with deviations.

Both fits are in linear light and project out what they need not know (levels of each row and channel): variable
projection (Golub and Pereyra 1973). Rows and channels weigh by their noise.
"""

import math
from dataclasses import dataclass, fields

import torch
from torch import Tensor, nn

_STEPS = 8
_NEAR = 0.03  # samples: the next step is a twentieth, and of places two more follow
_SETTLED = 0.03  # pixels: the step after is a third of it; gloss and shadow move a middle by 0.05
_SHARED = 1.2  # neighbours share pixels: how much larger deviations are than of samples that do not, measured
_STRANGE = 1.5  # what is left, over its white part: above it the model misses something, and averaging does not help
_OTHER = 4.0  # standard deviations of an edge's own blur
_SLICES = 8
_SHADINGS = (torch.ones_like, lambda q: q, lambda q: (1 - q * q).sqrt(), lambda q: q**3)
_MEANS = (1.0, 0.0, math.pi / 4, 0.0)  # of the shadings over the tube
_SHARES = (1e3, 1.5, 1.5, 1.0)  # of a band's light: what each shading may amount to; the even one is free
_SHARPEST, _BLUNTEST = 0.35, 6.0  # pixels, standard deviation of an edge


@dataclass(frozen=True, eq=False)
class EdgeFit:
    """Of edges [E].

    Attributes:
        place: In samples from the window's middle.
        blur: Standard deviation of the edge in samples.
        deviation: Standard deviation of ``place`` from the noise; infinite where there is no edge.
        noise: Standard deviation of what the fit leaves, over that of the weights: 1 where those are right.
        steps: [E, U, C], light after the edge less light before, of each row and channel.
        levels: [E, U, C], light before.
    """

    place: Tensor
    blur: Tensor
    deviation: Tensor
    noise: Tensor
    steps: Tensor
    levels: Tensor

    def or_better(self, other: "EdgeFit") -> "EdgeFit":
        """Of each edge the fit with the smaller deviation."""
        better = other.deviation < self.deviation
        pairs = ((getattr(self, field.name), getattr(other, field.name)) for field in fields(self))
        return EdgeFit(*(torch.where(better.view(-1, *[1] * (a.ndim - 1)), b, a) for a, b in pairs))


def fit_edges(light: Tensor, weight: Tensor, blur: float = 0.9) -> EdgeFit:
    """Error functions of a place for each edge and one blur, with levels of their own in each row and channel.

    Args:
        light: [E, T, U, C] samples; T odd, the edge near the middle.
        weight: Inverse variances, of the same shape; 0 leaves a sample out.
        blur: To begin with, in samples.
    """
    rows = light.shape[2:]
    light, weight = (given.to(torch.float64).flatten(2) for given in (light, weight))  # [E, T, U C]
    count = light.shape[1]
    t = torch.arange(count, dtype=torch.float64, device=light.device) - (count - 1) / 2
    place = torch.zeros(len(light), dtype=torch.float64, device=light.device)
    sigma = torch.full_like(place, blur)
    total = weight.sum(1).clamp(min=1e-300)
    mean = (weight * light).sum(1) / total
    centred = light - mean[:, None]
    given = weight, weight * centred, total
    far, sure = (count - 1) / 2, place
    for _ in range(_STEPS):
        (pp, pb, bb), (p, b), *_ = _edge_terms(t, place, sigma, *given)
        sure = (bb - pb * pb / pp.clamp(min=1e-300)).clamp(0, 1e12).nan_to_num(0)  # inverse variance of the blur
        # An edge without weight has 0 / 0: it stays where it is, of infinite deviation.
        whole = (1 + 1e-6) * pp * bb - pb * pb
        step = torch.stack([bb * p - pb * b, pp * b - pb * p]).div(whole).nan_to_num(0, 0, 0).clamp(-1.5, 1.5)
        place, sigma = (place + step[0]).clamp(-far, far), (sigma + step[1]).clamp(_SHARPEST, _BLUNTEST)
        if float(step.abs().max()) < _NEAR:
            break
    # One lens blurs all edges alike. Where one side is dark and so has little noise, place and blur are hard to tell
    # apart, edge by edge; together they are not.
    common = (sure * sigma).sum() / sure.sum().clamp(min=1e-300)
    alike = (sigma / common - 1).abs() < 0.5
    other = ~alike & ((sigma - common).abs() > _OTHER * sure.rsqrt())  # surely not blurred by that lens
    together = (sure * alike).sum().clamp(min=1e-300)
    sigma = torch.where(alike, (sure * alike * sigma).sum() / together, sigma)

    def moved(p: Tensor, pp: Tensor) -> Tensor:
        return (place + (p / pp.clamp(min=1e-300)).nan_to_num(0).clamp(-0.5, 0.5)).clamp(-far, far)

    (pp, *_), (p, _), *_ = _edge_terms(t, place, sigma, *given)
    place = moved(p, pp)
    (pp, pb, _), (p, _), amplitude, middle, rise = _edge_terms(t, place, sigma, *given)
    place = moved(p, pp)
    left = centred - amplitude[:, None] * (rise[..., None] - middle[:, None])
    free = (weight > 0).sum((1, 2)) - 2 * (weight > 0).any(1).sum(1) - 2
    noise = ((weight * left.square()).sum((1, 2)) / free.clamp(min=1)).sqrt()
    variance = 1 / pp + (pb / pp).square() / torch.where(alike, together, sure).clamp(min=1e-12)
    # What varies from sample to sample is noise; what does not is something else that the edge is mixed with.
    rough = (weight[:, 1:-1] * left.diff(n=2, dim=1).square()).sum((1, 2)) / (weight[:, 1:-1] > 0).sum((1, 2)) / 6
    strange = noise / rough.sqrt().clamp(min=1e-9)
    doubt = (strange / _STRANGE).clamp(min=1).square()
    good = torch.isfinite(variance) & (variance > 0) & (free > 0) & ~other
    deviation = torch.where(good, _SHARED * variance.clamp(min=0).sqrt() * noise.clamp(min=0.5) * doubt, torch.inf)
    steps, levels = (value.unflatten(1, rows) for value in (amplitude, mean - amplitude * middle))
    return EdgeFit(place, sigma, deviation, noise, steps, levels)


def _edge_terms(t: Tensor, place: Tensor, sigma: Tensor, weight: Tensor, weighted: Tensor, total: Tensor):
    """Normal matrix (pp, pb, bb) and slope (p, b) [E] for place and blur, amplitudes and means [E, U C], rise [E, T].

    ``weight`` and ``weighted`` (light times it) are [E, T, U C], their ``total`` over T [E, U C].
    """
    z = (t - place[:, None]) / sigma[:, None]
    rise = 0.5 * torch.erfc(z * -math.sqrt(0.5))
    bell = torch.exp(-0.5 * z * z) / (-math.sqrt(2 * math.pi) * sigma[:, None])
    basis = torch.stack([rise, bell, bell * z], 1)  # the rise, and its slopes to place and blur: [E, 3, T]
    # Weighted moments over T, for each row and channel.
    moments = torch.cat([basis, basis * rise[:, None]], 1) @ weight
    means, with_light = moments[:, :3] / total[:, None], basis @ weighted
    second = moments[:, 3:] - moments[:, :1] * means
    power = second[:, :1].clamp(min=1e-300)
    amplitude = with_light[:, :1] / power
    slopes = ((with_light[:, 1:] - second[:, 1:] * amplitude) * amplitude).sum(-1)
    # What the rise itself, and the levels, explain is taken out of its slopes (Kaufman's form).
    square = amplitude.square()
    raw = (basis[:, 1:] * (weight @ square.mT).mT) @ basis[:, 1:].mT
    taken = torch.cat(
        [moments[:, 1:3] * (amplitude * total[:, None].rsqrt()), second[:, 1:] * (amplitude * power.rsqrt())], -1
    )
    normal = raw - taken @ taken.mT
    entries = normal[:, 0, 0], normal[:, 0, 1], normal[:, 1, 1]
    return entries, slopes.unbind(-1), amplitude[:, 0], means[:, 0], rise


@dataclass(frozen=True, eq=False)
class AxisFit:
    """Of a straight tube that is seen at stations along it.

    Attributes:
        sides: [4] offset and slope of its middle, width and taper: u = offset + slope t, width + taper t.
        covariance: [4, 4] of them, from the noise and from what is not known of the shading.
        blur: Of the sides, standard deviation in samples.
        contrast: [2], light of the tube less that on either side, over the larger of the two; medians.
        weight: [S], how much each station counts; near 0 where something else is seen.
        unknown: All that was found, for a fit to begin at.
    """

    sides: Tensor
    covariance: Tensor
    blur: float
    contrast: Tensor
    weight: Tensor
    unknown: Tensor


def fit_axis(
    light: Tensor,
    weight: Tensor,
    t: Tensor,
    band: Tensor,
    level: Tensor,
    width: tuple[float, float],
    blur: float,
    known: float = 0.35,
    start: Tensor | None = None,
) -> AxisFit:
    """Blurred boxes whose two sides are straight lines along the tube, all stations at once.

    Beside a box each station has two levels of its own; in it each band has a shading: even, and rising across, round
    as Lambert's law gives, and cubic where part of the tube is in shadow. Their sizes are free within what light can
    do (a prior of a share of the band's light), so that where pixels do not tell, the covariance does.

    Args:
        light: [S, U] samples across, U odd; of one channel or a mix.
        weight: Inverse variances of the same shape.
        t: [S] places along, in samples.
        band: [S] which band a station is on, from 0.
        level: [bands] light of each band, as ``light``.
        width: Of the tube at t = 0 in samples, and its taper per sample, to begin with.
        blur: Standard deviation to begin with, in samples.
        known: Share of the width to which it and the taper are known beforehand. Shading and width are hard to tell
            apart; whoever knows the width finds the middle better.
        start: ``unknown`` of an earlier fit to the same stations, for all but width and taper.
    """
    light, weight = light.to(torch.float64), weight.to(torch.float64)[..., None]
    count, bands, kinds = light.shape[1], len(level), len(_SHADINGS)
    u = torch.arange(count, dtype=torch.float64, device=light.device) - (count - 1) / 2
    reach = float(t.abs().max().clamp(min=1.0))
    # Unknown are middle and width (each at t = 0 and what t = reach adds), blur, and the shadings of each band. A
    # station sees 3 + kinds numbers of them: ``parts`` [S, 3 + kinds, 5 + bands kinds].
    lever = torch.stack([torch.ones_like(t), t / reach], -1)
    parts = light.new_zeros(len(t), 3 + kinds, 5 + bands * kinds)
    parts[:, 0, :2], parts[:, 1, 2:4], parts[:, 2, 4] = lever, lever, 1
    member = nn.functional.one_hot(band, bands).to(light.dtype)
    for kind in range(kinds):
        parts[:, 3 + kind, 5 + kind :: kinds] = member
    flat = parts.flatten(0, 1)
    expected = light.new_zeros(5 + bands * kinds)
    expected[2:5] = light.new_tensor([width[0], width[1] * reach, blur])
    unknown = expected.clone()
    if start is None:
        unknown[5::kinds] = level
    else:
        unknown[:2], unknown[4:] = start[:2], start[4:]
    shares = level.abs().clamp(min=1e-9)[:, None] * light.new_tensor(_SHARES)
    known_to = light.new_tensor([math.inf, math.inf, known * width[0], known * width[0], math.inf])
    prior = torch.cat([known_to, shares.flatten()]).square().reciprocal()
    farthest = torch.full_like(prior, math.inf)
    farthest[:5] = light.new_tensor([1.5, 1.5, 1.5, 1.5, 0.5])
    beside = light.new_zeros(len(t), 2)
    station, noise, normal = torch.ones_like(t), 1.0, prior
    for k in range(_STEPS):
        at, wide, softness, *_ = (seen := (flat @ unknown).view(len(t), -1)).unbind(-1)
        columns, slopes_of = _strip_terms(u, at, wide.clamp(min=1.0) / 2, softness[0])
        outer, inner = columns[..., :2], columns[..., 2:]
        rest = light[..., None] - inner @ seen[:, 3:, None]
        # Levels beside the tube are projected out, station by station.
        weighted = (outer * weight).mT
        inverse = torch.linalg.inv_ex(_ridged(weighted @ outer)).inverse
        beside = (inverse @ (weighted @ rest))[..., 0]
        design = torch.cat([slopes_of(torch.cat([beside, seen[:, 3:]], -1)), inner, rest], -1)
        both = weighted @ design
        gram = design.mT @ (design * weight) - both.mT @ (inverse @ both)  # [S, 4 + kinds, 4 + kinds]
        if k:
            chi = gram[:, -1, -1] / count
            typical = chi.median().clamp(min=1e-12)
            noise = float(typical.sqrt()) * math.sqrt(count / max(1, count - 3))
            station = 1 / (chi / (4 * typical)).clamp(min=1.0).square()
            gram = gram * station[:, None, None]
        normal = flat.T @ (gram[:, :-1, :-1] @ parts).flatten(0, 1)
        ridge = prior * max(noise, 0.5) ** 2
        normal = normal + torch.diag(ridge + 1e-12 * normal.diagonal())
        if k == _STEPS - 1:
            break
        slope = flat.T @ gram[:, :-1, -1].flatten() - ridge * (unknown - expected)
        step = torch.linalg.solve_ex(normal, slope).result.nan_to_num(0.0, 0.0, 0.0)
        unknown = unknown + step.clamp(-farthest, farthest)
        unknown[4].clamp_(_SHARPEST, _BLUNTEST)
        if k and float(step[:4].abs().max()) < max(_SETTLED, 0.1 * known):
            break
    scale = light.new_tensor([1.0, 1.0 / reach, 1.0, 1.0 / reach])
    covariance = torch.linalg.inv_ex(normal).inverse[:4, :4] * max(noise, 0.5) ** 2
    tube = member @ (unknown[5:].view(bands, kinds) @ light.new_tensor(_MEANS))
    apart = (tube[:, None] - beside).abs().median(0).values
    contrast = apart / apart.max().clamp(min=1e-300)
    covariance = covariance * scale * scale[:, None]
    return AxisFit(unknown[:4] * scale, covariance, float(unknown[4]), contrast, station, unknown)


def _ridged(normal: Tensor) -> Tensor:
    return normal + torch.diag_embed(1e-9 * normal.diagonal(dim1=-2, dim2=-1) + 1e-300)


def _slices() -> tuple[Tensor, Tensor]:
    """Nodes [N] over the tube, -1 to 1, and what columns (left, right, shadings) take of a rise there [N, 2 + K]."""
    q = torch.linspace(-1, 1, _SLICES + 1, dtype=torch.float64)
    middle = (q[1:] + q[:-1]) / 2
    shadings = nn.functional.pad(torch.stack([f(middle) for f in _SHADINGS], -1), (0, 0, 1, 1))
    ends = torch.zeros(len(q), 2, dtype=torch.float64)
    ends[0, 0], ends[-1, 1] = -1, 1
    return q, torch.cat([ends, shadings.diff(dim=0)], -1)


_SLICED = _slices()


def _strip_terms(u: Tensor, at: Tensor, half: Tensor, blur: Tensor):
    """Columns [S, U, 2 + K]: light to the left of tubes at [S], to the right, and K shadings of the tube.

    And a function of levels [S, 2 + K]: the slopes [S, U, 3] of the columns' sum to middle, width and blur.
    """
    q, takes = (table.to(u.device) for table in _SLICED)
    scale = math.sqrt(2) * blur
    z = (u[:, None] - (at[:, None] + half[:, None] * q)[:, None]) / scale  # [S, U, N]
    # A rise is (1 + erf z) / 2; what the tube takes of the 1 cancels.
    columns = torch.erf(z) @ (takes / 2)
    columns[..., :2] += 0.5
    bell = torch.exp(-z * z)

    def slopes(levels: Tensor) -> Tensor:
        steps = levels @ takes.T / (-math.sqrt(math.pi) * scale)
        middle, aside = (bell @ torch.stack([steps, steps * q], -1)).unbind(-1)
        softer = ((u - at[:, None]) * middle - half[:, None] * aside) / blur
        return torch.stack([middle, aside / 2, softer], -1)

    return columns, slopes
