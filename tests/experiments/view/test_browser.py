"""The page in a real browser: a slider by its keys, a volume by dragging. Skipped without Chromium."""

import asyncio

import numpy as np
import pytest
import torch
from paths import CONFIGS
from tiny_runs import RUNS

from holotorch import Grid
from holotorch.core.complex import intensity
from holotorch.correction.problem import best_scale
from holotorch.experiments.execute import execute
from holotorch.experiments.registry import load_config
from holotorch.experiments.streaming.chromium import CHROMIUM, browser
from holotorch.experiments.view.opening import open_viewer
from holotorch.experiments.view.server import ViewServer
from holotorch.optics import AngularSpectrum

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no chromium, chromium-browser or google-chrome on the path")

WATCH = """window.wrong = [];
addEventListener("error", (event) => wrong.push(String(event.message)));
addEventListener("unhandledrejection", (event) => wrong.push(String(event.reason)));
document.addEventListener("securitypolicyviolation", (event) => wrong.push(event.violatedDirective));
const error = console.error; console.error = (...words) => { wrong.push(words.join(" ")); error(...words); };"""
AT_REST = "view.state.drawn > 0 && view.state.drawn === view.state.asked && !view.state.coarse"
PIXELS = """(() => { const canvas = document.getElementById("picture-shown");
  return [...canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height).data]; })()"""


async def pixels(tab) -> np.ndarray:
    """The picture of the hologram as the page shows it, [3, 32, 32] from 0 to 1."""
    return np.reshape(await tab.value(PIXELS), (32, 32, 4))[..., :3].transpose(2, 0, 1) / 255


def expected(folder, focus: float) -> np.ndarray:
    """The same by a propagation of the stored hologram, in float64 and with much padding."""
    hologram, rendering = (np.load(folder / "arrays" / f"{name}.npy") for name in ("hologram", "rendering"))
    settings = load_config(folder / "config.yaml")
    grid = Grid(settings.hologram.shape, settings.hologram.pitch)
    back = AngularSpectrum(grid, settings.wavelengths, -focus, pad=8, band_limit=False)
    image, wanted = intensity(back(torch.from_numpy(hologram).to(torch.complex128))), torch.from_numpy(rendering)
    return (image * best_scale(image, wanted.double())[:, None, None]).clamp(0, 1).numpy()


def test_the_page_shows_the_depth_of_its_slider_and_turns_the_volume(tiny, tmp_path):
    config, *words = RUNS["volume"]
    one_ray_a_pixel = "hologram={shape: [32, 32], pitch: 3.74 um, distance: 0.6 mm, depths: 2}"
    settings = load_config(CONFIGS / config, [*words, one_ray_a_pixel, "report.seeds=1"])
    assert execute(settings, tmp_path / "run")[1]

    async def press(tab, key: str, code: int) -> None:
        for kind in ("rawKeyDown", "keyUp"):
            await tab.call("Input.dispatchKeyEvent", type=kind, key=key, code=key, windowsVirtualKeyCode=code)

    async def run():
        async with ViewServer(open_viewer(tmp_path / "run")) as server, browser(tmp_path, (1280, 800)) as open_tab:
            tab = await open_tab(server.address, WATCH)
            await tab.until(AT_REST)
            first = await pixels(tab)
            assert np.abs(first - expected(tmp_path / "run", 0.6e-3)).max() < 0.01
            await tab.value("document.getElementById('focus').focus()")
            await press(tab, "End", 35)
            await press(tab, "ArrowLeft", 37)
            await tab.until(f"view.state.asked > 2 && {AT_REST}")
            focus = await tab.value("view.values().focus")
            assert 0.65 < focus < 0.75
            moved = await pixels(tab)
            assert np.abs(moved - expected(tmp_path / "run", 1e-3 * focus)).max() < 0.01
            assert np.abs(moved - first).max() > 0.1
            assert f"{focus:.4g} mm" in await tab.value("document.querySelector('figcaption').textContent")
            # Dragging turns by half a degree a pixel; the last picture is fine again.
            canvas = "document.getElementById('picture-shown')"
            box = await tab.value(f"(({{x, y}}) => [x, y])({canvas}.getBoundingClientRect())")
            for kind, by in (("mousePressed", 0), ("mouseMoved", 30), ("mouseMoved", 60), ("mouseReleased", 60)):
                at = {"x": box[0] + 50 + by, "y": box[1] + 50}
                await tab.call("Input.dispatchMouseEvent", type=kind, button="left", buttons=1, clickCount=1, **at)
            await tab.until(f"view.values().azimuth === 30 && {AT_REST}")
            assert np.abs(await pixels(tab) - moved).max() > 0.1
            await tab.value("document.querySelector('#controls button').click()")
            await tab.until(f"view.values().azimuth === 0 && {AT_REST}")
            assert np.array_equal(await pixels(tab), first)
            inputs = "[...document.querySelectorAll('input, select')]"
            assert await tab.value(f"{inputs}.length === 8 && {inputs}.every((each) => each.labels.length === 1)")
            for width in (1280, 390):
                size = {"width": width, "height": 800, "deviceScaleFactor": 1, "mobile": False}
                await tab.call("Emulation.setDeviceMetricsOverride", **size)
                assert await tab.value("document.documentElement.scrollWidth <= innerWidth"), width
            resources = "performance.getEntriesByType('resource').map((each) => new URL(each.name))"
            assert await tab.value(f"{resources}.every((each) => each.origin === location.origin)")
            assert await tab.value("wrong") == []

    asyncio.run(asyncio.wait_for(run(), 60))
