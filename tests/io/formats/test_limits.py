"""Files that state what they do not hold, or hold far more than they state, cost neither memory nor time."""

import bz2
import gzip
import json
import struct
import subprocess
import sys
import zipfile
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest

from holotorch.io.formats.decoding import decode, picture_size
from holotorch.io.formats.limits import VARIABLE, affordable, unzipped
from holotorch.io.images import load_image
from holotorch.io.panel_files import read_levels

MEMORY, SECONDS = 2 << 30, 10  # what any file below 1 MB may take, libraries included
ZEROS = bytes(1 << 24)


def chunk(kind: bytes, data: bytes, length: int | None = None) -> bytes:
    size = len(data) if length is None else length
    return struct.pack(">I", size) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def png(height: int, width: int, rows: bytes, *, more: bytes = b"") -> bytes:
    header = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + header + more + chunk(b"IDAT", zlib.compress(rows)) + chunk(b"IEND", b"")


def flat_png(side: int) -> bytes:
    """All of its pixels are there: black, of one bit each."""
    rows = zlib.compress(bytes(side * (1 + side // 8)), 9)
    header = chunk(b"IHDR", struct.pack(">IIBBBBB", side, side, 1, 0, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + header + chunk(b"IDAT", rows) + chunk(b"IEND", b"")


def bmp(height: int, width: int) -> bytes:
    return (
        b"BM" + struct.pack("<IHHIIiiHHIIiiII", 200, 0, 0, 54, 40, width, height, 1, 24, 0, 0, 0, 0, 0, 0) + bytes(60)
    )


def tiff(pages: int, side: int) -> bytes:
    """Pages that all show the same compressed strip."""
    strip = zlib.compress(bytes(side * side), 9)
    data, entries = (
        b"",
        [(256, 4, side), (257, 4, side), (258, 3, 8), (259, 3, 8), (262, 3, 1), (273, 4, 8), (277, 3, 1)],
    )
    entries += [(278, 4, side), (279, 4, len(strip))]
    place = 8 + len(strip)
    for page in range(pages):
        after = place + 2 + 12 * len(entries) + 4
        data += struct.pack("<H", len(entries)) + b"".join(struct.pack("<HHII", t, k, 1, v) for t, k, v in entries)
        data += struct.pack("<I", after if page + 1 < pages else 0)
        place = after
    return b"II*\0" + struct.pack("<I", 8 + len(strip)) + strip + data


def nrrd(encoding: str, data: bytes, sizes: str = "6 7 8", more: str = "") -> bytes:
    return f"NRRD0004\ntype: uint8\ndimension: 3\nsizes: {sizes}\nencoding: {encoding}\n{more}\n".encode() + data


def vti(blocks: list[bytes]) -> bytes:
    table = struct.pack(f"<{3 + len(blocks)}I", len(blocks), 1 << 24, 0, *map(len, blocks))
    head = b'<VTKFile type="ImageData" byte_order="LittleEndian" compressor="vtkZLibDataCompressor"><ImageData '
    head += b'WholeExtent="0 5 0 6 0 7" Spacing="1 1 1"><Piece Extent="0 5 0 6 0 7"><PointData><DataArray type="UInt8" '
    head += b'Name="a" format="appended" offset="0"/></PointData></Piece></ImageData><AppendedData encoding="raw">_'
    return head + table + b"".join(blocks) + b"</AppendedData></VTKFile>"


def metaimage(size: str, data: str, more: str = "") -> bytes:
    return f"NDims = 3\nDimSize = {size}\nElementType = MET_UCHAR\n{more}ElementDataFile = {data}\n".encode()


def jpeg_scans(side: int, most: int) -> bytes:
    """A progressive picture whose last scan, of a few bytes, comes again and again."""
    options = [cv2.IMWRITE_JPEG_PROGRESSIVE, 1]
    data = cv2.imencode(".jpg", np.full((side, side), 90, np.uint8), options)[1].tobytes()
    last = data[data.rindex(b"\xff\xda") : -2]
    return data[:-2] + last * ((most - len(data)) // len(last)) + data[-2:]


def npz(path: Path, shape: tuple[int, ...]) -> None:
    header = f"{{'descr': '|u1', 'fortran_order': False, 'shape': {shape}, }}".ljust(117) + "\n"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("a.npy", b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header.encode() + bytes(1000))


@pytest.fixture(scope="module")
def bombs(tmp_path_factory) -> dict[str, tuple[str, str]]:
    """Calls and what their error must say."""
    folder = tmp_path_factory.mktemp("bombs")
    members, blocks = bz2.compress(ZEROS) * 20, [zlib.compress(ZEROS, 9)] * 40
    zipped = gzip.compress(ZEROS, 9) * 40
    headless = png(16, 16, b"")[: 8 + 25]  # a signature and a header
    words = b" ".join([b"1"] * 2000 + [b"1" * 400_000])
    files = {
        "bzip2.nrrd": (nrrd("bzip2", members * 10), "holds more than the expected 336 bytes"),
        "gzip.nrrd": (nrrd("gzip", zipped), "holds more than the expected 336 bytes"),
        "skip.nrrd": (nrrd("gzip", zipped, more="byte skip: -1\n"), "holds more than the expected"),
        "large.nrrd": (
            nrrd("bzip2", members, "4000 4000 4000"),
            "asks for 64 GB of memory, more than the limit of 1.07",
        ),
        "lines.nrrd": (nrrd("raw", b"1", more="line skip: 999999999999\n"), "expected 336 bytes"),
        "words.nrrd": (nrrd("ascii", words), "not a readable text"),
        "a_8x7x6_uint8.raw.gz": (zipped, "holds more than the expected 336 bytes"),
        "large_4000x4000x4000_uint8.raw.gz": (zipped, "asks for 64 GB of memory"),
        "a.mha": (metaimage("8 7 6", "LOCAL", "CompressedData = True\n") + zipped, "holds more than the expected 336"),
        "a.vti": (vti(blocks), "block holds more than the expected 336 bytes"),
        "marks.vti": (b"<AppendedData " * 60_000, "not a readable VTK XML"),
        "stack.tif": (tiff(3000, 2000), "asks for 24 GB of memory"),
        "false.png": (png(16, 16, bytes(784), more=chunk(b"tEXt", b"a", 0xFFFFFFF0)), "is not a readable picture"),
        "levels_end.png": (png(16, 16, bytes(784))[:-12] + chunk(b"IEND", b"", 0xFFFFFFF0), "not a readable picture"),
        "levels_after.png": (
            headless + chunk(b"IEND", b"") + chunk(b"IDAT", b"a", 0x7FFFFFFF),
            "not a readable picture",
        ),
        "flat.png": (flat_png(32_000), "asks for 57.3 GB of memory"),
        "wide.png": (png(32_000, 32_000, b""), "asks for 57.3 GB of memory"),
        "wide.bmp": (bmp(30_000, 30_000), "asks for 50.4 GB of memory"),
        "broken.bmp": (bmp(3, 1 << 21), "is not a readable picture"),
        "scans.jpg": (jpeg_scans(4000, 1 << 20), "scans, each of which takes as long to decode as a whole picture"),
        "cut.bmp": (bmp(300, 300), "is not a readable picture"),
        "levels.png": (png(32_000, 32_000, b""), "asks for 16.4 GB of memory"),
        "levels.bmp": (bmp(300, 300), "is not a readable picture"),
    }
    for name, (data, _) in files.items():
        assert len(data) < 1 << 20, name
        (folder / name).write_bytes(data)
    npz(folder / "a.npz", (1 << 20, 1 << 20, 1 << 10))
    calls = {name: (str(folder / name), message) for name, (_, message) in files.items()}
    return calls | {"a.npz": (str(folder / "a.npz"), "states 1125899906842624 bytes, and 1000 follow")}


PROGRAM = """
import json, resource, sys, time
from holotorch.io.images import load_image
from holotorch.io.panel_files import read_levels
from holotorch.io.volumes import load_volume
resource.setrlimit(resource.RLIMIT_AS, (12 << 30, 12 << 30))  # where it fails, no other program shall starve
for path in json.loads(sys.argv[1]):
    name, began = path.rsplit("/", 1)[1], time.perf_counter()
    read = load_volume
    if name.endswith((".png", ".bmp", ".jpg")):
        read = read_levels if name.startswith("levels") else load_image
    try:
        error = repr(read(path if read is not read_levels else __import__("pathlib").Path(path)))
    except Exception as caught:
        error = f"{type(caught).__name__}: {caught}"
    status = open("/proc/self/status").read()  # ru_maxrss would begin with the memory of the tests' own process
    peak = int(status.split("VmHWM:")[1].split()[0]) * 1024
    print(json.dumps([name, error, time.perf_counter() - began, peak]), flush=True)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_no_small_file_takes_much_memory_or_time(bombs):
    paths = json.dumps([path for path, _ in bombs.values()])
    done = subprocess.run([sys.executable, "-c", PROGRAM, paths], capture_output=True, text=True, timeout=300)
    found = [json.loads(line) for line in done.stdout.splitlines()]
    assert [name for name, *_ in found] == list(bombs), done.stderr
    for name, error, seconds, peak in found:
        assert error.startswith("ValueError: ") and bombs[name][1] in error, (name, error)
        assert seconds < SECONDS and peak < MEMORY, (name, seconds, peak)


def test_the_limit_can_be_raised_as_its_error_says(tmp_path, monkeypatch):
    path = tmp_path / "a.png"
    cv2.imwrite(str(path), np.full((40, 50), 7, np.uint8))
    monkeypatch.setenv(VARIABLE, "100")
    monkeypatch.setattr("holotorch.io.formats.limits.RATIO", 1)
    with pytest.raises(
        ValueError, match=rf"a.png has \d+ bytes and asks for .* set the environment variable {VARIABLE}="
    ):
        load_image(path)
    monkeypatch.setenv(VARIABLE, "1e6")
    assert load_image(path).shape == (1, 40, 50)
    monkeypatch.setenv(VARIABLE, "plenty")
    with pytest.raises(ValueError, match=f"{VARIABLE} must be a number of bytes, got 'plenty'"):
        read_levels(path)


def test_ordinary_files_stay_below_the_limit(tmp_path):
    affordable("photograph of 100 Mpx", 100_000_000 * 56, 20_000_000)
    affordable("labels of 1024^3", 1 << 30, 100_000)
    with pytest.raises(ValueError, match="labels of 2048"):
        affordable("labels of 2048^3", 1 << 33, 1_000_000)


@pytest.mark.parametrize("kind", ["gzip", "bzip2"])
@pytest.mark.parametrize("size", [1, (1 << 20) - 1, 1 << 20, (1 << 20) + 1])
def test_whole_contents_come_back(tmp_path, kind, size):
    """Also where they end with a chunk of the decompressor, in one member or in three."""
    content = np.random.default_rng(size).integers(0, 2, size, np.uint8).tobytes()
    pack = (lambda data: gzip.compress(data, 1)) if kind == "gzip" else (lambda data: bz2.compress(data, 1))
    thirds = [content[: size // 3], content[size // 3 : size // 2], content[size // 2 :]]
    for data in (pack(content), b"".join(map(pack, thirds))):
        (tmp_path / "a").write_bytes(b"head" + data)
        assert unzipped(tmp_path / "a", size, 4, kind=kind) == content
        with pytest.raises(ValueError, match=f"holds more than the expected {size - 1} bytes"):
            unzipped(tmp_path / "a", size - 1, 4, kind=kind)
        (tmp_path / "a").write_bytes(b"head" + data[:-3])
        with pytest.raises(ValueError, match=f"is truncated: its {kind} data stop"):
            unzipped(tmp_path / "a", size, 4, kind=kind)


@pytest.mark.parametrize(
    ("suffix", "options"),
    [
        (".png", []),
        (".bmp", []),
        (".jpg", []),
        (".jpg", [cv2.IMWRITE_JPEG_PROGRESSIVE, 1, cv2.IMWRITE_JPEG_RST_INTERVAL, 2]),
        (".tif", []),
        (".webp", [cv2.IMWRITE_WEBP_QUALITY, 80]),
        (".webp", [cv2.IMWRITE_WEBP_QUALITY, 101]),
    ],
)
def test_sizes_are_those_of_the_decoded_picture(tmp_path, suffix, options):
    picture = np.random.default_rng(3).integers(0, 256, (37, 52, 3), np.uint8)
    _, data = cv2.imencode(suffix, picture, options)
    assert picture_size(tmp_path / "a", data.tobytes()) == (37, 52)
    (tmp_path / "a").write_bytes(data.tobytes())
    assert decode(tmp_path / "a", cv2.IMREAD_COLOR).shape == (37, 52, 3)
    with pytest.raises(ValueError, match="is not a readable picture"):
        decode(tmp_path / "a", cv2.IMREAD_COLOR, data=data.tobytes()[:20])


def test_a_size_beyond_all_floats_is_refused_like_other_large_ones(tmp_path):
    with pytest.raises(ValueError, match=r"has 10 bytes and asks for 1e\+291 GB of memory, more than the limit"):
        affordable(tmp_path / "a.vti", 10**400, 10)
