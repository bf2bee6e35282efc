import math

import pytest
import torch
from oracles import perception as oracle

from holotorch.perception import FITTED_DEG, TABLE_2_2, TESTED_DEG, EqualEfficiencyScale, PerceptionTime

PATTERNS = list(oracle.SIZES)


def test_table_is_the_printed_one():
    assert [(row.size_deg, row.eccentricity_deg) for row in TABLE_2_2] == PATTERNS
    assert {(row.size_deg, row.eccentricity_deg): (row.f, row.p) for row in TABLE_2_2} == oracle.ANOVA
    assert {row.freedom for row in TABLE_2_2} == {3}
    assert FITTED_DEG == (40, 70) and TESTED_DEG == (5, 26)


@pytest.mark.parametrize("pattern", PATTERNS, ids=str)
def test_every_size_is_that_worked_by_hand(pattern):
    scale = EqualEfficiencyScale.from_table(*pattern)
    where = torch.tensor([40.0, 50.0, 60.0, 70.0], dtype=torch.float64)
    wanted = torch.tensor(oracle.SIZES[pattern], dtype=torch.float64)
    torch.testing.assert_close(scale(where), wanted, rtol=0, atol=1e-12)
    torch.testing.assert_close(scale.inverse(wanted), where, rtol=0, atol=1e-12)
    assert [scale(e).item() for e in (40, 70)] == pytest.approx([wanted[0].item(), wanted[3].item()], abs=1e-12)
    assert scale.tested(where).tolist() == [5 <= size <= 26 for size in oracle.SIZES[pattern]]


def test_what_lies_outside_is_refused_or_extrapolated_by_name():
    scale = EqualEfficiencyScale.from_table(5, 10)
    for bad in (39.999, 70.001, 80.0, 0.0):
        with pytest.raises(ValueError, match=r"within 40 \.\. 70 degrees.*extrapolate=True"):
            scale(torch.tensor([50.0, bad]))
    assert scale(80, extrapolate=True).item() == pytest.approx(26.56)  # 0.47 * 80 - 11.04
    assert not scale.tested(80) and not scale.inside(80)
    assert scale(30, extrapolate=True).item() == pytest.approx(3.06)
    with pytest.raises(ValueError, match=r"far periphery only: its size is -6\.34 degrees at 10"):
        scale(10, extrapolate=True)
    with pytest.raises(ValueError, match=r"within 7\.76 \.\. 21\.86 degrees"):
        scale.inverse(22.0)
    assert scale.inverse(26.56, extrapolate=True).item() == pytest.approx(80)
    with pytest.raises(ValueError, match="Table 2.2 has no target of 5 deg at 15 deg; it has 5 at 10"):
        EqualEfficiencyScale.from_table(5, 15)


@pytest.mark.parametrize("call", ["__call__", "inside", "tested"])
def test_negative_and_impossible_angles(call):
    use = getattr(EqualEfficiencyScale.from_table(5, 10), call)
    with pytest.raises(ValueError, match="without a sign for left or right; take the absolute value"):
        use(-50.0)
    with pytest.raises(ValueError, match="within 0 to 180 degrees, got 181"):
        use(181.0)
    for bad in (math.nan, math.inf):
        with pytest.raises(ValueError, match="must be finite"):
            use(torch.tensor([50.0, bad]))
    for wrong in ("50", None, True, torch.tensor([True])):
        with pytest.raises(TypeError):
            use(wrong)
    with pytest.raises(ValueError, match="at least one value"):
        use(torch.zeros(0))


