"""Colours and opacities against numpy's interpolation; what may be skipped; learning."""

import math

import numpy as np
import pytest
import torch

from holotorch.scene.transfer import TransferFunction

POSITIONS = [-10.0, 0.0, 5.0, 25.0, 100.0]
COLOURS = [[0.0, 0.1, 0.2], [0.5, 0.4, 0.9], [1.0, 0.0, 0.3], [0.2, 0.2, 1.0], [0.9, 0.8, 0.0]]
OPACITIES = [0.0, 0.0, 0.4, 0.1, 1.0]


def table(dtype=torch.float64, opacities=OPACITIES) -> TransferFunction:
    parts = [torch.tensor(part, dtype=dtype) for part in (POSITIONS, COLOURS, opacities)]
    return TransferFunction(*parts, unit_distance=0.01)


def test_lookup_is_linear_interpolation_and_constant_beyond():
    values = torch.cat(
        [torch.linspace(-30, 130, 97, dtype=torch.float64), torch.tensor(POSITIONS, dtype=torch.float64)]
    )
    colour, opacity = table()(values.reshape(2, 3, 17))
    assert colour.shape == (3, 2, 3, 17) and opacity.shape == (2, 3, 17)
    np.testing.assert_allclose(opacity.flatten(), np.interp(values, POSITIONS, OPACITIES), atol=1e-15)
    for c in range(3):
        np.testing.assert_allclose(
            colour[c].flatten(), np.interp(values, POSITIONS, np.array(COLOURS)[:, c]), atol=1e-15
        )


@pytest.mark.parametrize("dtype", [torch.uint8, torch.int16, torch.uint16, torch.int32])
def test_integers_give_what_their_numbers_give(dtype):
    values = torch.arange(0, 110, dtype=torch.int32)
    for found, wanted in zip(table()(values.to(dtype)), table()(values.double()), strict=True):
        assert torch.equal(found, wanted)


def test_precision_is_the_wider_one():
    single = table(torch.float32)
    assert single(torch.tensor([1], dtype=torch.uint8))[1].dtype == torch.float32
    assert single(torch.ones(1, dtype=torch.float64))[1].dtype == torch.float64
    assert table()(torch.ones(1))[1].dtype == torch.float64


def test_gradcheck_of_values_colours_and_opacities():
    values = torch.tensor([-20.0, -3.0, 2.0, 4.0, 17.0, 60.0, 110.0], dtype=torch.float64, requires_grad=True)
    transfer = table(opacities=[0.1, 0.2, 0.4, 0.1, 0.7])
    inner = (torch.rand(5, 3, dtype=torch.float64) * 0.8 + 0.1).requires_grad_()

    def lookup(values, colours, opacities):
        return torch.func.functional_call(transfer, {"colours": colours, "opacities": opacities}, (values,))

    opacities = transfer.opacities.detach().clone().requires_grad_()
    assert torch.autograd.gradcheck(lookup, (values, inner, opacities))


def test_learning_stays_in_range_and_starts_from_the_ends():
    transfer = table()
    assert not any(p.requires_grad for p in transfer.parameters())
    transfer.requires_grad_()
    transfer(torch.tensor([-10.0, 100.0]))[1].sum().backward()
    # Opacities of exactly 0 and 1 are not stuck.
    assert transfer.opacities.grad is not None and transfer.opacities.grad[[0, -1]].tolist() == [1, 1]
    with torch.no_grad():
        transfer.opacities.add_(torch.tensor([-0.5, 0, 0, 0, 0.5]))
    assert transfer(torch.tensor([-10.0, 100.0]))[1].tolist() == [0, 1]
    transfer.clip_()
    assert transfer.opacities[[0, -1]].tolist() == [0, 1]


@pytest.mark.parametrize("opacities", [OPACITIES, [0, 0.2, 0, 0, 0.5], [0.1, 0, 0, 0, 0], [0] * 5, [0, 0, 0, 0.3, 0]])
def test_what_may_be_skipped_is_what_is_transparent(opacities):
    transfer = table(opacities=[float(o) for o in opacities])
    ends = torch.arange(-15, 110, dtype=torch.float64)
    fine = np.interp(np.arange(-15, 109.01, 0.25), POSITIONS, opacities)
    low, high = torch.meshgrid(ends, ends, indexing="ij")
    visible = transfer.visible(low, high)
    for i in range(0, 125, 3):
        for j in range(i, 125, 7):
            assert visible[i, j].item() == bool((fine[4 * i : 4 * j + 1] > 0).any()), (ends[i], ends[j])
    least, most = transfer.support()
    seen = np.arange(-15, 109.01, 0.25)[fine > 0]
    assert all(least < value < most for value in seen)
    if len(seen):
        assert least >= seen[0] - 0.25 or least == -math.inf
        assert most <= seen[-1] + 0.25 or most == math.inf


def test_nothing_is_skipped_while_opacities_are_learned():
    transfer = table(opacities=[0.0] * 5).requires_grad_()
    assert transfer.visible(torch.zeros(2), torch.ones(2)).all()
    assert transfer.support() == (-math.inf, math.inf)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"positions": [0.0]}, "at least 2 values"),
        ({"positions": [0.0, 0.0, 1.0, 2.0, 3.0]}, "positions must rise, got 0 before 0"),
        ({"colours": [[0.0, 0.0]] * 5}, r"colours must be \(K, 3\) = \(5, 3\)"),
        ({"colours": [[0.0, 0.0, 255.0]] * 5}, r"colours must lie in \[0, 1\], got 0 to 255"),
        ({"opacities": [0.0, 1.0]}, r"opacities must be \(K,\) = \(5,\)"),
        ({"opacities": [0.0, 0.1, 0.2, 0.3, -0.1]}, r"opacities must lie in \[0, 1\]"),
        ({"opacities": [0.0, 0.1, math.nan, 0.3, 0.1]}, "opacities must be finite"),
        ({"unit_distance": 0.0}, "unit_distance must be above zero"),
    ],
)
def test_mistakes_are_named(change, message):
    with pytest.raises(ValueError, match=message):
        TransferFunction(
            **{"positions": POSITIONS, "colours": COLOURS, "opacities": OPACITIES, "unit_distance": 0.01, **change}
        )
    with pytest.raises(TypeError, match="colours must be numbers"):
        TransferFunction(POSITIONS, "red", OPACITIES, unit_distance=0.01)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("opacities", "begin"),
    [
        (OPACITIES, 0.0),
        ([0.0, 0.0, 0.0, 0.0, 0.5], 25.0),
        ([0.1, 0.0, 0.0, 0.0, 0.0], -math.inf),
        ([0.0] * 5, math.inf),
    ],
)
def test_nothing_is_visible_below_the_value_that_is_said(opacities, begin):
    transfer = table(opacities=opacities)
    assert transfer.visible_from == begin
    values = torch.linspace(-20, 110, 1301, dtype=torch.float64)
    assert not transfer(values[values <= begin])[1].any()
    assert not math.isfinite(begin) or transfer(torch.tensor(begin + 1e-6, dtype=torch.float64))[1] > 0
