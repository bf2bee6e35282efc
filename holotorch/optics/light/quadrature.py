"""Quadrature rules with few nodes for integrals over wavelength: Gauss's, and the one of least error for speckle."""

import torch
from torch import Tensor

_MOST = 512  # largest number of nodes; a tolerance that needs more is refused
_JITTER = 1e-10  # keeps the equations of the weights solvable; costs 1e-5 of error at most
_EXACT = 1e-5  # error at which the search for better nodes stops
_STARTS = (0.85, 0.95)  # outermost nodes of evenly spaced initial nodes, as fractions of the half band


def gauss_rule(nodes: Tensor, weights: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Gauss's rule for a discrete measure: ``count`` nodes and weights, exact for polynomials up to degree 2 count - 1.

    Args:
        nodes: Nodes of the measure, float64 [M], around 0.
        weights: Weights of the measure, float64 [M], positive with a sum of 1. The measure may approximate an integral
            or be a sum over every nanometre.
        count: At most M; for M the rule is the measure itself.

    Raises:
        ValueError: A count above M.

    Source: Golub and Welsch (1969), with Lanczos' recurrence and full orthogonalisation.
    """
    if count > len(nodes):
        raise ValueError(f"count must be at most {len(nodes)}, the number of wavelengths given, got {count}")
    half = nodes.abs().max().clamp_min(torch.finfo(nodes.dtype).tiny)
    vectors = weights.sqrt()[None]
    diagonal, beside = [], []
    for _ in range(count):
        turned = nodes / half * vectors[-1]
        diagonal.append(vectors[-1] @ turned)
        for _ in range(2):  # the second pass removes rounding errors of the first
            turned = turned - (vectors @ turned) @ vectors
        length = turned.norm()
        beside.append(length)
        vectors = torch.cat([vectors, (turned / length.clamp_min(torch.finfo(nodes.dtype).tiny))[None]])
    matrix = torch.diag(torch.stack(diagonal))
    if count > 1:
        side = torch.stack(beside[:-1])
        matrix = matrix + torch.diag(side, 1) + torch.diag(side, -1)
    positions, directions = torch.linalg.eigh(matrix)
    return half * positions, directions[0].square()


def correlation(first: Tensor, second: Tensor, beat: float, rim: float = 0.0) -> Tensor:
    """Correlation [M, N] of speckle intensities at two wavelengths: sinc^2(beat (first - second)).

    Light that fills a round pupil evenly arrives with phases 2 pi beat t lambda, where t is uniformly distributed in
    0..1 and ``beat`` is the path difference divided by the squared wavelength (see ``coherence``). The correlation of
    the intensities is the square of the mean of exp(2 pi i beat t (lambda - lambda')).

    An iris passes fixed directions, not fixed frequencies: as the wavelength grows, it cuts off a fraction 2 ``rim`` of
    the power per metre of wavelength, ``rim`` = 1 / wavelength; 0 is no iris. Only light that passes at both
    wavelengths is correlated, so the correlation has a kink at equal wavelengths: the intensity at a point, as a
    function of wavelength, is as rough as a random walk.
    """
    shared = 1 - 2 * rim * torch.maximum(first[:, None], second)
    return (shared * torch.sinc(beat * shared * (first[:, None] - second))).square()


def expected_error(
    nodes: Tensor, weights: Tensor, positions: Tensor, shares: Tensor, beat: float, rim: float = 0.0
) -> Tensor:
    """Rms error of a rule (``positions``, ``shares``) for a measure, relative to the rms of the picture; a scalar.

    The error is the expectation for fully developed speckle whose intensities correlate as in :func:`correlation`,
    around the mean brightness that the iris passes. Its square is a quadratic form of the difference between the rule
    and the measure. Wavelengths are relative to the middle of the band.
    """
    own = weights @ _second_moment(nodes, nodes, beat, rim) @ weights
    return (_square(own, nodes, weights, positions, shares, beat, rim).clamp_min(0) / own).sqrt()


def speckle_rule(
    nodes: Tensor, weights: Tensor, beat: float, count: int, rim: float = 0.0, *, enough: float = _EXACT
) -> tuple[Tensor, Tensor]:
    """Nodes and weights with the smallest :func:`expected_error` found; the weights are positive and sum to 1.

    For given nodes the best weights solve a linear system; L-BFGS moves the nodes, starting from Gauss's and from
    evenly spaced ones. Where many nodes are needed, this takes up to a third fewer than Gauss's rule, whose nodes lie
    closer at the ends of the band although the correlation is the same over the band. The search stops at an error of
    ``enough``.
    """
    best = gauss_rule(nodes, weights, count)
    least = float(expected_error(nodes, weights, *best, beat, rim))
    half = nodes.abs().max()
    even = 2 * (torch.arange(count, dtype=nodes.dtype) + 0.5) / count - 1
    starts = [*(even * part * count / max(count - 1, 1) for part in _STARTS), best[0] / half]
    for start in starts:
        if least <= enough:
            break
        rule = _descended(nodes / half, weights, beat * float(half), rim * float(half), start.clamp(-0.99, 0.99))
        rule = (rule[0] * half, rule[1])
        error = float(expected_error(nodes, weights, *rule, beat, rim))
        if error < least and bool((rule[1] > 0).all()):
            best, least = rule, error
    return best


def least_rule(
    nodes: Tensor, weights: Tensor, beat: float, tolerance: float, rim: float = 0.0
) -> tuple[Tensor, Tensor]:
    """The rule of :func:`speckle_rule` with the least count whose expected error is within ``tolerance``.

    Raises:
        ValueError: More than 512 wavelengths would be needed.
    """
    half = float(nodes.abs().max())
    # The search for an upper bound with Gauss's rule starts at 0.75 beat half nodes; fewer give far larger errors.
    count = max(1, int(beat * half * 0.75))
    while count <= min(_MOST, len(nodes)):
        rule = gauss_rule(nodes, weights, count)
        if float(expected_error(nodes, weights, *rule, beat, rim)) <= tolerance:
            break
        count += 1 + count // 16
    else:
        raise ValueError(
            f"an error of {tolerance:g} needs more than {min(_MOST, len(nodes))} wavelengths: the path difference is "
            "many times the coherence length; allow a larger error, or a narrower spectrum or pupil"
        )
    low, high = 0, count  # counts known to be too small and to be sufficient
    while high - low > 1:
        middle = max((low + 2 * high) // 3, low + 1) if high - low > 2 else high - 1
        found = speckle_rule(nodes, weights, beat, middle, rim, enough=tolerance)
        if float(expected_error(nodes, weights, *found, beat, rim)) <= tolerance:
            rule, high = found, middle
        else:
            low = middle
    return rule


def _descended(nodes: Tensor, weights: Tensor, beat: float, rim: float, start: Tensor) -> tuple[Tensor, Tensor]:
    hidden = torch.atanh(start).clone().requires_grad_()
    own = weights @ _second_moment(nodes, nodes, beat, rim) @ weights
    search = torch.optim.LBFGS([hidden], max_iter=60, line_search_fn="strong_wolfe", tolerance_change=1e-12)

    def closure() -> Tensor:
        search.zero_grad()
        positions = torch.tanh(hidden)  # within the band
        shares = _best_weights(nodes, weights, positions, beat, rim)
        # The logarithm is minimized because errors span decades; the addend is far below any tolerance.
        loss = (_square(own, nodes, weights, positions, shares, beat, rim).clamp_min(0) + 1e-12).log()
        loss.backward()
        return loss

    with torch.enable_grad():
        search.step(closure)
    positions = torch.tanh(hidden.detach()).sort().values
    return positions, _best_weights(nodes, weights, positions, beat, rim)


def _second_moment(first: Tensor, second: Tensor, beat: float, rim: float) -> Tensor:
    return torch.outer(1 - 2 * rim * first, 1 - 2 * rim * second) + correlation(first, second, beat, rim)


def _square(
    own: Tensor, nodes: Tensor, weights: Tensor, positions: Tensor, shares: Tensor, beat: float, rim: float
) -> Tensor:
    cross = shares @ _second_moment(positions, nodes, beat, rim) @ weights
    return own - 2 * cross + shares @ _second_moment(positions, positions, beat, rim) @ shares


def _best_weights(nodes: Tensor, weights: Tensor, positions: Tensor, beat: float, rim: float) -> Tensor:
    """Weights of least error for given nodes. Their sum is 1, so that brightness without speckle is exact."""
    count = len(positions)
    own = _second_moment(positions, positions, beat, rim) + _JITTER * torch.eye(count, dtype=positions.dtype)
    ones = torch.ones(count, 1, dtype=positions.dtype)
    top = torch.cat([own, ones], 1)
    bottom = torch.cat([ones.T, torch.zeros(1, 1, dtype=positions.dtype)], 1)
    wanted = torch.cat([_second_moment(positions, nodes, beat, rim) @ weights, torch.ones(1, dtype=positions.dtype)])
    return torch.linalg.solve(torch.cat([top, bottom]), wanted)[:count]
