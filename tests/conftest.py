import pytest
import torch

# Tests are small: threads gain nothing, and where others share the cores they cost tens of times.
torch.set_num_threads(1)


@pytest.fixture(autouse=True)
def seeded():
    torch.manual_seed(2026)
