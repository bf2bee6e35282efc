"""What the page shows of a run: the pictures of the run itself at first, and what other means give after a change."""

import json

import cv2
import numpy as np
import pytest
import torch
from paths import CONFIGS
from tiny_runs import RUNS

from holotorch.cli import main
from holotorch.experiments.config.errors import ConfigError
from holotorch.experiments.execute import execute
from holotorch.experiments.joint.experiment import build
from holotorch.experiments.registry import find_kind, load_config
from holotorch.experiments.view.check import check
from holotorch.experiments.view.controls import Choice, Slider, checked, span
from holotorch.experiments.view.opening import VIEWERS, open_viewer
from holotorch.experiments.view.viewer import Outdated, Picture
from holotorch.io.colour_tables import srgb_matrix, white_balance
from holotorch.optics import equal_power, gamut_map, tone_map
from holotorch.optics.picture import linear_srgb

MORE = {
    "pec": ["frames=2", "multiplexing=independent"],
    "volume": ["hologram={shape: [32, 32], pitch: 3.74 um, distance: 3 mm, depths: 2, rays: 16}", "report.seeds=1"],
    "joint": ["eye.parallax=0"],
    "eye": [],
}
LEVEL = 1.01 / 255  # of a PNG file, whose values are rounded


@pytest.fixture(scope="module")
def runs(tiny, tmp_path_factory):
    """A finished run of each kind that has a viewer."""
    folders = {}
    for kind in VIEWERS:
        config, *words = RUNS[kind]
        folders[kind] = tmp_path_factory.mktemp(kind) / "run"
        assert execute(load_config(CONFIGS / config, [*words, *MORE[kind]]), folders[kind])[1]
    return folders


def shown(viewer, coarse=False, **changes):
    with torch.no_grad():
        return viewer.show(checked(viewer.controls, changes), coarse, lambda: None)


def pixels(picture: Picture) -> np.ndarray:
    image = cv2.imdecode(np.frombuffer(picture.png, np.uint8), cv2.IMREAD_UNCHANGED)
    assert image is not None
    image = image[..., ::-1].transpose(2, 0, 1) if image.ndim == 3 else image[None]
    return image / 255


def by_name(result) -> dict[str, np.ndarray]:
    return {picture.name: pixels(picture) for picture in result.pictures}


def test_a_corrected_picture_is_that_of_the_run_and_another_heat_spoils_it(runs):
    viewer, arrays = open_viewer(runs["pec"]), runs["pec"] / "arrays"
    first = shown(viewer)
    wanted, phase = np.load(arrays / "target.npy"), np.load(arrays / "phase.npy").astype(float)
    assert np.abs(by_name(first)["shown"] - np.load(arrays / "intensity.npy").clip(0, 1)).max() < LEVEL
    assert np.abs(by_name(first)["target"] - wanted).max() < LEVEL
    scores = json.loads((runs["pec"] / "summary.json").read_text())["methods"]["corrected"]
    assert first.numbers["SSIM"] == f"{scores['ssim_mean']:.3f}"
    # One frame in another heat, by matrices: row and column of a Gaussian, and the far field of a chip.
    size = phase.shape[-2:]
    rows, columns = (np.exp(-(np.subtract.outer(range(n), range(n)) ** 2) / 1.1**2) for n in size)
    field = np.exp(1j * (rows @ phase[1] @ columns))
    far = np.fft.fftshift(np.fft.fft2(np.fft.ifftshift(field, axes=(1, 2)), norm="ortho"), axes=(1, 2))
    picture = np.abs(far) ** 2 * wanted.mean((1, 2), keepdims=True)
    result = shown(viewer, sigma=1.1, frame="1")
    assert np.abs(by_name(result)["shown"] - picture.clip(0, 1)).max() < LEVEL
    # Two levels of the heaters, and the maps of heaters and temperature.
    maps = shown(viewer, picture="heaters", bits="1")
    assert len(maps.pictures) == 3 and len(np.unique(by_name(maps)["630"].reshape(3, -1), axis=1).T) == 2
    warm = (rows @ phase[0] @ columns)[0] * 175 / np.pi
    caption = shown(viewer, picture="temperature", sigma=1.1).pictures[0].caption
    assert caption == f"630 nm: {warm.min():.1f} (dark) to {warm.max():.1f} degC (bright)"


