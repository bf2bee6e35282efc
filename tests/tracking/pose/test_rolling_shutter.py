"""Covariance from a motion during the readout, against poses fitted to edges that have moved."""

import torch

from holotorch.tracking import THESIS, Camera, solve_pose
from holotorch.tracking.pose.rolling_shutter import readout_covariance

HEIGHT = 1080
CAMERA = Camera(
    torch.tensor([[1400.0, 0, 930], [0, 1390, 560], [0, 0, 1]], dtype=torch.float64),
    torch.tensor([-0.05, 0.01, 5e-4, -3e-4, 0.0], dtype=torch.float64),
)
TIPS = torch.tensor([[-0.02, -0.09, 0.52], [0.03, 0.01, 0.45]], dtype=torch.float64)
DIRECTIONS = torch.nn.functional.normalize(torch.tensor([[0.3, 0.9, -0.4], [-0.8, -0.3, 0.3]]).double(), dim=-1)


def test_it_is_that_of_poses_fitted_to_edges_that_move_while_the_rows_are_read():
    motion = 1e-6  # metres: small, so that the pose depends linearly on it
    points = TIPS[:, None] + THESIS.positions[:, None] * DIRECTIONS[:, None]
    rows = CAMERA.project(points)[..., 1]
    middle = TIPS + THESIS.positions[[0, -1]].mean() * DIRECTIONS
    late = (rows - CAMERA.project(middle)[:, None, 1]) / HEIGHT
    moves = []
    for axis in torch.eye(3, dtype=torch.float64):
        pixels = CAMERA.project(points + motion * late[..., None] * axis)
        pose = solve_pose(pixels, THESIS.positions, CAMERA, offset=0.0)
        moves.append(torch.cat([pose.tip - TIPS, pose.direction - DIRECTIONS], -1) / motion)
    lever = torch.stack(moves, -1)
    found = readout_covariance(CAMERA, TIPS, DIRECTIONS, THESIS.positions, HEIGHT, 3e-4)
    expected = 3e-4**2 * lever @ lever.mT
    # Of the second order of the bands' change of depth, which is neglected across the tube, and of the distortion.
    error = (found - expected).flatten(1).norm(dim=-1) / expected.flatten(1).norm(dim=-1)
    assert bool((error < 0.03).all()), error


def test_a_tool_along_a_row_is_read_at_one_time():
    tip = torch.tensor([[-0.1, 0.0, 0.5]], dtype=torch.float64)
    camera = Camera(CAMERA.matrix, torch.zeros(5, dtype=torch.float64))
    along = torch.tensor([[1.0, 0.0, 0.0]], dtype=torch.float64)
    assert not readout_covariance(camera, tip, along, THESIS.positions, HEIGHT, 3e-4).any()


def test_it_grows_with_the_square_of_the_motion():
    one, two = (readout_covariance(CAMERA, TIPS, DIRECTIONS, THESIS.positions, HEIGHT, x) for x in (1e-4, 2e-4))
    assert torch.allclose(two, 4 * one, rtol=1e-12, atol=0) and bool((one != 0).any())
