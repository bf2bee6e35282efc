import gc
import signal
from collections.abc import Iterator
from contextlib import contextmanager

import pytest
import torch

# Tests are small: threads gain nothing, and where others share the cores they cost tens of times.
torch.set_num_threads(1)
# A job in the background is started with Ctrl-C ignored, and tests of Ctrl-C would wait for ever.
signal.signal(signal.SIGINT, signal.default_int_handler)
# Modules and tests are objects by the hundred thousand that stay to the end: collecting garbage looks at none of them,
# neither while they are made nor in the tests.
gc.disable()


def pytest_collection_finish():
    gc.collect()
    gc.freeze()
    gc.enable()


@pytest.fixture(autouse=True, scope="session")
def cache(tmp_path_factory):
    """Tests neither read nor write the user's cache."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        yield


@pytest.fixture(autouse=True)
def seeded():
    torch.default_generator.manual_seed(2026)  # torch.manual_seed also looks at all other devices, in a millisecond
    if torch.cuda.is_available():
        torch.cuda.manual_seed_all(2026)


@pytest.fixture
def full_disk():
    """As a disk that fills up: within ``with full_disk(size)`` no file can be written beyond ``size`` bytes."""
    resource = pytest.importorskip("resource", reason="this system has no limits of file sizes")

    @contextmanager
    def limited(size: int) -> Iterator[None]:
        soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
        resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))  # Python ignores the signal, and gets an error
        try:
            yield
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))

    return limited
