"""Files of speed ratios, and what counts as slower: planted slowdowns are found, noise is not."""

import json
import random
import sys
import time
from collections.abc import Callable
from functools import partial
from types import ModuleType

import pytest
import torch
from paths import ROOT

ROUNDS = 15
COSTS = {"baseline": 1e-3, "ours": 0.7e-3, "padded": 4e-3, "planned": 1.2e-3}  # seconds


@pytest.fixture
def scripts(monkeypatch):
    """Imports a script by its name; scripts import each other as files of one folder."""
    monkeypatch.syspath_prepend(str(ROOT / "scripts"))

    def load(name: str) -> ModuleType:
        monkeypatch.delitem(sys.modules, name, raising=False)
        return __import__(name)

    return load


def timings(seed: int, slowed: dict[str, float] | None = None) -> dict[str, list[float]]:
    """Seconds of each contender in each round, as on a busy machine.

    Other work slows whole rounds by up to a half, single calls vary by 8 %, and one call in twenty is stalled.
    """
    generator, times = random.Random(seed), {name: [] for name in COSTS}
    for _ in range(ROUNDS):
        load = 1 + 0.5 * generator.random()
        for name, cost in COSTS.items():
            stall = 1 + 2 * generator.random() if generator.random() < 0.05 else 1.0
            noise = generator.lognormvariate(0, 0.08)
            times[name].append(cost * (slowed or {}).get(name, 1.0) * load * stall * noise)
    return times


def test_an_unchanged_run_is_not_flagged(scripts):
    module = scripts("ratios")
    for seed in range(300):
        before, after = (module.ratios("s", "c", timings(each)) for each in (seed, 1000 + seed))
        assert not module.slower(before, after) and not module.faster(before, after)


@pytest.mark.parametrize("name", [name for name in COSTS if name != "baseline"])
def test_a_planted_slowdown_is_found_and_nothing_else(scripts, name):
    module = scripts("ratios")
    for seed in range(300):
        before = module.ratios("s", "c", timings(seed))
        after = module.ratios("s", "c", timings(1000 + seed, {name: 1.5}))
        assert [change.after.contender for change in module.slower(before, after)] == [name]
        # A slowdown within the factor that the caller allows is none.
        assert not module.slower(before, after, factor=2.0)


def test_a_slower_baseline_shows_as_faster_contenders(scripts):
    module = scripts("ratios")
    before = module.ratios("s", "c", timings(1))
    after = module.ratios("s", "c", timings(2, {"baseline": 1.5}))
    assert not module.slower(before, after)
    assert {change.after.contender for change in module.faster(before, after)} == set(COSTS) - {"baseline"}


def test_a_large_change_within_the_spread_is_not_flagged(scripts):
    module = scripts("ratios")
    before = [module.Ratio("s", "c", "ours", 1.0, 0.7, 1.6, 2.0)]
    assert not module.slower(before, [module.Ratio("s", "c", "ours", 1.5, 1.5, 2.1, 3.0)])
    assert module.slower(before, [module.Ratio("s", "c", "ours", 1.7, 1.65, 2.1, 3.0)])


def test_ratios_are_of_the_same_round(scripts):
    module = scripts("ratios")
    base, other = module.ratios("s", "c", {"a": [1.0, 2.0, 4.0], "b": [3.0, 6.0, 12.0]})
    assert (base.median, base.lower, base.upper) == (1.0, 1.0, 1.0)
    assert (other.median, other.lower, other.upper, other.milliseconds) == (3.0, 3.0, 3.0, 6000.0)


def test_a_file_holds_the_machine_and_every_ratio(scripts, tmp_path, monkeypatch, capsys):
    bench = scripts("bench")
    monkeypatch.setattr(bench, "SUBJECTS", {"sleep": lambda: iter([("1 ms", {"a": sleep, "b": sleep})])})
    file = tmp_path / "bench.json"
    monkeypatch.setattr(sys, "argv", ["bench.py", "--json", str(file)])
    bench.main()
    content = json.loads(file.read_text())
    assert set(content["machine"]) == {"cpu", "cores", "torch", "threads"} and all(content["machine"].values())
    assert content["date"][:2] == "20" and "commit" in content and content["rounds"] == bench.ROUNDS
    a, b = sys.modules["ratios"].from_json(content)
    assert (a.key, b.key) == (("sleep", "1 ms", "a"), ("sleep", "1 ms", "b")) and a.median == 1.0
    assert b.lower <= b.median <= b.upper and f"{b.median:6.3f} of the baseline" in capsys.readouterr().out


def sleep(milliseconds: float = 1.0) -> None:
    """A contender whose time other work on the machine changes little."""
    time.sleep(1e-3 * milliseconds)


def transforms(count: int) -> object:
    """Work of a few milliseconds: ``count`` Fourier transforms."""
    field = torch.ones(256, 256, dtype=torch.complex64)
    for _ in range(count):
        field = torch.fft.fft2(field, norm="ortho")
    return field


def processor_seconds(call: Callable[[], object]) -> float:
    """Of one call; unlike the time on the clock, it hardly depends on what else this machine does during a test."""
    started = time.process_time()
    call()
    return time.process_time() - started


@pytest.mark.parametrize(("work", "status"), [(8, 0), (12, 1)])
def test_a_real_run_finds_a_contender_that_does_its_work_one_and_a_half_times(
    scripts, tmp_path, monkeypatch, capsys, work, status
):
    bench = scripts("bench")
    monkeypatch.setattr(bench, "seconds", processor_seconds)
    file = tmp_path / "bench.json"

    def run(count: int, *words: str) -> None:
        contenders = {name: partial(transforms, n) for name, n in (("base", 8), ("ours", count), ("theirs", 12))}
        monkeypatch.setattr(bench, "SUBJECTS", {"fft": lambda: iter([("case", contenders)])})
        monkeypatch.setattr(sys, "argv", ["bench.py", *words])
        bench.main()

    run(8, "--json", str(file))
    with pytest.raises(SystemExit) as ended:
        run(work, "--compare", str(file))
    assert ended.value.code == status
    lines = [line for line in capsys.readouterr().out.splitlines() if line.startswith("slower:")]
    assert len(lines) == status and all(" ours " in line for line in lines)


def test_a_file_of_other_subjects_or_none_is_refused(scripts, tmp_path, monkeypatch):
    bench = scripts("bench")
    file = tmp_path / "bench.json"
    monkeypatch.setattr(sys, "argv", ["bench.py", "--compare", str(file), "crosstalk"])
    with pytest.raises(SystemExit, match="a file that --json wrote"):
        bench.main()
    file.write_text(json.dumps({"machine": bench.machine(), "ratios": {}}))
    with pytest.raises(SystemExit, match="has only the subjects"):
        bench.main()
