import math
import warnings

import numpy as np
import pytest
import torch
from oracles import panel as oracle

from holotorch import Grid
from holotorch.modulator import Cauchy, PhaseModulator, phase_scale
from holotorch.modulator.panel import even_lut, level_of, nearest_levels, quantisation_rms, snapped

GRID = Grid((12, 17), (5e-6, 4e-6))
WAVES = (630e-9, 530e-9)
TURN = 2 * math.pi


def bent(bits: int, stroke: float, power: float = 1.3) -> torch.Tensor:
    return stroke * torch.linspace(0, 1, 2**bits, dtype=torch.float64) ** power


def wanted(*batch: int, dtype: torch.dtype = torch.float64) -> torch.Tensor:
    generator = torch.Generator().manual_seed(3)
    return 20 * torch.rand((*batch, len(WAVES), *GRID.shape), generator=generator, dtype=dtype) - 10


TABLES = {
    "even": even_lut(4),
    "even, short of a turn": even_lut(4, 20.5),
    "even, beyond a turn": even_lut(5, 12.3),
    "bent": bent(6, 6.2),
    "bent, short": bent(6, 4.4),
    "bent, two turns": bent(6, 13.0),
    "falling": 2.0 - bent(5, 6.0),
}


@pytest.mark.parametrize("lut", TABLES.values(), ids=TABLES)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_every_phase_goes_to_the_nearest_level_on_the_circle(lut, dtype):
    phase = 40 * torch.rand(3000, generator=torch.Generator().manual_seed(1), dtype=dtype) - 20
    got = lut[nearest_levels(phase, lut)].numpy()
    best = oracle.nearest(phase.double().numpy(), lut.numpy())
    # Equally near ones may differ; on the circle they are the same, or equally far from what was wanted.
    far = [np.abs(np.exp(1j * phase.double().numpy()) - np.exp(1j * shown)) for shown in (got, best)]
    np.testing.assert_allclose(far[0], far[1], rtol=0, atol=1e-12)
    assert set(snapped(phase, lut).double().tolist()) <= set(lut.to(dtype).double().tolist())  # to the bit


