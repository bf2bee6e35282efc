"""Presets stay within a range of values; files of two viewers come in as their own interpolation says."""

import json

import numpy as np
import pytest
import torch

from holotorch.scene.transfer_presets import bone, industrial, skin, soft_tissue, transfer_from_json, vessels

PARAVIEW = {
    "ColorSpace": "RGB",
    "Name": "hot",
    "NanColor": [1, 0, 0],
    "RGBPoints": [-100, 0, 0, 0, 50, 1, 0.5, 0, 400, 1, 1, 1],
    "Points": [-100, 0, 0.5, 0, 20, 0.2, 0.25, 0, 200, 0.8, 0.5, 0],
}
SLICER = {
    "@schema": "volume-property-schema-v1.0.0.json#",
    "volumeProperties": [
        {
            "effectiveRange": [-1000, 1000],
            "components": [
                {
                    "shade": True,
                    "scalarOpacityUnitDistance": 1.0,
                    "scalarOpacity": {
                        "points": [
                            {"x": -1000, "y": 0, "midpoint": 0.5, "sharpness": 0},
                            {"x": 100, "y": 0.25, "midpoint": 0.5, "sharpness": 0},
                            {"x": 1000, "y": 1, "midpoint": 0.5, "sharpness": 0},
                        ]
                    },
                    "gradientOpacity": {"points": [{"x": 0, "y": 1, "midpoint": 0.5, "sharpness": 0}]},
                    "rgbTransferFunction": {
                        "points": [
                            {"x": -500, "color": [0.1, 0.2, 0.3], "midpoint": 0.5, "sharpness": 0},
                            {"x": 700, "color": [1, 0.9, 0.8], "midpoint": 0.5, "sharpness": 0},
                        ]
                    },
                }
            ],
        }
    ],
}


def changed(content, path, value) -> str:
    copy = json.loads(json.dumps(content))
    *way, last = path
    place = copy
    for step in way:
        place = place[step]
    if value is None:
        del place[last]
    else:
        place[last] = value
    return json.dumps(copy)


@pytest.mark.parametrize("preset", [bone, soft_tissue, vessels, industrial])
def test_presets_follow_the_range_and_leave_air_clear(preset):
    small, large = preset(0, 1), preset(-1000, 3000, unit_distance=0.02)
    values = torch.linspace(-0.1, 1.1, 50)
    # float32 positions of up to 3000 are right to 1e-4, that is 3e-8 of the range times slopes of up to 7.
    torch.testing.assert_close(small(values), large(values * 4000 - 1000), rtol=0, atol=1e-5)
    assert (small.unit_distance, large.unit_distance) == (0.01, 0.02)
    assert small(torch.tensor(0.1))[1] == 0 < small(torch.tensor(0.9))[1] < 1
    with pytest.raises(ValueError, match="low must be below high, got 5 and 5"):
        preset(5, 5)


def test_skin_is_opaque_from_just_above_air_on():
    assert skin(20, 120)(torch.tensor(20.0))[1] == 0
    torch.testing.assert_close(skin(20, 120)(torch.tensor(26.0))[1], torch.tensor(0.9), rtol=0, atol=1e-5)


def test_paraview_map_with_its_own_positions_and_a_moved_midpoint():
    transfer = transfer_from_json(json.dumps([PARAVIEW, {"Name": "ignored"}]), unit_distance=0.03)
    values = torch.linspace(-150, 450, 121)
    colour, opacity = transfer(values)
    # Half-way in value is a quarter of the way in position.
    np.testing.assert_allclose(opacity, np.interp(values, [-100, 20, 65, 200], [0, 0.2, 0.5, 0.8]), atol=2e-6)
    for c, channel in enumerate(([0, 1, 1], [0, 0.5, 1], [0, 0, 1])):
        np.testing.assert_allclose(colour[c], np.interp(values, [-100, 50, 400], channel), atol=2e-6)
    assert transfer.unit_distance == 0.03


def test_paraview_jump():
    text = changed(PARAVIEW, ["Points"], [-100, 0, 0.5, 0, 50, 0.1, 0.5, 0, 50, 0.9, 0.5, 0, 400, 1, 0.5, 0])
    opacity = transfer_from_json(text)(torch.tensor([50.0 - 1e-3, 50.0, 50.0 + 1e-3]))[1]
    np.testing.assert_allclose(opacity, [0.1, 0.1, 0.9], atol=1e-5)


def test_slicer_property():
    transfer = transfer_from_json(json.dumps(SLICER))
    values = torch.linspace(-1200, 1200, 97)
    colour, opacity = transfer(values)
    np.testing.assert_allclose(opacity, np.interp(values, [-1000, 100, 1000], [0, 0.25, 1]), atol=2e-6)
    for c, channel in enumerate(([0.1, 1], [0.2, 0.9], [0.3, 0.8])):
        np.testing.assert_allclose(colour[c], np.interp(values, [-500, 700], channel), atol=2e-6)


PART = ["volumeProperties", 0, "components", 0]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "must be JSON text"),
        ("[" * 100_000, "must be JSON text"),
        (changed(PARAVIEW, ["RGBPoints", 1], 10**400), r"RGBPoints\[1\] must be a number, got 1000"),
        ("[]", "'RGBPoints' or a 3D Slicer file with 'volumeProperties', got list"),
        (changed(PARAVIEW, ["ColorSpace"], "Lab"), "ColorSpace must be RGB.*got 'Lab'"),
        (changed(PARAVIEW, ["Points"], None), "Points must be a list that is not empty, got nothing"),
        (changed(PARAVIEW, ["Points", 3], 0.4), r"Points\[0:4\] must have sharpness 0.*got 0.4"),
        (changed(PARAVIEW, ["RGBPoints", 5], "red"), r"RGBPoints\[5\] must be a number, got 'red'"),
        (changed(PARAVIEW, ["RGBPoints", 5], 255), r"RGBPoints\[4:8\] must hold colours and opacities in \[0, 1\]"),
        (changed(PARAVIEW, ["RGBPoints", 8], 3), r"RGBPoints\[8:12\] must not lie below the one before, got 50"),
        (changed(PARAVIEW, ["RGBPoints"], [1, 2, 3]), "RGBPoints must hold four numbers per point, got 3"),
        (changed(PARAVIEW, ["RGBPoints"], [1, 0, 0, 0]), "RGBPoints must hold at least two different positions"),
        (changed(SLICER, [*PART, "scalarOpacity"], None), r"components\[0\].scalarOpacity must be an object"),
        (changed(SLICER, [*PART, "scalarOpacity", "points", 1, "y"], None), r"points\[1\].y must be a number"),
        (changed(SLICER, [*PART, "rgbTransferFunction", "points", 0, "color"], [1, 2]), r"color must be red, green"),
        (changed(SLICER, [*PART, "gradientOpacity", "points", 0, "y"], 0.5), "gradientOpacity must be 1 throughout"),
        (changed(SLICER, PART[:-1], [{}, {}]), "components must be one, for a volume of one scalar, got 2"),
        (changed(SLICER, PART[:-1], [3]), r"components\[0\] must be an object, got int '3'"),
    ],
)  # fmt: skip
def test_mistakes_name_the_field(text, message):
    with pytest.raises(ValueError, match=message):
        transfer_from_json(text)
