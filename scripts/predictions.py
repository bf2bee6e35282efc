"""Predicted seconds of whole commands beside the measured ones: OMP_NUM_THREADS=1 python scripts/predictions.py."""

import argparse
import json
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

# Name and words of ``holotorch run``.
RUNS = {
    "pec fourier": ["configs/pec/fourier.yaml", "report.baselines=[]"],
    "pec fourier, baselines": ["configs/pec/fourier.yaml"],
    "pec fourier, 48 px": ["configs/pec/fourier.yaml", "grid.shape=[48, 48]"],
    "pec fourier, 512 px": ["configs/pec/fourier.yaml", "grid.shape=[512, 512]", "solver.max_steps=40"],
    "pec capped": ["configs/pec/capped.yaml", "report.baselines=[]"],
    "pec capped, baselines": ["configs/pec/capped.yaml"],
    "pec fresnel": ["configs/pec/fresnel.yaml", "report.baselines=[]"],
    "pec depths": ["configs/pec/depths.yaml"],
    "pec peripheral": ["configs/pec/peripheral.yaml"],
    "volume c60": ["configs/volume/c60.yaml", "scale=4"],
    "volume c60, finer": ["configs/volume/c60.yaml", "scale=2"],
    "volume engine": ["configs/volume/engine.yaml", "volume={phantom: shells}", "scale=4"],
    "eye, laser": [
        "configs/eye/teapot.yaml",
        "scene={config: configs/volume/c60.yaml, change: ['hologram={shape: [256, 256], pitch: 3.74 um, "
        "distance: 30 mm, depths: 29, rays: 128}']}",
        "light={sources: [laser]}",
        "seeds=1",
    ],
    "joint c60": ["configs/joint/teapot.yaml", "volume={phantom: c60}", "report.baselines=[]", "steps=20"],
    "joint c60, baselines": ["configs/joint/teapot.yaml", "volume={phantom: c60}", "steps=20"],
    "joint c60, 48 px": ["configs/joint/teapot.yaml", "volume={phantom: c60}", "display.shape=[48, 48]", "frames=5"],
}


def _processor_seconds() -> float:
    """Seconds that finished commands spent on processors; far fewer than measured ones on a busy machine."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def main() -> None:
    """Run each configuration in a process of its own and print a line for it, then the median ratio."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, help="file to write the lines to as well")
    lines, ratios = ["run: predicted s, measured s (of which the processor worked), measured / predicted"], []
    options = parser.parse_args()
    for name, words in RUNS.items():
        with tempfile.TemporaryDirectory() as folder:
            out, started = Path(folder) / "run", time.perf_counter()
            command = [sys.executable, "-m", "holotorch", "run", *words, "--out", str(out)]
            worked = _processor_seconds()
            subprocess.run(command, check=True, capture_output=True)
            measured, worked = time.perf_counter() - started, _processor_seconds() - worked
            predicted = json.loads((out / "plan.json").read_text())["predicted_seconds"]
        ratios.append(measured / max(predicted, 1e-3))
        lines.append(f"{name}: {predicted:.3g}, {measured:.3g} ({worked:.3g}), {ratios[-1]:.2f}")
        print(lines[-1], flush=True)
    off = statistics.median(max(ratio, 1 / ratio) for ratio in ratios)
    lines.append(f"median of the factor between them: {off:.2f} over {len(ratios)} runs")
    print(lines[-1])
    if options.out:
        options.out.write_text("\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
