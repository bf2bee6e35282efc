"""Where numbers can be read at no cost, on which skipping what is dark depends."""

import pytest
import torch
from torch import nn
from torch._subclasses.fake_tensor import FakeTensorMode

from holotorch.core import checks


def test_numbers_on_the_processor_can_be_read():
    assert checks.readable(torch.ones(2), nn.Parameter(torch.ones(2)))
    assert checks.readable()


@pytest.mark.parametrize("device", ["cuda", "mps", "meta"])
def test_numbers_elsewhere_cannot(device):
    """Tensors of a device that this machine lacks have a shape and no values."""
    with FakeTensorMode():
        there = torch.empty(2, device=device)
    assert there.device.type == device
    assert not checks.readable(there) and not checks.readable(torch.ones(2), there)
    assert not checks.readable(torch.empty(2, device="meta"))


def test_tensors_without_values_cannot():
    with FakeTensorMode():
        assert not checks.readable(torch.empty(2))

    def doubled_if_readable(values: torch.Tensor) -> torch.Tensor:
        return 2 * values if checks.readable(values) else values

    compiled = torch.compile(doubled_if_readable, fullgraph=True, backend="eager")
    exported = torch.export.export(_Module(doubled_if_readable), (torch.ones(2),)).module()
    assert doubled_if_readable(torch.ones(2)).sum() == 4
    assert compiled(torch.ones(2)).sum() == 2 and exported(torch.ones(2)).sum() == 2


class _Module(nn.Module):
    def __init__(self, function):
        super().__init__()
        self.function = function

    def forward(self, values: torch.Tensor) -> torch.Tensor:
        return self.function(values)