def test_a_hologram_is_refocused_as_by_propagation_and_turned(runs):
    from holotorch import Grid
    from holotorch.core.complex import intensity
    from holotorch.optics import AngularSpectrum

    viewer, arrays = open_viewer(runs["volume"]), runs["volume"] / "arrays"
    hologram, rendering = (np.load(arrays / f"{name}.npy") for name in ("hologram", "rendering"))
    assert np.abs(by_name(shown(viewer))["rendering"] - rendering.clip(0, 1)).max() < LEVEL
    settings = load_config(runs["volume"] / "config.yaml")
    grid = Grid(settings.hologram.shape, settings.hologram.pitch)
    for c, wavelength in enumerate(settings.wavelengths):
        back = AngularSpectrum(grid, wavelength, -2.97e-3, pad=8, band_limit=False)
        image = intensity(back(torch.from_numpy(hologram[c : c + 1]).to(torch.complex128)))[0].numpy()
        image = np.pad(image, ((1, 0), (1, 0)))[:-1, :-1]  # a ray is in the middle of its 2 x 2 pixels, but for edges
        counts = np.pad(np.ones_like(image), ((1, 0), (1, 0)))[:-1, :-1]
        image, counts = (each.reshape(16, 2, 16, 2).sum((1, 3)) for each in (image, counts))
        image /= counts
        image *= (image * rendering[c]).sum() / (image**2).sum()
        result = by_name(shown(viewer, focus=2.97, colour=str(c)))["shown"][0]
        assert np.abs(result - image.clip(0, 1)).max() < LEVEL + 2e-3  # both wrap a little light around
    # Turned, all is computed as by a run of that orientation.
    turned = shown(viewer, azimuth=30.0)
    again = load_config(runs["volume"] / "config.yaml", ["view.azimuth_deg=30"])
    folder = runs["volume"].parent / "turned"
    assert execute(again, folder)[1]
    other = open_viewer(folder)
    for one, two in zip(turned.pictures, shown(other).pictures, strict=True):
        assert np.array_equal(pixels(one), pixels(two)), one.name


def test_a_moving_volume_is_small_and_abandoned_only_at_rest(runs, monkeypatch):
    from holotorch.experiments.view.kinds import volume

    monkeypatch.setattr(volume, "_COARSE", 16)
    monkeypatch.setattr("holotorch.experiments.view.kinds.turning._LEAST", 8)
    viewer = open_viewer(runs["volume"])
    moving = shown(viewer, coarse=True, azimuth=20.0, focus=3.02)
    assert moving.coarse and moving.numbers["hologram"] == "16 x 16 px"
    # It is the scene of the run's setting ``scale``, in focus at half the distance, with half the samples of the run.
    samples = json.loads((runs["volume"] / "plan.json").read_text())["samples"]
    words = ["view.azimuth_deg=20", "scale=2", f"view.samples={max(1, samples // 2)}"]
    again = load_config(runs["volume"] / "config.yaml", words)
    folder = runs["volume"].parent / "small"
    assert execute(again, folder)[1]
    small = open_viewer(folder)
    assert np.array_equal(by_name(moving)["shown"], by_name(shown(small, focus=1.51))["shown"])
    assert not np.array_equal(by_name(moving)["shown"], by_name(shown(small, focus=1.5))["shown"])
    assert not shown(viewer, coarse=True).coarse  # the stored hologram needs no smaller one

    def outdated():
        raise Outdated

    with pytest.raises(Outdated):
        viewer.show(checked(viewer.controls, {"azimuth": 25.0}), False, outdated)
    assert shown(viewer, azimuth=25.0).numbers["hologram"] == "32 x 32 px"
    assert not shown(viewer, coarse=True, azimuth=25.0, focus=3.01).coarse  # the fine hologram is at hand


