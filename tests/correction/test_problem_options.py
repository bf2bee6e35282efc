"""The options of PECProblem against plain numpy in float64, the limit on the heat, boxes."""

import itertools
import math

import numpy as np
import pytest
import torch
from oracles import dense

from holotorch import Grid
from holotorch.correction import (
    APG,
    LBFGS,
    Box,
    PECProblem,
    limit_peak_phase,
    penalty_schedule,
    run_stages,
    spread_preconditioner,
)
from holotorch.modulator import ThermalCrosstalk
from holotorch.optics import DepthStack, Fraunhofer, Fresnel, Propagator, PupilViews, View

GRID, WAVES = Grid((6, 7), (5e-6, 4e-6)), (630e-9, 530e-9)
DISTANCES = (0.1e-3, 0.25e-3)
CROSSTALK, KERNEL = ThermalCrosstalk(0.9, 5), dense.heat_kernel(0.9, 5)
pytestmark = pytest.mark.filterwarnings("ignore::holotorch.core.checks.SamplingWarning")

OPTIONS = [
    {name: value for name, value in zip(("mask", "scale_free", "amplitude", "frames", "depths"), chosen, strict=True)}
    for chosen in itertools.product([False, True], repeat=5)
]
each_combination = pytest.mark.parametrize(
    "options", OPTIONS, ids=lambda options: "+".join(name for name, on in options.items() if on) or "plain"
)
HEAT = {"limit": torch.tensor([2.0, 3.0], dtype=torch.float64), "limit_weight": 0.3, "power_weight": 0.02}


def matrices(depths: bool) -> list[list[np.ndarray]]:
    """Of channel c and depth d; a Fourier hologram has one."""
    if not depths:
        return [[dense.centred_unitary_dft(GRID.shape)] for _ in WAVES]
    transfers = [[dense.fresnel_transfer(GRID.shape, GRID.pitch, wave, z) for z in DISTANCES] for wave in WAVES]
    return [[dense.spectral_filter(GRID.shape, transfer) for transfer in row] for row in transfers]


def setting(mask: bool, depths: bool, frames: bool, **options):
    image = (2, *GRID.shape) if depths else GRID.shape
    target = torch.rand(2, *image, dtype=torch.float64)
    weights = torch.rand(image, dtype=torch.float64).round(decimals=1) if mask else None
    filters = [Fresnel(GRID, WAVES, z, pad=1) for z in DISTANCES]
    propagator = DepthStack(filters) if depths else Fraunhofer(GRID, WAVES)
    problem = PECProblem(CROSSTALK, propagator, target, mask=weights, frames=frames, **options)
    phase = torch.rand(3, *([4] if frames else []), 2, *GRID.shape, dtype=torch.float64) * 4
    return problem, phase


def loss_in_numpy(x, target, mask, operators, frames, scale_free, amplitude, limit, limit_weight, power_weight):
    """Of one hologram and colour, from the docstring: x [F, H, W], target [D, H, W]."""
    matrix = dense.convolution(GRID.shape, KERNEL)
    spread = [matrix @ frame.ravel() for frame in x]
    formed = [np.mean([np.abs(operator @ np.exp(1j * p)) ** 2 for p in spread], 0) for operator in operators]
    u, i = np.stack(formed), target.reshape(len(operators), -1)
    if amplitude:
        u, i = np.sqrt(u), np.sqrt(i)
    u, i = u * mask, i * mask
    scale = (u * i).sum() / (u * u).sum() if scale_free else 1.0
    over = sum((np.maximum(p - limit, 0) ** 2).sum() for p in spread)
    return ((scale * u - i) ** 2).sum() + limit_weight * over + power_weight * x.sum()


@each_combination
def test_values(options):
    problem, phase = setting(**options, **HEAT)
    wanted = np.empty((3, 2))
    for b, c in np.ndindex(3, 2):
        x = phase[b, ..., c, :, :].numpy().reshape(-1, *GRID.shape)
        mask = 1.0 if problem.mask is None else problem.mask.numpy().reshape(1 + options["depths"], -1)
        wanted[b, c] = loss_in_numpy(
            x,
            problem.target[c].numpy(),
            mask,
            matrices(options["depths"])[c],
            options["frames"],
            options["scale_free"],
            options["amplitude"],
            HEAT["limit"][c].item(),
            0.3,
            0.02,
        )
    np.testing.assert_allclose(problem(phase), wanted, rtol=1e-12)
    assert CROSSTALK(phase).max() > 3  # the limit is at work


