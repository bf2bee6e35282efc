"""Targets: volumes, pictures, a panel's files, recordings and videos, read by the functions that users call."""

import io
import json
import zlib
from collections.abc import Callable
from functools import partial
from pathlib import Path
from random import Random

import cv2
import numpy as np
import OpenEXR
import torch
from fuzz.commands import files
from fuzz.engine import Input, Target
from fuzz.mutate import mutated
from fuzz.mutate_headers import fields_mutated, packed, png_mutated, sized
from fuzz.mutate_tree import json_mutated, table_mutated

from holotorch.experiments.config.errors import ConfigError
from holotorch.experiments.tracking.synthetic import read_truth
from holotorch.io.images import load_image
from holotorch.io.panel_files import read_levels, read_phases, write_levels, write_phases
from holotorch.io.recording import Recorder, open_recording
from holotorch.io.video import Frame, open_frames
from holotorch.io.volumes import load_volume
from holotorch.scene.transfer_presets import transfer_from_json

Bytes = Callable[[Random, bytes, bytes], bytes]
_VOXELS = np.random.default_rng(1).integers(0, 200, (5, 6, 7), dtype=np.uint8)
_PICTURE = np.random.default_rng(2).integers(0, 255, (16, 20, 3), dtype=np.uint8)


def one(change: Bytes) -> Callable[[Random, Input, Input], Input]:
    """Change one file of an input, any of them."""

    def mutate(rng: Random, made: Input, other: Input) -> Input:
        name = rng.choice(list(made))
        return made | {name: change(rng, made[name], other.get(name, made[name]))}

    return mutate


def _nrrd(_: Path) -> list[Input]:
    import gzip

    head = b"NRRD0004\ntype: uint8\ndimension: 3\nsizes: 7 6 5\nspace: left-posterior-superior\n"
    head += b'space directions: (0.5,0,0) (0,0.5,0) (0,0,1)\nspace units: "mm" "mm" "mm"\nspace origin: (0,1,2)\n'
    voxels = _VOXELS.tobytes()
    text = " ".join(map(str, _VOXELS.ravel())).encode()
    import bz2

    coded = {b"raw": voxels, b"gzip": gzip.compress(voxels), b"bzip2": bz2.compress(voxels), b"ascii": text}
    made = [{"volume.nrrd": head + b"encoding: " + name + b"\n\n" + data} for name, data in coded.items()]
    apart = head + b"encoding: raw\ndata file: data.raw\nbyte skip: 0\n\n"
    short = b"NRRD0001\ntype: short\ndimension: 3\nsizes: 3 2 5\nendian: little\nspacings: 1 1 2\nencoding: raw\n\n"
    return [*made, {"volume.nhdr": apart, "data.raw": voxels}, {"volume.nrrd": short + voxels[:60]}]


def _metaimage(_: Path) -> list[Input]:
    head = b"ObjectType = Image\nNDims = 3\nBinaryData = True\nBinaryDataByteOrderMSB = False\nDimSize = 7 6 5\n"
    head += (
        b"ElementSpacing = 0.5 0.5 1\nTransformMatrix = 1 0 0 0 1 0 0 0 1\nOffset = 0 1 2\nElementType = MET_UCHAR\n"
    )
    voxels, deflated = _VOXELS.tobytes(), zlib.compress(_VOXELS.tobytes())
    wide = head.replace(b"UCHAR", b"SHORT").replace(b"7 6 5", b"7 3 5") + b"HeaderSize = -1\n"
    return [
        {"volume.mha": head + b"ElementDataFile = LOCAL\n" + voxels},
        {"volume.mha": head + b"CompressedData = True\nElementDataFile = LOCAL\n" + deflated},
        {"volume.mhd": head + b"ElementDataFile = data.raw\n", "data.raw": voxels},
        {"volume.mhd": wide + b"ElementDataFile = data.raw\n", "data.raw": voxels},
        {"volume.mhd": head + b"CompressedData = True\nElementDataFile = data.zraw\n", "data.zraw": deflated},
    ]


