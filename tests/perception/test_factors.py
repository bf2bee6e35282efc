import math

import pytest

from holotorch.perception.factors import contrast_term, motion_term


def test_the_terms_by_hand():
    assert contrast_term([1, 0.5, 0.1]).tolist() == pytest.approx([0, 1, 9])
    # 8^(-2/3) is 1/4.
    assert motion_term(7, 0).item() == pytest.approx(0.75)
    assert motion_term(0, [0, 40, 105]).tolist() == pytest.approx([0, 0, 0])
    # The best speeds of McKee and Nakayama: 5 deg/s in the fovea are 30 deg/s at 40 deg.
    assert motion_term(30, 40).item() == pytest.approx(motion_term(5, 0).item())
    assert (motion_term(list(range(0, 60, 5)), 80).diff() > 0).all()


def test_impossible_patterns_are_refused():
    for contrast in (0, 1.01, -0.5, math.nan):
        with pytest.raises(ValueError, match="contrast"):
            contrast_term(contrast)
    for speed, angle in ((-1, 0), (1, -1), (math.nan, 3)):
        with pytest.raises(ValueError, match="must not be below 0|must be within 0 to 180|must be finite"):
            motion_term(speed, angle)