@pytest.mark.parametrize("lut", [*TABLES.values(), even_lut(8)], ids=[*TABLES, "8 bits"])
def test_the_error_of_uniform_phases_is_predicted(lut):
    phase = TURN * torch.rand(200_000, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    rms = oracle.wrapped_rms(snapped(phase, lut).numpy(), phase.numpy())
    # The mean of N squares of an error with fourth moment m4 has a relative deviation sqrt(m4 / m2^2 - 1) / sqrt(N); of
    # a short stroke's error, zero but in its gap, m4 / m2^2 stays below 12. Half of it for the root, five deviations.
    assert rms == pytest.approx(quantisation_rms(lut), rel=5 * math.sqrt(11 / 200_000) / 2)


def test_eight_bits_err_by_seven_milliradians():
    assert PhaseModulator(GRID, WAVES).expected_rms == pytest.approx([TURN / 256 / math.sqrt(12)] * 2, rel=1e-12)
    assert TURN / 256 / math.sqrt(12) == pytest.approx(0.007, abs=1e-4)


@pytest.mark.parametrize("bits", [1, 8, 10, 16])
def test_frames_lead_back_to_the_phases_shown(bits):
    panel = PhaseModulator(GRID, WAVES, bits=bits, flip_rows=True, flip_columns=True)
    plain = PhaseModulator(GRID, WAVES, bits=bits)
    phase = wanted(3)
    levels = panel.levels(phase)
    assert levels.dtype == (torch.uint8 if bits <= 8 else torch.uint16)
    assert torch.equal(panel.phase(levels), panel.shown(phase))
    np.testing.assert_array_equal(levels.numpy(), plain.levels(phase).numpy()[..., ::-1, ::-1])


def test_each_colour_has_its_own_table():
    rows = torch.stack([even_lut(6), even_lut(6, 70)])
    panel = PhaseModulator(GRID, WAVES, bits=6, lut=rows)
    phase = wanted()
    for c in range(2):
        assert torch.equal(panel.shown(phase)[c], snapped(phase[c], rows[c]))
    assert panel.lut_hash(0) == PhaseModulator(GRID, WAVES, bits=6).lut_hash(1) != panel.lut_hash(1)


def test_gradient_passes_the_levels_and_is_that_of_the_shown_phase():
    panel = PhaseModulator(GRID, WAVES, bits=3, crosstalk=0.6, fill_factor=0.8, gap=0.4, birefringence=Cauchy())
    phase, light = wanted().requires_grad_(), (640e-9, 520e-9)
    weights = torch.randn(2, *GRID.shape, dtype=torch.complex128, generator=torch.Generator().manual_seed(5))

    def loss(field):
        return (weights * field).real.sum()

    (through,) = torch.autograd.grad(loss(panel(phase, light)), phase)
    shown = panel.shown(phase).detach().requires_grad_()
    (there,) = torch.autograd.grad(loss(panel.emitted(shown, light)), shown)
    assert torch.equal(through, there)
    index, step = (1, 5, 7), 1e-5
    up, down = (shown.detach().clone() for _ in range(2))
    up[index] += step
    down[index] -= step
    slope = (loss(panel.emitted(up, light)) - loss(panel.emitted(down, light))) / (2 * step)
    # Third derivatives below 10: 10 step^2 / 6 and 1e-15 * 200 / step of rounding.
    assert there[index].item() == pytest.approx(slope.item(), abs=5e-8)


def test_fringing_is_a_mean_of_neighbours_and_leaves_flat_phases_flat():
    panel = PhaseModulator(GRID, WAVES, crosstalk=0.7)
    shown = wanted().remainder(TURN)
    got = panel.emitted(shown)
    for c in range(2):
        phase = oracle.fringed(shown[c].numpy(), 0.7)
        # Taps below 1e-6 of the centre are dropped, at most 4 pi e-6 / 0.7 of them along the rim: under 1e-4 rad.
        np.testing.assert_allclose(got[c].numpy(), np.exp(1j * phase), rtol=0, atol=1e-4)
    flat = panel.emitted(torch.full((2, *GRID.shape), 3.0, dtype=torch.float64))
    np.testing.assert_allclose(flat.numpy(), np.exp(3j), rtol=0, atol=1e-14)


def test_gaps_leave_a_zero_order():
    grid = Grid((8, 16), 4e-6)
    blaze = (TURN / 8 * torch.arange(16.0, dtype=torch.float64)).expand(1, 8, 16)
    field = PhaseModulator(grid, 530e-9, fill_factor=0.9, gap=0.5)(blaze)[0]
    orders = np.fft.fft2(field.numpy()) / 128
    assert abs(orders[0, 2]) == pytest.approx(0.9, rel=1e-12)  # the blaze has 2 periods on the panel
    assert abs(orders[0, 0]) == pytest.approx(0.1 * 0.5, rel=1e-12)
    assert np.abs(orders).sum() == pytest.approx(0.95, rel=1e-12)


def test_other_light_meets_another_phase():
    panel = PhaseModulator(GRID, WAVES, birefringence=Cauchy())
    phase = wanted(4)
    assert torch.allclose(panel(phase, WAVES), panel(phase), rtol=0, atol=1e-13)
    light = torch.tensor([[620e-9, 520e-9], [640e-9, 540e-9], [636e-9, 455e-9]], dtype=torch.float64)[:, None]
    got = panel(phase, light)
    assert got.shape == (3, 4, 2, *GRID.shape)
    scale = phase_scale(light[1, 0, 1].item(), WAVES[1]).item()
    np.testing.assert_allclose(got[1, 2, 1], np.exp(1j * scale * panel.shown(phase)[2, 1].numpy()), rtol=0, atol=1e-12)
    unspecified = PhaseModulator(GRID, WAVES)
    assert torch.equal(unspecified(phase, light[0, 0]), unspecified(phase))  # the thesis's simulation


def test_dtype_follows_the_input_and_tables_stay_whole():
    panel = PhaseModulator(GRID, WAVES, bits=16).half()
    assert panel.lut.dtype == torch.float64
    assert panel(wanted(dtype=torch.float32)).dtype == torch.complex64
    assert panel(wanted()).dtype == torch.complex128


@pytest.mark.parametrize("lut", [bent(6, 6.2), 2.0 - bent(5, 6.0)], ids=["rising", "falling"])
def test_the_inverse_of_a_table(lut):
    level = torch.tensor([0, 0.25, 3.5, len(lut) - 1.5, len(lut) - 1], dtype=torch.float64)
    low = level.floor().long().clamp(max=len(lut) - 2)
    phase = lut[low] + (level - low) * (lut[low + 1] - lut[low])
    assert torch.allclose(level_of(phase, lut), level, rtol=0, atol=1e-10)
    with pytest.raises(ValueError, match="phases must lie in the table's range"):
        level_of(lut.max() + 0.1, lut)


def test_nan_is_seen_and_not_shown():
    panel, phase = PhaseModulator(GRID, WAVES), wanted()
    phase[1, 2, 3] = math.nan
    assert torch.isnan(panel(phase)[1, 2, 3].real)
    with pytest.raises(ValueError, match=r"phase must be finite, but element \(1, 2, 3\) is nan"):
        panel.levels(phase)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_a_gpu_shows_the_same():
    panel = PhaseModulator(GRID, WAVES, crosstalk=0.6, birefringence=Cauchy())
    wide, light = wanted(2), (640e-9, 520e-9)
    there = panel.cuda()(wide.cuda(), light)
    assert there.is_cuda and torch.equal(panel.levels(wide.cuda()).cpu(), panel.levels(wide))
    assert torch.allclose(there.cpu(), panel.cpu()(wide, light), rtol=0, atol=1e-12)


def test_a_batch_mapped_or_turned_equals_its_items():
    panel, phase = PhaseModulator(GRID, WAVES, bits=5, crosstalk=0.6, fill_factor=0.9, gap=0.2), wanted(3)
    whole = panel(phase)
    assert torch.equal(torch.vmap(panel)(phase), whole)
    with warnings.catch_warnings(action="error"):
        turned = panel(phase.transpose(-1, -2).contiguous().transpose(-1, -2))
    assert torch.equal(turned, whole) and torch.equal(panel(phase[1]), whole[1])


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"bits": 0}, ValueError, "bits must be at least 1"),
        ({"bits": 17}, ValueError, "bits must be at most 16, got 17"),
        ({"full_turn": 0}, ValueError, "full_turn must be above zero in levels"),
        ({"full_turn": 200, "lut": even_lut(8)}, ValueError, "give lut or full_turn, not both"),
        ({"lut": even_lut(7)}, ValueError, "lut must hold 256 phases for 8 bits"),
        ({"lut": torch.ones(3, 256)}, ValueError, "lut must be monotone"),
        ({"lut": even_lut(8).expand(3, -1)}, ValueError, "one row for each of 2 wavelengths, got 3"),
        ({"lut": even_lut(8).sin()}, ValueError, r"monotone.*from level \d+ to \d+ .* \(12\d such steps\)"),
        ({"lut": even_lut(8) * math.nan}, ValueError, "lut must be finite"),
        ({"lut": torch.arange(256)}, TypeError, "lut must be a real floating-point tensor"),
        ({"fill_factor": 0}, ValueError, "fill_factor must be above 0 and at most 1"),
        ({"gap": 1.5}, ValueError, "gap must be at least 0 and at most 1"),
        ({"crosstalk": -1}, ValueError, "sigma_px must be at least zero in pixels"),
        ({"crosstalk": torch.ones(2, 3)}, ValueError, "patch must have two odd sizes"),
    ],
)
def test_refuses(options, error, message):
    with pytest.raises(error, match=message):
        PhaseModulator(GRID, WAVES, **options)


def test_refuses_frames_that_are_none():
    panel = PhaseModulator(GRID, WAVES, bits=7)
    levels = panel.levels(wanted())
    levels[0, 0, 0], levels[1, 2, 3] = 0, 128
    with pytest.raises(ValueError, match="levels must lie between 0 and 127 for 7 bits, got 0 to 128"):
        panel.phase(levels)
    with pytest.raises(TypeError, match="levels must be whole numbers"):
        panel.phase(wanted())
    with pytest.raises(ValueError, match=r"phase must end in \(C, H, W\) = \(2, 12, 17\)"):
        panel(wanted()[:1])