def _fields(rng: Random, made: Input, other: Input) -> Input:
    name = next(iter(made))
    data = next((name for name in made if name.startswith("data")), None)
    if data and rng.random() < 0.3:
        return made | {data: rng.choice((packed(rng, made[data]), mutated(rng, made[data], made[name])))}
    end = b"\n\n" if name.endswith(("nrrd", "nhdr")) else b"LOCAL\n"
    return made | {name: fields_mutated(rng, made[name], other.get(name, made[name]), end)}


def _vti(_: Path) -> list[Input]:
    import base64

    voxels = _VOXELS.tobytes()
    about = 'Name="v" NumberOfComponents="1" type="UInt8"'
    kind = 'type="ImageData" version="1.0" byte_order="LittleEndian" header_type="UInt32"'
    head = f'<?xml version="1.0"?>\n<VTKFile {kind}{{}}>\n'
    image = '<ImageData WholeExtent="0 6 0 5 0 4" Origin="0 0 0" Spacing="0.5 0.5 1">\n<Piece Extent="0 6 0 5 0 4">\n'
    image = (
        head
        + image
        + '<PointData Scalars="v">\n<DataArray {}{}</DataArray></PointData></Piece></ImageData>{}</VTKFile>'
    )
    size = len(voxels).to_bytes(4, "little")
    block = zlib.compress(voxels)
    table = b"".join(number.to_bytes(4, "little") for number in (1, len(voxels), len(voxels), len(block)))
    coded = base64.b64encode(size + voxels).decode()
    blocks = base64.b64encode(table).decode() + base64.b64encode(block).decode()
    zipped = ' compressor="vtkZLibDataCompressor"'
    outside = '<AppendedData encoding="{}">_{}</AppendedData>'
    ascii_ = f'{about} format="ascii">'
    apart = f'{about} format="appended" offset="0">'
    raw = image.format("", apart, "", outside.format("raw", "@")).encode()
    texts = [
        image.format("", ascii_, " ".join(map(str, _VOXELS.ravel())), ""),
        image.format("", f'{about} format="binary">', coded, ""),
        image.format(zipped, f'{about} format="binary">', blocks, ""),
        image.format("", apart, "", outside.format("base64", coded)),
    ]
    made = [text.encode() for text in texts]
    made.append(raw.replace(b"_@", b"_" + size + voxels))
    zipped_raw = image.format(zipped, apart, "", outside.format("raw", "@")).encode()
    made.append(zipped_raw.replace(b"_@", b"_" + table + block))
    return [{"volume.vti": data} for data in made]


_ENTITIES = b'<!DOCTYPE a [<!ENTITY a "xxxxxxxxxx"><!ENTITY b "&a;&a;&a;&a;&a;&a;&a;&a;&a;&a;">' + b"".join(
    f'<!ENTITY {chr(99 + i)} "{f"&{chr(98 + i)};" * 10}">'.encode() for i in range(8)
)
_XML = (
    b'format="raw"',
    b'type="Float64"',
    b"&j;",
    _ENTITIES + b"]>",
    b'byte_order="BigEndian"',
    b'Extent="0 1"',
    b"<Piece/>",
)


def _arrays(_: Path) -> list[Input]:
    made = []
    for values in (_VOXELS, np.asfortranarray(_VOXELS.astype(">i2")), _VOXELS / 200):
        whole, several = io.BytesIO(), io.BytesIO()
        np.save(whole, values)
        np.savez_compressed(several, volume=values)
        made += [{"volume.npy": whole.getvalue()}, {"volume.npz": several.getvalue()}]
    return made


def _raw(_: Path) -> list[Input]:
    import gzip

    voxels = _VOXELS.tobytes()
    return [{"v_7x6x5_uint8.raw": voxels}, {"v_7x6x5_uint8.raw.gz": gzip.compress(voxels)}]


def _raw_mutated(rng: Random, made: Input, other: Input) -> Input:
    ((name, data),) = made.items()
    size = "x".join(str(rng.choice((0, 1, 5, 6, 7, 100000, 10**9, 10**19, "x", -1))) for _ in range(3))
    if rng.random() < 0.5:
        kind = rng.choice(("uint8", "int16", "float64", "float16", "uint64", "int7", "float128", "uint" + "9" * 100))
        name = f"v_{size}_{kind}.raw" + rng.choice(("", ".gz"))
    return {name: rng.choice((packed(rng, data), mutated(rng, data, data), data))}