def test_a_volume_on_a_chip_is_that_of_its_views(runs):
    import csv

    viewer, folder = open_viewer(runs["joint"]), runs["joint"]
    with open(folder / "views.csv", newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["use"] == "trained"]
    focus = 1e3 * float(rows[0]["focus_m"])
    result = shown(viewer, focus=focus)
    images = [np.load(folder / "arrays" / f"{name}.npy")[0] for name in ("shown", "target")]
    stack = np.load(folder / "arrays" / "target.npy")[:2]
    # White light has the colours of the volume: those of the light of its planes, which the pictures show.
    colours = build(load_config(folder / "config.yaml")).colours[:, 0].numpy()
    peak = (stack * colours).max()
    for name, image in zip(("shown", "wanted"), images, strict=True):
        assert np.abs(by_name(result)[name] - np.sqrt((image * colours / peak).clip(0, 1))).max() < 2 * LEVEL, name
    moving = shown(viewer, coarse=True, focus=focus)
    assert moving.coarse and [each.name for each in moving.pictures] == ["shown"]
    assert not np.array_equal(by_name(shown(viewer, focus=focus, frame="0"))["shown"], by_name(result)["shown"])


def test_an_observer_sees_what_the_run_has_stored(runs):
    viewer, folder = open_viewer(runs["eye"]), runs["eye"]
    row = json.loads((folder / "summary.json").read_text())["rows"][0]
    first = shown(viewer)
    assert float(first.numbers["SSIM"]) == pytest.approx(np.mean(row["ssim"]), abs=6e-4)
    assert float(first.numbers["contrast of speckle"]) == pytest.approx(np.mean(row["contrast"]), abs=6e-4)
    assert [each.name for each in first.pictures] == ["shown", "beside"]
    assert shown(viewer, coarse=True).coarse and not shown(viewer, coarse=True, source="one").coarse
    # Another light and pupil, by the library's own call.
    settings = load_config(folder / "config.yaml", ["eye.pupil_radius=0.12 mm", "light.sources=[led]"])
    observer = find_kind("eye").build(settings)
    hologram, _ = observer.scene.hologram(settings.seed)
    with torch.no_grad():
        rendering = observer.scene.sampler().render(observer.scene.volume)[0]
        light = equal_power(observer.image(hologram, "led", 2e-3), rendering)
    wavelengths = observer.scene.settings.wavelengths
    colour = gamut_map(linear_srgb(light, srgb_matrix(wavelengths, white_balance(wavelengths)).float()))
    wanted = tone_map(colour, peak=colour.flatten().quantile(0.995)).numpy()
    led = by_name(shown(viewer, source="led", pupil=0.12))["shown"]
    assert np.abs(led - wanted).max() < LEVEL
    assert np.abs(by_name(shown(viewer, source="one", pupil=0.12))["shown"] - wanted).max() > 10 * LEVEL
    assert [each.name for each in shown(viewer, coarse=True, azimuth=40.0).pictures] == ["beside"]
    turned = shown(viewer, azimuth=40.0, source="one")
    assert [each.caption for each in turned.pictures][1] == "Direct volume rendering" and "SSIM" not in turned.numbers


@pytest.mark.parametrize("kind", VIEWERS)
def test_every_position_of_every_control_gives_a_picture_or_a_reason(runs, kind):
    viewer = open_viewer(runs[kind])
    with_reason = 0
    for control in viewer.controls:
        ends = (control.low, control.high) if isinstance(control, Slider) else list(control.options)
        for value in ends:
            try:
                result = shown(viewer, coarse=True, **{control.name: value})
                assert result.pictures and all(np.isfinite(pixels(each)).all() for each in result.pictures)
            except ConfigError as error:
                assert kind == "eye" and "\n" not in str(error)
                with_reason += 1
    assert with_reason <= 2


def test_the_speed_of_each_control_is_printed(runs):
    lines: list[str] = []
    viewer = open_viewer(runs["pec"])
    check(viewer, lines.append)
    assert len(lines) == len(viewer.controls) and all("pictures/s" in line and "transforms" in line for line in lines)