@each_combination
def test_gradcheck(options):
    problem, phase = setting(**options, **HEAT)
    assert problem(phase).shape == (3, 2)
    assert torch.autograd.gradcheck(problem, (phase[:1].requires_grad_(),), fast_mode=True)


def test_amplitude_has_a_finite_gradient_where_no_light_falls():
    for dtype in (torch.float32, torch.float64):
        target = torch.ones(1, 4, 4, dtype=dtype)
        problem = PECProblem(ThermalCrosstalk(0), Fraunhofer(Grid(4, 9e-6), 530e-9), target, amplitude=True)
        phase = torch.zeros(1, 4, 4, dtype=dtype, requires_grad=True)
        (gradient,) = torch.autograd.grad(problem(phase).sum(), phase)
        # Each of 16 samples changes by 1 / 4 in each of 16 pixels at most, times twice a residual of at most 4.
        assert gradient.abs().max() <= 2 * 4 * 16 / 4


def test_a_mask_may_be_of_one_channel_or_of_truth_values():
    target, phase = torch.rand(2, *GRID.shape), torch.rand(2, *GRID.shape)
    mask = torch.rand(GRID.shape) > 0.4
    losses = [
        PECProblem(CROSSTALK, Fraunhofer(GRID, WAVES), target, mask=m)(phase)
        for m in (mask, mask.float(), mask[None].expand(2, -1, -1).double())
    ]
    torch.testing.assert_close(losses[0], losses[1], rtol=0, atol=0)
    torch.testing.assert_close(losses[0], losses[2], rtol=0, atol=0)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"mask": -torch.ones(6, 7)}, r"mask must be >= 0 and broadcast to the target \(2, 6, 7\)"),
        ({"mask": torch.ones(3, 1, 6, 7)}, "mask must be >= 0 and broadcast"),
        ({"mask": torch.ones(5, 7)}, "mask must be >= 0 and broadcast"),
        ({"limit": 0.0}, "limit must be above zero in rad"),
        ({"limit": torch.tensor([1.0, -1.0])}, "limit must be above zero in rad"),
        ({"limit": math.nan}, "limit must be above zero in rad"),
        ({"limit": torch.ones(3)}, "limit must be a number or one per channel"),
    ],
)
def test_refuses_impossible_options(options, message):
    with pytest.raises(ValueError, match=message):
        PECProblem(CROSSTALK, Fraunhofer(GRID, WAVES), torch.ones(2, *GRID.shape), **options)


@pytest.mark.parametrize("shape", [(2, 6, 7), (6, 7), (2, 4, 6, 7)])
def test_frames_need_their_axis(shape):
    problem = PECProblem(CROSSTALK, Fraunhofer(GRID, WAVES), torch.ones(2, *GRID.shape), frames=True)
    with pytest.raises(ValueError, match=r"must end in"):
        problem(torch.rand(shape))


def test_a_target_of_several_depths_needs_an_image_of_them():
    stack = DepthStack([Fresnel(GRID, WAVES, z, pad=1) for z in DISTANCES])
    with pytest.raises(
        ValueError, match=r"target must end in \(C, \*image\) = \(2, 2, 6, 7\), as .* got \(2, 3, 6, 7\)"
    ):
        PECProblem(CROSSTALK, stack, torch.ones(2, 3, 6, 7))(torch.rand(2, 6, 7))
    with pytest.raises(ValueError, match=r"target must have axes \(..., C, D, H, W\), got \(2, 6, 5\)"):
        PECProblem(CROSSTALK, stack, torch.ones(2, 6, 5))


@pytest.mark.parametrize("sigma", [0.33, 0.66, 1.0, 2.0, 5.0])
def test_limit_peak_phase_never_passes_the_limit(sigma):
    """Judged in float64; even and sharp pictures, as the rounding of a sum differs for both."""
    crosstalk = ThermalCrosstalk(sigma)
    for scale in (1e-3, 1.0, 77.0, 1e6):
        phase = torch.rand(6, 3, 20, 21) * scale
        phase[0], phase[1] = scale, (phase[1] > 0.98 * scale) * scale
        for limit in (0.01, math.pi, 4 * math.pi, 1000 / 3):
            held = limit_peak_phase(limit, phase, crosstalk)
            exact = crosstalk(held.double())
            assert exact.max() <= limit and held.dtype == phase.dtype
            cold = crosstalk(phase.double()).amax((-2, -1)) < 0.999 * limit
            assert torch.equal(held[cold], phase[cold])
            # Scaled no further than needed: what it leaves is 1e-6 and the rounding of the sum.
            assert (exact.amax((-2, -1))[~cold] >= limit * (1 - 1e-3)).all()


