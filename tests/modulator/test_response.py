import math

import pytest
import torch

from holotorch.modulator import Response


def test_the_identity_by_default_and_linear_between_and_beyond_the_knots():
    drive = torch.tensor([-1.0, 0.0, 0.3, 2.0, 3.0, 5.0], dtype=torch.float64)
    torch.testing.assert_close(Response(3.0, knots=4)(drive), drive)
    bent = Response(2.0, [0.0, 1.0, 3.0])
    torch.testing.assert_close(
        bent(drive), torch.tensor([-1.0, 0.0, 0.3, 3.0, 5.0, 9.0], dtype=torch.float64)
    )  # slopes 1 and 2
    torch.testing.assert_close(bent.drive(bent(drive)), drive)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_round_trip_and_dtype(dtype):
    response = Response(4 * math.pi, torch.linspace(0.1, 3.5, 9).cumsum(0))
    drive = 4 * math.pi * torch.rand(2, 3, 5, dtype=dtype)
    assert response(drive).dtype == dtype
    torch.testing.assert_close(response.drive(response(drive)), drive)
    assert response(drive.half()).dtype == torch.float32


def test_gradients_to_drive_and_knots():
    response = Response(3.0, [0.1, 1.0, 2.5, 3.0], learnable=True)
    drive = 3 * torch.rand(7, dtype=torch.float64)

    def function(drive, phases):
        return torch.func.functional_call(response, {"phases": phases}, (drive,))

    assert torch.autograd.gradcheck(
        function, (drive.requires_grad_(), response.phases.detach().clone().requires_grad_())
    )


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((0.0,), "limit must be above zero"),
        ((1.0, [0.0, 2.0, 1.0]), "phases must be at least 2 rising numbers"),
        ((1.0, [0.0]), "phases must be at least 2 rising numbers"),
        ((1.0, torch.tensor([0.0, 1.0], requires_grad=True)), "phases requires a gradient"),
    ],
)
def test_refusals(arguments, message):
    with pytest.raises(ValueError, match=message):
        Response(*arguments)
