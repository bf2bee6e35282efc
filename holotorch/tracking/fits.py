"""Where an edge lies between two colours, and where the middle of a strip, to hundredths of a pixel, with deviations.

Both fits are in linear light and project out what they need not know (levels of each row and channel): variable
projection (Golub and Pereyra 1973). Rows and channels weigh by their noise.
"""

import math
from dataclasses import dataclass, fields

import torch
from torch import Tensor

_STEPS = 8
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
    for _ in range(_STEPS):
        normal, slope, *_ = _edge_terms(t, place, sigma, *given)
        step = _solved(normal, slope).clamp(-1.5, 1.5)
        place = (place + step[:, 0]).clamp(-(count - 1) / 2, (count - 1) / 2)
        sigma = (sigma + step[:, 1]).clamp(_SHARPEST, _BLUNTEST)
        if float(step.abs().max()) < 1e-3:
            break
    # One lens blurs all edges alike. Where one side is dark and so has little noise, place and blur are hard to tell
    # apart, edge by edge; together they are not.
    normal = _edge_terms(t, place, sigma, *given)[0]
    sure = 1 / torch.linalg.inv_ex(normal + 1e-300 * torch.eye(2, dtype=torch.float64)).inverse[:, 1, 1].clamp(
        min=1e-12
    )
    common = (sure * sigma).sum() / sure.sum().clamp(min=1e-300)
    alike = (sigma / common - 1).abs() < 0.5
    other = ~alike & ((sigma - common).abs() > _OTHER * sure.rsqrt())  # surely not blurred by that lens
    sigma = torch.where(alike, (sure * alike * sigma).sum() / (sure * alike).sum().clamp(min=1e-300), sigma)
    for _ in range(2):  # an edge without weight has 0 / 0: it stays where it is, of infinite deviation
        normal, slope, *_ = _edge_terms(t, place, sigma, *given)
        place = place + (slope[:, 0] / normal[:, 0, 0].clamp(min=1e-300)).nan_to_num(0).clamp(-0.5, 0.5)
    place = place.clamp(-(count - 1) / 2, (count - 1) / 2)
    normal, _, amplitude, middle = _edge_terms(t, place, sigma, *given)
    z = (t - place[:, None]) / sigma[:, None]
    left = centred - amplitude[:, None] * (0.5 * torch.erfc(-z / math.sqrt(2))[..., None] - middle[:, None])
    free = (weight > 0).sum((1, 2)) - 2 * (weight > 0).any(1).sum(1) - 2
    noise = ((weight * left.square()).sum((1, 2)) / free.clamp(min=1)).sqrt()
    tilt = normal[:, 0, 1] / normal[:, 0, 0]
    variance = 1 / normal[:, 0, 0] + tilt.square() / torch.where(alike, (sure * alike).sum(), sure).clamp(min=1e-12)
    # What varies from sample to sample is noise; what does not is something else that the edge is mixed with.
    rough = (weight[:, 1:-1] * left.diff(n=2, dim=1).square()).sum((1, 2)) / (weight[:, 1:-1] > 0).sum((1, 2)) / 6
    strange = noise / rough.sqrt().clamp(min=1e-9)
    doubt = (strange / _STRANGE).clamp(min=1).square()
    good = torch.isfinite(variance) & (variance > 0) & (free > 0) & ~other
    deviation = torch.where(good, _SHARED * variance.clamp(min=0).sqrt() * noise.clamp(min=0.5) * doubt, torch.inf)
    steps, levels = (value.unflatten(1, rows) for value in (amplitude, mean - amplitude * middle))
    return EdgeFit(place, sigma, deviation, noise, steps, levels)


