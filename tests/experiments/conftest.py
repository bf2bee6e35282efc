import pytest
import torch

from holotorch.experiments import pictures


@pytest.fixture(scope="module")
def tiny():
    """For tiny runs: no figures, which take longer than they do, and one thread, as two would wait for each other."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    with pytest.MonkeyPatch.context() as patch:
        for name in ("comparison", "channel_maps", "convergence"):
            patch.setattr(pictures, name, lambda *_, **__: b"")
        yield
    torch.set_num_threads(threads)