def _tiff(_: Path) -> list[Input]:
    data = cv2.imencodemulti(".tiff", [_VOXELS[0], _VOXELS[1]])[1]
    wide = cv2.imencodemulti(".tiff", [_VOXELS[0].astype(np.uint16)], [cv2.IMWRITE_TIFF_COMPRESSION, 8])[1]
    return [{"volume.tif": data.tobytes()}, {"volume.tif": wide.tobytes()}]


def _slices(_: Path) -> list[Input]:
    grey = [cv2.imencode(".png", plane)[1].tobytes() for plane in _VOXELS[:3]]
    return [{f"slices/{index:03}.png": data for index, data in enumerate(grey)}]


def _volume(folder: Path) -> None:
    path = next(p for p in sorted(folder.iterdir()) if not p.name.startswith("data"))
    volume = load_volume(path, spacing=(1e-3, 1e-3, 1e-3)) if path.suffix != ".mhd" else load_volume(path)
    assert volume.values.ndim == 3 and min(volume.spacing) > 0
    float(volume.values.double().sum())  # reads what is mapped


def _encoded(suffix: str, words: tuple[int, ...], _: Path) -> list[Input]:
    made = [_PICTURE, _PICTURE[..., 0]]
    made += [_PICTURE.astype(np.uint16) * 257] if suffix in ("png", "tiff") else []
    return [{f"picture.{suffix}": cv2.imencode(f".{suffix}", each, words)[1].tobytes()} for each in made]


def _exr(folder: Path) -> list[Input]:
    made, values = [], _PICTURE.astype(np.float32) / 255
    for index, (form, channels) in enumerate(
        [
            ("ZIP", {"RGB": values}),
            ("PIZ", {"Y": values[..., 0].copy()}),
            ("NO", {"RGBA": np.dstack([values, values[..., 0]])}),
        ]
    ):
        header = {"compression": getattr(OpenEXR, f"{form}_COMPRESSION"), "type": OpenEXR.scanlineimage}
        path = folder / f"{index}.exr"
        OpenEXR.File(header, channels).write(str(path))
        made.append({"picture.exr": path.read_bytes()})
    return made


def _picture(folder: Path) -> None:
    image = load_image(next(folder.iterdir()))
    assert image.dtype == torch.float64 and image.ndim == 3 and bool(((image >= 0) & (image <= 1)).all())


def _panel_files(folder: Path) -> list[Input]:
    levels, facts = torch.from_numpy(_PICTURE[..., 0].copy()), {"wavelength": 5e-7, "name": "panel"}
    write_levels(folder / "levels.png", levels, facts)
    write_levels(folder / "levels.bmp", levels, facts)
    write_phases(folder / "phases.exr", levels.float() / 40, facts)
    made = files(folder)
    return [
        {"levels.png": made["levels.png"]},
        {name: made[name] for name in ("levels.bmp", "levels.bmp.json")},
        {"phases.exr": made["phases.exr"]},
    ]


def _panel_mutated(rng: Random, made: Input, other: Input) -> Input:
    name = rng.choice(list(made))
    change = {"png": png_mutated, "json": json_mutated}.get(name.rpartition(".")[2], sized)
    return made | {name: change(rng, made[name], other.get(name, made[name]))}


def _panel(folder: Path) -> None:
    path = next(path for path in sorted(folder.iterdir()) if path.suffix != ".json")
    values, facts = (read_phases if path.suffix == ".exr" else read_levels)(path)
    assert values.ndim == 2 and isinstance(facts, dict)


_TRUTH = (
    b"frame,time_s,tip_x_m,tip_y_m,tip_z_m,along_x,along_y,along_z\n0,0.0,0.1,0.2,0.5,0,0,1\n1,0.1,0.1,0.2,0.5,0,0,1\n"
)


