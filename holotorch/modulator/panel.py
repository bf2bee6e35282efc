"""PhaseModulator: the field that a liquid-crystal panel with discrete grey levels emits for a target phase."""

import hashlib
import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from holotorch.core import checks
from holotorch.core.complex import phasor
from holotorch.core.grid import Grid
from holotorch.core.learning import PreciseModule, without_graph
from holotorch.core.precision import at_least_single, double
from holotorch.core.quantities import WAVELENGTH
from holotorch.modulator.crosstalk import ThermalCrosstalk
from holotorch.modulator.dispersion import Birefringence, phase_scale
from holotorch.modulator.quantised import checked_bits


def even_lut(bits: int, full_turn: float | None = None) -> Tensor:
    """Phases of evenly spaced levels, float64 [2^bits] in rad, 0 at level 0.

    ``full_turn`` is the level at which the phase is 2 pi, by default 2^bits. It need not be a whole number, and may be
    larger than 2^bits for a panel whose largest phase is below 2 pi.
    """
    count = 2 ** checked_bits(bits)
    levels_per_cycle = checks.positive("full_turn", count if full_turn is None else full_turn, "levels")
    return torch.arange(count, dtype=torch.float64) * (math.tau / levels_per_cycle)


def nearest_levels(phase: Tensor, lut: Tensor) -> Tensor:
    """Grey level whose phase modulo 2 pi is nearest to the target phase, int64 of the shape of ``phase``.

    Args:
        phase: In rad, of any size.
        lut: Phases of the levels, float64 [L] in rad, over any range. If they cover less than 2 pi, a phase outside
            their range gives the nearer end. Of several levels with the same phase modulo 2 pi, any may be returned.
    """
    circle, order = torch.sort(torch.remainder(lut.detach(), math.tau))
    circle = torch.cat([circle[-1:] - math.tau, circle, circle[:1] + math.tau])
    order = torch.cat([order[-1:], order, order[:1]])
    borders = ((circle[1:] + circle[:-1]) / 2).to(phase.device)
    target = torch.remainder(phase.detach().double(), math.tau).contiguous()
    return order.to(phase.device)[torch.bucketize(target, borders)]


def snapped(phase: Tensor, lut: Tensor) -> Tensor:
    """Phase from ``lut`` [L] of the level by :func:`nearest_levels`, in the shape and dtype of ``phase``.

    The gradient with respect to ``phase`` is that of the identity (straight-through estimator); with respect to
    ``lut`` it is that of the levels shown. Phases in half precision, which cannot hold one, give float32.
    """
    phase = at_least_single(phase)
    shown = lut.to(phase.device)[nearest_levels(phase, lut)].to(phase.dtype)
    return shown + (phase - phase.detach())  # the second term is exactly zero and carries the gradient


def quantisation_rms(lut: Tensor) -> float:
    """Expected rms phase error in rad of the nearest level for phases uniform on the circle.

    It is sqrt(sum g^3 / (24 pi)) over the gaps g between neighbouring levels on the circle: 2 pi / (L sqrt(12)) for L
    evenly spaced levels, 0.0071 rad for 8 bits.
    """
    circle = torch.remainder(lut.double(), math.tau).sort().values
    gaps = torch.diff(circle, append=circle[:1] + math.tau)
    return math.sqrt((gaps**3).sum().item() / (12 * math.tau))


