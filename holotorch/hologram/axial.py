"""AxialHologram: many planes with few Fourier transforms, by interpolation onto nodes along the optical axis."""

import math
import warnings
from collections.abc import Iterable, Sequence

import numpy as np
import torch
from torch import Tensor

from holotorch.core import checks
from holotorch.core.complex import phasor
from holotorch.core.fourier import multiply_even
from holotorch.core.grid import Grid
from holotorch.hologram.cone import Cone
from holotorch.hologram.layered import LayerHologram
from holotorch.hologram.nodes import axial_range, choose_nodes
from holotorch.hologram.padding import Axis, choose_length
from holotorch.hologram.raster import Raster, has_light
from holotorch.hologram.transfer import AxialDesign, TransferFactors
from holotorch.optics.free_space.padding import FINEST

_GROUP = 16  # number of planes spread onto the nodes by one matrix product


class AxialHologram(LayerHologram):
    """Sum over planes of band-limited spherical waves exp(i k r) / r, with one small transform per node, not per plane.

    Planes are spread onto evenly spaced nodes along the axis (:class:`Nodes`). Each node needs one FFT at the
    resolution of the sources. The spectra are summed by Horner's rule: the partial sum is multiplied by the same
    factor from each node to the next. Finally the sum is multiplied by the spectrum of the spherical wave and
    transformed back. If the planes are evenly spaced and need no more FFTs than nodes would, they serve as nodes.

    Args:
        grid: Pixels of the hologram.
        wavelength: In metres.
        depths: Distances of the planes from the hologram in metres, above 0; any order and spacing.
        cone: "taper", "band" or "full", see ``holotorch.hologram.cone``. "full" is allowed only if every pixel lies
            within the cone of every source, since steeper light is left out.
        stride: Distance between neighbouring sources of a plane in pixels.
        tolerance: Largest relative L2 error for layers of random noise; complex64 reaches 1e-6 at best.

    Raises:
        TypeError, ValueError: Invalid arguments; in a call: layers that are not complex [..., D, h, w], or so wide
            that "full" is not allowed.

    Warns:
        SamplingWarning: In a call, if the predicted error exceeds the tolerance.

    Source: Sec. 5.3.2 of the thesis for the sum; Weyl's expansion exp(ikr)/r = i int exp(2 pi i (f x + z w)) / w df.
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
        super().__init__(grid, wavelength, depths, cone, stride)
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
        """Nodes and transform sizes for layers of ``shape`` (h, w)."""
        if shape not in self._designs:
            axes = self._axes(shape)
            if self.cone == "full" and not all(axis.within_band for axis in axes):
                raise ValueError(
                    f"cone='full' leaves out no light only where every pixel lies within every source's cone, from "
                    f"{max(axis.apart * axis.pitch / axis.steepest for axis in axes):.3g} m on for layers of {shape}; "
                    f"the nearest depth is {min(self.depths):.3g} m: use cone='taper' or ConvolutionHologram"
                )
            (height, ey), (width, ex) = (choose_length(axis, 0.4 * self.tolerance) for axis in axes)
            steepest = axes[0].fade(height)[1], axes[1].fade(width)[1]
            low, high = axial_range(self.grid, self.wavelength, steepest)
            nodes = choose_nodes(self.depths, low, high, 0.3 * self.tolerance)
            error = math.hypot(ey, ex, nodes.error(low, high))
            self._designs[shape] = AxialDesign(nodes, (height, width), error, error <= self.tolerance)
        return self._designs[shape]

    def transfer_factors(self, shape: tuple[int, int], dtype: torch.dtype, device: torch.device) -> TransferFactors:
        """Transfer factors for layers of ``shape`` (h, w); warns if the predicted error exceeds the tolerance."""
        design = self.design(shape)
        if not design.adequate:
            warnings.warn(
                f"the hologram's relative error is about {design.predicted_error:.1e}, and its tolerance "
                f"{self.tolerance:.1e}: use ConvolutionHologram, cone='taper' or a larger tolerance",
                checks.SamplingWarning,
                stacklevel=2,
            )
        raster = Raster(self.grid, shape, self.stride, design.size)
        return TransferFactors(self.grid, self.wavelength, design, self._axes(shape), raster, dtype, device)

    def _axes(self, shape: tuple[int, int]) -> tuple[Axis, Axis]:
        near, far = min(self.depths), max(self.depths)
        y, x = (
            Axis((count - 1) * self.stride + 1, pixels, self.stride, pitch, self.wavelength, near, far, self.cone)
            for count, pixels, pitch in zip(shape, self.grid.shape, self.grid.pitch, strict=True)
        )
        return y, x

    def accumulate(self, planes: Iterable[Tensor], phase: Tensor | None = None) -> Tensor:
        """Field [H, W] of planes [h, w], real or complex, in the order of ``depths``, which must rise or fall.

        The planes are read one after another and not all kept in memory. ``phase`` [h, w] in rad is common to all
        planes; it is applied once per node.
        """
        if isinstance(planes, Tensor) and len(planes):
            total = self.accumulator((planes.shape[-2], planes.shape[-1]), phase)
            total.add_stack(planes)
            return total.finish()
        total = None
        for j, plane in enumerate(planes):
            total = total or self.accumulator((plane.shape[-2], plane.shape[-1]), phase)
            total.add(j, plane)
        if total is None:
            raise ValueError("there are no planes")
        return total.finish()

    def accumulator(self, shape: tuple[int, int], phase: Tensor | None = None) -> "Accumulator":
        """Running sum to which planes are added one by one; see :meth:`accumulate`."""
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
        factors = self.transfer_factors(shape, field.dtype, field.device)
        nodes, raster = factors.design.nodes, factors.raster
        out = field.new_zeros(len(field), len(self.depths), *shape)
        begins, weights = nodes.weights(self.depths)
        back = factors.step(-1)
        for item, layers in zip(field, out, strict=True):
            spectrum = multiply_even(raster.spectrum_of_pixels(item), factors.last(0).conj())
            for m in range(nodes.count):
                near = [j for j, begin in enumerate(begins) if begin <= m < begin + nodes.width]
                layer = raster.layer(spectrum) if near else spectrum
                for j in near:
                    layers[j] += layer * complex(weights[j, m - begins[j]].conj())
                spectrum *= back
        return out


class Accumulator:
    """Running sum of an :class:`AxialHologram` over planes that are added in rising or falling depth.

    A node is open while planes that contribute to it may still be added. The open nodes share one block of memory, node
    m in row m modulo the number of rows, so that a group of planes is added in place by one matrix product.
    """

    def __init__(self, operator: AxialHologram, shape: tuple[int, int], phase: Tensor | None = None):
        self.operator, self.shape = operator, shape
        self.phasor = None if phase is None else phasor(phase)
        self.nodes = operator.design(shape).nodes
        self.begins, self.weights = self.nodes.weights(operator.depths)
        # Additional rows beyond the width of the window, so that a group holds several planes even if they are sparse.
        spare = round(_GROUP / 2 * self.nodes.count / len(operator.depths))
        self.rows = self.nodes.width + min(spare, self.nodes.width)
        self.factors: TransferFactors | None = None
        self.total: Tensor | None = None
        self.step: Tensor | None = None
        self.at = 0
        self.before: float | None = None
        self.rising: bool | None = None
        self.pending: list[tuple[int, Tensor]] = []
        self.open: set[int] = set()
        self.block: Tensor | None = None  # [h, rows, w] complex, or [h, 2 rows, w] while all planes are real

    def add(self, j: int, plane: Tensor) -> None:
        """Add the plane at ``depths[j]``, real or complex [h, w]; a plane of zeros is skipped."""
        depth = self.operator.depths[j]
        if self.before is not None and depth != self.before:
            rising = depth > self.before
            if self.rising not in (None, rising):
                raise ValueError("planes that arrive one by one must come in rising or falling depth")
            self.rising = rising
        self.before = depth
        if plane.stride() == (0, 0) and not plane[0, 0]:
            return  # a single expanded zero, which renderers yield for an empty plane
        plane = plane.detach()
        if self.nodes.width == 1:
            if has_light(plane):
                self._add_node(self.begins[j], plane * complex(self.weights[j, 0]))
            return
        if self.pending:
            span = abs(self.begins[j] - self.begins[self.pending[0][0]])
            same_dtype = plane.dtype == self.pending[0][1].dtype
            if len(self.pending) == _GROUP or span > self.rows - self.nodes.width or not same_dtype:
                self._spread()
        self.pending.append((j, plane))

    def finish(self) -> Tensor:
        """The field [H, W]; zeros if no plane emits light."""
        self._spread()
        self._close(self.open)
        if self.total is None or self.factors is None:
            return torch.zeros(self.operator.grid.shape, dtype=torch.complex64)
        self.step = self.block = None  # frees memory for the transform
        return self.factors.raster.pixels(multiply_even(self.total, self.factors.last(self.at)))

    def _spread(self) -> None:
        """Add the pending planes to the nodes around them."""
        planes, self.pending = self.pending, []
        if planes:
            self._gather(_side_by_side([plane for _, plane in planes]), [j for j, _ in planes])

    def add_stack(self, planes: Tensor) -> None:
        """Add all planes [D, h, w], plane j at ``depths[j]``; the depths must rise or fall."""
        steps = np.diff(self.operator.depths)
        if self.nodes.width == 1 or not planes.is_contiguous() or not ((steps > 0).all() or (steps < 0).all()):
            for j, plane in enumerate(planes):
                self.add(j, plane)
            return
        self.rising = bool(steps[0] > 0) if len(steps) else None
        flat, start, spare = planes.detach().flatten(1), 0, self.rows - self.nodes.width
        while start < len(flat):
            end = start + 1
            while end < len(flat) and abs(self.begins[end] - self.begins[start]) <= spare:
                end += 1
            # Planes that contribute to the same nodes are divided into groups of about equal size.
            end = start + math.ceil((end - start) / math.ceil((end - start) / _GROUP))
            self._gather(flat[start:end], list(range(start, end)))
            start = end

    def _gather(self, stack: Tensor, order: list[int]) -> None:
        """Add planes [J, h w]; ``order`` holds their indices into the depths."""
        if not has_light(stack):
            return
        begins = np.asarray([self.begins[j] for j in order])
        touched = {*range(begins.min(), begins.max() + self.nodes.width)}
        self._close(self.open - touched)
        self.open |= touched
        spread = np.zeros((self.rows, len(order)), np.complex128)
        slots = (begins + np.arange(self.nodes.width)[:, None]) % self.rows
        spread[slots, np.arange(len(order))] = self.weights[order].T
        matrix = torch.from_numpy(spread)
        dtype = torch.promote_types(stack.dtype, torch.complex64)
        height, width = self.shape
        if self.block is None:
            rows = self.rows if stack.is_complex() else 2 * self.rows
            block = stack.new_zeros((height, rows, width), dtype=dtype if stack.is_complex() else dtype.to_real())
            self.block = block
        elif stack.is_complex() and not self.block.is_complex():
            self.block = torch.complex(self.block[:, ::2], self.block[:, 1::2])
        if not self.block.is_complex():
            # Real planes: rows hold real and imaginary parts alternately.
            matrix = torch.view_as_real(matrix).movedim(-1, 1).flatten(0, 1)
        # A batch of products, one per picture row, takes a third less time than one product for the whole picture,
        # which would first be copied into another memory order.
        lines = stack.to(self.block.dtype).view(len(order), height, width).transpose(0, 1)
        self.block.baddbmm_(matrix.to(self.block).expand(height, -1, -1), lines)

    def _close(self, nodes: set[int]) -> None:
        """Add ``nodes``, to which no later plane contributes, to the sum and free their rows."""
        for index in sorted(nodes, reverse=self.rising is False):
            assert self.block is not None
            k = index % self.rows
            row = self.block[:, k] if self.block.is_complex() else self.block[:, 2 * k : 2 * k + 2]
            self._add_node(index, row.clone() if row.is_complex() else torch.complex(row[:, 0], row[:, 1]))
            row.zero_()
        self.open = self.open - nodes

    def _add_node(self, index: int, node: Tensor) -> None:
        """Apply Horner's rule: propagate the sum to node ``index`` and add the spectrum of the node."""
        node = node.reshape(self.shape)
        if self.phasor is not None:
            node *= self.phasor
        if self.factors is None:
            self.factors = self.operator.transfer_factors(self.shape, node.dtype, node.device)
        raster = self.factors.raster
        period = raster.spectrum(node)
        if self.total is None:
            self.total = raster.repeated(period)
        else:
            # The phase at a deeper node is advanced, so the sum so far is retarded relative to it.
            forward = 1 if index > self.at else -1
            if self.step is None:
                self.step = self.factors.step(-forward)
            for _ in range(abs(index - self.at) - 1):
                self.total *= self.step
            total = raster.tiles(self.total)
            torch.addcmul(period[:, None, :], total, raster.tiles(self.step), out=total)
        self.at = index


def _side_by_side(planes: list[Tensor]) -> Tensor:
    """Planes [h, w] as [J, h w]; a view if they are adjacent in memory, like the slices of one tensor."""
    first = planes[0]
    size, store = first.numel(), first.untyped_storage().data_ptr()
    begin, step = first.data_ptr(), size * first.element_size()
    if all(
        plane.is_contiguous() and plane.untyped_storage().data_ptr() == store and plane.data_ptr() == begin + k * step
        for k, plane in enumerate(planes)
    ):
        return first.as_strided((len(planes), size), (size, 1))
    return torch.stack([plane.reshape(-1) for plane in planes])
