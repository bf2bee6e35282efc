"""Image quality metrics, one value per image and channel."""

from importlib.util import find_spec
from pathlib import Path

import torch
from torch import Tensor, nn

from holotorch.core import checks
from holotorch.core.precision import at_least_single

SSIM_WINDOW = 11  # side of the square window of ssim, in pixels


def psnr(image: Tensor, reference: Tensor, *, data_range: float) -> Tensor:
    """Peak signal-to-noise ratio in dB, [...] for images [..., H, W]; infinite for equal images, with a gradient of 0.

    The peak is ``data_range``, the difference between the largest and smallest possible value; thesis Eq. 4.37 uses the
    maximum of the reference instead. Errors are those of :func:`ssim`, but images of any size are allowed.
    """
    image, reference = _checked_pair(image, reference, data_range)
    error = (image - reference).square().mean((-2, -1))
    ratio = 10 * torch.log10(data_range**2 / torch.where(error == 0, 1.0, error))
    return torch.where(error == 0, torch.inf, ratio)


def ssim(image: Tensor, reference: Tensor, *, data_range: float) -> Tensor:
    """Structural similarity (SSIM), averaged over the image: [...] for images [..., H, W].

    The settings are those of Wang et al. (2004): an 11 x 11 Gaussian window with sigma = 1.5 px, and the constants
    K1 = 0.01 and K2 = 0.03. Only windows that lie inside the image count. SSIM is the product of a luminance term, a
    contrast term and a structure term; thesis Eq. 4.39 prints their sum, which would be 3 for equal images.

    TypeError for images that are not real floating-point tensors; ValueError for unequal shapes, a side below 11 px, or
    a ``data_range`` that is not positive.
    """
    return ssim_map(image, reference, data_range=data_range).mean((-2, -1))


def ssim_map(image: Tensor, reference: Tensor, *, data_range: float) -> Tensor:
    """Structural similarity in each 11 x 11 window inside the image, [..., H - 10, W - 10]; see :func:`ssim`."""
    from kornia.metrics import ssim as kornia_ssim

    image, reference = _checked_pair(image, reference, data_range)
    height, width = image.shape[-2:]
    if min(height, width) < SSIM_WINDOW:
        least = f"{SSIM_WINDOW} x {SSIM_WINDOW} px"
        raise ValueError(f"ssim needs images of at least {least}, got {height} x {width}; psnr has no such limit")
    if not image.numel():  # an empty batch has an empty map
        return image[..., SSIM_WINDOW - 1 :, SSIM_WINDOW - 1 :]
    # A GPU would round the products of float32 convolutions to 11 bits (TF32).
    exact = torch.float64 if image.is_cuda else image.dtype
    images, references = (tensor.reshape(-1, 1, height, width).to(exact) for tensor in (image, reference))
    scores = kornia_ssim(images, references, SSIM_WINDOW, float(data_range), eps=0.0, padding="valid")
    return scores.reshape(*image.shape[:-2], *scores.shape[-2:]).to(image.dtype)


class PerceptualSimilarity(nn.Module):
    """Similarity exp(-d) with the LPIPS distance d between two images, as in thesis Fig. 4.17; 1 for equal images.

    The constructor needs the optional dependency ``lpips`` (ImportError without it). It loads AlexNet's weights, which
    are downloaded to torch's cache if they are not there (OSError if the download fails).

    Source: Zhang et al. (2018).
    """

    def __init__(self):
        super().__init__()
        try:
            from lpips import LPIPS  # pyright: ignore[reportMissingImports]
        except ImportError as error:
            install = "pip install 'holotorch[lpips]'"
            raise ImportError(f"LPIPS is an extra of holotorch; install it with: {install}") from error
        self.distance = LPIPS(net="alex", verbose=False).requires_grad_(False)

    @staticmethod
    def is_there() -> bool:
        """Whether the constructor succeeds without a download."""
        weights = Path(torch.hub.get_dir()) / "checkpoints" / "alexnet-owt-7be5be79.pth"
        return find_spec("lpips") is not None and weights.is_file()

    def forward(self, image: Tensor, reference: Tensor) -> Tensor:
        """Similarity [...] of images [..., C, H, W] with values in [0, 1].

        C is 3 (RGB) or 1 (grey, repeated for R, G and B). ValueError for another C or for unequal shapes.
        """
        _checked_pair(image, reference, 1.0)
        if image.ndim < 3 or image.shape[-3] not in (1, 3):
            raise ValueError(f"images must be [..., C, H, W] with C = 1 (grey) or 3 (RGB), got {tuple(image.shape)}")
        batches = (x.expand(*x.shape[:-3], 3, -1, -1).reshape(-1, 3, *x.shape[-2:]) for x in (image, reference))
        distances = self.distance(*(2 * batch.float() - 1 for batch in batches))
        return torch.exp(-distances).reshape(image.shape[:-3]).to(image.dtype)


def _checked_pair(image: Tensor, reference: Tensor, data_range: float) -> tuple[Tensor, Tensor]:
    checks.real("image", image)
    checks.real("reference", reference)
    checks.positive("data_range", data_range)
    if image.shape != reference.shape or image.ndim < 2:
        shapes = f"{tuple(image.shape)} and {tuple(reference.shape)}"
        raise ValueError(f"images must share a shape [..., H, W], got {shapes}")
    return at_least_single(image), at_least_single(reference)
