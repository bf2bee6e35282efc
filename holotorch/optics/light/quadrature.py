"""Quadrature rules with few nodes for integrals over wavelength: Gauss's rule, and rules of least error for speckle."""

from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

_MOST = 512  # largest number of nodes
_JITTER = 1e-10  # added to the diagonal so that the equations for the weights are solvable; adds <= 1e-5 to the error
_FLOOR = 1e-12  # added to the squared error before its logarithm
_EXACT = 1e-5  # error at which the search for better nodes stops
_STARTS = (0.85, 0.95)  # outermost nodes of evenly spaced initial nodes, as fractions of the half band


def gauss_rule(nodes: Tensor, weights: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Gauss's rule for a discrete measure: ``count`` nodes and weights, exact for polynomials up to degree 2 count - 1.

    Args:
        nodes: Nodes of the measure, float64 [M], around 0.
        weights: Weights of the measure, float64 [M], positive with a sum of 1.
        count: At most M; for M the rule is the measure itself.

    Raises ValueError for a count above M.

    Source: Golub and Welsch (1969), with Lanczos' recurrence and full orthogonalisation.
    """
    if count > len(nodes):
        raise ValueError(f"count must be at most {len(nodes)}, the number of wavelengths given, got {count}")
    tiny = torch.finfo(nodes.dtype).tiny
    half = nodes.abs().max().clamp_min(tiny)
    vectors = weights.sqrt()[None]
    diagonal, side = [], []
    for _ in range(count):
        product = nodes / half * vectors[-1]
        diagonal.append(vectors[-1] @ product)
        for _ in range(2):  # the second pass removes rounding errors of the first
            product = product - (vectors @ product) @ vectors
        side.append(product.norm())
        vectors = torch.cat([vectors, (product / side[-1].clamp_min(tiny))[None]])
    # Of the symmetric tridiagonal matrix, eigh reads the lower triangle only.
    matrix = torch.diag(torch.stack(diagonal)) + torch.diag(torch.stack(side)[:-1], -1)
    positions, directions = torch.linalg.eigh(matrix)
    return half * positions, directions[0].square()


def correlation(first: Tensor, second: Tensor, beat: float, iris: float = 0.0) -> Tensor:
    """Correlation [M, N] of speckle intensities at wavelengths ``first`` [M] and ``second`` [N]: a squared sinc.

    Light that fills a round pupil uniformly arrives with phases 2 pi beat t lambda, where t is uniformly distributed in
    0..1 and ``beat`` is the path difference divided by the squared wavelength (see ``coherence``). The correlation of
    the intensities is the squared mean of exp(2 pi i beat t (lambda - lambda')): sinc^2(beat (lambda - lambda')).

    An iris transmits fixed directions, not fixed frequencies. As the wavelength grows, it cuts off a fraction
    2 ``iris`` of the power per metre of wavelength, where ``iris`` is 1 / wavelength, or 0 without an iris. Only light
    that passes at both wavelengths is correlated. The correlation therefore has a kink at equal wavelengths, and the
    intensity at a point, as a function of wavelength, is as rough as a random walk.
    """
    shared = 1 - 2 * iris * torch.maximum(first[:, None], second)
    return (shared * torch.sinc(beat * shared * (first[:, None] - second))).square()


@dataclass(frozen=True)
class SpeckleIntegral:
    """Integral of a speckle image over wavelength, which rules with few nodes approximate.

    Attributes:
        nodes: Many wavelengths [M] relative to the middle of the band, in metres, float64.
        weights: Power at these wavelengths, [M], positive with a sum of 1.
        beat: As in :func:`correlation`.
        iris: As in :func:`correlation`.
    """

    nodes: Tensor
    weights: Tensor
    beat: float
    iris: float = 0.0

    def error(self, positions: Tensor, shares: Tensor) -> Tensor:
        """Expected rms error of a rule with nodes ``positions`` and weights ``shares``, relative to the rms intensity.

        The expectation is over fully developed speckle with the correlation of :func:`correlation` and a mean
        brightness proportional to the transmission of the iris.
        """
        cross = shares @ self._second_moment(positions, self.nodes) @ self.weights
        square = self._energy - 2 * cross + shares @ self._second_moment(positions, positions) @ shares
        return (square.clamp_min(0) / self._energy).sqrt()

    def rule(self, count: int, *, enough: float = _EXACT) -> tuple[Tensor, Tensor]:
        """``count`` nodes and weights with the smallest :meth:`error` found; the weights are positive and sum to 1.

        For given nodes the best weights solve a linear system. L-BFGS moves the nodes, starting from those of Gauss's
        rule and from evenly spaced ones, until the error is at most ``enough``. Where many nodes are needed, this takes
        up to a third fewer than Gauss's rule, whose nodes are denser at the ends of the band although the correlation
        is the same over the band.
        """
        best = gauss_rule(self.nodes, self.weights, count)
        least = float(self.error(*best))
        half = self.nodes.abs().max()
        even = 2 * (torch.arange(count, dtype=self.nodes.dtype) + 0.5) / count - 1
        scaled = SpeckleIntegral(self.nodes / half, self.weights, self.beat * float(half), self.iris * float(half))
        for start in (*(even * part * count / max(count - 1, 1) for part in _STARTS), best[0] / half):
            if least <= enough:
                break
            positions, shares = scaled._descend(start.clamp(-0.99, 0.99))
            error = float(self.error(positions * half, shares))
            if error < least and bool((shares > 0).all()):
                best, least = (positions * half, shares), error
        return best

    def least_rule(self, tolerance: float) -> tuple[Tensor, Tensor]:
        """The :meth:`rule` with the fewest nodes whose expected error is within ``tolerance``.

        Raises ValueError if more than 512 wavelengths would be needed.
        """
        # A count that suffices for Gauss's rule is an upper bound. The search for it starts where errors are large.
        count = max(1, int(self.beat * float(self.nodes.abs().max()) * 0.75))
        most = min(_MOST, len(self.nodes))
        while count <= most:
            rule = gauss_rule(self.nodes, self.weights, count)
            if float(self.error(*rule)) <= tolerance:
                break
            count += 1 + count // 16
        else:
            raise ValueError(
                f"an error of {tolerance:g} needs more than {most} wavelengths: the path difference is many times the "
                "coherence length; allow a larger error, or a narrower spectrum or pupil"
            )
        low, high = 0, count  # counts known to be too small and to be sufficient
        while high - low > 1:
            middle = max((low + 2 * high) // 3, low + 1) if high - low > 2 else high - 1
            candidate = self.rule(middle, enough=tolerance)
            if float(self.error(*candidate)) <= tolerance:
                rule, high = candidate, middle
            else:
                low = middle
        return rule

    @cached_property
    def _energy(self) -> Tensor:
        """Expected square of the integral."""
        return self.weights @ self._second_moment(self.nodes, self.nodes) @ self.weights

    def _descend(self, start: Tensor) -> tuple[Tensor, Tensor]:
        """Rule at a local minimum of the error, by L-BFGS from nodes ``start``; the band is scaled to -1..1."""
        hidden = torch.atanh(start).clone()
        search = torch.optim.LBFGS([hidden], max_iter=60, line_search_fn="strong_wolfe", tolerance_change=1e-12)

        def closure() -> Tensor:
            positions = torch.tanh(hidden)  # within the band
            square, gradient = self._least_square(positions)
            hidden.grad = gradient * (1 - positions.square())
            return square

        search.step(closure)
        positions = torch.tanh(hidden).sort().values
        given, among = self._second_moment(positions, self.nodes), self._second_moment(positions, positions)
        return positions, self._best_weights(given, among)

    def _least_square(self, positions: Tensor) -> tuple[Tensor, Tensor]:
        """Logarithm of the squared error with the best weights for ``positions``, and its gradient [N].

        The logarithm, since errors span decades; its addend is far below any tolerance. Where the weights are best, the
        gradient is that with fixed weights.
        """
        given, slope = self._moment_and_slope(positions, self.nodes)
        among, slope_among = self._moment_and_slope(positions, positions)
        shares = self._best_weights(given, among)
        square = (self._energy - 2 * shares @ given @ self.weights + shares @ among @ shares).clamp_min(0) + _FLOOR
        return square.log(), 2 * shares * (slope_among @ shares - slope @ self.weights) / square

    def _second_moment(self, first: Tensor, second: Tensor) -> Tensor:
        means = torch.outer(1 - 2 * self.iris * first, 1 - 2 * self.iris * second)
        return means + correlation(first, second, self.beat, self.iris)

    def _moment_and_slope(self, first: Tensor, second: Tensor) -> tuple[Tensor, Tensor]:
        """:meth:`_second_moment`, and its derivative [M, N] with respect to ``first``; at a kink, the mean of both."""
        shown = 1 - 2 * self.iris * second
        apart, shared = first[:, None] - second, 1 - 2 * self.iris * torch.maximum(first[:, None], second)
        scale = torch.pi * self.beat * shared
        phase = scale * apart
        cosine, sine, close = phase.cos(), phase.sin(), phase.abs() < 0.01
        # sinc, and (cos x - sinc x) / x by its series where the difference would lose digits
        sinc = torch.where(close, 1 - phase.square() / 6 * (1 - phase.square() / 20), sine / phase)
        bend = torch.where(close, phase * (phase.square() / 30 - 1 / 3), (cosine - sinc) / phase)
        square_root = shared * sinc
        slope = bend * scale * shared - self.iris * cosine * (1 + apart.sign())
        moment = torch.outer(1 - 2 * self.iris * first, shown) + square_root.square()
        return moment, 2 * square_root * slope - 2 * self.iris * shown

    def _best_weights(self, given: Tensor, among: Tensor) -> Tensor:
        """Weights of least error, from the second moments of their nodes with the many and among themselves.

        Their sum is 1, which is exact for an intensity without speckle.
        """
        count = len(among)
        identity, ones = torch.eye(count, dtype=among.dtype), among.new_ones(count, 1)
        top = torch.cat([among + _JITTER * identity, ones], 1)
        bottom = torch.cat([ones.T, among.new_zeros(1, 1)], 1)
        moments = torch.cat([given @ self.weights, among.new_ones(1)])
        return torch.linalg.solve(torch.cat([top, bottom]), moments)[:count]
