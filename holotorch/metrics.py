"""Image quality, one value per image and channel."""

import torch
from torch import Tensor

from holotorch.core import checks

SSIM_WINDOW = 11


def psnr(image: Tensor, reference: Tensor, *, data_range: float) -> Tensor:
    """Peak signal-to-noise ratio in dB, [...] for images [..., H, W]; infinite for equal images.

    The peak is ``data_range``, not the maximum of the reference as printed in thesis Eq. 4.37. ValueError for unequal
    shapes or a range that is not positive.
    """
    _check_pair(image, reference, data_range)
    error = (image - reference).square().mean((-2, -1))
    return 10 * torch.log10(data_range**2 / error)


def ssim(image: Tensor, reference: Tensor, *, data_range: float) -> Tensor:
    """Structural similarity, mean over the image, [...] for images [..., H, W].

    With the settings of Wang et al. (2004): 11 x 11 Gaussian window of sigma 1.5, K = (0.01, 0.03), border dropped. The
    three terms are multiplied; thesis Eq. 4.39 prints a sum, for which an image would score 3 against itself.

    Raises:
        TypeError: Images that are not real floating-point tensors.
        ValueError: Unequal shapes, a side below 11 px, or a range that is not positive.
    """
    from kornia.metrics import ssim as ssim_map

    _check_pair(image, reference, data_range)
    height, width = image.shape[-2:]
    if min(height, width) < SSIM_WINDOW:
        raise ValueError(
            f"ssim needs images of at least {SSIM_WINDOW} x {SSIM_WINDOW} px, got {height} x {width}; "
            "psnr has no such limit"
        )
    images, references = (tensor.reshape(-1, 1, height, width) for tensor in (image, reference))
    scores = ssim_map(images, references, SSIM_WINDOW, float(data_range), eps=0.0, padding="valid")
    return scores.mean((-3, -2, -1)).reshape(image.shape[:-2])


def _check_pair(image: Tensor, reference: Tensor, data_range: float) -> None:
    checks.real("image", image)
    checks.real("reference", reference)
    checks.positive("data_range", data_range)
    if image.shape != reference.shape or image.ndim < 2:
        shapes = f"{tuple(image.shape)} and {tuple(reference.shape)}"
        raise ValueError(f"images must share a shape [..., H, W], got {shapes}")