def _edge_terms(t: Tensor, place: Tensor, sigma: Tensor, weight: Tensor, weighted: Tensor, total: Tensor):
    """Normal matrix [E, 2, 2] and slope [E, 2] for (place, blur), amplitudes and basis means [E, U C].

    ``weight`` and ``weighted`` (light times it) are [E, T, U C], their ``total`` over T [E, U C].
    """
    z = (t - place[:, None]) / sigma[:, None]
    rise = 0.5 * torch.erfc(-z / math.sqrt(2))
    bell = torch.exp(-0.5 * z * z) / (math.sqrt(2 * math.pi) * sigma[:, None])
    basis = torch.stack([rise, -bell, -bell * z], 1)  # the rise, and its slopes to place and blur: [E, 3, T]
    # Weighted moments of the three over T, for each row and channel.
    moments = torch.cat([basis, (basis[:, :, None] * basis[:, None]).flatten(1, 2)], 1) @ weight
    first, second = moments[:, :3] / total[:, None], moments[:, 3:].unflatten(1, (3, 3))
    second = second - moments[:, :3, None] * first[:, None]
    with_light = basis @ weighted
    power = second[:, 0, 0].clamp(min=1e-300)
    amplitude = with_light[:, 0] / power
    # What the rise itself explains is taken out of its slopes (Kaufman's form).
    left = with_light[:, 1:] - second[:, 0, 1:] * amplitude[:, None]
    matrix = second[:, 1:, 1:] - second[:, 1:, :1] * second[:, :1, 1:] / power[:, None, None]
    normal = (matrix @ amplitude.square()[:, None, :, None])[..., 0]
    slope = (left @ amplitude[..., None])[..., 0]
    return normal, slope, amplitude, first[:, 0]


def _solved(normal: Tensor, slope: Tensor) -> Tensor:
    damped = normal + torch.diag_embed(1e-6 * normal.diagonal(dim1=-2, dim2=-1) + 1e-300)
    return torch.linalg.solve_ex(damped, slope[..., None]).result[..., 0].nan_to_num(0.0, 0.0, 0.0)


@dataclass(frozen=True, eq=False)
class AxisFit:
    """Of a straight tube that is seen at stations along it.

    Attributes:
        sides: [4] offset and slope of its middle, width and taper: u = offset + slope t, width + taper t.
        covariance: [4, 4] of them, from the noise and from what is not known of the shading.
        blur: Of the sides, standard deviation in samples.
        contrast: [2], light of the tube less that on either side, over the larger of the two; medians.
        weight: [S], how much each station counts; near 0 where something else is seen.
    """

    sides: Tensor
    covariance: Tensor
    blur: float
    contrast: Tensor
    weight: Tensor


