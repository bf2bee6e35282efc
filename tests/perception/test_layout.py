import ast
import subprocess
import sys
from pathlib import Path

import pytest
import torch

import holotorch.perception as perception
from holotorch.perception import TABLE_2_1, EqualEfficiencyScale, WideDisplay, check_display, overlaps, scale_layout

SCALE = EqualEfficiencyScale.from_table(5, 20)  # 0.55 E - 16.3
CENTRES = torch.tensor([[0.0, 10.0], [0.0, -40.0], [0.0, 60.0], [0.0, -80.0], [20.0, 55.0]], dtype=torch.float64)
SIZES = torch.tensor([[5.0, 5.0], [5.0, 5.0], [2.0, 4.0], [5.0, 5.0], [3.0, 1.0]], dtype=torch.float64)


def test_each_item_gets_the_size_of_its_eccentricity():
    found = scale_layout(CENTRES, SIZES, SCALE)
    skew = torch.tensor(20.0).double().deg2rad().cos() * torch.tensor(55.0).double().deg2rad().cos()
    where = skew.acos().rad2deg().item()  # 57.4 deg
    assert found.eccentricity_deg.tolist() == pytest.approx([10, 40, 60, 80, where])
    wanted = [[5, 5], [5.7, 5.7], [8.35, 16.7], [5, 5], [0.55 * where - 16.3, (0.55 * where - 16.3) / 3]]
    torch.testing.assert_close(found.size_deg, torch.tensor(wanted, dtype=torch.float64))
    assert found.fitted.tolist() == [False, True, True, False, True]
    assert found.kept.tolist() == [True, False, False, True, False] and not found.extrapolated.any()
    assert found.tested.all()


def test_extrapolation_is_asked_for_and_flagged_and_never_towards_the_centre():
    found = scale_layout(CENTRES, SIZES, SCALE, extrapolate=True)
    assert found.size_deg[3].tolist() == pytest.approx([27.7, 27.7])  # 0.55 * 80 - 16.3
    assert found.extrapolated.tolist() == [False, False, False, True, False]
    assert found.tested.tolist() == [True, True, True, False, True]
    assert found.size_deg[0].tolist() == [5, 5] and found.kept[0]


def test_layout_is_differentiable_and_follows_dtype():
    # Not at 40 deg itself, where sizes jump.
    centres, sizes = (CENTRES + 1).requires_grad_(), SIZES.clone().requires_grad_()
    assert torch.autograd.gradcheck(lambda c, s: scale_layout(c, s, SCALE, extrapolate=True).size_deg, (centres, sizes))
    alpha = torch.tensor(0.5, dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad(scale_layout(CENTRES, SIZES, EqualEfficiencyScale(alpha, -10)).size_deg[1, 0], alpha)
    assert slope.item() == pytest.approx(40)
    assert scale_layout(CENTRES.float(), SIZES.float(), SCALE).size_deg.dtype == torch.float32
    with pytest.raises(ValueError, match=r"must both be \[N, 2\]"):
        scale_layout(CENTRES, SIZES[:2], SCALE)
    with pytest.raises(ValueError, match="within 90 degrees of elevation"):
        scale_layout([[95.0, 0.0]], [[5.0, 5.0]], SCALE)
    with pytest.raises(ValueError, match="size_deg must be above zero"):
        scale_layout(CENTRES, -SIZES, SCALE)


def test_overlaps_are_found_also_across_the_back():
    centres = [[0.0, 0.0], [0.0, 9.0], [0.0, 19.5], [0.0, 178.0], [0.0, -178.0], [60.0, 0.0], [60.0, 16.0]]
    sizes = [[10.0, 10.0]] * 7
    pairs, depth = overlaps(centres, sizes)
    # At 60 deg of elevation 10 deg of width span 20 deg of azimuth: 4 deg too near, 2 deg of width.
    assert pairs.tolist() == [[0, 1], [3, 4], [5, 6]]
    assert depth.tolist() == pytest.approx([1, 6, 2])
    pairs, _ = overlaps([[0.0, 0.0], [0.0, 10.0]], [[10.0, 10.0]] * 2)
    assert pairs.shape == (0, 2)
    assert overlaps([[0.0, 0.0]], [[10.0, 10.0]])[0].shape == (0, 2)


def test_table_of_displays_is_the_printed_one():
    assert len(TABLE_2_1) == 14
    assert [d.field_deg for d in TABLE_2_1] == [80, 87, 90, 90, 100, 110, 150, 180, 190, 190, 210, 318, 360, 360]
    coarsest = [None, 4.1, 3.4, 3, 2.5, 4.5, 3, 10.5, 60, 5.5, 5.5, 7.5, 3, 4]
    assert [d.arcmin and d.arcmin[1] for d in TABLE_2_1] == coarsest
    assert [d.arcmin[0] for d in TABLE_2_1 if d.arcmin and d.arcmin[0] != d.arcmin[1]] == [5.7, 5.4, 1.5, 3]
    assert [d.height_deg for d in TABLE_2_1 if d.height_deg] == [91, 45, 50, 100, 130, 130]
    assert [d.name for d in TABLE_2_1 if not d.colour] == ["Pinlight"] and TABLE_2_1[0].pitch == 3.74e-6
    assert [d.derived for d in TABLE_2_1] == [False, True, True, False, True, True, False] + [True] * 7


def test_a_display_is_checked_for_its_field_and_its_pixels():
    # The line asks for 5.7, 11.2, 16.7 and 22.2 deg, up to 42.85, 55.6, 68.35 and 81.1 deg from the centre.
    where = [40.0, 50.0, 60.0, 70.0]
    tiled = check_display(TABLE_2_1[6], SCALE, where)  # 150 deg, 20 px/deg
    assert tiled.covered.tolist() == [True, True, True, False] and tiled.reach_deg == 75
    assert tiled.needed.tolist() == pytest.approx([12 / 5.7, 12 / 11.2, 12 / 16.7, 12 / 22.2])
    assert tiled.resolved is not None and tiled.resolved.all() and tiled.tested.all()
    mirror = check_display(TABLE_2_1[8], SCALE, where)  # one pixel per degree
    assert mirror.resolved is not None and mirror.resolved.tolist() == [False, False, True, True]
    assert mirror.covered.all()
    hologram = check_display(TABLE_2_1[0], SCALE, where)
    assert hologram.resolved is None and not hologram.covered.any()
    with pytest.raises(ValueError, match=r"within 40 \.\. 70"):
        check_display(TABLE_2_1[0], SCALE, [80.0])
    own = check_display(WideDisplay("mine", 200, arcmin=(2, 2)), SCALE, [80.0], samples=24, extrapolate=True)
    assert own.covered.tolist() == [True] and own.tested.tolist() == [False]


def test_perception_imports_torch_alone():
    folder = Path(perception.__file__).parent
    standard = {"math", "dataclasses", "typing", "collections"}
    for path in folder.glob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            for name in names:
                own = name.startswith(("holotorch.perception", "holotorch.core"))
                assert own or name.split(".")[0] in {"torch", *standard}, f"{path.name} imports {name}"
    code = (
        "import sys, holotorch.perception; print({'scipy', 'cv2', 'kornia', 'matplotlib', 'yaml'} & set(sys.modules))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "set()"
