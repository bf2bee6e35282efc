import struct

import cv2
import numpy as np
import OpenEXR
import pytest
import torch

from holotorch.io.panel_files import read_levels, read_phases, write_levels, write_phases

FACTS = {
    "wavelength_m": 530e-9,
    "encoding": "double_phase",
    "source": "Läufe/µ-001",
    "pitch_m": [5e-6, 4e-6],
    "frame": 0,
}


def levels(kind: torch.dtype) -> torch.Tensor:
    top = 256 if kind == torch.uint8 else 65536
    values = torch.randint(top, (12, 17), generator=torch.Generator().manual_seed(1), dtype=torch.int32)
    values[0, :2] = torch.tensor([0, top - 1])
    return values.to(kind)


@pytest.mark.parametrize(
    ("name", "kind"), [("a.png", torch.uint8), ("a.png", torch.uint16), ("a.bmp", torch.uint8), ("A.PNG", torch.uint8)]
)
def test_levels_and_facts_come_back(tmp_path, name, kind):
    wanted = levels(kind)
    write_levels(tmp_path / name, wanted, FACTS)
    got, facts = read_levels(tmp_path / name)
    assert got.dtype == kind and facts == FACTS
    np.testing.assert_array_equal(got.numpy(), wanted.numpy())
    by_others = cv2.imread(str(tmp_path / name), cv2.IMREAD_ANYDEPTH | cv2.IMREAD_GRAYSCALE)
    assert by_others is not None
    np.testing.assert_array_equal(by_others, wanted.numpy())
    assert {path.name for path in tmp_path.iterdir()} == ({name, "a.bmp.json"} if name.endswith("bmp") else {name})


def test_the_text_chunk_is_one_that_others_read(tmp_path):
    image = pytest.importorskip("PIL.Image")
    write_levels(tmp_path / "a.png", levels(torch.uint8), FACTS)
    with image.open(tmp_path / "a.png") as opened:
        opened.verify()  # the checksums of all chunks
    with image.open(tmp_path / "a.png") as opened:
        assert '"wavelength_m": 5.3e-07' in opened.info["holotorch"] and "Läufe/µ-001" in opened.info["holotorch"]


def test_strided_frames_are_written_as_they_look(tmp_path):
    wide = torch.arange(24 * 40).reshape(24, 40)
    for i, part in enumerate((wide[::2, 1::3], wide.T, wide.flip(0)[:, ::4])):
        bytes_ = (part % 251).to(torch.uint8)
        write_levels(tmp_path / f"{i}.png", bytes_, {})
        assert torch.equal(read_levels(tmp_path / f"{i}.png")[0], bytes_)
    phases = torch.randn(3, 24, 40, dtype=torch.float32)
    views = (phases[1, ::2, 1::3], phases[2].T, phases.permute(1, 2, 0)[..., 1], phases[0].expand(24, 40)[3:, 5:])
    for i, part in enumerate((*views, torch.tensor(2.5).expand(6, 7))):
        write_phases(tmp_path / f"{i}.exr", part, {})
        assert torch.equal(read_phases(tmp_path / f"{i}.exr")[0], part)


def test_phases_come_back_to_the_bit(tmp_path):
    info = np.finfo(np.float32)
    rare = [0.0, -0.0, info.max, -info.max, info.tiny, info.smallest_subnormal, 1 + info.eps, -3.14159265, 1e3, 7e-9]
    wanted = torch.cat([torch.tensor(rare, dtype=torch.float32), torch.randn(194)]).reshape(12, 17)
    write_phases(tmp_path / "a.exr", wanted, FACTS)
    got, facts = read_phases(tmp_path / "a.exr")
    assert facts == FACTS and got.dtype == torch.float32
    np.testing.assert_array_equal(got.numpy().view(np.uint32), wanted.numpy().view(np.uint32))
    by_others = OpenEXR.File(str(tmp_path / "a.exr")).channels()["Y"].pixels
    np.testing.assert_array_equal(by_others.view(np.uint32), wanted.numpy().view(np.uint32))


