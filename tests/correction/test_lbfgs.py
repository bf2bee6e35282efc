"""LBFGS against the textbook's recursion, constrained minima from SciPy, and APG."""

import math

import numpy as np
import pytest
import torch
from oracles import dense
from scipy.optimize import lsq_linear

from holotorch import Grid
from holotorch.correction import APG, LBFGS, Box, PECProblem, Solution, spread_preconditioner
from holotorch.io.images import fit_image, load_image
from holotorch.modulator import ThermalCrosstalk
from holotorch.optics import Fraunhofer

UNBOUNDED = Box(-math.inf, math.inf)


def least_squares(items: int, dtype: torch.dtype = torch.float64):
    """|| M x - b ||^2 per item, x [items, 2, 3], with M [12, 6] and b from a fixed seed."""
    generator = np.random.default_rng(5)
    matrix, wanted = generator.normal(size=(items, 12, 6)), generator.normal(size=(items, 12))
    m, b = torch.as_tensor(matrix).to(dtype), torch.as_tensor(wanted).to(dtype)
    return matrix, wanted, lambda x: ((m @ x.flatten(-2)[..., None])[..., 0] - b).square().sum(-1)


def pec_problem(channels: int = 1, dtype: torch.dtype = torch.float64, **options):
    target = torch.rand(channels, 16, 16, dtype=dtype) + 0.05
    propagator = Fraunhofer(Grid(16, 9e-6), [530e-9] * channels)
    target = target / target.mean((-2, -1), keepdim=True)
    return PECProblem(ThermalCrosstalk(0.8), propagator, target, **options)


@pytest.mark.parametrize("memory", [1, 3, 8])
@pytest.mark.parametrize("tensors", [False, True], ids=["numbers", "tensors"])
def test_finds_the_minimum_within_a_box(memory, tensors):
    matrix, wanted, loss = least_squares(4)
    low, high = -0.05, 0.1
    box = Box(torch.full((2, 3), low), torch.full((1, 1), high, dtype=torch.float64)) if tensors else Box(low, high)
    if tensors:
        low = float(torch.tensor(low))  # as float32 has it
    solution = LBFGS(memory, max_steps=400, tolerance=1e-12)(loss, torch.zeros(4, 2, 3, dtype=torch.float64), box)
    pairs = zip(matrix, wanted, strict=True)
    best = np.stack([lsq_linear(m, b, (low, high), tol=1e-14).x for m, b in pairs]).reshape(4, 2, 3)
    # The loss is flat to rounding within sqrt(1e-16) of the minimum, over the least singular value of about 1.
    np.testing.assert_allclose(solution.x, best, rtol=0, atol=1e-7)
    assert solution.converged.all()
    x = solution.x.clone().requires_grad_()
    (slope,) = torch.autograd.grad(loss(x).sum(), x)
    on_low, on_high = solution.x == low, solution.x == high
    assert on_low.any() and on_high.any() and (~on_low & ~on_high).any()  # both bounds are at work
    assert (slope[on_low] > 0).all() and (slope[on_high] < 0).all()
    assert slope[~on_low & ~on_high].abs().max() <= 1e-5


def two_loops(gradient, pairs, precondition):
    """Nocedal and Wright, Algorithm 7.4: H g, with H0 = (s y / y P y) P of the newest pair."""
    q, alphas = gradient.copy(), []
    for s, y in reversed(pairs):
        alphas.append(s @ q / (s @ y))
        q -= alphas[-1] * y
    scale = pairs[-1][0] @ pairs[-1][1] / (pairs[-1][1] @ precondition @ pairs[-1][1]) if pairs else 1.0
    r = scale * precondition @ q
    for (s, y), alpha in zip(pairs, reversed(alphas), strict=True):
        r += s * (alpha - y @ r / (s @ y))
    return r


@pytest.mark.parametrize("memory", [1, 3])
@pytest.mark.parametrize("preconditioned", [False, True])
def test_takes_the_steps_of_the_textbook(memory, preconditioned):
    generator = np.random.default_rng(3)
    matrix, root = generator.normal(size=(9, 6)), generator.normal(size=(6, 6))
    precondition = root @ root.T + np.eye(6) if preconditioned else np.eye(6)

    def value_and_gradient(x):  # not convex: a sum of squares of sines
        residual = np.sin(matrix @ x) - 0.5
        return residual @ residual, 2 * matrix.T @ (np.cos(matrix @ x) * residual)

    x, pairs, path, halvings = 0.1 * generator.normal(size=6), [], [], 0
    start = torch.as_tensor(x.copy())
    value, gradient = value_and_gradient(x)
    for _ in range(10):
        direction = -two_loops(gradient, pairs, precondition)
        length = 1.0 if pairs else 2.0 / np.abs(direction).max()
        while value_and_gradient(x + length * direction)[0] > value + 1e-4 * length * (direction @ gradient):
            length, halvings = length / 2, halvings + 1
        s, before = length * direction, gradient
        x = x + s
        value, gradient = value_and_gradient(x)
        assert s @ (gradient - before) > 0 or not len(path)  # else the textbook's recursion does not apply
        pairs = [*pairs, (s, gradient - before)][-memory:]
        path.append(x)

    m, p = torch.as_tensor(matrix), torch.as_tensor(precondition)
    seen: list[Solution] = []
    solver = LBFGS(memory, (lambda g: g @ p) if preconditioned else None, first=2.0, max_steps=10, tolerance=0)
    solver(lambda x: (torch.sin(m @ x) - 0.5).square().sum(), start, UNBOUNDED, callback=seen.append)
    assert halvings > 0  # the search was exercised
    # Rounding grows from step to step, by the condition of the inverse Hessian: 10 digits of 16 are left after ten.
    np.testing.assert_allclose([now.x.numpy() for now in seen], path, rtol=0, atol=1e-10)


