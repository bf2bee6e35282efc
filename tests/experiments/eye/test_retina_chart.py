"""The chart of predicted errors on the retina on a small scale; the real one is committed."""

import math

import pytest

from holotorch.experiments.eye import retina_chart
from holotorch.experiments.eye.retina_chart import CUT, QUICK, Amount, retina
from holotorch.optics.viewing.elementwise import least_oversampling


@pytest.fixture(scope="module")
def quick():
    return retina(quick=True)


def test_rows_hold_both_methods_of_every_setting_and_light(quick):
    rows, further, pictures, verdict = quick
    assert not further and pictures["chart"].startswith(b"\x89PNG")
    assert len(rows) == 2 * (QUICK.drawn + QUICK.cut) * (QUICK.lights or 0)
    keys = {(row["setting"], row["light"], row["method"]) for row in rows}
    assert len(keys) == len(rows)
    assert all(0 < float(row[key]) < math.inf for row in rows for key in ("measured", "predicted", "reference_error"))
    assert f"{len(rows)} errors" in verdict[0]


def test_verdict_states_the_extreme_ratios_of_the_rows_that_count(quick):
    rows, _, _, verdict = quick
    chosen = [r for r in rows if r["method"] == "elements" and r["setting"].startswith(CUT) and r["counts"]]
    ratios = [float(row["predicted"]) / float(row["measured"]) for row in chosen]
    [line] = [line for line in verdict if line.startswith("elements, eyepiece that cuts")]
    assert f"{min(ratios):.2f} to {max(ratios):.2f}" in line


def test_ratios_beyond_the_promised_factor_are_listed():
    row = {"setting": "drawn 1", "light": "noise", "method": "collapse", "counts": True, "without_example": "1.0"}
    rows = [row | {"measured": "1.0", "predicted": "0.2"}, row | {"measured": "0.5", "predicted": "0.6"}]
    rows.append(rows[0] | {"predicted": "1e-9", "counts": False})  # below the error of its reference
    lines = retina_chart._verdict(rows, Amount(1, 0, ()))
    assert "2 of 3 errors" in lines[0] and "0.20 to 1.20, 1 of 2 within a factor 3" in lines[1]
    assert lines[-1] == "beyond a factor 3: drawn 1, noise, collapse (0.20)"


def test_settings_are_the_same_each_time_and_some_eyepieces_cut_light_off():
    once, again = (retina_chart._settings(Amount(3, 3, ())) for _ in range(2))
    assert once == again
    narrow = [each for each in once if each.name.startswith(CUT)]
    assert len(narrow) == 3
    for each in narrow:
        height = (each.grid.extent[0] + each.display.lens_distance * each.wavelengths[0] / each.grid.pitch[0]) / 2
        assert each.display.lens_radius is not None and each.display.lens_radius < 0.8 * height
    for each in once:
        least, finer = least_oversampling(*each.arguments), each.reference
        assert all(a >= 1.25 * 2 * b for a, b in zip(finer.fine, least.fine, strict=True))
        assert math.prod(finer.oversampling) == pytest.approx(1.25**2 * math.prod(least.oversampling))
