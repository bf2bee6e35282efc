"""Frames for a panel: written, read by other means, and simulated."""

import json
import math
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from oracles import panel as oracle
from paths import CONFIGS

from holotorch.cli import main
from holotorch.experiments.config.errors import ConfigError
from holotorch.experiments.execute import execute
from holotorch.experiments.panel.config import build_panel, load_panel
from holotorch.experiments.panel.export import export_slm, resimulate
from holotorch.experiments.panel.source import load_panel_phases
from holotorch.experiments.registry import load_config
from holotorch.io.panel_files import read_levels, read_phases

PANEL = str(CONFIGS / "slm" / "lcos_2048.yaml")
EVEN = "calibration=[{wavelength: 630 nm}, {wavelength: 530 nm}, {wavelength: 445 nm}]"
SMALL = ["shape=[41,36]", "pitch=9 um", EVEN]
VOLUME = [
    "volume={phantom: shells, samples: 24}",
    "transfer={points: [[20, 1, 0.2, 0, 0], [120, 1, 0.6, 0.2, 0.3], [255, 0.2, 0.9, 1, 0.9]], unit_distance: 0.05}",
    "hologram={shape: 64, pitch: 3.74 um, distance: 3 mm, depths: 12, rays: 32}",
    "device=cpu",
]
# Of 768 pixels a colour: the squares of a uniform error have a relative deviation sqrt(4 / 5), half of it for the root.
FIVE_DEVIATIONS = 5 * math.sqrt(0.8 / 768) / 2


def by_others(path: Path) -> np.ndarray:
    pixels = cv2.imread(str(path), cv2.IMREAD_ANYDEPTH | cv2.IMREAD_GRAYSCALE)
    assert pixels is not None
    return pixels


@pytest.fixture(scope="module")
def pec(tiny, tmp_path_factory):
    folder = tmp_path_factory.mktemp("pec") / "a"
    overrides = ["grid.shape=[32,24]", "grid.pitch=9 um", "solver.max_steps=12", "target.image=coffee", "frames=2"]
    assert execute(load_config(CONFIGS / "pec" / "fourier.yaml", [*overrides, "multiplexing=independent"]), folder)[1]
    return folder


@pytest.fixture(scope="module")
def volume(tiny, tmp_path_factory):
    folder = tmp_path_factory.mktemp("volume") / "a"
    assert execute(load_config(CONFIGS / "volume" / "tooth.yaml", VOLUME), folder, "a")[1]
    return folder