class PhaseModulator(PreciseModule):
    """Emitted field of one panel, complex [..., C, H, W], for a target phase, real [..., C, H, W] in rad.

    The phase is rounded to that of the nearest grey level (:func:`snapped`), smoothed by the fringing fields between
    pixels, and scaled by dispersion if the light has another wavelength than the calibration. Fringing is a convolution
    of the phase, and not of the field, since it smooths the orientation of the crystal; its kernel is normalised, also
    at the border of the panel.

    The amplitude is that of the central diffraction order for unit illumination: ``fill_factor`` times the modulated
    field, plus (1 - ``fill_factor``) ``gap`` for the gaps between pixels. If ``gap`` is 0, the lower amplitude of the
    higher orders may be modelled by applying ``holotorch.optics.PixelShape`` with a ``fill`` of sqrt(``fill_factor``).

    Args:
        grid: Pixels of the panel.
        wavelengths: Wavelengths of the calibration in metres, one per channel; the channels are shown in sequence.
        bits: Bits of a grey level, 1 to 16.
        full_turn: Level at which the phase is 2 pi, see :func:`even_lut`.
        lut: Phase in rad of every level, real [2^bits] or [C, 2^bits], strictly rising or falling; excludes
            ``full_turn``. An ``nn.Parameter`` is learned: the emitted field then depends on the phases of the levels
            shown, while the choice of levels has no derivative. It is in ``state_dict`` in any case.
        fill_factor: Share of the area that is modulated, above 0 and at most 1.
        gap: Amplitude reflected by the gaps, 0 (dark) to 1, with phase 0.
        flip_rows: Whether the panel shows the last row of a frame at its top; affects only :meth:`levels` and
            :meth:`phase`. For an even size, the flip moves the optical axis, at pixel n // 2, by one pixel.
        flip_columns: The same for columns.
        crosstalk: Fringing kernel: the standard deviation in pixels of a Gaussian, a measured kernel [h, w], see
            :meth:`ThermalCrosstalk.from_patch`, or a ``ThermalCrosstalk``, which may learn.
        birefringence: Birefringence of the crystal, see :func:`phase_scale`. With None
            the phase is the same for every wavelength, as in the thesis's simulation.
        learnable: Make the table a Parameter, ``lut``.

    Raises:
        TypeError: A wrong kind of number or tensor.
        ValueError: A parameter outside its range, a table of another size or not monotone, a phase of another shape.
    """

    lut: Tensor

    def __init__(
        self,
        grid: Grid,
        wavelengths: float | Sequence[float],
        *,
        bits: int = 8,
        full_turn: float | None = None,
        lut: Tensor | None = None,
        fill_factor: float = 1.0,
        gap: float = 0.0,
        flip_rows: bool = False,
        flip_columns: bool = False,
        crosstalk: float | Tensor | ThermalCrosstalk = 0.0,
        birefringence: Birefringence | None = None,
        learnable: bool = False,
    ):
        super().__init__()
        self.grid, self.wavelengths, self.bits = grid, checks.wavelengths(wavelengths), checked_bits(bits)
        if lut is not None and full_turn is not None:
            raise ValueError("give lut or full_turn, not both: the table says how far the levels reach")
        without_graph("lut", lut)
        table = even_lut(bits, full_turn) if lut is None else checked_lut(lut, self.bits)
        if table.ndim == 2 and len(table) != len(self.wavelengths):
            raise ValueError(f"lut must have one row for each of {len(self.wavelengths)} wavelengths, got {len(table)}")
        rows = table.expand(len(self.wavelengths), -1).contiguous()
        self.record("lut", lut if isinstance(lut, nn.Parameter) else rows, learnable=learnable)
        self.fill_factor, self.gap = _fraction("fill_factor", fill_factor), _fraction("gap", gap, allow_zero=True)
        self.flips = tuple(axis for axis, flipped in ((-2, flip_rows), (-1, flip_columns)) if flipped)
        self.crosstalk, self.birefringence = None, birefringence
        if isinstance(crosstalk, ThermalCrosstalk):
            self.crosstalk = crosstalk
        elif isinstance(crosstalk, Tensor) and crosstalk.ndim > 0:
            self.crosstalk = ThermalCrosstalk.from_patch(crosstalk)
        elif width := checks.finite("crosstalk", crosstalk, "pixels"):  # type: ignore[arg-type]
            # A Gaussian of standard deviation s, exp(-d^2 / (2 s^2)), is exp(-d^2 / sigma^2) with sigma = sqrt(2) s.
            self.crosstalk = ThermalCrosstalk(math.sqrt(2) * width)

    @property
    def expected_rms(self) -> tuple[float, ...]:
        """Expected rms error in rad of the quantised phase, one per channel, see :func:`quantisation_rms`."""
        return tuple(quantisation_rms(row) for row in self._rows().detach())

    def forward(self, phase: Tensor, light: float | Sequence[float] | Tensor | None = None) -> Tensor:
        """Emitted field [..., C, H, W] for a target phase [..., C, H, W].

        ``light``: Wavelengths of the illumination in metres, which broadcast against [..., C]; by default those of the
        calibration.
        """
        return self.emitted(self.shown(phase), light)

    def shown(self, phase: Tensor) -> Tensor:
        """Phase [..., C, H, W] of the levels nearest to a target phase, see :func:`snapped`."""
        self._check(phase)
        rows = [snapped(phase[..., c, :, :], row) for c, row in enumerate(self._rows())]
        return torch.stack(rows, -3)

    def emitted(self, shown: Tensor, light: float | Sequence[float] | Tensor | None = None) -> Tensor:
        """Emitted field for the phases [..., C, H, W] of grey levels, as :meth:`phase` returns; ``light`` as above."""
        self._check(shown)
        if self.crosstalk is not None:
            weight = self.crosstalk(torch.ones(self.grid.shape, dtype=shown.dtype, device=shown.device))
            shown = self.crosstalk(shown) / weight
        if light is not None:
            lit = torch.as_tensor(light, dtype=torch.float64)
            checks.quantities(WAVELENGTH, lit, "light")
            if self.birefringence is not None:
                design = double(self.wavelengths, lit.device)
                scale = phase_scale(lit, design, self.birefringence)
                shown = shown * scale.to(shown.device, shown.dtype)[..., None, None]
        field = phasor(shown)
        return field if self.fill_factor == 1 else self.fill_factor * field + (1 - self.fill_factor) * self.gap

    def levels(self, phase: Tensor) -> Tensor:
        """Frames of the nearest levels, uint8 (uint16 above 8 bits) [..., C, H, W], with the flips of the panel."""
        self._check(phase)
        checks.all_finite("phase", phase.detach())
        rows = [nearest_levels(phase[..., c, :, :], row) for c, row in enumerate(self._rows())]
        return torch.stack(rows, -3).flip(self.flips).to(torch.uint8 if self.bits <= 8 else torch.uint16)

    def phase(self, levels: Tensor) -> Tensor:
        """Phase in rad, float64 [..., C, H, W], of frames from :meth:`levels`, with the flips undone."""
        if levels.is_floating_point() or levels.is_complex():
            raise TypeError(f"levels must be whole numbers, got {levels.dtype}")
        index = levels.to(torch.int64)
        shape = (len(self.wavelengths), *self.grid.shape)
        if tuple(index.shape[-3:]) != shape:
            raise ValueError(f"levels must end in (C, H, W) = {shape}, got {tuple(index.shape)}")
        if index.numel() and not 0 <= int(index.min()) <= int(index.max()) < 2**self.bits:
            raise ValueError(
                f"levels must lie between 0 and {2**self.bits - 1} for {self.bits} bits, got {int(index.min())} to "
                f"{int(index.max())}"
            )
        lut = self._rows().to(index.device)
        return torch.stack([row[index[..., c, :, :]] for c, row in enumerate(lut)], -3).flip(self.flips)

    def lut_hash(self, channel: int = 0) -> str:
        """First 16 hexadecimal digits of the SHA-256 of a channel's table, float64 little-endian."""
        data = self._rows()[channel].detach().cpu().contiguous().numpy().astype("<f8").tobytes()
        return hashlib.sha256(data).hexdigest()[:16]

    def extra_repr(self) -> str:
        """Main parameters, for ``print(module)``."""
        return f"grid={self.grid}, bits={self.bits}, fill_factor={self.fill_factor:g}, gap={self.gap:g}"

    def _check(self, phase: Tensor) -> None:
        checks.field("phase", phase, (len(self.wavelengths), *self.grid.shape), complex_valued=False)

    def _rows(self) -> Tensor:
        """The table with one row for each channel, [C, 2^bits]."""
        return self.lut.expand(len(self.wavelengths), -1)