def test_a_step_must_bring_a_part_of_what_its_slope_promises():
    """From 1 over the valley of x^2 to -0.9999: a fall of 2e-4, of 4 that the slope promises. Half of it is taken."""
    solution = LBFGS(first=1.9999, max_steps=1)(lambda x: x.square().sum(-1), torch.ones(1).double(), UNBOUNDED)
    assert solution.x.item() == pytest.approx(1 - 1.9999 / 2, rel=1e-9) and solution.evaluations == 3


def test_both_bounds_are_held_alike():
    """The mirror image of a problem takes mirrored steps, to the bit, as a change of sign rounds nothing."""
    problem, start = pec_problem(2), torch.rand(2, 16, 16, dtype=torch.float64) * 6
    seen: list[list[Solution]] = [[], []]
    solver = LBFGS(3, spread_preconditioner(ThermalCrosstalk(0.8).kernel), max_steps=30, tolerance=0)
    solver(problem, start, Box(1.0, 4.0), callback=seen[0].append)
    solver(lambda x: problem(-x), -start, Box(-4.0, -1.0), callback=seen[1].append)
    for one, other in zip(*seen, strict=True):
        assert torch.equal(one.x, -other.x)
    assert (seen[0][-1].x == 1).any() and (seen[0][-1].x == 4).any()


@pytest.mark.parametrize("box", [UNBOUNDED, Box(0.0, 4.0)], ids=["unbounded", "box"])
def test_every_step_descends(box):
    problem = pec_problem(2)
    precondition = spread_preconditioner(ThermalCrosstalk(0.8).kernel)
    seen: list[Solution] = []
    start = torch.rand(2, 16, 16, dtype=torch.float64) * 6
    LBFGS(3, precondition, max_steps=40, tolerance=0)(problem, start, box, callback=seen.append)
    for last, now in zip(seen, seen[1:], strict=False):
        slope = (last.state["gradient"] * (now.x - last.x)).sum((-2, -1))
        assert (slope < 0).all()
        assert (now.losses[-1] <= last.losses[-1] + 1e-4 * slope).all()  # Armijo
        assert ((now.x >= box.lower) & (now.x <= box.upper)).all()


def test_frames_that_share_an_image_are_one_unknown():
    problem = pec_problem(2, frames=True)
    start = torch.rand(3, 4, 2, 16, 16, dtype=torch.float64) * 6
    solver = LBFGS(3, spread_preconditioner(ThermalCrosstalk(0.8).kernel), max_steps=12, tolerance=0)
    together = solver(problem, start)
    assert together.losses.shape == (13, 3, 2) and together.steps.shape == (3, 2)
    for i in range(3):
        alone = solver(problem, start[i])
        # Twelve steps amplify rounding of 1e-16 by less than 1e6.
        torch.testing.assert_close(together.x[i], alone.x, rtol=0, atol=1e-9)
        torch.testing.assert_close(together.losses[:, i], alone.losses, rtol=1e-9, atol=0)


def test_solved_and_hopeless_items_leave_the_others_alone():
    """Item 0 is at its minimum of 0, item 1 has no finite value below its start, item 2 is an ordinary one."""

    def loss(x):
        value = (x - 1).square().sum((-2, -1)) + 0.1 * (x[..., 0, 0] - x[..., 0, 1]).square()
        cliff = torch.tensor([False, True, False])[-value.numel() :] & (value < 64)
        return torch.where(cliff, math.nan, value)

    start = torch.stack([torch.ones(2, 2), torch.full((2, 2), 5.0), torch.tensor([[3.0, 0.5], [2.0, 7.0]])]).double()
    solver = LBFGS(max_steps=100)
    solution, alone = solver(loss, start), solver(loss, start[2:])
    assert torch.equal(solution.x[:2], start[:2])
    assert solution.steps[:2].tolist() == [0, 0]
    assert solution.converged.tolist() == [True, False, True] and solution.stalled.tolist() == [False, True, False]
    torch.testing.assert_close(solution.x[2:], alone.x, rtol=0, atol=1e-12)
    assert solution.steps[2] == alone.steps[0]
    assert torch.isfinite(solution.losses).all()


