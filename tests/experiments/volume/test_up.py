"""Which way up a volume is shown, and that left and right are those of what was scanned."""

import sys
from pathlib import Path

import nrrd
import numpy as np
import pytest
import torch
from paths import CONFIGS

from holotorch.cli import main
from holotorch.experiments.config.errors import ConfigError
from holotorch.experiments.registry import load_config
from holotorch.experiments.volume.experiment import VolumeExperiment, build
from holotorch.experiments.volume.plan import viewpoint

UP = {"-y": (0, -1, 0), "y": (0, 1, 0), "z": (1, 0, 0), "-z": (-1, 0, 0), "x": (0, 0, 1), "-x": (0, 0, -1)}


def rotation(*words: str) -> torch.Tensor:
    return build(
        load_config(CONFIGS / "volume" / "hand.yaml", ["volume={phantom: shells, samples: 16}", *words])
    ).rotation


@pytest.mark.parametrize("up", UP)
def test_the_direction_points_up_and_turns_about_the_vertical(up):
    """Vectors (z, y, x); y points down on a picture. The far observer's volume is mirrored along x."""
    top = torch.tensor(UP[up], dtype=torch.float64) * torch.tensor([1, 1, -1])
    for azimuth in (0, 90, -37):
        matrix = rotation(f"view.up={up}", f"view.azimuth_deg={azimuth}")
        torch.testing.assert_close(matrix @ top, torch.tensor([0.0, -1, 0]).double(), rtol=0, atol=1e-12)
        torch.testing.assert_close(matrix @ matrix.mT, torch.eye(3).double(), rtol=0, atol=1e-12)
        assert torch.linalg.det(matrix) > 0  # a rotation shows no mirror image


def test_by_default_nothing_is_turned():
    torch.testing.assert_close(rotation(), torch.eye(3).double(), rtol=0, atol=0)


LPS = "left-posterior-superior"
MARKED = "transfer={points: [[0, 0, 0, 0, 0], [50, 0.2, 0.2, 0.2, 0.6], [200, 0, 1, 0, 0.9], [250, 1, 0, 0, 0.9]]}"


def scanned(folder: Path, *words: str, flipped: int | None = None, space: str = LPS) -> VolumeExperiment:
    """A body with a lump of value 250 in front, at its left and high up, and one of 200 at its back, right and low.

    ``flipped``: the axis (x, y, z) along which the file holds the voxels in reverse order, and says so.
    """
    body = np.zeros((24, 24, 24), np.uint8)  # left, posterior, superior
    body[2:22, 4:20, 2:22] = 50
    body[14:20, 0:4, 15:20] = 250
    body[4:10, 20:24, 4:9] = 200
    axes = np.eye(3)
    if space != LPS:
        axes[1, 1] = -1  # posterior, in the coordinates of a space whose second axis is anterior
    if flipped is not None:
        body, axes[flipped] = np.flip(body, flipped), -axes[flipped]
    header = {"space": space, "space directions": axes, "space units": ["mm"] * 3}
    nrrd.write(str(folder / "body.nrrd"), np.ascontiguousarray(body), header)
    hologram = "hologram={shape: [48, 48], pitch: 8 um, distance: 4 mm, depths: 24}"
    path = f"volume={{path: {folder / 'body.nrrd'}}}"
    return build(load_config(CONFIGS / "volume" / "hand.yaml", [path, MARKED, hologram, "view.up=z", *words]))


def lump(picture: torch.Tensor) -> tuple[str, str, str]:
    """Colour of the lump in a rendering [3, h, w], and whether it is at the left or right, and high or low."""
    red, green, _ = picture
    share = {"red": (red - green).clamp(min=0), "green": (green - red).clamp(min=0)}
    name = max(share, key=lambda colour: share[colour].sum())
    y, x = torch.meshgrid(*(torch.arange(n) - n / 2 for n in red.shape), indexing="ij")
    across, down = ((share[name] * axis).sum() for axis in (x, y))
    return name, "right" if across > 0 else "left", "low" if down > 0 else "high"


@pytest.mark.parametrize("flipped", [None, 0, 1])
def test_an_observer_sees_the_body_and_not_its_mirror_image(flipped, tmp_path):
    """Face to face, its left is at the observer's right; from behind, at his left."""
    face, back = ("red", "right", "high"), ("green", "right", "low")
    turned = flipped == 1  # stored from the back on, so that the ends change centres
    near = lump(scanned(tmp_path, "view.front=near", flipped=flipped).rendering()[0])
    far = lump(scanned(tmp_path, flipped=flipped).rendering()[0])
    assert (near, far) == ((back, face) if turned else (face, back))
    around = lump(scanned(tmp_path, "view.azimuth_deg=180", flipped=flipped).rendering()[0])
    assert around == near
    text = viewpoint(scanned(tmp_path, "view.front=near", flipped=flipped))
    sides = ("back", "right") if turned else ("front", "left")
    words = "from the {} of a patient, with the head up and the {} to the right, as the file names its sides"
    assert text == words.format(*sides)
    stated = scanned(tmp_path, "volume.left_handed=true", flipped=flipped)
    assert "guess" not in viewpoint(stated)


