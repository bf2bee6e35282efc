"""What a pose depends on and how sure it is: gradients, covariance, chi square, invariances."""

import math

import numpy as np
import pytest
import torch
from oracles import tracking as oracle
from oracles.tracking import DIRECTION, EDGES, LENS, MATRIX, TIP

from holotorch.tracking import Camera, Pose, Status, solve_pose

CAMERA = Camera(torch.tensor(MATRIX), torch.tensor(LENS))
RADIUS = 0.9e-3


def image(
    tip=TIP, direction=DIRECTION, positions=EDGES, offset: float | np.ndarray = 0.0, matrix=MATRIX, lens=LENS
) -> torch.Tensor:
    return torch.tensor(oracle.image(tip, direction, positions, matrix, lens, offset))


def codes(pose: Pose) -> tuple[Status, ...]:
    assert isinstance(pose.status, tuple)
    return pose.status


def noisy(count: int, along: float, across: float, rng: np.random.Generator) -> torch.Tensor:
    """[count, 4, 2] images of the tool with noise along and across it."""
    clean = image(offset=RADIUS).numpy()
    line = (clean[-1] - clean[0]) / np.linalg.norm(clean[-1] - clean[0])
    normal = np.array([-line[1], line[0]])
    shift = rng.normal(size=(count, 4, 1)) * along * line + rng.normal(size=(count, 4, 1)) * across * normal
    return torch.tensor(clean + shift)


def everything(edges, positions, matrix, lens, offset, **given):
    pose = solve_pose(edges, positions, Camera(matrix, lens), offset=offset, **given)
    return torch.cat([pose.tip, pose.direction], -1)


def parameters(noise: float) -> list[torch.Tensor]:
    edges = image(offset=RADIUS)[None] + noise * torch.randn(1, 4, 2, dtype=torch.float64)
    offset = torch.tensor(RADIUS, dtype=torch.float64)
    return [edges, torch.tensor(EDGES), torch.tensor(MATRIX), torch.tensor(LENS), offset]


@pytest.mark.parametrize("noise", [0.0, 0.1])
@pytest.mark.parametrize("across", [0.1, 0.03])
def test_gradients_against_whole_solves(noise, across):
    """Central differences over steps at which neither rounding (1e-13 / step) nor curvature reaches 1e-6."""
    given = parameters(noise)
    exact = torch.autograd.functional.jacobian(lambda *v: everything(*v, across_px=across), tuple(given))
    for at, (value, slopes, step) in enumerate(zip(given, exact, (1e-2, 1e-5, 1e-2, 1e-5, 1e-5), strict=True)):
        slopes = slopes.reshape(6, -1)
        for i in range(value.numel()):
            if at == 2 and i not in (0, 2, 4, 5):
                continue  # the matrix has four free elements
            ends = []
            for sign in (1, -1):
                moved = [v.clone() for v in given]
                moved[at].view(-1)[i] += sign * step
                ends.append(everything(*moved, across_px=across)[0])
            difference = (ends[0] - ends[1]) / (2 * step)
            assert (difference - slopes[:, i]).abs().max() <= 1e-6 * slopes.abs().max(), (at, i)


def test_gradcheck():
    edges, positions, _, lens, offset = parameters(0.1)
    focal = torch.tensor([1400.0, 1350, 959.5, 539.5], dtype=torch.float64)

    def function(edges, positions, focal, lens, offset):
        zero = torch.zeros((), dtype=torch.float64)
        rows = [focal[0], zero, focal[2], zero, focal[1], focal[3], zero, zero, zero + 1]
        # In millimetres and as the perturbation of 1e-6 to positions in centimetres wants it: derivatives of order one.
        return 1e3 * everything(edges, positions / 100, torch.stack(rows).view(3, 3), lens, offset / 100)

    inputs = [v.requires_grad_() for v in (edges, positions * 100, focal, lens, offset * 100)]
    assert torch.autograd.gradcheck(function, inputs, rtol=1e-4, atol=1e-4)
    pose = solve_pose(edges, positions, CAMERA)
    (gradient,) = torch.autograd.grad(pose.chi_square.sum(), edges)
    step = torch.zeros_like(edges)
    step[0, 1] = torch.tensor([1e-4, -1e-4])
    ends = [solve_pose(edges.detach() + sign * step, positions, CAMERA).chi_square for sign in (1, -1)]
    assert (ends[0] - ends[1]).item() / 2 == pytest.approx((gradient * step).sum().item(), rel=1e-6)


