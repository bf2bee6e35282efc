"""Available memory, so that an operation that needs more is refused before it allocates any."""

import os
import re
from pathlib import Path

import torch


def available_memory(device: torch.device | str = "cpu") -> int | None:
    """Bytes that can be allocated on ``device`` without swapping, or None if the system does not state it.

    On Linux this is MemAvailable, or what is left of the limit of a container if that is less. Elsewhere it is the
    physical memory of the machine, an upper bound.
    """
    device = torch.device(device)
    if device.type == "cuda":
        cached = torch.cuda.memory_reserved(device) - torch.cuda.memory_allocated(device)
        return torch.cuda.mem_get_info(device)[0] + cached
    if device.type != "cpu":
        return None
    meminfo = Path("/proc/meminfo")
    match = re.search(r"MemAvailable:\s+(\d+) kB", meminfo.read_text()) if meminfo.is_file() else None
    if match:
        return min(int(match[1]) * 1024, _container_limit())
    try:
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, ValueError, OSError):
        return None


def _container_limit(folder: Path = Path("/sys/fs/cgroup")) -> int:
    """Bytes left of the memory limit of this control group (version 2); 2^62 without a limit."""
    try:
        limit, used = (folder / "memory.max").read_text().strip(), (folder / "memory.current").read_text()
        cache = re.search(r"^inactive_file (\d+)", (folder / "memory.stat").read_text(), re.MULTILINE)
        return int(limit) - int(used) + (int(cache[1]) if cache else 0)
    except (OSError, ValueError):  # no control group, or no limit ("max")
        return 1 << 62