@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_what_is_no_phase_is_refused_and_the_old_file_stays(tmp_path, bad):
    path, good = tmp_path / "a.exr", torch.ones(4, 5)
    write_phases(path, good, {})
    with pytest.raises(ValueError, match=r"phase must be finite, but element \(2, 3\)"):
        write_phases(path, good.index_put((torch.tensor(2), torch.tensor(3)), torch.tensor(bad)), {})
    with pytest.raises(ValueError, match="JSON compliant"):
        write_phases(path, good * 2, {"loss": bad})
    assert torch.equal(read_phases(path)[0], good) and len(list(tmp_path.iterdir())) == 1


@pytest.mark.parametrize(
    ("call", "error", "message"),
    [
        (lambda at: write_phases(at / "a.exr", torch.ones(3, 4, dtype=torch.float64), {}), TypeError, "keeps float32"),
        (lambda at: write_phases(at / "a.png", torch.ones(3, 4), {}), ValueError, "written as .exr, got .png"),
        (lambda at: write_phases(at / "a.exr", torch.ones(2, 3, 4), {}), ValueError, r"one frame \(H, W\), got \(2, 3"),
        (lambda at: write_levels(at / "a.png", torch.ones(3, 4), {}), TypeError, "uint8 or uint16, got torch.float32"),
        (lambda at: write_levels(at / "a.jpg", levels(torch.uint8), {}), ValueError, "as .png or .bmp, got .jpg"),
        (lambda at: write_levels(at / "a.bmp", levels(torch.uint16), {}), ValueError, "a BMP holds 8 bits"),
        (lambda at: write_levels(at / "a.png", levels(torch.uint8)[:0], {}), ValueError, r"got \(0, 17\)"),
        (lambda at: write_levels(at / "a.png", levels(torch.uint8), {"a": {1}}), TypeError, "not JSON serializable"),
        (lambda at: read_levels(at / "a.png"), ValueError, "no such file"),
        (lambda at: read_phases(at / "a.exr"), ValueError, "no such file"),
    ],
)
def test_refuses(tmp_path, call, error, message):
    with pytest.raises(error, match=message):
        call(tmp_path)
    assert not list(tmp_path.iterdir())


def test_damaged_and_foreign_files(tmp_path):
    path = tmp_path / "a.png"
    write_levels(path, levels(torch.uint8), FACTS)
    data = path.read_bytes()
    (tmp_path / "empty.png").write_bytes(b"")
    (tmp_path / "cut.exr").write_bytes(b"v/1\x01" + data[:40])
    cv2.imwrite(str(tmp_path / "colour.png"), np.arange(60, dtype=np.uint8).reshape(4, 5, 3))
    cv2.imwrite(str(tmp_path / "plain.png"), np.arange(60, dtype=np.uint8).reshape(6, 10))
    with pytest.raises(ValueError, match="empty.png is not a readable picture"):
        read_levels(tmp_path / "empty.png")
    with pytest.raises(ValueError, match="must be grey"):
        read_levels(tmp_path / "colour.png")
    with pytest.raises(ValueError, match="not a readable EXR"):
        read_phases(tmp_path / "cut.exr")
    assert read_levels(tmp_path / "plain.png")[1] == {}
    (tmp_path / "plain.png.json").write_text("{")
    with pytest.raises(ValueError, match="metadata are damaged"):
        read_levels(tmp_path / "plain.png")


def test_the_chunk_follows_the_header(tmp_path):
    write_levels(tmp_path / "a.png", levels(torch.uint16), FACTS)
    data = (tmp_path / "a.png").read_bytes()
    length = struct.unpack(">I", data[33:37])[0]
    assert data[12:16] == b"IHDR" and data[37:41] == b"iTXt" and data[41 : 41 + length].startswith(b"holotorch\0")
