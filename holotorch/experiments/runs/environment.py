"""Versions, device, seed and git state, which are needed to repeat a run."""

import datetime
import platform
import subprocess
import sys
from pathlib import Path
from typing import Any

import torch

import holotorch
from holotorch.experiments.doctor import installed_version

_PACKAGES = ("torch", "numpy", "kornia", "scikit-image", "opencv-contrib-python-headless")


def environment(seed: int, device: torch.device) -> dict[str, Any]:
    """Contents of env.json, as plain JSON values."""
    cpu = f"CPU, {torch.get_num_threads()} threads"
    return {
        "holotorch": holotorch.__version__,
        "git": _git_state(Path(holotorch.__file__).parents[1]),
        "python": platform.python_version(),
        "packages": {name: installed_version(name) for name in _PACKAGES},
        "platform": platform.platform(),
        "device": torch.cuda.get_device_name(device) if device.type == "cuda" else cpu,
        "seed": seed,
        "started": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "command": ["holotorch", *sys.argv[1:]],
    }


def _git_state(checkout: Path) -> str | None:
    """Commit of this checkout, with "-dirty" if files have changed; None for an installed package."""
    if not (checkout / ".git").exists():
        return None
    command = ["git", "-C", str(checkout), "describe", "--always", "--dirty", "--abbrev=12"]
    try:
        return subprocess.run(command, capture_output=True, text=True, timeout=5).stdout.strip() or None
    except (OSError, subprocess.TimeoutExpired):
        return None
