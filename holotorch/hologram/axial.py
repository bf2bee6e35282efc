"""AxialHologram: many planes with few Fourier transforms, by interpolation onto nodes along the optical axis."""

import math
import warnings
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from holotorch.core import checks
from holotorch.core.complex import phasor
from holotorch.core.fourier import multiply_even
from holotorch.core.grid import Grid
from holotorch.core.learning import fixed
from holotorch.core.tracing import constant_when_compiled
from holotorch.hologram.cone import Cone, taper
from holotorch.hologram.layered import LayerHologram
from holotorch.hologram.nodes import Nodes, axial_range, choose_nodes
from holotorch.hologram.padding import Axis, choose_length, faded_out
from holotorch.hologram.raster import Raster, has_light
from holotorch.optics.free_space.kernels import cycles_phasor
from holotorch.optics.free_space.padding import FINEST

_GROUP = 16  # largest number of planes that one matrix product spreads onto the nodes


@dataclass(frozen=True)
class AxialDesign:
    """Nodes and transforms of an ``AxialHologram`` for layers of one shape."""

    axes: tuple[Axis, Axis]  # sources and pixels along (y, x)
    nodes: Nodes  # nodes along the optical axis
    begins: tuple[int, ...]  # index of the first node that each plane contributes to
    weights: tuple[tuple[complex, ...], ...]  # weights of each plane on its nodes, from that one on
    raster: Raster  # padded array that holds the sources and the pixels
    predicted_error: float  # expected relative L2 error of the field of random sources
    adequate: bool  # whether ``predicted_error`` is within the tolerance

    @property
    def size(self) -> tuple[int, int]:
        """Size (N_y, N_x) of the spectra in samples."""
        return self.raster.size

    def step(self, nodes: int, like: Tensor) -> Tensor:
        """Factor exp(2 pi i (w - w0) z), [N_y, N_x], for a distance z of ``nodes`` times the spacing of the nodes.

        w is the axial frequency and w0 is ``nodes.centre``. dtype and device are those of ``like``.
        """
        _, offset = self._axial_frequency(like.device)
        whole = torch.ones(self.size, dtype=like.dtype, device=like.device)
        return multiply_even(whole, cycles_phasor(offset * (self.nodes.spacing * nodes)).to(like.dtype))

    def last(self, node: int, like: Tensor) -> Tensor:
        """First quadrant of the factor by which the sum over all nodes is multiplied, to give the hologram's spectrum.

        The sum refers to the plane of ``node``. The factor is the spectrum of the spherical wave from it, times taper
        and attenuation, divided by the Fourier transform of the window. dtype and device are those of ``like``.
        """
        axial, offset = self._axial_frequency(like.device)
        strength = 1 / (axial * math.prod(self.raster.grid.pitch) * self.nodes.response(offset))
        strength = torch.where(axial > 0.07 / self.axes[0].wavelength, strength, 0)
        for axis, frequency, length in zip(self.axes, self.raster.frequencies(like.device), self.size, strict=True):
            if axis.cone == "taper":
                strength = strength * taper(2 * axis.pitch * frequency)
            strength = strength * faded_out(frequency / axial, *axis.fade(length))
        # The factor i of Weyl's expansion is a phase of a quarter cycle.
        wave = cycles_phasor(offset * self.nodes.depth(node) + 0.25)
        return (wave * strength).to(like.dtype)

    def _axial_frequency(self, device: torch.device) -> tuple[Tensor, Tensor]:
        """Axial frequency w in cycles per metre, in the first quadrant, and w minus ``nodes.centre``."""
        fy, fx = self.raster.frequencies(device)
        wavelength = self.axes[0].wavelength
        square = wavelength**-2 - fy.square() - fx.square()
        axial = torch.sqrt(square.clamp(min=(0.05 / wavelength) ** 2))
        return axial, axial - self.nodes.centre


