"""PhaseModulator: the field that a liquid-crystal panel with discrete grey levels emits for a wanted phase."""

import hashlib
import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from holotorch.core import checks
from holotorch.core.complex import phasor
from holotorch.core.grid import Grid
from holotorch.core.quantities import WAVELENGTH
from holotorch.modulator.crosstalk import ThermalCrosstalk
from holotorch.modulator.dispersion import Birefringence, phase_scale

_CYCLE = 2 * math.pi


def even_lut(bits: int, full_turn: float | None = None) -> Tensor:
    """Phases of evenly spaced levels, float64 [2^bits] in rad, 0 at level 0.

    ``full_turn`` is the level at which the phase is 2 pi. It need not be a whole number. The default 2^bits spreads the
    levels evenly over the circle; it is larger for a panel whose phases do not reach 2 pi.
    """
    count = 2 ** _checked_bits(bits)
    levels_per_cycle = checks.positive("full_turn", count if full_turn is None else full_turn, "levels")
    return torch.arange(count, dtype=torch.float64) * (_CYCLE / levels_per_cycle)


def nearest_levels(phase: Tensor, lut: Tensor) -> Tensor:
    """Grey level whose phase modulo 2 pi is nearest to the wanted phase, int64 of the shape of ``phase``.

    Args:
        phase: In rad, of any size.
        lut: Phases of the levels, float64 [L] in rad, of any stroke. Wanted phases beyond a stroke of less than 2 pi go
            to the nearer of its two ends; of levels with the same phase modulo 2 pi one is taken.
    """
    circle, order = torch.sort(torch.remainder(lut, _CYCLE))
    circle = torch.cat([circle[-1:] - _CYCLE, circle, circle[:1] + _CYCLE])
    order = torch.cat([order[-1:], order, order[:1]])
    borders = ((circle[1:] + circle[:-1]) / 2).to(phase.device)
    wanted = torch.remainder(phase.detach().double(), _CYCLE).contiguous()
    return order.to(phase.device)[torch.bucketize(wanted, borders)]


def snapped(phase: Tensor, lut: Tensor) -> Tensor:
    """Phase of the nearest level, in the dtype of ``phase`` and the range of ``lut`` [L].

    The gradient is that of the identity (straight-through estimator), as in :func:`holotorch.modulator.quantised`. Here
    the levels are those of the panel, and phases are compared modulo 2 pi.
    """
    shown = lut.to(phase.device)[nearest_levels(phase, lut)].to(phase.dtype)
    return shown + (phase - phase.detach())  # the second term is exactly zero and carries the gradient


def quantisation_rms(lut: Tensor) -> float:
    """Expected rms phase error in rad of the nearest level for phases uniform on the circle.

    It is sqrt(sum g^3 / 24 pi) over the gaps g between neighbouring levels on the circle. For L evenly spread levels
    this is 2 pi / L / sqrt(12), 0.0071 rad for 8 bits.
    """
    circle = torch.remainder(lut.double(), _CYCLE).sort().values
    gaps = torch.diff(circle, append=circle[:1] + _CYCLE)
    return math.sqrt((gaps**3).sum().item() / (12 * _CYCLE))


