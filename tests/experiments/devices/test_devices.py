"""The computations of the chart at a small size, and its rows with and without a GPU."""

import csv
from functools import partial

import pytest
import torch

from holotorch.cli import main
from holotorch.experiments.devices import chart, tasks
from holotorch.experiments.devices.tasks import Amount, Task
from holotorch.experiments.volume.chart import TABLE

SMALL = Amount(64, ("Tooth", "Bonsai"), 16, 2, 1, (1, 1))
OPTICAL = [task for task in tasks.tasks(SMALL) if "catheter" not in task.name]


@pytest.mark.parametrize("task", OPTICAL, ids=lambda task: f"{task.name}, {task.method}")
@pytest.mark.filterwarnings("ignore::holotorch.core.checks.SamplingWarning")
def test_every_computation_gives_the_same_each_time(task: Task):
    cpu = torch.device("cpu")
    one, other = task.build(cpu)(), task.build(cpu)()
    assert torch.equal(one, other) and one.isfinite().all() and one.abs().max() > 0
    assert task.times > 0 and task.thesis is None  # the thesis states times for its own size


def test_the_dissertation_s_scenes_are_timed_at_its_size():
    whole = {task.name: task for task in tasks.tasks(tasks.FULL) if task.method == tasks.OURS}
    assert {task.thesis for task in whole.values()} == {seconds for _, _, seconds in TABLE.values()}
    assert "Teapot, 253 planes, 2048 px" in whole


@pytest.mark.parametrize("gpu", [False, True])
def test_rows_and_verdict(gpu: bool, monkeypatch, tmp_path, capsys):
    """A GPU is stood in for by the processor under another name, whose results differ a little."""
    available = [torch.device("cpu"), torch.device("cpu", 0)] if gpu else [torch.device("cpu")]
    calls: list[str] = []

    def build(size: float, device: torch.device):
        calls.append(str(device))
        return lambda: torch.full((4,), size if device.index is None else size * (1 + 1e-6), dtype=torch.float64)

    monkeypatch.setattr(chart, "computing_devices", lambda: available)
    monkeypatch.setattr(chart, "device_name", lambda device: "a CPU" if device.index is None else "a GPU")
    monkeypatch.setattr(chart, "tasks", lambda _: [Task("sum", "slow", "step", partial(build, 2.0), 10.0, 3.5)])
    assert main(["chart", "devices", "--out", str(tmp_path)]) == 0
    with open(tmp_path / "chart.csv", newline="") as stream:
        rows = list(csv.DictReader(stream))
    text = capsys.readouterr().out
    assert [row["device"] for row in rows] == ["a CPU", "a GPU" if gpu else chart.NOT_MEASURED]
    assert float(rows[0]["seconds"]) > 0 and rows[0]["rounds"] == "3" and rows[0]["thesis_seconds"] == "3.5"
    if gpu:
        assert rows[1]["rounds"] == "7" and float(rows[1]["difference"]) == pytest.approx(1e-6, rel=0.1)
        ratio = float(rows[0]["seconds"]) / float(rows[1]["seconds"])
        assert float(rows[1]["over_processor"]) == pytest.approx(ratio, rel=0.02)
        assert "on a GPU" in text and "times as fast as the processor" in text and calls == ["cpu", "cpu:0"]
    else:
        assert not rows[1]["seconds"] and "GPU: not measured" in text
    assert "the thesis's GPU 3.5 s" in text and (tmp_path / "chart.png").stat().st_size > 0