@pytest.mark.parametrize("kind", ["least squares", "hologram"])
def test_a_run_that_may_not_settle_is_bounded(kind):
    """With a tolerance of 0 only rounding or max_steps end it; a search mostly takes one evaluation, 13 at most."""
    if kind == "hologram":
        loss, start = pec_problem(2, torch.float32), torch.rand(2, 16, 16) * 6
    else:
        loss, start = least_squares(4, torch.float32)[2], torch.ones(4, 2, 3)
    solution = LBFGS(max_steps=300, tolerance=0)(loss, start)
    assert torch.isfinite(solution.x).all()
    assert solution.evaluations <= 2 * 300
    # The slack of the search is 8 eps of the loss in each step.
    rises = solution.losses[1:] / solution.losses[:-1].clamp(min=1e-30)
    assert rises.max() <= 1 + 10 * torch.finfo(torch.float32).eps


KERNELS = {
    "Gaussian": ThermalCrosstalk(1.0, 5).kernel,
    "measured": torch.tensor([[0.05, 0.3, 0.1], [0.2, 1.0, 0.4], [0.0, 0.25, 0.15]], dtype=torch.float64),
}


@pytest.mark.parametrize("shape", [(6, 7), (9, 4), (3, 2), (1, 1), (1, 5)])
@pytest.mark.parametrize("kernel", KERNELS.values(), ids=KERNELS)
def test_preconditioner_equals_a_dense_matrix(kernel, shape):
    h, w = shape
    size = h * w
    periodic = np.zeros((size, size))
    for y, x in np.ndindex(shape):
        for i, j in np.ndindex(*kernel.shape):
            row = (y + i - kernel.shape[0] // 2) % h * w + (x + j - kernel.shape[1] // 2) % w
            periodic[row, y * w + x] += kernel[i, j].item()
    dft = np.kron(dense.dft(h), dense.dft(w))
    squared = np.abs(np.diag(dft @ periodic @ dft.conj().T)) ** 2 / size**2
    wanted = (dft.conj().T @ ((1 / (squared / squared.max() + 0.2))[:, None] * dft)).real / size
    precondition = spread_preconditioner(kernel, 0.2)
    columns = torch.eye(size, dtype=torch.float64).reshape(size, h, w)
    matrix = precondition(columns).reshape(size, size).T.numpy()
    np.testing.assert_allclose(matrix, wanted, rtol=0, atol=1e-12)
    np.testing.assert_allclose(matrix, matrix.T, rtol=0, atol=1e-12)
    eigenvalues = np.linalg.eigvalsh(matrix)
    assert eigenvalues.min() > 0 and eigenvalues.max() <= 1.2 / 0.2 * eigenvalues.min() * (1 + 1e-12)


def test_preconditioner_follows_shape_and_dtype():
    precondition = spread_preconditioner(ThermalCrosstalk(0.66).kernel)
    x = torch.rand(2, 3, 9, 8, dtype=torch.float64)
    wanted = precondition(x)
    single = precondition(x.float())  # a table is kept for one shape and dtype; this is another
    assert single.dtype == torch.float32
    torch.testing.assert_close(single.double(), wanted, rtol=0, atol=1e-5)
    assert precondition(x[..., :5]).shape == (2, 3, 9, 5)
    assert torch.equal(precondition(x), wanted)


@pytest.mark.parametrize("floor", [0.0, -0.1, math.nan, math.inf])
def test_preconditioner_refuses_an_impossible_floor(floor):
    with pytest.raises(ValueError, match="floor must be"):
        spread_preconditioner(ThermalCrosstalk(0.66).kernel, floor)


@pytest.mark.parametrize("sigma", [1.0, 1.5])
def test_reaches_what_the_thesis_solver_does_in_a_quarter_of_its_evaluations(sigma):
    image = fit_image(load_image("camera"), (48, 48)).float()
    crosstalk = ThermalCrosstalk(sigma, 7)
    problem = PECProblem(crosstalk, Fraunhofer(Grid(48, 9e-6), 530e-9), image / image.mean())
    hot = torch.rand(1, 48, 48) * 2 * math.pi
    thesis = APG(max_steps=200, tolerance=0)(problem, hot)
    evaluations = {}

    def reached(now: Solution):
        if now.losses[-1] <= thesis.losses[-1]:
            evaluations.setdefault("needed", now.evaluations)

    LBFGS(3, spread_preconditioner(crosstalk.kernel), max_steps=110, tolerance=0)(problem, hot, callback=reached)
    assert evaluations["needed"] <= thesis.evaluations / 4