def test_directions_without_names_and_files_without_directions(tmp_path):
    """Axes named by a scanner point to no side of a patient that is known; slices state nothing."""
    named = viewpoint(scanned(tmp_path, "view.front=near", space="scanner-xyz"))
    assert named == "from y in the coordinates of its file, with z up and -x to the right"
    np.save(tmp_path / "body.npy", np.zeros((4, 4, 4), np.uint8) + np.arange(4, dtype=np.uint8))
    words = [f"volume={{path: {tmp_path / 'body.npy'}, spacing: 1 mm}}", MARKED]
    hologram = "hologram={shape: [48, 48], pitch: 8 um, distance: 4 mm, depths: 24}"
    unknown = build(load_config(CONFIGS / "volume" / "hand.yaml", [*words, hologram]))
    assert "left and right are a guess" in viewpoint(unknown)


@pytest.mark.parametrize("front", ["far", "near"])
@pytest.mark.parametrize("flipped", [None, 0, 1, 2])
@pytest.mark.parametrize("space", [LPS, "right-anterior-superior", "left-anterior-superior"])
def test_a_patient_stands_upright_and_faces_the_observer(front, flipped, space, tmp_path):
    """However the file holds the voxels; the last space has the body's left for its right, and a left-handed frame."""
    words = ("view.up=head", f"view.front={front}")
    assert lump(scanned(tmp_path, *words, flipped=flipped, space=space).rendering()[0])[::2] == ("red", "high")
    turned = scanned(tmp_path, *words, "view.azimuth_deg=180", flipped=flipped, space=space)
    assert lump(turned.rendering()[0])[0] == "green"
    text = viewpoint(scanned(tmp_path, *words, flipped=flipped, space=space))
    assert text.startswith("from the front of a patient, with the head up and the left to the right")


def test_a_head_that_is_not_known_is_asked_for(tmp_path):
    with pytest.raises(ConfigError, match="head is known for files that say how a patient lies .* -y, y, z"):
        scanned(tmp_path, "view.up=head", space="scanner-xyz")


def test_a_left_handed_space_is_known(tmp_path):
    seen = lump(scanned(tmp_path, "view.front=near", space="left-anterior-superior").rendering()[0])
    assert seen == ("red", "right", "high")


@pytest.mark.parametrize("front", ["far", "near"])
def test_angles_turn_what_the_observer_sees_to_the_right_and_downwards(front, tmp_path):
    """As dragging in the live page does, with the positive signs."""
    colour, side, height = lump(scanned(tmp_path, f"view.front={front}").rendering()[0])
    pictures = [
        scanned(tmp_path, f"view.front={front}", word).rendering()[0]
        for word in ("view.azimuth_deg=0", "view.azimuth_deg=20", "view.elevation_deg=20")
    ]
    channel, other = (0, 1) if colour == "red" else (1, 0)
    centres = []
    for picture in pictures:
        share = (picture[channel] - picture[other]).clamp(min=0)
        y, x = torch.meshgrid(*(torch.arange(n, dtype=share.dtype) for n in share.shape), indexing="ij")
        centres.append(((share * x).sum() / share.sum(), (share * y).sum() / share.sum()))
    assert centres[1][0] > centres[0][0] + 1 and centres[2][1] > centres[0][1] + 1


@pytest.mark.parametrize("front", ["far", "near"])
@pytest.mark.parametrize("light", ["view.lighting=true", "view.scattering={half_angle_deg: 0}"])
def test_the_lamp_is_on_the_observer_s_side(front, light, tmp_path):
    one = scanned(tmp_path, f"view.front={front}", light)
    lighting = one._lighting()
    assert lighting is not None and lighting.towards[0] * (-1 if front == "far" else 1) < 0
    assert lighting.towards[1:] == (-0.5, -0.5)


def test_a_file_that_does_not_say_how_its_axes_lie_can_be_mirrored(tmp_path):
    seen = [lump(scanned(tmp_path, f"volume.left_handed={word}").rendering()[0]) for word in ("false", "true")]
    assert seen == [("green", "right", "low"), ("green", "left", "low")]


def test_a_format_whose_library_is_missing_is_bad_input(tmp_path, monkeypatch, capsys):
    (tmp_path / "a.nii").write_bytes(bytes(400))
    monkeypatch.setitem(sys.modules, "nibabel", None)
    assert main(["check", str(CONFIGS / "volume" / "hand.yaml"), f"volume={{path: {tmp_path / 'a.nii'}}}"]) == 2
    assert "a.nii: reading NIfTI needs nibabel" in capsys.readouterr().err
