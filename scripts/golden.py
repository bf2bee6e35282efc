"""The net under a change of form: numbers, texts and exit statuses of every shipped configuration at a small size.

Usage: python scripts/golden.py record FILE [NAME ...]     write what this checkout does
       python scripts/golden.py compare FILE [NAME ...]    say what has changed since; 1 if anything has

Not a test: sums may differ between processors. Times, memory and machine are left out.
"""

import argparse
import contextlib
import csv
import io
import json
import math
import os
import re
import sys
import tempfile
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))
os.chdir(ROOT)

TOLERANCE = 1e-6  # relative, of numbers; those that an order of summation may change
SMALL_PEC = ["grid.shape=[24,20]", "solver.max_steps=6"]
SMALL_VOLUME = ["hologram.shape=[64,64]", "hologram.rays=32", "hologram.depths=6", "report.seeds=1"]
PHANTOM = [*SMALL_VOLUME, "volume={phantom: shells, samples: 16}"]
SCENE = (
    "scene={config: configs/volume/c60.yaml, change: ['volume={phantom: c60, samples: 16}', "
    "'hologram={shape: [64, 64], pitch: 3.74 um, distance: 2 mm, depths: 4, rays: 32}']}"
)
SMALL_EYE = [
    SCENE,
    "display={kind: planar, distance: 4 mm}",
    "eye={pupil_radius: 0.1 mm, axial_length: 2 mm}",
    "eye.tolerance=0.1",
]
SMALL_STUDY = ["images=[camera]", "size=24", "max_steps=4"]
# Name: words after ``holotorch run``.
RUNS: dict[str, list[str]] = {
    "pec-fourier": ["configs/pec/fourier.yaml", *SMALL_PEC],
    "pec-fresnel": ["configs/pec/fresnel.yaml", *SMALL_PEC],
    "pec-fresnel-periodic": ["configs/pec/fresnel.yaml", "propagator.boundary=periodic", *SMALL_PEC],
    "pec-capped": ["configs/pec/capped.yaml", *SMALL_PEC],
    "pec-depths": ["configs/pec/depths.yaml", *SMALL_PEC],
    "pec-peripheral": ["configs/pec/peripheral.yaml", "grid.shape=[24,48]", "solver.max_steps=6"],
    "demo": ["configs/demo.yaml", *SMALL_PEC],
    "demo-volume": ["configs/demo_volume.yaml", "volume.samples=16", *SMALL_VOLUME],
    "study-lowpass": ["configs/pec/studies/lowpass.yaml", *SMALL_STUDY, "sweep=[0.1,0.2]"],
    "study-targets": ["configs/pec/studies/targets.yaml", *SMALL_STUDY],
    "study-limits": ["configs/pec/studies/limits.yaml", *SMALL_STUDY],
    "study-multiplexing": ["configs/pec/studies/multiplexing.yaml", *SMALL_STUDY],
    "study-iterations": ["configs/pec/studies/iterations.yaml", *SMALL_STUDY],
    "study-focus": ["configs/pec/studies/focus.yaml", *SMALL_STUDY],
    "study-reproduction": ["configs/pec/studies/reproduction.yaml", *SMALL_STUDY],
    "volume-c60": ["configs/volume/c60.yaml", "volume.samples=16", *SMALL_VOLUME],
    "volume-tooth": ["configs/volume/tooth.yaml", *PHANTOM],
    "volume-box": ["configs/volume/tooth.yaml", *PHANTOM, "hologram.cone=box"],
    "eye-teapot": ["configs/eye/teapot.yaml", *SMALL_EYE, "seeds=1", "light={sources: [laser]}", "focus=[2 mm]"],
    "layout": ["configs/perception/layout.yaml"],
    "analysis": ["configs/perception/analysis.yaml", "resamples=100", "power.studies=10", "power.participants=[10]"],
}
# Name: words after ``holotorch``; all are refused, or only print.
TEXTS: dict[str, list[str]] = {
    **{f"check {path.relative_to(ROOT)}": ["check", str(path.relative_to(ROOT))] for path in sorted(
        path for path in (ROOT / "configs").rglob("*.yaml")
        if path.parent.name not in ("slm", "tracking") and path.name not in ("study.yaml", "factors.yaml")
    )},
    "unknown key": ["check", "configs/pec/fourier.yaml", "grid.pich=8um"],
    "unknown section": ["check", "configs/volume/c60.yaml", "holograms.shape=[8,8]"],
    "no such file": ["run", "configs/pec/none.yaml"],
    "no such picture": ["check", "configs/pec/fourier.yaml", "target.image=missing.png"],
    "forgotten unit": ["check", "configs/pec/fourier.yaml", "grid.pitch=8"],
    "several mistakes": ["check", "configs/eye/teapot.yaml", "eye.pupil_radius=100mm", "seeds=0", "light.sources=[a]"],
    "empty list": ["check", "configs/pec/fourier.yaml", "wavelengths=[]"],
    "no folder": ["resume", "runs/there-is-none"],
    "no run": ["report", "tests"],
    "unknown chart": ["chart", "everything"],
    "study settings": ["study", "configs/perception/study.yaml", "repeats.target=0"],
    "no recording": ["track", "there-is-none"],
    "slm of nothing": ["export-slm", "tests", "--slm", "configs/slm/lcos_2048.yaml"],
}  # fmt: skip
ANEW = re.compile(r"seconds|_s$|bytes|memory|count$|version|device|created|time|pairs", re.IGNORECASE)