def test_second_derivatives():
    """Of tip and direction by edges that no pose fits exactly, against differences of the first derivatives."""
    edges, positions, *_ = parameters(0.1)
    generator = torch.Generator().manual_seed(2)
    edges = edges + 0.5 * torch.randn(edges.shape, generator=generator, dtype=torch.float64)
    weights = torch.randn(6, generator=generator, dtype=torch.float64)

    def gradient(at, **options):
        pose = solve_pose(at, positions, CAMERA)
        return torch.autograd.grad((torch.cat([pose.tip, pose.direction], -1) @ weights).sum(), at, **options)[0]

    direction = torch.randn(edges.shape, generator=generator, dtype=torch.float64)
    at = edges.clone().requires_grad_()
    (second,) = torch.autograd.grad((gradient(at, create_graph=True) * direction).sum(), at)
    ends = [gradient((edges + sign * 1e-2 * direction).requires_grad_()) for sign in (1, -1)]
    difference = (ends[0] - ends[1]) / 2e-2
    assert (second - difference).norm() < 1e-3 * difference.norm()


def test_refused_poses_do_not_spoil_gradients():
    edges = torch.cat([image()[None]] * 5).clone()
    edges[1] = 500.0  # one point
    edges[2] = torch.nan
    edges[3, 0] = 1e5
    edges[3, 1] = torch.inf
    seen = torch.ones(5, 4, dtype=torch.bool)
    seen[4, :2] = False
    values = [edges.requires_grad_(), *(v.requires_grad_() for v in parameters(0)[1:])]
    pose = solve_pose(values[0], values[1], Camera(values[2], values[3]), seen=seen, offset=values[4])
    assert pose.status == (
        Status.OK,
        Status.INCONSISTENT,
        Status.BANDS_MISSING,
        Status.OUTSIDE_CAMERA,
        Status.BANDS_MISSING,
    )
    gradients = torch.autograd.grad(pose.tip[0].sum(), values)
    assert all(gradient.isfinite().all() and gradient.any() for gradient in gradients)
    assert not gradients[0][1:].any()


@pytest.mark.parametrize(("along", "across"), [(0.1, 0.1), (0.1, 0.03)])
def test_covariance_and_chi_square(along, across):
    given, draws = {"along_px": along, "across_px": across, "offset": RADIUS}, 2000
    exact = solve_pose(image(offset=RADIUS)[None], torch.tensor(EDGES), CAMERA, **given)[0]
    bound = oracle.cramer_rao(TIP, DIRECTION, EDGES, MATRIX, LENS, (along, across), RADIUS)
    np.testing.assert_allclose(exact.covariance, bound, rtol=1e-4, atol=1e-6 * np.abs(bound).max())
    assert exact.tip_sd.item() == pytest.approx(math.sqrt(np.trace(bound[:3, :3])), rel=1e-4)
    assert torch.linalg.matrix_rank(exact.covariance, hermitian=True, rtol=1e-12) == 5
    noise = noisy(draws, along, across, np.random.default_rng(7))
    pose = solve_pose(noise, torch.tensor(EDGES), CAMERA, **given)
    assert set(codes(pose)) == {Status.OK}
    error = torch.cat([pose.tip - torch.tensor(TIP), pose.direction - torch.tensor(DIRECTION)], -1).numpy()
    spread = error.T @ error / draws
    scale = np.sqrt(np.diag(bound))
    # Of a sample of n the variances are uncertain by sqrt(2 / n), covariances by less; 4.5 times for 21 of them.
    np.testing.assert_allclose(
        spread / scale / scale[:, None], bound / scale / scale[:, None], atol=4.5 * (2 / draws) ** 0.5
    )
    # Mean of n chi squares of f degrees of freedom: f, of variance 2 f / n; their variance 2 f, of (8 f^2 + 48 f) / n.
    assert pose.freedom.eq(3).all()
    assert abs(pose.chi_square.mean().item() - 3) < 4 * (6 / draws) ** 0.5
    assert abs(pose.chi_square.var().item() - 6) < 4 * ((8 * 9 + 48 * 3) / draws) ** 0.5
    # In 95 % of draws the truth lies within 11.07, the quantile of chi square with 5 degrees of freedom.
    inverse = torch.linalg.pinv(pose.covariance, hermitian=True, rtol=1e-12)
    far = torch.einsum("bi,bij,bj->b", torch.tensor(error), inverse, torch.tensor(error))
    assert abs((far < 11.07).double().mean().item() - 0.95) < 4 * (0.95 * 0.05 / draws) ** 0.5 + 0.002


