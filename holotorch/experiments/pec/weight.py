"""Weights of the squared error by eccentricity, and scores of a picture by zone of the visual field."""

import math
from typing import Any

import torch
from torch import Tensor

from holotorch.experiments.pec.config import PeripheralWeightSettings
from holotorch.metrics import SSIM_WINDOW, ssim_map
from holotorch.perception import Headset, LinearMagnification, peripheral_weight, separation

# Limits in degrees of eccentricity of central vision and of the near, middle and far periphery (thesis Sec. 2.1).
ZONES = {"central": (0, 8), "near": (8, 30), "middle": (30, 60), "far": (60, 180)}


def eccentricities(settings: PeripheralWeightSettings, shape: tuple[int, int]) -> Tensor:
    """Angle in degrees between each pixel of a picture (H, W) and the gaze, float64 [H, W]."""
    display = Headset(shape, shape[1] / settings.field_deg)
    y, x = (torch.arange(side, dtype=torch.float64) for side in shape)
    return separation(*display.angles(y[:, None], x), *settings.gaze_deg)


def weight_map(settings: PeripheralWeightSettings, shape: tuple[int, int]) -> Tensor:
    """Weights of the squared errors, mean 1, float64 [H, W]."""
    law = LinearMagnification(1.0, settings.e2_deg)
    return peripheral_weight(eccentricities(settings, shape), law, least=settings.least)


def zone_scores(
    settings: PeripheralWeightSettings, picture: Tensor, image: Tensor, lit: Tensor
) -> list[dict[str, Any]]:
    """PSNR and SSIM of a picture against ``image``, both [C, H, W] in 0 .. 1, one row for each of ``ZONES``.

    Only the colours in the mask ``lit`` [C] count. The PSNR of a zone is that of its pixels. The SSIM is the mean over
    the windows centred in the zone, or None without such a window. ``error`` is the share of the zone in the total
    squared error. Zones without pixels are left out.
    """
    picture, image = picture[lit].clamp(0, 1), image[lit]
    angles, edge = eccentricities(settings, (image.shape[-2], image.shape[-1])), SSIM_WINDOW // 2
    square = (picture - image).double().square().mean(0)
    centres = angles[edge:-edge, edge:-edge]  # eccentricities of the centres of the SSIM windows
    has_windows = min(angles.shape) >= SSIM_WINDOW
    windows = ssim_map(picture, image, data_range=1.0).mean(0) if has_windows else torch.zeros_like(centres)
    rows: list[dict[str, Any]] = []
    for name, (low, high) in ZONES.items():
        inside = (angles >= low) & (angles < high)
        if not inside.any():
            continue
        error = square[inside].mean().item()
        similar = windows[(centres >= low) & (centres < high)]
        rows.append(
            {
                "zone": name,
                "from_deg": low,
                "to_deg": high,
                "pixels": int(inside.sum()),
                "psnr": -10 * math.log10(error) if error > 0 else None,
                "ssim": similar.mean().item() if similar.numel() else None,
                "error": (square[inside].sum() / square.sum().clamp(min=1e-300)).item(),
            }
        )
    return rows
