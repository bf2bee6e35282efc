"""Runs on a GPU against the same runs on the processor; without a GPU there is nothing to compare."""

import numpy as np
import pytest
from paths import DEVICES
from tiny_runs import RUNS, command

from holotorch.cli import main

pytestmark = [pytest.mark.usefixtures("tiny"), pytest.mark.skipif(not DEVICES[1:], reason="no CUDA device")]
ON_DEVICES = {
    "pec": ["device={}"],
    "volume": ["device={}"],
    "eye": [RUNS["eye"][1].replace("change: [", "change: ['device={}', ")],
    "joint": ["device={}", "report.baselines=[random, afterwards, unheated, light_field, slabs]", "frames=2"],
}


@pytest.mark.parametrize("kind", ON_DEVICES)
def test_a_run_gives_the_same_on_every_device(kind: str, tmp_path):
    arrays = {}
    for device in DEVICES:
        words = [word.replace("{}", device) for word in ON_DEVICES[kind]]
        assert main(command(kind, tmp_path / device, *words)) == 0
        folder = tmp_path / device / "arrays"
        arrays[device] = {path.name: np.load(path) for path in sorted(folder.glob("*.npy"))}
    here, *others = arrays.values()
    assert here
    for there in others:
        assert there.keys() == here.keys()
        for name, wanted in here.items():
            error = np.linalg.norm(there[name] - wanted) / np.linalg.norm(wanted)
            assert error <= 1e-3, (kind, name, error)
