"""Image quality and speckle metrics; float16 and bfloat16 images are converted to float32."""

from holotorch.metrics.quality import SSIM_WINDOW, PerceptualSimilarity, psnr, ssim, ssim_map
from holotorch.metrics.seeds import seed_statistics, squared_blur, squared_error
from holotorch.metrics.speckle import anisotropy, dark_spots, grain_size, power_spectrum, sharpness, speckle_contrast

__all__ = [
    "SSIM_WINDOW",
    "PerceptualSimilarity",
    "anisotropy",
    "dark_spots",
    "grain_size",
    "power_spectrum",
    "psnr",
    "seed_statistics",
    "sharpness",
    "speckle_contrast",
    "squared_blur",
    "squared_error",
    "ssim",
    "ssim_map",
]
