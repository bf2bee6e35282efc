"""A run ends by saying what came out: the numbers of its summary, where its pictures are, and its report."""

import json
from statistics import fmean

import pytest
from tiny_runs import RUNS, command

from holotorch.cli import main


def wanted(kind: str, summary: dict) -> list[str]:
    """What the last lines of a run must contain, taken from its summary.json."""
    if kind == "pec":
        corrected, none = (summary["methods"][name] for name in ("corrected", "none"))
        heat = f"hottest pixel {max(corrected['peak_temperature_rise_K']):.0f} degC"
        ssim = f"SSIM {corrected['ssim_mean']:.3f} ({none['ssim_mean']:.3f} without correction)"
        between = f"SSIM {corrected['between_samples']['ssim_mean']:.3f} midway between the samples"
        return [
            ssim,
            f"PSNR {corrected['psnr_mean']:.1f} dB ({none['psnr_mean']:.1f} without correction)",
            between,
            heat,
        ]
    if kind == "volume":
        return [f"SSIM {summary['ssim_in_focus']:.3f}", f"contrast {summary['speckle_contrast']:.2f} in 3 realisation"]
    if kind == "eye":
        (row,) = summary["rows"]
        return [f"laser: SSIM {fmean(row['ssim']):.2f}, speckle contrast {fmean(row['contrast']):.2f}"]
    if kind == "joint":
        methods = summary["methods"]
        stack, half = (methods["joint"][f"{name}_psnr"] for name in ("stack", "half"))
        return [
            f"dB by exact heat and light ({stack:.1f} dB by the run's own calculation) at the corrected foci",
            f"; {half:.1f} dB through half pupils",
            f"hottest pixel {methods['joint']['peak_temperature_K']:.0f} degC above ambient",
            f": {max(methods[name]['stack_psnr'] for name in ('afterwards', 'slabs')):.1f} dB at",
        ]
    if kind == "study":
        return [f"study of limits: {summary['rows']} rows"]
    if kind == "measure":
        return [f"reference {summary['faces'][0]['acc_mm']:.3f} mm"]
    if kind == "layout":
        return [f"{item['size_deg']:.1f} deg; 1 icons" for item in summary["items"]]
    (row,) = summary["rows"]
    return [
        f"a pattern of {row['alpha']:.3g} E {row['beta']:+.3g} deg",
        "as fast as 450 ms",
        "40 simulated participants",
    ]


@pytest.mark.usefixtures("tiny")
@pytest.mark.parametrize("kind", RUNS)
def test_a_run_ends_with_its_main_numbers_its_pictures_and_its_report(kind, tmp_path, capsys):
    folder = tmp_path / "a"
    assert main(command(kind, folder, *(["report.baselines=[none]"] if kind == "pec" else []))) == 0
    *_, pictures, report = lines = capsys.readouterr().out.splitlines()
    assert report == str(folder / "report.html") and pictures == f"Pictures   {folder / 'images'}"
    summary = json.loads((folder / "summary.json").read_text())
    assert main(["resume", str(folder)]) == 0
    _, *last = capsys.readouterr().out.splitlines()
    assert last == lines[-len(last) :] and len(last) > 2  # what was computed before is said again
    for words in wanted(kind, summary):
        assert sum(words in line for line in last) == 1, (words, last)
    if "predicted_error" in summary:
        (error,) = [line for line in last if line.startswith("Error")]
        assert f"itself: {100 * summary['measured_error']:.2g} % measured" in error
        assert f"{100 * summary['predicted_error']:.2g} % predicted" in error
    plan = json.loads((folder / "plan.json").read_text()) if (folder / "plan.json").is_file() else {}
    assert [line for line in last if line.startswith("WARNING")] == [
        f"WARNING    {warning}" for warning in plan.get("warnings", [])
    ]


def test_a_complete_run_whose_summary_is_damaged_is_refused(tmp_path, capsys):
    folder = tmp_path / "a"
    assert main(command("layout", folder)) == 0
    (folder / "summary.json").write_text('{"experiment": "perception_layout", "status": "complete"}')
    assert main(["resume", str(folder)]) == 2
    assert f"{folder} holds a run that cannot be read: KeyError 'lines'" in capsys.readouterr().err
