"""Checks of an installation, with the command that repairs what has failed."""

import platform
import re
import socket
import sys
import tempfile
from collections.abc import Callable, Iterator
from importlib import metadata
from pathlib import Path

import numpy as np
from packaging.requirements import Requirement

from holotorch.experiments.runs.environment import installed_version


def diagnose() -> bool:
    """Print the results of all checks and return whether all of them passed."""
    all_passed = True
    for name, check in _CHECKS.items():
        try:
            results = list(check())
        except Exception as error:  # any failure is reported as a failed check
            results = [(False, f"{type(error).__name__}: {error}")]
        for passed, text in results:
            all_passed &= passed
            print(f"{'OK  ' if passed else 'FAIL'}  {name}: {text}")
    return all_passed


def _python() -> Iterator[tuple[bool, str]]:
    fine = sys.version_info >= (3, 11)
    yield fine, f"Python {platform.python_version()}" + ("" if fine else "; install Python 3.11 or newer")


def _packages() -> Iterator[tuple[bool, str]]:
    for line in metadata.requires("holotorch") or []:
        requirement = Requirement(line)
        if requirement.marker and "extra" in str(requirement.marker):
            continue
        version = installed_version(requirement.name)
        if version and requirement.specifier.contains(version, prereleases=True):
            yield True, f"{requirement.name} {version}"
        else:
            yield False, f"{requirement} needed, {version or 'nothing'} found; run: pip install '{requirement}'"


def _devices() -> Iterator[tuple[bool, str]]:
    import torch

    yield True, f"CPU with {torch.get_num_threads()} threads"
    for i in range(torch.cuda.device_count()):
        yield True, f"CUDA {i}: {torch.cuda.get_device_name(i)}"
    if not torch.cuda.is_available():
        yield True, "no CUDA device; everything runs on the CPU"
    from holotorch.experiments.planning.machine import machine_speed, speed_file

    yield True, f"{machine_speed()}; kept in {speed_file()}, delete it to measure anew"


def _opencv() -> Iterator[tuple[bool, str]]:
    package = "opencv-contrib-python-headless"
    names = {dist.metadata["Name"].lower() for dist in metadata.distributions()}
    others = sorted(name for name in names if name.startswith("opencv") and name != package)
    if others:
        repair = f"pip uninstall -y {' '.join(others)} && pip install --force-reinstall --no-deps {package}"
        yield False, f"{', '.join(others)} beside {package} overwrite each other; run: {repair}"
    else:
        yield True, f"{package} alone"


def _fft() -> Iterator[tuple[bool, str]]:
    import torch

    from holotorch.core.fourier import fft2, ifft2

    for size in ((60, 75), (2048, 2048)):
        x = torch.randn(size, dtype=torch.complex64, generator=torch.Generator().manual_seed(0))
        error = (ifft2(fft2(x)) - x).abs().max().item()
        advice = "" if error < 1e-5 else "; run: pip install --force-reinstall torch"
        yield not advice, f"round trip of {size[0]} x {size[1]} samples errs by {error:.1e}{advice}"
    if (torch.fft.ifft2(torch.fft.fft2(x)) - x).abs().max() > 1e-3:
        yield True, "torch.fft.ifft2 itself is wrong at 2048 x 2048 here (pytorch#169670); holotorch avoids it"


def _exr() -> Iterator[tuple[bool, str]]:
    import OpenEXR

    pixels = np.linspace(0, 1, 12, dtype=np.float32).reshape(3, 4)
    with tempfile.TemporaryDirectory() as folder:
        path = str(Path(folder) / "check.exr")
        OpenEXR.File({"type": OpenEXR.scanlineimage}, {"Y": pixels}).write(path)
        fine = np.array_equal(OpenEXR.File(path).channels()["Y"].pixels, pixels)
    yield fine, "round trip exact" if fine else "round trip differs; run: pip install --force-reinstall OpenEXR"


def _udp() -> Iterator[tuple[bool, str]]:
    with socket.socket(type=socket.SOCK_DGRAM) as receiver, socket.socket(type=socket.SOCK_DGRAM) as sender:
        receiver.bind(("127.0.0.1", 0))
        receiver.settimeout(2)
        sender.sendto(b"holotorch", receiver.getsockname())
        fine = receiver.recv(64) == b"holotorch"
    yield fine, "loopback works" if fine else "loopback garbles packets; check the firewall"


def _extras() -> Iterator[tuple[bool, str]]:
    missing: dict[str, list[str]] = {}
    for line in metadata.requires("holotorch") or []:
        requirement = Requirement(line)
        match = re.search(r"""extra == ['"](\w+)['"]""", str(requirement.marker))
        if match and installed_version(requirement.name) is None:
            missing.setdefault(match[1], []).append(requirement.name)
    for extra, names in missing.items():
        yield True, f"{', '.join(names)} not installed (optional); to add: pip install 'holotorch[{extra}]'"
    if not missing:
        yield True, "all installed"


_CHECKS: dict[str, Callable[[], Iterator[tuple[bool, str]]]] = {
    "python": _python,
    "package": _packages,
    "device": _devices,
    "opencv": _opencv,
    "fft": _fft,
    "exr": _exr,
    "udp": _udp,
    "extra": _extras,
}