@pytest.mark.parametrize("edges", [5, 9])
def test_chi_square_of_more_edges_and_of_missing_ones(edges):
    rng, draws = np.random.default_rng(8), 1500
    positions = 0.07 + 0.02 * np.arange(edges)
    noise = image(positions=positions) + torch.tensor(rng.normal(size=(draws, edges, 2))) * 0.2
    seen = torch.tensor(rng.uniform(size=(draws, edges)).argsort(-1) < 4)  # 4 of them
    deviation = torch.full((draws, edges), 0.2, dtype=torch.float64)
    for mask, freedom in ((None, 2 * edges - 5), (seen, 3)):
        pose = solve_pose(noise, torch.tensor(positions), CAMERA, along_px=deviation, across_px=deviation, seen=mask)
        assert pose.freedom.eq(freedom).all() and set(codes(pose)) == {Status.OK}
        assert abs(pose.chi_square.mean().item() - freedom) < 4 * (2 * freedom / draws) ** 0.5


def test_invariances():
    camera = Camera(torch.tensor(np.diag([1400.0, 1400, 1])), torch.zeros(5))
    edges = image(matrix=np.diag([1400.0, 1400, 1]), lens=np.zeros(5))[None] + 0.1 * torch.randn(1, 4, 2).double()
    positions = torch.tensor(EDGES)
    before = solve_pose(edges, positions, camera, across_px=0.05)

    def alike(pose, turn, size=1.0):
        double = torch.block_diag(turn * size, turn)
        assert (pose.tip[0] - size * turn @ before.tip[0]).norm() < 1e-7 * pose.tip_sd[0]
        assert (pose.direction[0] - turn @ before.direction[0]).norm() < 1e-9
        wanted = double @ before.covariance[0] @ double.mT
        torch.testing.assert_close(pose.covariance[0], wanted, rtol=1e-6, atol=1e-9 * wanted.abs().max().item())
        assert pose.chi_square[0].item() == pytest.approx(before.chi_square[0].item(), rel=1e-9)

    one = torch.eye(3, dtype=torch.float64)
    order = torch.tensor([2, 0, 3, 1])
    alike(solve_pose(edges[:, order], positions[order], camera, across_px=0.05), one)
    # A tool ten times as large is ten times as far away.
    alike(solve_pose(edges, 10 * positions, camera, across_px=0.05), one, 10.0)
    for angle in (0.3, 2.0, math.pi / 2, math.pi):
        c, s = math.cos(angle), math.sin(angle)
        turn = torch.tensor([[c, -s, 0], [s, c, 0], [0, 0, 1]], dtype=torch.float64)
        alike(solve_pose(edges @ turn[:2, :2].mT, positions, camera, across_px=0.05), turn)
    # All deviations times 10 (and a thousandth of a millionth): the same pose, 100 times the covariance.
    for factor in (10.0, 1e-6):
        pose = solve_pose(edges, positions, camera, along_px=0.1 * factor, across_px=0.05 * factor)
        assert (pose.tip - before.tip).norm() < 1e-7 * before.tip_sd[0]
        torch.testing.assert_close(pose.covariance, before.covariance * factor**2, rtol=1e-6, atol=0)
        assert pose.chi_square.item() == pytest.approx(before.chi_square.item() / factor**2, rel=1e-6)
    # Single precision in, double out.
    pose = solve_pose(edges.float(), positions.float(), camera)
    assert pose.tip.dtype == torch.float64 and (pose.tip - before.tip).norm() < 1e-4