def checked_lut(lut: Tensor, bits: int) -> Tensor:
    """``lut`` of [2^bits] or [C, 2^bits] phases as float64; ValueError for another size, NaN or no monotone table."""
    checks.real("lut", lut)
    lut = lut.detach()
    checks.all_finite("lut", lut)
    if lut.ndim not in (1, 2) or lut.shape[-1] != 2 ** checked_bits(bits):
        raise ValueError(f"lut must hold {2**bits} phases for {bits} bits, one per level, got {tuple(lut.shape)}")
    steps = torch.diff(lut.double())
    for row in steps.reshape(-1, steps.shape[-1]):
        wrong = (row * row.sum().sign() <= 0).nonzero()
        if len(wrong):
            at = int(wrong[0])
            raise ValueError(
                f"lut must be monotone: strictly rising or falling phases, but from level {at} to {at + 1} it goes by "
                f"{row[at].item():g} rad against the rest ({len(wrong)} such steps); smooth the measurement, as "
                "patterns.fit_lut does"
            )
    return lut.double()


def level_of(phase: Tensor, lut: Tensor) -> Tensor:
    """Inverse of a look-up table: the continuous level of a phase, float64, by linear interpolation.

    ``phase``, of any shape, is in rad and not wrapped; ``lut`` [L] is monotone. Differentiable with respect to both.
    Raises ValueError for phases outside the range of the table.
    """
    sign = 1 if lut[-1] >= lut[0] else -1
    table, target = sign * lut.double(), sign * phase.double()
    low, high = table.detach()[0], table.detach()[-1]
    if bool(((target.detach() < low) | (target.detach() > high)).any()):
        raise ValueError(
            f"phases must lie in the table's range, {lut.min().item():g} to {lut.max().item():g} rad, got "
            f"{phase.min().item():g} to {phase.max().item():g}"
        )
    row = torch.bucketize(target.detach(), table.detach()).clamp(1, len(table) - 1)
    return row - 1 + (target - table[row - 1]) / (table[row] - table[row - 1])


def _fraction(name: str, value: float, *, allow_zero: bool = False) -> float:
    number = checks.finite(name, value)
    if not 0 <= number <= 1 or (number == 0 and not allow_zero):
        raise ValueError(f"{name} must be {'at least' if allow_zero else 'above'} 0 and at most 1, got {value!r}")
    return number