class PhaseModulator(nn.Module):
    """Emitted field of one panel, complex [..., C, H, W], for a wanted phase, real [..., C, H, W] in rad.

    The model has these steps: the grey level nearest to the wanted phase modulo 2 pi, with the gradient of the
    identity; the phase of that level by the look-up table; fringing fields between pixels; dispersion, if the light has
    another wavelength than the calibration; the gaps between the pixels. Colours are shown one after another, each with
    a separate table.

    Fringing is a convolution of the phases with a kernel of sum 1, normalised at the border of the panel. Phases and
    not phasors are convolved, since the orientation of the crystal is smoothed. Detail within a pixel is not modelled.
    The amplitude is that of the central diffraction order for unit illumination: the modulated light, weighted by
    ``fill_factor``, plus the unmodulated light of the gaps, a zero order. ``holotorch.optics.PixelShape`` models the
    decrease towards higher orders and may follow, with a ``fill`` of the square root of ``fill_factor`` and only with a
    ``gap`` of 0, as the light of the gaps decreases in another way.

    Args:
        grid: Pixels of the panel.
        wavelengths: Wavelengths of the calibration in metres, one per channel.
        bits: Bits of a grey level, 1 to 16.
        full_turn: Level at which the phase is 2 pi, see :func:`even_lut`.
        lut: Phase in rad of every level, real [2^bits] or [C, 2^bits], strictly rising or falling; excludes
            ``full_turn``.
        fill_factor: Share of the area that is modulated, above 0 and at most 1.
        gap: Amplitude reflected by the rest, 0 (dark) to 1, with phase 0.
        flip_rows: Whether the panel shows its last row first; affects only :meth:`levels` and :meth:`phase`. A frame is
            flipped about its middle, which for an even size moves the optical axis by one pixel.
        flip_columns: The same for columns.
        crosstalk: Standard deviation in pixels of a Gaussian fringing field, or its measured kernel, odd sizes, centre
            largest.
        birefringence: Birefringence of the crystal, see :func:`holotorch.modulator.dispersion.phase_scale`. With None
            the phase is the same for every wavelength, as in the thesis's simulation.

    Raises:
        TypeError: A wrong kind of number or tensor.
        ValueError: A parameter outside its range, a table of another size or one that is not monotone; in a call: a
            phase of another shape.
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
        crosstalk: float | Tensor = 0.0,
        birefringence: Birefringence | None = None,
    ):
        super().__init__()
        self.grid, self.wavelengths, self.bits = grid, checks.wavelengths(wavelengths), _checked_bits(bits)
        if lut is not None and full_turn is not None:
            raise ValueError("give lut or full_turn, not both: the table says how far the levels reach")
        table = even_lut(bits, full_turn) if lut is None else checked_lut(lut, self.bits)
        if table.ndim == 2 and len(table) != len(self.wavelengths):
            raise ValueError(f"lut must have one row for each of {len(self.wavelengths)} wavelengths, got {len(table)}")
        self.register_buffer("lut", table.expand(len(self.wavelengths), -1).contiguous(), persistent=False)
        self.fill_factor, self.gap = _share("fill_factor", fill_factor), _share("gap", gap, least=True)
        self.flips = tuple(axis for axis, flipped in ((-2, flip_rows), (-1, flip_columns)) if flipped)
        self.crosstalk = _fringing(crosstalk)
        self.birefringence = birefringence

    @property
    def expected_rms(self) -> tuple[float, ...]:
        """Expected rms error in rad of the quantised phase, one per channel, see :func:`quantisation_rms`."""
        return tuple(quantisation_rms(row) for row in self.lut)

    def forward(self, phase: Tensor, light: float | Sequence[float] | Tensor | None = None) -> Tensor:
        """Emitted field [..., C, H, W] for a wanted phase [..., C, H, W].

        ``light``: wavelengths of the illumination in metres, broadcast against [..., C]; by default those of the
        calibration.
        """
        return self.emitted(self.shown(phase), light)

    def shown(self, phase: Tensor) -> Tensor:
        """Phase [..., C, H, W] of the levels nearest to a wanted phase, in the range of the table."""
        self._check(phase)
        rows = [snapped(phase[..., c, :, :], row) for c, row in enumerate(self.lut)]
        return torch.stack(rows, -3)

    def emitted(self, shown: Tensor, light: float | Sequence[float] | Tensor | None = None) -> Tensor:
        """Emitted field for the phases [..., C, H, W] of grey levels, such as :meth:`phase` returns."""
        self._check(shown)
        if self.crosstalk is not None:
            weight = self.crosstalk(torch.ones(self.grid.shape, dtype=shown.dtype, device=shown.device))
            shown = self.crosstalk(shown) / weight
        lit = None if light is None else torch.as_tensor(light, dtype=torch.float64)
        if lit is not None:
            checks.quantities(WAVELENGTH, lit, "light")
        if lit is not None and self.birefringence is not None:
            design = torch.tensor(self.wavelengths, dtype=torch.float64, device=lit.device)
            scale = phase_scale(lit, design, self.birefringence)
            shown = shown * scale.to(shown.device, shown.dtype)[..., None, None]
        field = phasor(shown)
        return field if self.fill_factor == 1 else self.fill_factor * field + (1 - self.fill_factor) * self.gap

    def levels(self, phase: Tensor) -> Tensor:
        """Frames for the panel, uint8 or (above 8 bits) uint16 [..., C, H, W], flipped as the panel is mounted."""
        self._check(phase)
        checks.all_finite("phase", phase.detach())
        rows = [nearest_levels(phase[..., c, :, :], row) for c, row in enumerate(self.lut)]
        return torch.stack(rows, -3).flip(self.flips).to(torch.uint8 if self.bits <= 8 else torch.uint16)

    def phase(self, levels: Tensor) -> Tensor:
        """Phase in rad, float64 [..., C, H, W], of frames as :meth:`levels` returns them, with the flips undone."""
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
        lut = self.lut.to(index.device)
        return torch.stack([row[index[..., c, :, :]] for c, row in enumerate(lut)], -3).flip(self.flips)

    def lut_hash(self, channel: int = 0) -> str:
        """First 16 hexadecimal digits of the SHA-256 of a channel's table, float64 little-endian."""
        data = self.lut[channel].cpu().contiguous().numpy().astype("<f8").tobytes()
        return hashlib.sha256(data).hexdigest()[:16]

    def extra_repr(self) -> str:
        """Sampling, levels and gaps, for ``print(module)``."""
        return f"grid={self.grid}, bits={self.bits}, fill_factor={self.fill_factor:g}, gap={self.gap:g}"

    def _check(self, phase: Tensor) -> None:
        checks.field("phase", phase, (len(self.wavelengths), *self.grid.shape), complex_valued=False)

    def _apply(self, fn, recurse=True):
        # The tables stay float64 when a module is cast: 16 bits are finer than half precision.
        return super()._apply(lambda tensor: tensor.to(fn(tensor).device), recurse)