def _recording(folder: Path) -> list[Input]:
    frames = [torch.from_numpy(_PICTURE).permute(2, 0, 1).contiguous(), None, torch.zeros(3, 16, 20, dtype=torch.uint8)]
    with Recorder(folder / "recording", (16, 20), 25.0, "a test") as recorder:
        for index, pixels in enumerate(frames):
            recorder.write(Frame(index / 25, pixels, "" if pixels is not None else "not decodable"))
    return [files(folder) | {"recording/truth.csv": _TRUTH}]


def _recording_mutated(rng: Random, made: Input, other: Input) -> Input:
    name = rng.choice(list(made))
    change = {"json": json_mutated, "csv": table_mutated}.get(name.rpartition(".")[2], mutated)
    return made | {name: change(rng, made[name], other[name])}


def _replayed(folder: Path) -> None:
    read_truth(folder / "recording")
    with open_recording(folder / "recording") as frames:
        for number, frame in enumerate(frames):
            assert frame.pixels is None or frame.pixels.shape[0] == 3
            if number > 100:
                break


def _videos(folder: Path) -> list[Input]:
    made = []
    for suffix, code in (("avi", "MJPG"), ("mp4", "mp4v")):
        path = folder / f"video.{suffix}"
        writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*code), 25.0, (64, 48))
        for level in range(4):
            writer.write(np.full((48, 64, 3), 40 * level, np.uint8))
        writer.release()
        made.append({path.name: path.read_bytes()})
    return made


def _video(folder: Path) -> None:
    with open_frames(next(folder.iterdir())) as frames:
        for number, frame in enumerate(frames):
            assert frame.pixels is None or frame.pixels.dtype == torch.uint8
            if number > 100:
                break


_PARAVIEW = [{"ColorSpace": "RGB", "RGBPoints": [0, 0, 0, 0, 1, 1, 1, 1], "Points": [0, 0, 0.5, 0, 1, 1, 0.5, 0]}]
_POINT = {"x": 0.0, "color": [1, 0, 0], "midpoint": 0.5, "sharpness": 0}
_COMPONENT = {
    "rgbTransferFunction": {"type": "colorTransferFunction", "points": [_POINT, _POINT | {"x": 9.0}]},
    "scalarOpacity": {"type": "piecewiseLinearFunction", "points": [{"x": 0.0, "y": 0.0}, {"x": 9.0, "y": 1.0}]},
}
_SLICER = {"@schema": "x", "volumeProperties": [{"scalarOpacityUnitDistance": 1.0, "components": [_COMPONENT]}]}


def _transfer(_: Path) -> list[Input]:
    return [{"transfer.json": json.dumps(value).encode()} for value in (_PARAVIEW, _SLICER)]


def _transferred(folder: Path) -> None:
    made = transfer_from_json((folder / "transfer.json").read_bytes().decode("utf-8", "replace"))
    assert torch.isfinite(made(torch.linspace(-1, 2, 7))[1]).all()


TARGETS = [
    Target("volume-nrrd", _nrrd, _fields, _volume),
    Target("volume-metaimage", _metaimage, _fields, _volume),
    Target("volume-vti", _vti, one(partial(mutated, tokens=_XML)), _volume),
    Target("volume-array", _arrays, one(mutated), _volume),
    Target("volume-raw", _raw, _raw_mutated, _volume),
    Target("volume-tiff", _tiff, one(sized), _volume),
    Target("volume-slices", _slices, one(png_mutated), _volume),
    Target("image-png", partial(_encoded, "png", ()), one(png_mutated), _picture),
    Target("image-bmp", partial(_encoded, "bmp", ()), one(sized), _picture),
    Target("image-jpeg", partial(_encoded, "jpg", ()), one(sized), _picture),
    Target("image-tiff", partial(_encoded, "tiff", ()), one(sized), _picture),
    Target("image-exr", _exr, one(sized), _picture),
    Target("panel-files", _panel_files, _panel_mutated, _panel),
    Target("recording", _recording, _recording_mutated, _replayed, (ValueError, ConfigError)),
    Target("video", _videos, one(sized), _video),
    Target("transfer", _transfer, one(json_mutated), _transferred),
]
