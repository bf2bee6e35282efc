"""The table of colours against angles between chromas that are computed one by one."""

import numpy as np
import pytest

from holotorch.tracking.camera.camera import Camera
from holotorch.tracking.detection.colours import ColourTable
from holotorch.tracking.pose.catheter import THESIS, Catheter
from holotorch.tracking.simulation.world import synthetic_camera

CAMERA = synthetic_camera()
TABLE = ColourTable(CAMERA, THESIS)
EDGES = (0.07, 0.108, 0.146, 0.184)


def light_of(levels) -> np.ndarray:
    share = np.asarray(levels, float) / 255
    return np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)


def levels_of(light) -> np.ndarray:
    light = np.clip(light, 0, 1)
    share = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    return np.round(255 * share).astype(np.uint8)


def labels(levels: np.ndarray, table: ColourTable = TABLE) -> list[int]:
    """Of levels [N, 3]."""
    return table.labels(levels[:, None])[:, 0].tolist()


@pytest.mark.parametrize("band", range(3))
def test_bands_keep_their_label_in_light_and_shade(band):
    gains = np.geomspace(0.12, 1.6, 40)[:, None]
    shades = levels_of(gains * light_of(THESIS.colours[band]))
    assert labels(shades) == [band + 1] * 40
    # A little white light on it, as gloss or haze: 3 % of what white paper sends back.
    hazy = levels_of(np.geomspace(0.5, 1.0, 20)[:, None] * light_of(THESIS.colours[band]) + 0.03)
    assert labels(hazy) == [band + 1] * 20


def test_what_is_grey_dark_or_of_another_hue_is_nothing():
    greys = np.arange(256, dtype=np.uint8)[:, None].repeat(3, 1)
    assert not any(labels(greys))
    dark = np.random.default_rng(1).integers(0, 24, (500, 3)).astype(np.uint8)
    assert not any(labels(dark))
    others = np.array([[230, 220, 40], [200, 50, 190], [60, 190, 190]], dtype=np.uint8)
    assert not any(labels(others))  # yellow, magenta, cyan


def test_random_colours_are_judged_by_their_angle_in_linear_light():
    """Cells are 8 levels wide: colours well inside or outside the cone of 32 degrees are judged as the formula says."""
    rng = np.random.default_rng(2)
    levels = rng.integers(0, 256, (20000, 3)).astype(np.uint8)

    def chroma(values):
        light = light_of(values)
        away = light - light.mean(-1, keepdims=True)
        length = np.linalg.norm(away, axis=-1, keepdims=True)
        return away / np.maximum(length, 1e-12), (length / np.maximum(np.linalg.norm(light, axis=-1)[:, None], 1e-12))[
            :, 0
        ]

    direction, pure = chroma(levels)
    wanted, saturation = chroma(np.array(THESIS.colours))
    angle = np.degrees(np.arccos(np.clip(direction @ wanted.T, -1, 1)))
    nearest, least = angle.argmin(-1), angle.min(-1)
    share, bright = pure / saturation[nearest], levels.max(-1) > 60
    found = np.array(labels(levels))
    inside = bright & (least < 24) & (share > 0.5)
    outside = bright & ((least > 40) | (share < 0.2))
    assert inside.sum() > 1000 and outside.sum() > 1000
    assert (found[inside] == nearest[inside] + 1).all()
    assert (found[outside] == 0).all()


def test_labels_keep_the_shape_and_take_any_strides():
    frame = np.zeros((3, 6, 8), dtype=np.uint8)
    frame[:, 2, 4] = THESIS.colours[1]
    found = TABLE.labels(np.moveaxis(frame, 0, -1)[::2, ::2])
    assert found.dtype == np.uint8 and found.shape == (3, 4)
    assert np.argwhere(found).tolist() == [[1, 2]] and found[1, 2] == 2


def test_labels_are_those_of_the_upper_five_bits():
    """Of all such colours, and with any lower bits."""
    bits = np.arange(32, dtype=np.uint8)
    cells = np.stack(np.meshgrid(bits, bits, bits, indexing="ij"), -1)
    index = (cells.astype(int) * [1 << 10, 1 << 5, 1]).sum(-1).reshape(1, -1)
    lower = np.random.default_rng(3).integers(0, 8, (1, 1 << 15, 3)).astype(np.uint8)
    found = TABLE.labels(8 * cells.reshape(1, -1, 3) + lower)
    assert np.array_equal(found, TABLE.table[index]) and len(set(found.ravel().tolist())) == 4
    assert np.array_equal(TABLE.table[: 1 << 15], TABLE.table[1 << 15 :])  # OpenCV may set the highest bit or not


def test_bands_that_read_the_same_from_both_ends_are_refused():
    """Four points keep their cross-ratio when they are turned round: no pose tells tip and rear apart."""
    red, green, _ = THESIS.colours
    with pytest.raises(ValueError, match="same from both ends.*change one"):
        ColourTable(CAMERA, Catheter(EDGES, (red, green, red), 1e-3, 0.35))


def test_the_tone_curve_counts():
    """The same light through another curve has other levels and the same label."""
    camera = Camera(CAMERA.matrix, CAMERA.distortion, "linear")
    straight = tuple(tuple(int(v) for v in np.round(255 * light_of(colour))) for colour in THESIS.colours)
    catheter = Catheter(EDGES, straight, 1e-3, 0.35)  # type: ignore[arg-type]
    table = ColourTable(camera, catheter)
    for band, colour in enumerate(THESIS.colours):
        light = np.linspace(0.5, 1.5, 20)[:, None] * light_of(colour)
        assert labels(np.round(255 * np.clip(light, 0, 1)).astype(np.uint8), table) == [band + 1] * 20


def test_repeated_colours_are_one():
    red, green, blue = THESIS.colours
    catheter = Catheter((0.01, 0.03, 0.05, 0.07, 0.09), (red, green, red, blue), 1e-3, 0.2)
    table = ColourTable(CAMERA, catheter)
    assert table.colours == (red, green, blue) and table.bands == (0, 1, 0, 2)
    assert np.array_equal(table.table, TABLE.table)


@pytest.mark.parametrize(
    ("colours", "message"),
    [
        (((200, 40, 45), (120, 120, 120), (40, 70, 190)), r"saturated colours, got \(120, 120, 120\); .* gap between"),
        (((120, 120, 120), (200, 40, 45), (40, 70, 190)), r"saturated colours, got \(120, 120, 120\)$"),
        (((200, 40, 45), (255, 255, 255), (40, 70, 190)), "saturated"),
        (((200, 40, 45), (0, 0, 0), (40, 70, 190)), "saturated"),
        (((200, 40, 45), (40, 150, 70), (40, 190, 70)), "25 degrees apart"),
        (((40, 70, 190), (200, 40, 45), (60, 60, 120)), "25 degrees apart"),
    ],
)
def test_colours_that_cannot_be_told_apart_are_refused(colours, message):
    with pytest.raises(ValueError, match=message):
        ColourTable(CAMERA, Catheter(EDGES, colours, 1e-3, 0.35))
