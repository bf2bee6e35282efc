"""The device of a run, and what is needed to repeat the run. torch is loaded only by functions that need it."""

from __future__ import annotations

import datetime
import os
import platform
import subprocess
import sys
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any

import holotorch
from holotorch.experiments.config.errors import ConfigError

if TYPE_CHECKING:
    import torch

_PACKAGES = ("torch", "numpy", "kornia", "scikit-image", "opencv-contrib-python-headless")


def environment(seed: int, device: torch.device) -> dict[str, Any]:
    """Contents of env.json, as plain JSON values."""
    return {
        "holotorch": holotorch.__version__,
        "git": _git_state(Path(holotorch.__file__).parents[1]),
        "python": platform.python_version(),
        "packages": {name: installed_version(name) for name in _PACKAGES},
        "platform": platform.platform(),
        "device": device_name(device),
        "seed": seed,
        "started": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "command": ["holotorch", *sys.argv[1:]],
        "folder": os.getcwd(),  # to which relative paths in config.yaml refer
    }


def device_name(device: torch.device) -> str:
    """Name of a GPU, or the number of threads on the processor."""
    import torch

    if device.type == "cuda":
        return torch.cuda.get_device_name(device)
    count = torch.get_num_threads()
    return f"CPU, {count} thread{'s' * (count > 1)}"


def installed_version(name: str) -> str | None:
    """Version of an installed package, or None."""
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return None


def find_device(name: str) -> torch.device:
    """The device for a setting "auto", "cpu" or "cuda". ConfigError if there is no CUDA device for "cuda".

    Each process that ``torchrun`` starts on a machine uses a GPU of its own, as far as there are enough.
    """
    import torch

    available = torch.cuda.is_available()
    if name == "cuda" and not available:
        raise ConfigError(["device: cuda was asked for, but torch finds no CUDA device; use device: auto or cpu"])
    if name == "cpu" or not available:
        return torch.device("cpu")
    if local_rank := os.environ.get("LOCAL_RANK"):
        torch.cuda.set_device(int(local_rank) % torch.cuda.device_count())
    return torch.device("cuda")


def _git_state(checkout: Path) -> str | None:
    """Commit of this checkout, with "-dirty" if files have changed; None for an installed package."""
    if not (checkout / ".git").exists():
        return None
    command = ["git", "-C", str(checkout), "describe", "--always", "--dirty", "--abbrev=12"]
    try:
        return subprocess.run(command, capture_output=True, text=True, timeout=5).stdout.strip() or None
    except (OSError, subprocess.TimeoutExpired):
        return None
