"""SpectralRetina: the image on the retina under light of a spectrum for each channel, as a module to train through."""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from holotorch.core import checks
from holotorch.core.complex import intensity
from holotorch.core.grid import Grid
from holotorch.optics.light.incoherent import incoherent_sum
from holotorch.optics.light.spectral import derived_margin, neighbours
from holotorch.optics.light.wavelength_sampling import select_wavelengths
from holotorch.optics.viewing.display import Display
from holotorch.optics.viewing.eye import Eye
from holotorch.optics.viewing.retina import Retina


class SpectralRetina(nn.Module):
    """Intensity on the retina, real [..., C, H, W], of fields [..., C, H, W] under light of a spectrum per channel.

    The module form of :func:`spectral_image`, with the same method, for many fields: all wavelengths of a channel are
    modulated alike, few of them are propagated by a :class:`Retina`, and the others are derived (:func:`neighbours`).
    The image has the samples of ``grid`` and the scale of ``Retina``.

    Args:
        grid: Sampling of the hologram.
        spectra: Wavelengths [K] in metres, increasing, and weights [K] for each channel, as from ``Spectrum.samples``.
            K may differ between channels.
        display: Positions of the hologram, the eyepiece and the eye.
        eye: Pupil, retina and accommodation; the image is that of the plane in focus.
        count: Number of wavelengths to propagate in each channel; ``wavelength_sampling.least_count`` finds it.
        recompute: In training, take a third more time and only the memory of one propagated wavelength of one channel
            of one field, as in :func:`incoherent_sum`.
        options: ``tolerance``, ``paraxial``, ``reach``, ``registered`` and ``memory_limit`` of ``Retina``, for the
            wavelengths that are propagated.

    Raises:
        ValueError: No spectra, wavelengths that do not increase, weights of another number or not positive, a count
            above the number of wavelengths; the errors of ``Retina`` and :func:`neighbours`.
        TypeError, ValueError: In a call: a field that is not complex [..., C, H, W].

    Warns as ``Retina``.
    """

    def __init__(
        self,
        grid: Grid,
        spectra: Sequence[tuple[Sequence[float] | Tensor, Sequence[float] | Tensor]],
        display: Display,
        eye: Eye,
        *,
        count: int = 1,
        recompute: bool = False,
        **options: Any,
    ):
        super().__init__()
        if not spectra:
            raise ValueError("SpectralRetina needs wavelengths and weights for at least one channel, got none")
        self.grid, self.recompute = grid, recompute
        self.spectra = tuple(_checked(*spectrum) for spectrum in spectra)
        # The brightest wavelength of each channel, for tables and comparisons.
        self.wavelengths = tuple(max(zip(weights, lengths, strict=True))[1] for lengths, weights in self.spectra)
        self.chosen = [
            select_wavelengths(torch.tensor(lengths, dtype=torch.float64), torch.tensor(weights), count)
            for lengths, weights in self.spectra
        ]
        channels: list[nn.ModuleList] = []
        self.wide: list[Grid] = []
        for (lengths, _), (nodes, nearest) in zip(self.spectra, self.chosen, strict=True):
            change = max(abs(length - lengths[nodes[owner]]) for length, owner in zip(lengths, nearest, strict=True))
            y, x = derived_margin(grid, change, display, eye)
            self.wide.append(Grid((grid.shape[0] + 2 * y, grid.shape[1] + 2 * x), grid.pitch))
            retinas = (Retina(self.wide[-1], lengths[node], display, eye, **options) for node in nodes)
            channels.append(nn.ModuleList(retinas))
        self.channels = nn.ModuleList(channels)

    def forward(self, field: Tensor) -> Tensor:
        """Intensity on the retina; its sum times the pitches is the power that arrives."""
        checks.field("field", field, (len(self.spectra), *self.grid.shape))
        height, width = self.grid.shape
        pictures = []
        for c, light in enumerate(field.unbind(-3)):
            y, x = ((wide - n) // 2 for wide, n in zip(self.wide[c].shape, self.grid.shape, strict=True))
            padded = functional.pad(light, (x, x, y, y))[..., None, :, :]
            if self.recompute and padded.ndim > 3:  # one by one, since each is computed again on its own
                parts = [self._channel(field, c) for field in padded.flatten(0, -4)]
                total = torch.stack(parts).unflatten(0, padded.shape[:-3])
            else:
                total = self._channel(padded, c)
            pictures.append(total[..., y : y + height, x : x + width])
        return torch.stack(pictures, -3)

    def _channel(self, padded: Tensor, c: int) -> Tensor:
        """Intensity [..., P, Q] of fields [..., 1, P, Q] of channel c."""
        items = [(padded, c, r) for r in range(len(self.chosen[c][0]))]
        return incoherent_sum(self._near, items, [1.0] * len(items), recompute=self.recompute)

    def _near(self, item: tuple[Tensor, int, int]) -> Tensor:
        """Weighted intensity of a propagated wavelength, number r of channel c, and of those derived from it."""
        light, c, r = item
        channel = self.channels[c]
        assert isinstance(channel, nn.ModuleList)
        retina = channel[r]
        assert isinstance(retina, Retina)
        (lengths, weights), (nodes, nearest) = self.spectra[c], self.chosen[c]
        image = retina.field(light)[..., 0, :, :]
        picture = intensity(image) * weights[nodes[r]]
        derived = [k for k, owner in enumerate(nearest) if owner == r and k != nodes[r]]
        if derived:
            setup = [lengths[k] for k in derived], retina.present("display"), retina.present("eye")
            elements = retina.plan.method == "elements"
            near = neighbours(image, self.wide[c], lengths[nodes[r]], *setup, elements=elements)
            for k, other in zip(derived, near, strict=True):
                picture = picture + intensity(other) * weights[k]
        return picture

    def extra_repr(self) -> str:
        """Grid and numbers of wavelengths, for ``print(module)``."""
        return f"grid={self.grid}, wavelengths per channel={[len(lengths) for lengths, _ in self.spectra]}"


def _checked(wavelengths: Sequence[float] | Tensor, weights: Sequence[float] | Tensor) -> tuple[tuple[float, ...], ...]:
    """Wavelengths and weights of a channel as floats."""
    lengths = checks.wavelengths(torch.as_tensor(wavelengths, dtype=torch.float64).tolist())
    shares = tuple(torch.as_tensor(weights, dtype=torch.float64).tolist())
    if len(lengths) != len(shares) or any(b <= a for a, b in zip(lengths, lengths[1:], strict=False)):
        raise ValueError(
            f"wavelengths of a channel must increase, with one weight each, got {len(lengths)} wavelengths and "
            f"{len(shares)} weights"
        )
    if not all(share > 0 for share in shares):
        raise ValueError(f"weights must be above 0; leave out wavelengths without power; got {list(shares)}")
    return lengths, shares