@pytest.mark.parametrize(("bits", "form"), [(8, "png"), (8, "bmp"), (10, "png")])
def test_files_hold_the_phases_to_the_predicted_error(pec, tmp_path, bits, form):
    words = [*SMALL, f"bits={bits}", "flip_columns=true"]
    out, report = export_slm(pec, PANEL, tmp_path / "slm", form=form, overrides=words)
    wanted = load_panel_phases(pec).phase.double().numpy()
    step = 2 * math.pi / 2**bits
    names = [f"frame-{f:03d}_{wave}nm.{form}" for f in range(2) for wave in (630, 530, 445)]
    assert report["files"] == names and report["padded"]
    for i, name in enumerate(names):
        pixels = by_others(out / name)
        assert pixels.shape == (41, 36) and pixels.dtype == (np.uint8 if bits == 8 else np.uint16)
        # Axis on axis: sample 16, 12 of the hologram on 20, 18 of the panel; nothing around it.
        phase = pixels[:, ::-1] * step
        inside = phase[4:36, 6:30]
        assert np.count_nonzero(phase) == np.count_nonzero(inside)
        rms = oracle.wrapped_rms(inside, wanted[i // 3, i % 3])
        assert rms == pytest.approx(step / math.sqrt(12), rel=FIVE_DEVIATIONS)
    if bits == 8:
        assert report["rms_phase_error_rad"] == pytest.approx([0.00708] * 3, rel=FIVE_DEVIATIONS / math.sqrt(2))
    assert report["expected_rms_phase_error_rad"] == pytest.approx([step / math.sqrt(12)] * 3, rel=1e-9)
    # An error of relative size e in the field is one of about 2 e in its intensity, less where the picture is dark.
    assert all(step / 20 < change < step for change in report["picture_change_by_levels"])
    assert json.loads((out / "export.json").read_text()) == report


def test_facts_survive_in_every_format(pec, tmp_path):
    for form, read in (("png", read_levels), ("bmp", read_levels), ("exr", read_phases)):
        out, report = export_slm(pec, PANEL, tmp_path / form, form=form, overrides=SMALL)
        facts = read(out / report["files"][4])[1]
        assert facts["wavelength_m"] == 530e-9 and facts["pitch_m"] == [9e-6, 9e-6]
        assert (facts["frame"], facts["colour"], facts["bits"]) == (1, 1, 8)
        assert facts["encoding"] == "phase" and facts["source"] == str(pec) and facts["window"] == [[4, 36], [6, 30]]
        panel = build_panel(load_panel(PANEL, SMALL), [630e-9, 530e-9, 445e-9])
        assert facts["lut_sha256"] == panel.lut_hash(1) and len(facts["config_sha256"]) == 64


def test_exr_is_exact(pec, tmp_path):
    out, report = export_slm(pec, PANEL, tmp_path / "a", form="exr", overrides=[*SMALL, "flip_rows=true"])
    wanted = load_panel_phases(pec).phase
    for i, name in enumerate(report["files"]):
        assert torch.equal(read_phases(out / name)[0].flip(0)[4:36, 6:30], wanted[i // 3, i % 3])
    assert report["rms_phase_error_rad"] == [0, 0, 0] and max(report["picture_change_by_levels"]) < 1e-6


def test_the_picture_is_that_of_the_run(pec):
    wanted = load_panel_phases(pec)
    formed = wanted.picture(torch.polar(torch.ones_like(wanted.phase), wanted.phase)).double()
    saved = torch.from_numpy(np.load(pec / "arrays" / "intensity.npy"))
    ratio = formed / saved
    # The run's picture has a scale of its own for each colour; float32 phases near 20 rad are rounded to 1e-6.
    bright = saved > 0.05 * saved.amax()
    for c in range(3):
        values = ratio[c][bright[c]]
        assert (values.max() / values.min()).item() == pytest.approx(1, abs=1e-3)


@pytest.mark.parametrize("encoding", [None, "kinoform", "error_diffusion"])
def test_a_volume_is_encoded_and_its_loss_is_told(volume, tmp_path, encoding):
    words = ["shape=64", "pitch=3.74 um"]
    out, report = export_slm(volume, PANEL, tmp_path / "a", encoding=encoding, overrides=words)
    assert report["encoding"] == (encoding or "double_phase") and not report["padded"]
    assert report["content"].startswith("phases that form the volume behind the panel")  # view.front=far
    hologram = np.load(volume / "arrays" / "hologram.npy")
    levels = [by_others(out / name) for name in report["files"]]
    phases = np.stack(levels) * (2 * math.pi / 256)
    if encoding == "kinoform":
        for c in range(3):
            rms = oracle.wrapped_rms(phases[c], np.angle(hologram[c]))
            # 4096 pixels, five deviations as above.
            assert rms == pytest.approx(2 * math.pi / 256 / math.sqrt(12), rel=5 * math.sqrt(0.8 / 4096) / 2)
    if encoding is None:
        # Neighbours of a checkerboard average to the field, up to what neighbours differ by.
        shown = np.exp(1j * phases)
        mean = shown[:, ::2, ::2] + shown[:, 1::2, ::2] + shown[:, ::2, 1::2] + shown[:, 1::2, 1::2]
        field = hologram[:, ::2, ::2] + hologram[:, 1::2, ::2] + hologram[:, ::2, 1::2] + hologram[:, 1::2, 1::2]
        for a, b in zip(mean, field, strict=True):
            assert abs(np.vdot(a, b)) / np.linalg.norm(a) / np.linalg.norm(b) > 0.6
    losses = report["encoding_loss"]
    assert set(losses) == {report["encoding"], "kinoform"} and all(0 < x < 1 for row in losses.values() for x in row)
    assert max(losses["kinoform"]) < 0.4


def test_the_panel_itself_changes_the_picture_more_than_its_levels(volume, tmp_path):
    words = ["shape=64", "pitch=3.74 um", "crosstalk_px=0.5", "gap=0.5", "fill_factor=0.8"]
    report = export_slm(volume, PANEL, tmp_path / "a", encoding="kinoform", overrides=words)[1]
    levels, whole = report["picture_change_by_levels"], report["picture_change_by_panel"]
    assert all(5 * small < large for small, large in zip(levels, whole, strict=True))


def test_wavelengths_between_calibrations_use_the_crystals_dispersion():
    one = "calibration=[{wavelength: 532 nm, full_turn: 256}]"
    panel = build_panel(load_panel(PANEL, [one]), [636e-9, 532e-9, 532.3e-9])
    dn = [0.18 + 0.0085 / um**2 for um in (0.636, 0.532)]
    scale = 532 / 636 * dn[0] / dn[1]
    np.testing.assert_allclose(panel.lut[0].numpy(), np.arange(256) * (2 * math.pi / 256) * scale, rtol=1e-12)
    assert torch.equal(panel.lut[1], panel.lut[2])  # to 0.1 % the same laser
    with pytest.raises(ConfigError, match="is not calibrated at 636 nm but at 532 nm; add a calibration"):
        build_panel(load_panel(PANEL, [one, "dispersion=null"]), [636e-9])


def test_tables_come_from_files_too(tmp_path):
    path = tmp_path / "panel.yaml"
    path.write_text("shape: 8\npitch: 4 um\nbits: 3\ncalibration: [{wavelength: 530 nm, lut_file: lut.csv}]\n")
    (tmp_path / "lut.csv").write_text("level, phase\n0, 0\n# measured\n4 2.0\n7, 5.0\n")
    (row,) = build_panel(load_panel(path), [530e-9]).lut
    np.testing.assert_allclose(row.numpy(), [0, 0.5, 1, 1.5, 2, 3, 4, 5], rtol=1e-12)
    (tmp_path / "lut.csv").write_text("0, 0\n4, zwei\n")
    with pytest.raises(ConfigError, match=r"panel.yaml:4:\d+: calibration.0.lut_file: .*lut.csv:2: expected a level"):
        load_panel(path)


@pytest.mark.parametrize("path", sorted((CONFIGS / "slm").glob("*.yaml")), ids=lambda path: path.stem)
def test_every_panel_of_the_project_loads(path):
    panel = build_panel(load_panel(path), [630e-9, 530e-9, 455e-9])
    assert (panel.lut.diff() > 0).all() and max(panel.expected_rms) < 0.3


@pytest.mark.parametrize(
    ("word", "message"),
    [
        ("calibration=[{wavelength: 530 nm, lut: [[0, 0], [100, 3], [255, 2]]}]", "lut must be monotone"),
        ("calibration=[{wavelength: 530 nm, lut: [[0, 0], [254, 6]]}]", "expected rows from level 0 to 255"),
        ("calibration=[{wavelength: 530 nm, lut: [[0, 0], [0, 6]]}]", "expected levels that rise from row to row"),
        ("calibration=[{wavelength: 530 nm, full_turn: 9, lut: [[0, 0], [255, 6]]}]", "expected one of full_turn, lut"),
        ("calibration=[{wavelength: 530 nm, full_turn: -1}]", "calibration.0.full_turn: expected greater than 0"),
        ("calibration=[{wavelength: 530}]", "expected a length within 10 nm .. 300 um"),
        ("dispersion={a: 0.18}", "expected both a and b"),
        ("dispersion={table: [[500 nm, 0.2], [600 nm, 0.19]]}", "lie outside the birefringence table, 500 to 600 nm"),
        ("dispersion={a: 0.18, b: 0.0085, table: [[500 nm, 0.2], [600 nm, 0.19]]}", "not both"),
        ("fil_factor=0.9", "fil_factor: unknown setting; did you mean 'fill_factor'?"),
        ("bits=17", "bits: expected less than or equal to 16, got 17"),
    ],
)
def test_mistakes_in_a_description_are_pointed_at(word, message):
    with pytest.raises(ConfigError) as caught:
        load_panel(PANEL, [word])
    assert message in str(caught.value) and str(caught.value).startswith("argument '")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["pitch=8 um"], "was computed for pixels of 9 x 9 um, the panel LCOS 2048 has 8 x 8 um"),
        (["shape=[31,40]"], "the hologram has 32 x 24 pixels, more than the 31 x 40 of the panel LCOS 2048"),
        (["calibration=[{wavelength: 630 nm}]", "dispersion=null"], "is not calibrated at 530 nm"),
    ],
)
def test_what_does_not_fit_is_refused_and_nothing_is_left(pec, tmp_path, words, message):
    with pytest.raises(ConfigError, match=message):
        export_slm(pec, PANEL, tmp_path / "a", overrides=[*SMALL, *words])
    assert not (tmp_path / "a").exists()


def test_colours_before_frames_are_refused_where_no_shape_tells(pec, tmp_path):
    """As many frames as colours: the heating power of each colour, of which the run has told, does."""
    copy = tmp_path / "run"
    shutil.copytree(pec, copy)
    two = np.load(copy / "arrays" / "phase.npy")
    three = np.concatenate([two, two[:1] / 2])
    config, summary = copy / "config.yaml", copy / "summary.json"
    config.write_text(config.read_text().replace("frames: 2", "frames: 3"))
    numbers = json.loads(summary.read_text())
    told = numbers["methods"]["corrected"]
    power = np.array(told["heating_power_K_per_pixel"])
    told["heating_power_K_per_pixel"] = (power * three.mean((0, 2, 3)) / two.mean((0, 2, 3))).tolist()
    summary.write_text(json.dumps(numbers))
    np.save(copy / "arrays" / "phase.npy", three)
    assert load_panel_phases(copy).phase.shape == (3, 3, 32, 24)
    np.save(copy / "arrays" / "phase.npy", three.swapaxes(0, 1))
    with pytest.raises(
        ConfigError, match=r"phase.npy holds \[C, F, H, W\], .* and \[F, C, H, W\] is wanted; as F = C = 3"
    ):
        load_panel_phases(copy)
    np.save(copy / "arrays" / "phase.npy", three * 2)  # another solution of neither order is taken at its word
    assert load_panel_phases(copy).phase.shape == (3, 3, 32, 24)
    for damaged in ([10**400, 1.0, 1.0], ["x", 1.0, 1.0]):  # the first is a find of fuzzing
        told["heating_power_K_per_pixel"] = damaged
        summary.write_text(json.dumps(numbers))
        with pytest.raises(ConfigError, match=r"summary.json is damaged: it does not say the heating power"):
            load_panel_phases(copy)


def test_damaged_runs_are_refused(pec, tmp_path):
    copy = tmp_path / "run"
    shutil.copytree(pec, copy)
    phase = np.load(copy / "arrays" / "phase.npy")
    phase[1, 2, 3, 4] = np.nan
    np.save(copy / "arrays" / "phase.npy", phase)
    with pytest.raises(ConfigError, match=r"phase must be finite, but element \(1, 2, 3, 4\) is nan"):
        export_slm(copy, PANEL, overrides=SMALL)
    np.save(copy / "arrays" / "phase.npy", phase[:1])
    with pytest.raises(
        ConfigError, match=r"must have the shape \(F, C, H, W\) = \(2, 3, 32, 24\) of its configuration"
    ):
        export_slm(copy, PANEL, overrides=SMALL)
    (copy / "arrays" / "phase.npy").unlink()
    with pytest.raises(ConfigError, match="phase.npy is not in its arrays"):
        export_slm(copy, PANEL, overrides=SMALL)
    assert not (copy / "slm").exists()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda values: abs(values).astype(np.int32), "in complex64, got .* in int32"),
        (lambda values: values.real.copy(), "in complex64, got .* in float32"),
        (lambda values: np.array([{}]), "hologram.npy cannot be read"),
        (lambda values: [" "], "summary.json is damaged: it does not say at which depths"),
        (lambda values: 3.0, "summary.json is damaged"),
    ],
)
def test_a_volume_of_someone_else_is_refused_by_its_files(volume, tmp_path, change, message):
    folder = shutil.copytree(volume, tmp_path / "run")
    made = change(np.load(folder / "arrays" / "hologram.npy"))
    if isinstance(made, np.ndarray):
        np.save(folder / "arrays" / "hologram.npy", made, allow_pickle=True)
    else:
        summary = json.loads((folder / "summary.json").read_text())
        (folder / "summary.json").write_text(json.dumps(summary | {"refocused_m": made}))
    with pytest.raises(ConfigError, match=message):
        load_panel_phases(folder)