def main() -> int:
    """Record or compare."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("action", choices=["record", "compare"])
    parser.add_argument("file", type=Path)
    parser.add_argument("names", nargs="*", help="of runs and texts; all by default")
    options = parser.parse_args()
    names = options.names or [*RUNS, *TEXTS]
    held = json.loads(options.file.read_text()) if options.action == "compare" else {}
    now, changed = {}, 0
    for name in names:
        now[name] = done(name)
        print(f"{name}: exit {now[name]['exit']}", flush=True)
        if options.action == "compare":
            for line in differences(held.get(name), now[name], name):
                print(f"    {line}", flush=True)
                changed += 1
    if options.action == "record":
        options.file.write_text(json.dumps(now, indent=1, sort_keys=True))
    else:
        print(f"{changed} differences in {len(names)} entries")
    return int(changed > 0)


def done(name: str) -> dict[str, Any]:
    """What a run or a text gives."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "run"
        words = ["run", *RUNS[name], "--out", str(out)] if name in RUNS else TEXTS[name]
        status, printed, errors = call(words)
        got: dict[str, Any] = {"exit": status, "stdout": plain(printed, folder), "stderr": plain(errors, folder)}
        if name in RUNS:
            got["stderr"] = []  # progress bars
            got["files"] = contents(out)
    return got


def call(words: list[str]) -> tuple[int, str, str]:
    """Exit status, standard output and error of the command line."""
    from holotorch.cli import main as command

    printed, errors = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(errors):
        try:
            status = command(words)
        except SystemExit as end:
            status = end.code if isinstance(end.code, int) else 1
    return status, printed.getvalue(), errors.getvalue()


def plain(text: str, folder: str) -> list[str]:
    """Lines without what is of this moment and machine."""
    lines = without_seconds(text.replace(folder, "FOLDER").replace(str(ROOT), "ROOT").splitlines())
    return [re.sub(r"\d+(\.\d+)?(e[-+]\d+)? (s|GB|min)\b", r"# \3", line) for line in lines]


def without_seconds(lines: list[str]) -> list[str]:
    """Lines of a table without its column of seconds."""
    head = next((number for number, line in enumerate(lines) if re.search(r"  seconds\b", line)), None)
    if head is None:
        return lines
    begin = lines[head].index("  seconds") + 2
    end = begin + len(re.match(r"seconds *", lines[head][begin:])[0])  # type: ignore[index]
    return lines[:head] + [line[:begin] + line[end:] for line in lines[head:]]


def contents(folder: Path) -> dict[str, Any]:
    """Numbers of a run folder's files: JSON and CSV whole, arrays by their sums, the rest by name."""
    import numpy as np

    held: dict[str, Any] = {}
    for path in sorted(path for path in folder.rglob("*") if path.is_file()):
        name = str(path.relative_to(folder))
        if name == "env.json":
            held[name] = "there"
        elif path.suffix == ".json":
            held[name] = lasting(json.loads(path.read_text()))
        elif path.suffix == ".csv":
            with open(path, newline="") as stream:
                held[name] = lasting(list(csv.DictReader(stream)))
        elif path.suffix == ".npy":
            array = np.load(path).astype(complex)
            ramp = np.cos(np.arange(array.size)).reshape(array.shape)
            held[name] = [
                list(array.shape),
                *(float(abs(each)) for each in (np.linalg.norm(array), (array * ramp).sum())),
            ]
        else:
            held[name] = "there"
    return held


def lasting(value: Any) -> Any:
    """Nested values without what is measured anew."""
    if isinstance(value, dict):
        return {key: lasting(each) for key, each in value.items() if not ANEW.search(str(key))}
    return [lasting(each) for each in value] if isinstance(value, list) else value


def differences(old: Any, new: Any, where: str) -> list[str]:
    """Every place where two records differ, numbers by more than ``TOLERANCE``."""
    if isinstance(old, dict) and isinstance(new, dict):
        keys = sorted({*old, *new})
        return [line for key in keys for line in differences(old.get(key), new.get(key), f"{where} > {key}")]
    if isinstance(old, list) and isinstance(new, list) and len(old) == len(new):
        return [
            line
            for i, (one, other) in enumerate(zip(old, new, strict=True))
            for line in differences(one, other, f"{where}[{i}]")
        ]
    one, other = number(old), number(new)
    if one is not None and other is not None:
        same = math.isclose(one, other, rel_tol=TOLERANCE, abs_tol=1e-12) or (math.isnan(one) and math.isnan(other))
        return [] if same else [f"{where}: {old} is now {new}"]
    return [] if old == new else [f"{where}: {old!r} is now {new!r}"]


def number(value: Any) -> float | None:
    """A number, also one written in a table; None for anything else."""
    if isinstance(value, bool) or value is None:
        return None
    try:
        return float(value)
    except (TypeError, ValueError):
        return None


if __name__ == "__main__":
    sys.exit(main())