def test_folders_that_cannot_be_viewed_are_refused(runs, tmp_path, capsys):
    def refusal(folder) -> str:
        assert main(["view", str(folder)]) == 2
        text = capsys.readouterr().err
        assert len(text.splitlines()) == 1 and "Traceback" not in text
        return text

    def copy(name: str, *without: str, **changes: str):
        folder = tmp_path / name
        (folder / "arrays").mkdir(parents=True)
        for file in ("config.yaml", "summary.json", "env.json", "arrays/hologram.npy", "arrays/rendering.npy"):
            if file not in without:
                (folder / file).write_bytes((runs["volume"] / file).read_bytes())
        for file, text in changes.items():
            (folder / file.replace("_", ".")).write_text(text)
        return folder

    assert "holds no run" in refusal(tmp_path)
    assert "of kind track" in refusal(copy("a", summary_json='{"experiment": "track", "status": "complete"}'))
    unfinished = copy("b", "summary.json", interrupted_json='{"experiment": "volume", "status": "interrupted"}')
    assert "holotorch resume" in refusal(unfinished)
    (tmp_path / "a" / "env.json").touch()  # as one that was started later
    missing = f"{tmp_path} holds no run: neither summary.json nor interrupted.json is there"
    several = f"give one of the runs in it: {tmp_path / 'a'}, {unfinished}"
    assert refusal(tmp_path) == f"{missing}; {several}; for the latest: holotorch view {tmp_path / 'a'}\n"
    assert "hologram.npy is not in its arrays" in refusal(copy("c", "arrays/hologram.npy"))
    assert "cannot be read" in refusal(copy("d", summary_json="{"))
    foreign = copy("e", "arrays/hologram.npy")
    np.save(foreign / "arrays" / "hologram.npy", np.zeros((3, 16, 16), np.complex64))
    assert "must have the shape" in refusal(foreign)
    assert "describes a volume and summary.json a joint" in refusal(
        copy("f", summary_json='{"experiment": "joint", "status": "complete"}')
    )
    assert main(["view", str(runs["volume"]), "--port", "65536"]) == 2


CONTROLS = [
    Slider("focus", "Depth", "mm", 1.0, 3.0, 0.01, 2.0, ""),
    Choice("colour", "Colours", {"all": "all", "0": "red"}, "all", ""),
]


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"focus": 3.5}, "Depth: expected 1 to 3 mm, got 3.5 mm"),
        ({"focus": float("nan")}, "Depth: expected 1 to 3 mm, got no number"),
        ({"focus": True}, "got no number"),
        ({"focus": "2"}, "got no number"),
        ({"focus": 10**400}, "got no number"),
        ({"colour": "1"}, "Colours: expected one of all, 0, got '1'"),
        ({"colour": ["all"]}, "expected one of all, 0"),
        ({"zoom": 1}, "unknown 'zoom'; this run has focus, colour"),
        ([], "expected the values by the names"),
    ],
)
def test_values_out_of_range_are_refused_in_a_line(values, message):
    with pytest.raises(ValueError, match=r"^[^\n]*$") as error:
        checked(CONTROLS, values)
    assert message in str(error.value)


def test_values_that_are_left_out_stay_and_rounding_is_forgiven():
    assert checked(CONTROLS, {}) == {"focus": 2.0, "colour": "all"}
    assert checked(CONTROLS, {"focus": 3.0000001})["focus"] == 3.0


@pytest.mark.parametrize(("low", "high", "at"), [(0, 2.3, 0.66), (-4, 4, 0.0), (5.3, 12.9, 7.5), (50, 150, 100.0)])
def test_a_slider_has_round_steps_and_a_position_at_the_start(low, high, at):
    slider = span(low, high, at)
    count = (slider["high"] - slider["low"]) / slider["step"]
    assert 199 <= count <= 601 and low - 1e-9 <= slider["low"] <= at <= slider["high"] <= high + 1e-9
    position = (at - slider["low"]) / slider["step"]
    assert position == pytest.approx(round(position), abs=1e-6)
