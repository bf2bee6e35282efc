"""OpticalPath: a sequence of elements and propagations."""

from collections.abc import Sequence

from torch import Tensor, nn

from holotorch.core.grid import Grid
from holotorch.optics.free_space.propagators import Fraunhofer


class OpticalPath(nn.Sequential):
    """Linear operators applied one after the other: propagators, lenses, apertures, and other paths.

    Args:
        elements: In the order in which light meets them. Each has ``grid`` and ``wavelengths``, ``out_grid`` if its
            result is sampled differently, and ``adjoint``.

    Attributes:
        grid: Sampling of the field that enters.
        out_grid: Sampling of the field that leaves.
        wavelengths: In metres, one per channel.

    Raises:
        TypeError: An element that is not such an operator.
        ValueError: No element at all, or neighbours that disagree in sampling or wavelengths; the message names them.
    """

    def __init__(self, elements: Sequence[nn.Module]):
        elements = list(elements)
        if not elements:
            raise ValueError("an optical path needs at least one element, got none")
        for i, element in enumerate(elements):
            missing = [name for name in ("grid", "wavelengths", "adjoint") if not hasattr(element, name)]
            if not isinstance(element, nn.Module) or missing:
                lack = f" without {' and '.join(missing)}" if missing else ""
                raise TypeError(
                    f"element {i} of an optical path must be a propagator, lens or aperture, got "
                    f"{type(element).__name__}{lack}"
                )
        for i, (one, two) in enumerate(zip(elements[:-1], elements[1:], strict=True)):
            pair = f"elements {i} ({type(one).__name__}) and {i + 1} ({type(two).__name__}) of an optical path"
            if isinstance(one, Fraunhofer):
                raise ValueError(f"{pair}: the far field consists of directions, so nothing can follow it")
            if _out_grid(one) != two.grid:
                raise ValueError(f"{pair} must share their sampling, got {_out_grid(one)} and then {two.grid}")
            if one.wavelengths != two.wavelengths:
                raise ValueError(f"{pair} must share wavelengths, got {one.wavelengths} and then {two.wavelengths}")
        super().__init__(*elements)
        self.grid, self.out_grid, self.wavelengths = elements[0].grid, _out_grid(elements[-1]), elements[0].wavelengths

    def adjoint(self, field: Tensor) -> Tensor:
        """Apply the conjugate transposes of the elements in reverse order."""
        for element in reversed(list(self)):
            field = element.adjoint(field)  # type: ignore[operator]
        return field


def _out_grid(element: nn.Module) -> Grid:
    grid = getattr(element, "out_grid", None)
    return grid if isinstance(grid, Grid) else element.grid  # type: ignore[return-value]