def fit_axis(
    light: Tensor,
    weight: Tensor,
    t: Tensor,
    band: Tensor,
    level: Tensor,
    width: tuple[float, float],
    blur: float,
    known: float = 0.35,
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
    """
    light, root = light.to(torch.float64), weight.to(torch.float64).sqrt()
    count, bands, kinds = light.shape[1], len(level), len(_SHADINGS)
    u = torch.arange(count, dtype=torch.float64, device=light.device) - (count - 1) / 2
    reach = t.abs().max().clamp(min=1.0)
    lever = torch.stack([torch.ones_like(t), t / reach], -1)  # [S, 2]
    middle = torch.zeros(2, dtype=torch.float64, device=light.device)
    expected = torch.tensor([width[0], width[1] * float(reach)], dtype=torch.float64, device=light.device)
    wide = expected.clone()
    softness = torch.tensor(blur, dtype=torch.float64, device=light.device)
    member = torch.nn.functional.one_hot(band, bands).to(torch.float64)
    share = torch.tensor(_SHARES, dtype=torch.float64, device=light.device)
    prior = 1 / (share * level.abs().clamp(min=1e-9)[:, None]).square()  # [bands, kinds]
    station = torch.ones_like(t)
    y = light * root
    amount = torch.cat([level[:, None], level.new_zeros(bands, kinds - 1)], -1)
    sides = light.new_zeros(len(t), 2)
    normal, noise = torch.eye(5 + bands * kinds, dtype=torch.float64), 1.0
    for k in range(_STEPS):
        at, half = lever @ middle, (lever @ wide).clamp(min=1.0) / 2
        columns, slopes = _strip_terms(u, at - half, at + half, softness)
        columns, slopes = columns * root[..., None], slopes * root[..., None, None]
        # Levels beside the tube are projected out, station by station.
        beside, inside = columns[..., :2], columns[..., 2:]
        q = torch.linalg.qr(beside).Q
        sides = _beside(beside, y - (inside @ (member @ amount)[..., None])[..., 0])
        full = torch.cat([sides, member @ amount], -1)  # [S, 2 + kinds]
        moved = torch.einsum("sukj,sk->suj", slopes, full)
        to_middle, to_width = moved[..., 0] + moved[..., 1], (moved[..., 1] - moved[..., 0]) / 2
        design = torch.cat(
            [
                to_middle[..., None] * lever[:, None],
                to_width[..., None] * lever[:, None],
                moved[..., 2:],
                (inside[:, :, None] * member[:, None, :, None]).flatten(2),
            ],
            -1,
        )
        rest = y - (inside @ (member @ amount)[..., None])[..., 0]
        design, rest = design - q @ (q.mT @ design), rest - (q @ (q.mT @ rest[..., None]))[..., 0]
        if k:
            chi = rest.square().mean(-1)
            typical = chi.median().clamp(min=1e-12)
            noise = float(typical.sqrt()) * math.sqrt(count / max(1, count - 3))
            station = 1 / (chi / (4 * typical)).clamp(min=1.0).square()
        weighted = design * station[:, None, None]
        normal = torch.einsum("sui,suj->ij", weighted, design)
        slope = torch.einsum("sui,su->i", weighted, rest)
        ridge = torch.cat([torch.zeros(5, dtype=torch.float64), (prior * max(noise, 0.5) ** 2).flatten()])
        ridge[2:4] = (max(noise, 0.5) / (known * width[0])) ** 2
        slope[2:4] -= ridge[2:4] * (wide - expected)
        slope[5:] -= ridge[5:] * amount.flatten()
        normal = normal + torch.diag(ridge + 1e-12 * normal.diagonal())
        step = torch.linalg.solve_ex(normal, slope).result.nan_to_num(0.0, 0.0, 0.0)
        if k == _STEPS - 1:
            break
        middle, wide = middle + step[:2].clamp(-1.5, 1.5), wide + step[2:4].clamp(-1.5, 1.5)
        softness = (softness + step[4].clamp(-0.5, 0.5)).clamp(_SHARPEST, _BLUNTEST)
        amount = amount + step[5:].view(bands, kinds)
        if k > 1 and float(step[:4].abs().max()) < 3e-3:
            break
    scale = torch.tensor([1.0, 1.0 / float(reach), 1.0, 1.0 / float(reach)], dtype=torch.float64)
    covariance = torch.linalg.inv_ex(normal).inverse[:4, :4] * max(noise, 0.5) ** 2
    tube = member @ (amount @ torch.tensor(_MEANS, dtype=torch.float64))
    apart = (tube[:, None] - sides).abs().median(0).values
    contrast = apart / apart.max().clamp(min=1e-300)
    covariance = covariance * scale * scale[:, None]
    return AxisFit(torch.cat([middle, wide]) * scale, covariance, float(softness), contrast, station)


def _beside(columns: Tensor, y: Tensor) -> Tensor:
    """Weighted least squares [S, 2] of y [S, U] on two columns [S, U, 2]."""
    normal = columns.mT @ columns
    normal = normal + torch.diag_embed(1e-9 * normal.diagonal(dim1=-2, dim2=-1) + 1e-300)
    return torch.linalg.solve_ex(normal, (columns.mT @ y[..., None])).result[..., 0]


def _strip_terms(u: Tensor, low: Tensor, high: Tensor, blur: Tensor) -> tuple[Tensor, Tensor]:
    """Columns [S, U, 2 + K] (left, right, K shadings), and slopes [S, U, 2 + K, 3] to the two sides and the blur."""
    share = torch.linspace(0, 1, _SLICES + 1, dtype=u.dtype, device=u.device)
    nodes = low[:, None] + (high - low)[:, None] * share
    z = (u[:, None] - nodes[:, None]) / blur  # [S, U, K + 1]
    rise = 0.5 * torch.erfc(-z / math.sqrt(2))
    bell = torch.exp(-0.5 * z * z) / (math.sqrt(2 * math.pi) * blur)
    q = share[1:] + share[:-1] - 1
    shadings = torch.stack([f(q) for f in _SHADINGS])
    inside = -rise.diff(dim=-1) @ shadings.T
    falls = bell.diff(dim=-1) @ shadings.T
    spread = -z * bell
    softer = -spread.diff(dim=-1) @ shadings.T
    moved_high = (bell * share).diff(dim=-1) @ shadings.T
    zero = torch.zeros_like(rise[..., 0])
    columns = torch.cat([(1 - rise[..., 0])[..., None], rise[..., -1:], inside], -1)
    to_low = torch.cat([bell[..., :1], zero[..., None], falls - moved_high], -1)
    to_high = torch.cat([zero[..., None], -bell[..., -1:], moved_high], -1)
    to_blur = torch.cat([-spread[..., :1], spread[..., -1:], softer], -1)
    return columns, torch.stack([to_low, to_high, to_blur], -1)