def test_a_field_of_any_strength_is_exported_alike(volume, tmp_path):
    folder = shutil.copytree(volume, tmp_path / "run")
    values = np.load(folder / "arrays" / "hologram.npy")
    before = load_panel_phases(folder)
    np.save(folder / "arrays" / "hologram.npy", values * np.float32(2.0**60))  # its fourth power is beyond float32
    after = load_panel_phases(folder)
    assert torch.equal(after.phase, before.phase) and after.losses == before.losses


def test_a_failed_export_leaves_no_files(pec, tmp_path, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device", "frame")

    monkeypatch.setattr("holotorch.experiments.panel.export.write_levels", full)
    with pytest.raises(OSError, match="No space left"):
        export_slm(pec, PANEL, tmp_path / "a", overrides=SMALL)
    assert not (tmp_path / "a").exists()


def test_command(pec, tmp_path, capsys):
    words = ["export-slm", str(pec), "--slm", PANEL, *SMALL, "--out", str(tmp_path / "a")]
    assert main(words) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "Files      6 png for LCOS 2048, phase" and lines[-1] == str(tmp_path / "a")
    assert "0.0071 / 0.0071 / 0.0071 rad expected" in lines[2]
    # The files are of no use to a thermal chip, and the text says so.
    assert lines[-2].startswith("Content    phase after the heat has spread, modulo 2 pi, for a liquid-crystal panel")
    assert "holotorch export-heaters" in lines[-2] and "arrays/phase.npy" in lines[-2]
    assert json.loads((tmp_path / "a" / "export.json").read_text())["content"] == lines[-2].removeprefix("Content    ")
    assert main(words) == 2
    assert "holds files already; choose another --out" in capsys.readouterr().err
    run = shutil.copytree(pec, tmp_path / "run")
    for name in ("slm", "slm-002"):  # without --out, folders number themselves
        assert main(["export-slm", str(run), "--slm", PANEL, *SMALL]) == 0
        assert capsys.readouterr().out.splitlines()[-1] == str(run / name)
    for extra, message in (
        (["--encoding", "kinoform"], "holds phases already, which need no encoding"),
        (["--format", "tiff"], "expected one of png, bmp, exr as the format, got 'tiff'"),
        (["--format", "bmp", "--slm", PANEL, *SMALL, "bits=10"], "a BMP holds 8 bits"),
        (["--slm", "missing.yaml"], "missing.yaml: cannot read the configuration"),
    ):
        assert main([*words[:-1], str(tmp_path / "b"), *extra]) == 2
        assert message in capsys.readouterr().err
    assert main(["export-slm", str(tmp_path), "--slm", PANEL]) == 2
    assert "holds no run: config.yaml is not there" in capsys.readouterr().err


def test_files_of_another_panel_are_not_taken_for_ones_own(pec, tmp_path):
    out, report = export_slm(pec, PANEL, tmp_path / "a", overrides=SMALL)
    wanted = load_panel_phases(pec)
    other = build_panel(
        load_panel(PANEL, [*SMALL[:2], EVEN.replace("530 nm", "530 nm, full_turn: 260")]), wanted.wavelengths
    )
    names = [report["files"][:3], report["files"][3:]]
    with pytest.raises(ConfigError, match="frame-000_530nm.png was written for another table of levels"):
        resimulate(out, names, wanted, other, (..., slice(4, 36), slice(6, 30)), "png")


def test_a_bundled_panel_is_found_from_any_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert load_panel("configs/slm/lcos_2048.yaml", ["pitch=9um"]).pitch == (9e-6, 9e-6)