def test_stages_of_a_penalty_schedule_end_near_the_limit():
    image = torch.rand(1, 16, 16) ** 3
    crosstalk = ThermalCrosstalk(0.66, 7)

    def make(**options):
        return PECProblem(crosstalk, Fraunhofer(Grid(16, 9e-6), 530e-9), image / image.mean(), **options)

    limit = 2 * math.pi
    start = torch.rand(1, 16, 16) * 2 * math.pi
    solver = LBFGS(3, spread_preconditioner(crosstalk.kernel), max_steps=90, tolerance=0)
    free, held = (run_stages(penalty_schedule(make, solver, crosstalk.total, bound), start) for bound in (None, limit))
    assert crosstalk(free.x).max() > 1.1 * limit
    assert crosstalk(held.x).max() < 1.05 * limit and (held.x >= 0).all()
    assert make()(limit_peak_phase(limit, held.x, crosstalk)) < 0.5 * make()(limit_peak_phase(limit, free.x, crosstalk))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_box_projects_element_by_element(dtype):
    x = torch.randn(3, 2, 4, dtype=dtype)
    lower = torch.tensor([-0.5, 0.0, 0.1, -math.inf], dtype=torch.float64)
    upper = torch.tensor([[0.5], [0.2]])
    for box in (Box(lower, upper), Box(lower), Box(-0.3, upper), Box(-0.3, 0.4)):
        wanted = np.clip(x.numpy(), np.asarray(box.lower, x.numpy().dtype), np.asarray(box.upper, x.numpy().dtype))
        found = box(x)
        assert found.dtype == dtype
        np.testing.assert_array_equal(found.numpy(), wanted)
        assert torch.equal(box(found), found)


@pytest.mark.parametrize("solver", [APG(), LBFGS()], ids=["APG", "LBFGS"])
def test_solvers_keep_to_a_box_of_tensors(solver):
    lower, upper = torch.rand(5, dtype=torch.float64) - 1, torch.rand(4, 1, dtype=torch.float64)
    wanted = 2 * torch.randn(3, 4, 5, dtype=torch.float64)
    box = Box(lower, upper)
    solution = solver(lambda x: (x - wanted).square().sum((-2, -1)), torch.zeros_like(wanted), box)
    torch.testing.assert_close(solution.x, box(wanted), rtol=0, atol=1e-6)


def test_targets_in_a_batch_and_in_the_call():
    propagator = Fraunhofer(GRID, WAVES)
    targets = torch.rand(3, 2, *GRID.shape, dtype=torch.float64) + 0.1
    phases = torch.rand(3, 2, *GRID.shape, dtype=torch.float64)
    alone = torch.stack(
        [PECProblem(CROSSTALK, propagator, t)(p) for t, p in zip(targets, phases, strict=True)]
    )  # [3, 2]
    torch.testing.assert_close(PECProblem(CROSSTALK, propagator, targets)(phases), alone)
    late = PECProblem(CROSSTALK, propagator)
    torch.testing.assert_close(late(phases, targets), alone)
    # One target for all phases, and one phase for all targets.
    torch.testing.assert_close(late(phases, targets[0])[0], alone[0])
    torch.testing.assert_close(late(phases[0], targets)[0], alone[0])
    frames = torch.rand(3, 4, 2, *GRID.shape, dtype=torch.float64)
    shared = PECProblem(CROSSTALK, propagator, targets, frames=True)(frames)
    single = PECProblem(CROSSTALK, propagator, targets[1], frames=True)(frames[1])
    assert shared.shape == (3, 2)
    torch.testing.assert_close(shared[1], single)
    targets.requires_grad_()
    assert torch.autograd.gradcheck(lambda t: late(phases, t), (targets,), fast_mode=True)


def test_a_target_that_is_missing_or_does_not_fit_the_batch():
    problem = PECProblem(CROSSTALK, Fraunhofer(GRID, WAVES))
    phases = torch.rand(3, 2, *GRID.shape)
    with pytest.raises(ValueError, match="target must be given, to PECProblem or in the call, got none"):
        problem(phases)
    with pytest.raises(ValueError, match=r"leading axes that broadcast, got \(3,\) and \(2,\)"):
        problem(phases, torch.ones(2, 2, *GRID.shape))
    with pytest.raises(ValueError, match=r"target must have axes \(..., C, \*image\), .* got \(6, 7\)"):
        problem(phases, torch.ones(*GRID.shape))
    with pytest.raises(ValueError, match=r"channel 1 of item \(2,\) is black"):
        targets = torch.ones(3, 2, *GRID.shape)
        targets[2, 1] = 0
        PECProblem(CROSSTALK, Fraunhofer(GRID, WAVES), targets)
    with pytest.raises(ValueError, match="target requires a gradient, .* give it in the call"):
        PECProblem(CROSSTALK, Fraunhofer(GRID, WAVES), torch.ones(2, *GRID.shape, requires_grad=True))


