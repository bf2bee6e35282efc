"""Download of those volumes of Table 5.2 of the thesis for which a checksum is published."""

import difflib
import textwrap
from dataclasses import dataclass
from pathlib import Path

from holotorch.io.files import cache_folder
from holotorch.io.volumes import load_volume
from holotorch.scene.volume import Volume

_TIMEOUT = 10  # seconds to wait for a server that does not answer
_failed: dict[Path, str] = {}  # reasons of failed downloads by file; a process asks the server for each once
_ORIGIN = "http://klacansky.com/open-scivis-datasets"


@dataclass(frozen=True)
class Published:
    """A volume of the Open SciVis Datasets: a raw file of cubic voxels of unknown size, in which x varies fastest.

    The Open SciVis Datasets state no licence: do not redistribute the data.
    """

    url: str  # of the raw file, whose name contains the size (x, y, z) and the type
    shape: tuple[int, int, int]  # number of voxels (D, H, W)
    dtype: str
    sha512: str  # checksum of the raw file that the Open SciVis Datasets publish
    acknowledgement: str  # sources that the Open SciVis Datasets credit


PUBLISHED = {
    "tooth": Published(
        f"{_ORIGIN}/tooth/tooth_103x94x161_uint8.raw",
        (161, 94, 103),
        "uint8",
        "5ee3d77ae951e129d29062a4fd4d8730fd8670bdaf4d01ddf907848072180cbf"
        "ea8ab897880147d2a79dc7f1d1806a34b32853074eca88f6758e01382469f9f6",
        "",
    ),
    "boston_teapot": Published(
        f"{_ORIGIN}/boston_teapot/boston_teapot_256x256x178_uint8.raw",
        (178, 256, 256),
        "uint8",
        "b2bf7ba8ba7a7d5a8ea76ccd8fd2c0f5f043079a83cd6a3055e85f5e0a40c1c4"
        "d872b9bbc7aedf628989eb57bffd5729767c29fe8ae018c581406b196caa6359",
        "volvis.org and Terarecon Inc, MERL, Brigham and Women's Hospital",
    ),
    "bonsai": Published(
        f"{_ORIGIN}/bonsai/bonsai_256x256x256_uint8.raw",
        (256, 256, 256),
        "uint8",
        "b34156a0ffc80ffaf84d069f3d05a40fdd999a35f05492829a2b0c13403a3147"
        "e73712b1d10c2cc34da66a59540a1632dae6adc96f3ebf3efa5d4d6c10598997",
        "volvis.org and S. Roettger, VIS, University of Stuttgart",
    ),
}


def fetch_volume(name: str, directory: str | Path | None = None) -> Volume:
    """Download a volume of the thesis, verify its checksum and load it; later calls use the downloaded file.

    A download that failed is not tried again by the same process, since without a network every trial takes its time.

    Args:
        name: A key of :data:`PUBLISHED`. No checksum is published for the engine, C60 and the hand of Table 5.2:
            download them by hand and use :func:`~holotorch.io.volumes.load_volume`.
            :func:`~holotorch.scene.phantoms.c60` computes a C60 molecule.
        directory: Folder in which the file is kept; by default a folder in the user's cache.

    Returns:
        The volume, uint8, with a relative spacing of 1 along all axes.

    Raises:
        ValueError: Unknown name, or a downloaded file without the published checksum.
        OSError: The download failed; the message says where to put the file by hand.
    """
    if name not in PUBLISHED:
        near = difflib.get_close_matches(str(name), PUBLISHED, 1)
        known = f"{f'did you mean {near[0]!r}? ' if near else ''}known are {', '.join(PUBLISHED)}"
        raise ValueError(f"no such published volume: {name!r}; {known}. Load others with load_volume")
    import pooch

    entry = PUBLISHED[name]
    folder = Path(directory) if directory is not None else cache_folder()
    file = folder / entry.url.rsplit("/", 1)[1]
    cause = None
    if file.is_file() or file not in _failed:
        known, load = f"sha512:{entry.sha512}", pooch.HTTPDownloader(timeout=_TIMEOUT)
        try:
            pooch.retrieve(entry.url, known, file.name, folder, downloader=load)  # type: ignore[arg-type]
            _failed.pop(file, None)
        except OSError as error:  # includes the errors of the requests library
            cause, _failed[file] = error, _reason(error)
    if reason := _failed.get(file):
        raise OSError(f"could not fetch {entry.url} ({reason}); download it and put it at {file}") from cause
    return load_volume(file, spacing=1, unit="relative", shape=entry.shape, dtype=entry.dtype)


def _reason(error: OSError) -> str:
    """Why a download failed, in a few words: those of the requests library repeat the address."""
    from requests.exceptions import ConnectionError, Timeout

    if isinstance(error, Timeout):
        return f"no answer in {_TIMEOUT} s"
    if isinstance(error, ConnectionError):
        return "no connection"
    return textwrap.shorten(str(error), 80, placeholder=" ...")