def test_dtype_shape_and_gradient_follow_the_input():
    scale = EqualEfficiencyScale.from_table(15, 30)
    for dtype in (torch.float32, torch.float64):
        where = torch.full((2, 3), 55.0, dtype=dtype)
        assert scale(where).dtype == scale.inverse(scale(where)).dtype == dtype and scale(where).shape == (2, 3)
    where = torch.tensor([40.0, 55.0, 70.0], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda e: scale(e, extrapolate=True), where)
    (slope,) = torch.autograd.grad(
        scale.inverse(scale(where.detach()).requires_grad_()).sum(), where, allow_unused=True
    )
    assert slope is None
    alpha = torch.tensor(0.5, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda a: EqualEfficiencyScale(a, -10.0)(55.0), alpha)


def test_a_fitted_line_is_that_of_the_normal_equations():
    where = [30.0, 40.0, 50.0, 60.0, 70.0, 80.0]
    sizes = [99.0, 7.1, 12.9, 16.8, 22.4, 300.0]  # the first and the last lie outside and must not matter
    found = EqualEfficiencyScale.fit(where, sizes)
    line, covariance = oracle.line(where[1:5], sizes[1:5])
    assert [float(found.alpha), float(found.beta)] == pytest.approx(line.tolist(), rel=1e-12)
    assert found.covariance is not None
    torch.testing.assert_close(found.covariance, torch.from_numpy(covariance), rtol=1e-10, atol=0)
    two = EqualEfficiencyScale.fit([40, 70], [5.0, 20.0])
    assert float(two.alpha) == 0.5 and two.covariance is not None and two.covariance.isnan().all()
    for eccentricities in ([40.0], [40.0, 40.0], [10.0, 80.0]):
        with pytest.raises(ValueError, match="two or more eccentricities within 40"):
            EqualEfficiencyScale.fit(eccentricities, [5.0] * len(eccentricities))


def surface() -> tuple[PerceptionTime, list[float]]:
    """Laws whose sizes of 0.45 s are 0.5 E - 12, and whose times at 20 deg are known."""
    where = [20.0, 40.0, 50.0, 60.0, 70.0, 80.0]
    slopes = [-0.05, -0.06, -0.07, -0.08, -0.09, 0.01]
    sizes = [5.0, 8.0, 13.0, 18.0, 23.0, 28.0]
    parts = [0.45 - a * math.log(s) for a, s in zip(slopes, sizes, strict=True)]
    return PerceptionTime(torch.tensor(slopes, dtype=torch.float64), torch.tensor(parts, dtype=torch.float64)), where


def test_a_surface_gives_the_line_by_time_and_by_target():
    times, where = surface()  # that at 80 deg rises: it is not asked
    for found in (
        EqualEfficiencyScale.from_time(0.45, times, where),
        EqualEfficiencyScale.from_surface(5, 20, times, where),
    ):
        # Rounding of T - b, 1e-16 s, over a, -0.05 s, times sizes of 23 deg, and of a line at 40 deg from its middle.
        assert [float(found.alpha), float(found.beta)] == pytest.approx([0.5, -12], abs=1e-11)
    with pytest.raises(ValueError, match="one law at 25 degrees"):
        EqualEfficiencyScale.from_surface(5, 25, times, where)
    with pytest.raises(ValueError, match="one law per eccentricity"):
        EqualEfficiencyScale.from_time(0.45, times, where[1:])
    with pytest.raises(ValueError, match="larger pattern is not perceived sooner"):
        EqualEfficiencyScale.from_time(0.45, PerceptionTime(-times.slope, times.intercept), where)
    time = torch.tensor(0.45, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda t: EqualEfficiencyScale.from_time(t, times, where)(55.0), time)


def test_parameters_that_are_none():
    with pytest.raises(ValueError, match="alpha must be one number"):
        EqualEfficiencyScale(torch.ones(2), 0.0)
    with pytest.raises(ValueError, match="beta must be finite"):
        EqualEfficiencyScale(1.0, math.nan)
    with pytest.raises(ValueError, match="low_deg < high_deg"):
        EqualEfficiencyScale(1.0, 0.0, 70, 40)
    with pytest.raises(ValueError, match="alpha is 0"):
        EqualEfficiencyScale(0.0, 9.0).inverse(9.0)