class AxialHologram(LayerHologram):
    """Sum over planes of band-limited spherical waves exp(i k r) / r, with one small FFT per node instead of per plane.

    Planes are spread onto evenly spaced nodes, which are planes at fixed depths (``holotorch.hologram.nodes``). Each
    node needs one FFT at the resolution of the sources. The spectra are summed by Horner's rule: the partial sum is
    multiplied by the same propagation factor from each node to the next. Finally the sum is multiplied by the spectrum
    of the spherical wave and transformed back. Evenly spaced planes serve as nodes themselves if this is cheaper.

    Args:
        cone: "taper", "band" or "full". "full" is allowed only if every pixel lies within the cone of every source,
            since this method leaves out light outside the cone.
        tolerance: Largest relative L2 error of the field for random sources; complex64 reaches 1e-6 at best.

    The other arguments are those of :class:`LayerHologram`.

    Raises:
        TypeError, ValueError: Invalid arguments; in a call: layers that are not complex [..., D, h, w], or so wide
            that "full" is not allowed.

    Warns:
        SamplingWarning: In a call, if the predicted error exceeds the tolerance.

    Source: Sec. 5.3.2 of the thesis for the sum; Weyl's expansion, see ``holotorch.hologram.band_limited``.
    """

    def __init__(
        self,
        grid: Grid,
        wavelength: float,
        depths: Sequence[float],
        *,
        cone: Cone = "taper",
        stride: int = 1,
        tolerance: float = 1e-3,
    ):
        super().__init__(grid, wavelength, depths, cone=cone, stride=stride)
        if cone in ("box", "disc"):
            raise ValueError(f"AxialHologram works in frequency, with cone='taper', 'band' or 'full', got {cone!r}")
        if min(grid.pitch) < FINEST * self.wavelength:
            raise ValueError(
                f"AxialHologram needs a pitch of at least {FINEST} wavelengths, {FINEST * self.wavelength:.3g} m, got "
                f"{min(grid.pitch):g} m: use ConvolutionHologram"
            )
        self.tolerance = checks.positive("tolerance", tolerance)
        self._designs: dict[tuple[int, int], AxialDesign] = {}

    def design(self, shape: tuple[int, int]) -> AxialDesign:
        """Nodes, transform sizes and predicted error for layers of ``shape`` (h, w); computed once per shape."""
        self._keep_design(shape)
        return self._designs[shape]

    def checked_design(self, shape: tuple[int, int]) -> AxialDesign:
        """The design for layers of ``shape`` (h, w); warns if its predicted error exceeds the tolerance."""
        self._keep_design(shape, warn=True)
        return self._designs[shape]

    @constant_when_compiled
    def _keep_design(self, shape: tuple[int, int], *, warn: bool = False) -> None:
        """Have the design for ``shape``; computed when torch.compile traces, which cannot follow NumPy."""
        if shape not in self._designs:
            self._designs[shape] = self._choose_design(shape)
        design = self._designs[shape]
        if warn and not design.adequate:
            warnings.warn(
                f"the hologram's relative error is about {design.predicted_error:.1e}, and its tolerance "
                f"{self.tolerance:.1e}: use ConvolutionHologram, cone='taper' or a larger tolerance",
                checks.SamplingWarning,
                stacklevel=3,
            )

    def _choose_design(self, shape: tuple[int, int]) -> AxialDesign:
        common = self.wavelength, min(self.depths), max(self.depths), self.cone
        axes = y, x = [
            Axis((count - 1) * self.stride + 1, pixels, self.stride, pitch, *common)
            for count, pixels, pitch in zip(shape, self.grid.shape, self.grid.pitch, strict=True)
        ]
        if self.cone == "full" and not all(axis.within_band for axis in axes):
            least = max(axis.displacement * axis.pitch / axis.steepest for axis in axes)
            raise ValueError(
                "cone='full' leaves out no light only where every pixel lies within every source's cone, from "
                f"{least:.3g} m on for layers of {shape}; "
                f"the nearest depth is {min(self.depths):.3g} m: use cone='taper' or ConvolutionHologram"
            )
        # The error of each axis may be 0.4 of the tolerance, that of the nodes 0.3. They add in quadrature.
        (height, error_y), (width, error_x) = (choose_length(axis, 0.4 * self.tolerance) for axis in axes)
        steepest = min(y.steepest, y.fade(height)[1]), min(x.steepest, x.fade(width)[1])
        low, high = axial_range(self.wavelength, steepest)
        nodes = choose_nodes(self.depths, low, high, 0.3 * self.tolerance)
        error = math.hypot(error_y, error_x, nodes.error(low, high))
        raster = Raster(self.grid, shape, self.stride, (height, width))
        begins, weights = nodes.weights(self.depths)
        spread = tuple(begins), tuple(map(tuple, weights.tolist()))
        return AxialDesign((y, x), nodes, *spread, raster, error, error <= self.tolerance)

    def accumulate(self, planes: Iterable[Tensor], phase: Tensor | None = None) -> Tensor:
        """Field [H, W] of planes [h, w], real or complex, given in the order of ``depths``.

        The planes are read one after another and not all kept in memory. ``phase`` in rad, [h, w], is added to the
        phase of every plane. ValueError if there is no plane, or if the depths neither rise nor fall throughout.
        """
        total = None
        for j, plane in enumerate(planes):
            total = total or self.accumulator((plane.shape[-2], plane.shape[-1]), phase)
            total.add(j, plane)
        if total is None:
            raise ValueError("there are no planes")
        return total.finish()

    def accumulator(self, shape: tuple[int, int], phase: Tensor | None = None) -> "Accumulator":
        """Running sum over planes of ``shape`` (h, w); ``phase`` in rad, [h, w], is added to the phase of each."""
        return Accumulator(self, shape, phase)

    def _forward(self, layers: Tensor) -> Tensor:
        order = sorted(range(len(self.depths)), key=self.depths.__getitem__)
        fields = layers.new_zeros(len(layers), *self.grid.shape)
        for item, field in zip(layers, fields, strict=True):
            total = self.accumulator((item.shape[-2], item.shape[-1]))
            for j in order:
                total.add(j, item[j])
            field.copy_(total.finish())
        return fields

    def _adjoint(self, field: Tensor, shape: tuple[int, int]) -> Tensor:
        design = self.checked_design(shape)
        nodes, raster = design.nodes, design.raster
        out = field.new_zeros(len(field), len(self.depths), *shape)
        begins, weights = design.begins, design.weights
        back = design.step(-1, field)
        for item, layers in zip(field, out, strict=True):
            spectrum = multiply_even(raster.spectrum_of_pixels(item), design.last(0, field).conj())
            for m in range(nodes.count):
                planes = [j for j, start in enumerate(begins) if start <= m < start + nodes.width]
                layer = raster.layer(spectrum) if planes else spectrum
                for j in planes:
                    layers[j] += layer * weights[j][m - begins[j]].conjugate()
                spectrum *= back
        return out