def test_smoothness_adds_the_squared_steps_between_neighbours():
    crosstalk, propagator = ThermalCrosstalk(0.7, 5), Fraunhofer(Grid((5, 6), 9e-6), 530e-9)
    target = torch.rand(1, 5, 6, dtype=torch.float64)
    phase = torch.rand(2, 1, 5, 6, dtype=torch.float64)
    plain, smooth = (PECProblem(crosstalk, propagator, target, smoothness_weight=weight)(phase) for weight in (0, 0.3))
    steps = [
        sum((x[i, j] - x[i - 1, j]) ** 2 for i in range(1, 5) for j in range(6))
        + sum((x[i, j] - x[i, j - 1]) ** 2 for i in range(5) for j in range(1, 6))
        for x in phase[:, 0]
    ]
    wanted = torch.tensor([float(step) for step in steps], dtype=torch.float64)
    torch.testing.assert_close(smooth - plain, 0.3 * wanted[:, None], rtol=1e-10, atol=0)


def test_a_real_result_of_the_propagator_is_an_intensity():
    crosstalk, propagator = ThermalCrosstalk(0.7, 5), Fraunhofer(Grid((5, 6), 9e-6), 530e-9)
    target, phase = torch.rand(1, 5, 6, dtype=torch.float64), torch.rand(1, 5, 6, dtype=torch.float64)
    seen = PECProblem(crosstalk, lambda field: propagator(field).abs().square(), target)
    torch.testing.assert_close(seen(phase), PECProblem(crosstalk, propagator, target)(phase))


def test_light_that_misses_the_images_is_a_part_of_the_loss():
    crosstalk, grid = ThermalCrosstalk(0.7, 5), Grid((5, 6), 9e-6)
    views = PupilViews(grid, 530e-9, [View(1e-3, 0.02), View(2e-3, 0.01)])
    target, phase = torch.rand(1, 2, 5, 6, dtype=torch.float64), torch.rand(3, 1, 5, 6, dtype=torch.float64)
    plain, bright = (PECProblem(crosstalk, views, target, light_weight=weight) for weight in (0.0, 0.4))
    missing = 1 - plain.intensity(phase).sum((-2, -1)).mean(-1) / 30
    torch.testing.assert_close(bright(phase) - plain(phase), 0.4 * target.sum() * missing, rtol=1e-10, atol=0)
    assert 0 < missing.min() < missing.max() < 1


@pytest.mark.parametrize("amplitude", [False, True])
@pytest.mark.parametrize("frames", [False, True])
def test_second_derivatives_at_the_best_scale_are_those_of_the_formula(amplitude, frames):
    """The best scale changes with the phases, which first derivatives do not show."""
    generator = torch.Generator().manual_seed(4)
    wanted = torch.rand(1, 12, 10, generator=generator, dtype=torch.float64)
    phase = 3 * torch.rand(*([3] * frames), 1, 12, 10, generator=generator, dtype=torch.float64)
    heat, propagator = ThermalCrosstalk(0.66), Propagator(Grid((12, 10), 8e-6), 633e-9, 2e-3)
    problem = PECProblem(heat, propagator, wanted, scale_free=True, amplitude=amplitude, frames=frames)

    def written_out(x):
        spread = heat(x)
        formed = propagator(torch.polar(torch.ones_like(spread), spread)).abs().square()
        formed = formed.mean(0) if frames else formed
        formed, target = ((formed + 1e-300).sqrt(), wanted.sqrt()) if amplitude else (formed, wanted)
        scale = (formed * target).sum() / formed.square().sum()
        return (scale * formed - target).square().sum()

    along = torch.func.grad(written_out)(phase)  # the direction in which most is missing if the scale is a constant
    for direction in (along, torch.rand(phase.shape, generator=generator, dtype=torch.float64)):
        losses = (lambda x: problem(x).sum()), written_out
        both = (torch.func.jvp(torch.func.grad(loss), (phase,), (direction,)) for loss in losses)
        for one, other in zip(*both, strict=True):
            torch.testing.assert_close(one, other, rtol=1e-8, atol=1e-9 * float(other.abs().max()))
