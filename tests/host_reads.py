"""Counts the numbers that are read back from the device, each of which makes a GPU wait."""

import torch
from torch.utils._python_dispatch import TorchDispatchMode

aten = torch.ops.aten
WAITS = (aten._local_scalar_dense.default, aten.nonzero.default, aten.masked_select.default, aten.equal.default)
INDEXES = (aten.index.Tensor, aten.index_put.default, aten.index_put_.default)  # wait if an index is a mask


class HostReads(TorchDispatchMode):
    """Counts the operations that wait for a number to come back from the device."""

    def __init__(self):
        super().__init__()
        self.count = 0

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        masked = func in INDEXES and any(each is not None and each.dtype == torch.bool for each in args[1])
        self.count += func in WAITS or masked
        return func(*args, **(kwargs or {}))
