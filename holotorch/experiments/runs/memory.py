"""Memory that this process has used, and whether a run fits into the free memory."""

from __future__ import annotations

import re
import resource
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from holotorch.core.memory import available_memory

if TYPE_CHECKING:
    import torch


def peak_memory(device: torch.device | None = None) -> int:
    """Largest resident size of this process so far, in bytes; for a GPU, the memory there of all tensors at most."""
    if device is not None and device.type == "cuda":
        import torch

        return torch.cuda.max_memory_allocated(device)
    status = Path("/proc/self/status")
    # getrusage is not used on Linux, since there it also counts the program that started this process.
    if status.is_file() and (match := re.search(r"VmHWM:\s+(\d+) kB", status.read_text())):
        return int(match[1]) * 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)


def shortage(values: dict[str, Any]) -> str | None:
    """A message if the planned run does not fit into the free memory, otherwise None."""
    needed, free = values["predicted_peak_bytes"], available_memory()
    if free is None or needed <= free:
        return None
    return f"the run needs about {needed / 1e9:.1f} GB and {free / 1e9:.1f} GB are free; use a smaller grid"
