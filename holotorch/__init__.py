"""Differentiable optics for VR and AR displays, in PyTorch.

Units: metres, radians, seconds, kelvin differences. A field is a complex tensor ``[..., C, H, W]`` with one channel
per wavelength; axes are (y, x); the optical axis lies on sample ``n // 2``; frequencies stay in FFT order.
``exp(+ikz)`` travels towards +z, a converging lens is ``exp(-i k r^2 / 2f)``, the far field is the unitary DFT.

Importing this package opens no file and sets no global; ``torch`` itself is imported when a name is first used.
"""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from holotorch.core.grid import Grid

__version__ = "0.1.0"
__all__ = ["Grid", "__version__"]


def __getattr__(name: str) -> object:
    if name == "Grid":
        from holotorch.core.grid import Grid

        return Grid
    raise AttributeError(f"module 'holotorch' has no attribute {name!r}")