class Accumulator:
    """Running sum of an :class:`AxialHologram` over planes that are added in order of rising or falling depth.

    A node is open between the first and the last plane that contribute to it. The open nodes share one array, in which
    node m is row m modulo the number of rows. One matrix product adds a group of planes to all open nodes in place.
    """

    def __init__(self, operator: AxialHologram, shape: tuple[int, int], phase: Tensor | None = None):
        fixed("phase", phase, "call the hologram with layers [..., D, h, w], which is differentiable")
        self.operator, self.design = operator, operator.checked_design(shape)
        self.phasor = None if phase is None else phasor(phase)
        self.nodes = self.design.nodes
        self.begins, self.weights = self.design.begins, self.design.weights
        # A plane contributes to ``width`` nodes. Additional rows allow groups of planes that are far apart.
        spare = round(_GROUP / 2 * self.nodes.count / len(operator.depths))
        self.rows = self.nodes.width + min(spare, self.nodes.width)
        self.last_depth: float | None = None
        self.rising: bool | None = None
        self.pending: list[tuple[int, Tensor]] = []
        self.open: set[int] = set()
        self.block: Tensor | None = None  # [h, rows, w] complex, or [h, 2 rows, w] while all planes are real
        # Sum of the spectra of all closed nodes, [N_y, N_x], propagated to the depth of the node ``total_node``.
        self.total: Tensor | None = None
        self.total_node = 0
        self.step: Tensor | None = None

    def add(self, j: int, plane: Tensor) -> None:
        """Add the plane at ``depths[j]``, real or complex [h, w]; a plane of zeros is skipped."""
        depth = self.operator.depths[j]
        if self.last_depth is not None and depth != self.last_depth:
            rising = depth > self.last_depth
            if self.rising not in (None, rising):
                raise ValueError("planes that arrive one by one must come in rising or falling depth")
            self.rising = rising
        self.last_depth = depth
        fixed("plane", plane, "call the hologram with layers [..., D, h, w], which is differentiable")
        plane = plane.detach().to(torch.promote_types(plane.dtype, torch.float32))
        if not has_light(plane):
            return
        if self.nodes.width == 1:
            self._add_node(self.begins[j], plane * self.weights[j][0])
            return
        if self.pending:
            first, first_plane = self.pending[0]
            span = abs(self.begins[j] - self.begins[first])
            same_dtype = plane.dtype == first_plane.dtype
            if len(self.pending) == _GROUP or span > self.rows - self.nodes.width or not same_dtype:
                self._spread()
        self.pending.append((j, plane))

    def finish(self) -> Tensor:
        """The field [H, W]; zeros if no plane emits light."""
        self._spread()
        self._close(self.open)
        if self.total is None:
            return torch.zeros(self.operator.grid.shape, dtype=torch.complex64)
        self.step = self.block = None  # frees memory for the transform
        last = self.design.last(self.total_node, self.total)
        return self.design.raster.pixels(multiply_even(self.total, last))

    def _spread(self) -> None:
        """Add the pending planes to the nodes around them."""
        if not self.pending:
            return
        order, planes = [j for j, _ in self.pending], _stacked([plane for _, plane in self.pending])
        self.pending = []
        begins = [self.begins[j] for j in order]
        touched = {*range(min(begins), max(begins) + self.nodes.width)}
        self._close(self.open - touched)
        self.open |= touched
        matrix = [[0j] * len(order) for _ in range(self.rows)]
        for column, (j, start) in enumerate(zip(order, begins, strict=True)):
            for k, weight in enumerate(self.weights[j]):
                matrix[(start + k) % self.rows][column] = weight
        spread = torch.tensor(matrix, dtype=torch.complex128)
        height, _, width = planes.shape
        if self.block is None:
            count = self.rows if planes.is_complex() else 2 * self.rows
            self.block = planes.new_zeros((height, count, width))
        elif planes.is_complex() and not self.block.is_complex():
            self.block = torch.complex(self.block[:, ::2], self.block[:, 1::2])
        if not self.block.is_complex():
            # Rows of the block hold real and imaginary parts of the nodes alternately, since the planes are real.
            spread = torch.view_as_real(spread).movedim(-1, 1).flatten(0, 1)
        # One product per image row: for a single large product torch would first copy the planes into another order.
        self.block.baddbmm_(
            spread.to(self.block, non_blocking=True).expand(height, -1, -1), planes.to(self.block.dtype)
        )

    def _close(self, nodes: set[int]) -> None:
        """Add ``nodes``, to which no later plane contributes, to the total, and clear their rows of the block."""
        for index in sorted(nodes, reverse=self.rising is False):
            assert self.block is not None
            k = index % self.rows
            row = self.block[:, k] if self.block.is_complex() else self.block[:, 2 * k : 2 * k + 2]
            self._add_node(index, row.clone() if row.is_complex() else torch.complex(row[:, 0], row[:, 1]))
            row.zero_()
        self.open = self.open - nodes

    def _add_node(self, index: int, node: Tensor) -> None:
        """One step of Horner's rule: propagate the total to node ``index`` and add the spectrum of that node."""
        if self.phasor is not None:
            node *= self.phasor
        raster = self.design.raster
        period = raster.spectrum(node)
        if self.total is None:
            self.total = period.repeat(raster.stride, raster.stride)
        else:
            # The phase grows with depth as exp(2 pi i z w), so relative to a deeper node the total has a smaller phase.
            direction = 1 if index > self.total_node else -1
            if self.step is None:
                self.step = self.design.step(-direction, node)
            for _ in range(abs(index - self.total_node) - 1):
                self.total *= self.step
            total = raster.tiles(self.total)
            torch.addcmul(period[:, None, :], total, raster.tiles(self.step), out=total)
        self.total_node = index


def _stacked(planes: list[Tensor]) -> Tensor:
    """J planes [h, w] as one tensor [h, J, w]; a view if the planes follow one another in memory."""
    first = planes[0]
    if not checks.readable(*planes):  # nor have they addresses
        return torch.stack(planes, 1)
    start, memory = first.data_ptr(), first.untyped_storage().data_ptr()
    for k, plane in enumerate(planes):
        adjacent = plane.untyped_storage().data_ptr() == memory and plane.data_ptr() == start + k * first.nbytes
        if not (adjacent and plane.is_contiguous()):
            return torch.stack(planes, 1)
    return first.as_strided((len(first), len(planes), first.shape[1]), (first.shape[1], first.numel(), 1))