def checked_lut(lut: Tensor, bits: int) -> Tensor:
    """A table of phases [..., 2^bits] as float64, or ValueError saying what is wrong with it."""
    checks.real("lut", lut)
    checks.all_finite("lut", lut)
    if lut.ndim not in (1, 2) or lut.shape[-1] != 2 ** _checked_bits(bits):
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
    return lut.detach().double()


def level_of(phase: Tensor, lut: Tensor) -> Tensor:
    """Inverse of a look-up table: the continuous level of a phase, float64, by linear interpolation.

    ``phase`` is in rad and not wrapped, ``lut`` [L] is monotone; differentiable in both. Raises ValueError for phases
    outside the table.
    """
    table = lut.double() if lut[-1] >= lut[0] else -lut.double()
    wanted = phase.double() if lut[-1] >= lut[0] else -phase.double()
    low, high = table.detach()[0], table.detach()[-1]
    if bool(((wanted.detach() < low) | (wanted.detach() > high)).any()):
        raise ValueError(
            f"phases must lie in the table's range, {lut.min().item():g} to {lut.max().item():g} rad, got "
            f"{phase.min().item():g} to {phase.max().item():g}"
        )
    row = torch.bucketize(wanted.detach(), table.detach()).clamp(1, len(table) - 1)
    return row - 1 + (wanted - table[row - 1]) / (table[row] - table[row - 1])


def _checked_bits(bits: int) -> int:
    if checks.whole("bits", bits, 1) > 16:
        raise ValueError(f"bits must be at most 16, got {bits}")
    return bits


def _share(name: str, value: float, *, least: bool = False) -> float:
    number = checks.finite(name, value)
    if not (0 <= number <= 1) or (number == 0 and not least):
        raise ValueError(f"{name} must be {'at least' if least else 'above'} 0 and at most 1, got {value!r}")
    return number


def _fringing(crosstalk: float | Tensor) -> ThermalCrosstalk | None:
    if isinstance(crosstalk, Tensor) and crosstalk.ndim > 0:
        return ThermalCrosstalk.from_patch(crosstalk)
    width = checks.finite("crosstalk", float(crosstalk), "pixels")
    # A Gaussian of standard deviation s, exp(-d^2 / (2 s^2)), is exp(-d^2 / sigma^2) with sigma = sqrt(2) s.
    return None if width == 0 else ThermalCrosstalk(math.sqrt(2) * width)
