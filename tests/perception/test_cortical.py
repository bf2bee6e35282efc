import math

import pytest
import torch

from holotorch.perception import (
    COWEY_ROLLS,
    DOUGHERTY,
    HORTON_HOYT,
    INFERIOR,
    NASAL,
    SUPERIOR,
    TEMPORAL,
    Headset,
    LinearMagnification,
    LinearSize,
    RovamoVirsu,
    StrasburgerLetters,
    TolhurstLing,
    cortical_scale,
    peripheral_weight,
)

LAWS = [COWEY_ROLLS, HORTON_HOYT, DOUGHERTY, NASAL, TEMPORAL, SUPERIOR, INFERIOR, TolhurstLing(0.5)]
LAWS += [StrasburgerLetters(), LinearSize(0.05, 0.4)]


def test_laws_by_hand():
    # 1 / M at 10 deg in deg/mm, as printed: with the 1 that the thesis leaves out of Cowey and Rolls's.
    assert COWEY_ROLLS(10).item() == pytest.approx((1 + 10 / 1.746) / 8.55)
    assert 1 / HORTON_HOYT(10).item() == pytest.approx(17.3 / 10.75)
    assert 1 / DOUGHERTY(10).item() == pytest.approx(29.2 / 13.67)
    assert NASAL(10).item() == pytest.approx((1 + 3.3 + 0.07) / 7.99)
    assert TEMPORAL(10).item() == pytest.approx((1 + 2.9 + 0.012) / 7.99)
    assert SUPERIOR(10).item() == pytest.approx((1 + 4.2 + 0.12) / 7.99)
    assert INFERIOR(10).item() == pytest.approx((1 + 4.2 + 0.055) / 7.99)
    assert TolhurstLing(0.5)(10).item() == pytest.approx(6**1.1 / 24.88)
    assert StrasburgerLetters()(10).item() == pytest.approx(0.22 + 0.25 / (2.07 - 0.345))
    assert StrasburgerLetters(0.1)(10).item() == pytest.approx(0.22 + 0.25 / (1.07 - 0.345))
    assert LinearSize(0.05, 0.4)(10).item() == pytest.approx(0.9)


@pytest.mark.parametrize("law", LAWS, ids=repr)
def test_scale_is_relative_to_the_fovea_and_differentiable(law):
    assert cortical_scale(0, law, 2.5).item() == pytest.approx(2.5)
    where = torch.tensor([0.0, 12.0, 39.0], dtype=torch.float64, requires_grad=True)
    sizes = cortical_scale(where, law)
    assert (sizes.diff() > 0).all()
    torch.testing.assert_close(sizes, law(where) / law(0.0))
    (gradient,) = torch.autograd.grad(sizes.sum(), where)
    step = 1e-4  # the quotient is off by its square times the third derivative, below 1e-3 here
    inner = where.detach()[1:]
    quotient = (cortical_scale(inner + step, law) - cortical_scale(inner - step, law)) / (2 * step)
    torch.testing.assert_close(gradient[1:], quotient, rtol=1e-6, atol=1e-8)
    assert gradient.isfinite().all()
    assert cortical_scale(where.float(), law).dtype == torch.float32
    for bad in (-1.0, 181.0, math.nan):
        with pytest.raises(ValueError, match="eccentricity_deg must be"):
            cortical_scale(bad, law)


def test_strasburger_s_pole_is_guarded():
    law = StrasburgerLetters()
    assert law.pole_deg == pytest.approx(60) and law(59.9).item() == pytest.approx(0.022 * 59.9 + 0.25 / 0.00345)
    for bad in (60.0, 61.0, 80.0):
        with pytest.raises(ValueError, match=r"below 60 degrees, its pole at a contrast of 1, got"):
            law(bad)
    with pytest.raises(ValueError, match=r"below 31\.0"):
        StrasburgerLetters(0.1)(35)
    for bad in (0.0085, 0.001, 1.1):
        with pytest.raises(ValueError, match="contrast must be above"):
            StrasburgerLetters(bad)


def test_other_limits_and_parameters():
    with pytest.raises(ValueError, match="at most 40 degrees, as far as it was tested, got 41"):
        LinearSize(0.05, 0.4)(41)
    assert COWEY_ROLLS(80).item() == pytest.approx((1 + 80 / 1.746) / 8.55)
    for make in (lambda: LinearMagnification(8.0, 0.0), lambda: RovamoVirsu(-1.0, 1e-5), lambda: TolhurstLing(0.0)):
        with pytest.raises(ValueError, match="must be above zero"):
            make()


def test_weight_is_the_square_of_what_the_eye_resolves():
    where = Headset((12, 17), 0.14).eccentricity_map()
    weight = peripheral_weight(where, COWEY_ROLLS)
    assert weight.shape == (12, 17) and weight.mean().item() == pytest.approx(1)
    # Both relative to each other: (1 + E / 1.746)^-2.
    near, far = where[5, 8].item(), where[0, 0].item()
    wanted = ((1 + far / 1.746) / (1 + near / 1.746)) ** 2
    assert (weight[5, 8] / weight[0, 0]).item() == pytest.approx(wanted)
    limited = peripheral_weight(where, COWEY_ROLLS, least=0.1)
    corner, middle = limited[0, 0].item(), limited[5, 8].item()
    assert corner / middle == pytest.approx(0.1 * (1 + near / 1.746) ** 2)
    assert torch.allclose(peripheral_weight(where, COWEY_ROLLS, least=1.0), torch.ones(12, 17, dtype=torch.float64))
    where.requires_grad_()
    assert torch.autograd.grad(peripheral_weight(where, NASAL)[3, 3], where)[0].isfinite().all()
    with pytest.raises(ValueError, match="end in"):
        peripheral_weight(10.0, NASAL)
    with pytest.raises(ValueError, match="least must be within 0"):
        peripheral_weight(where, NASAL, least=2.0)
