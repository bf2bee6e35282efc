"""Screenshots of the pages of `stream --view` and `view`: python scripts/screenshots.py [HEAD.nrrd]; needs Chromium.

Frame and poses are synthetic. HEAD is a CT or MRI volume of a head (here that of the Visible Human, as published in the
thesis's list of volumes); without one the slice shows the Marschner-Lobb signal.
"""

import asyncio
import base64
import io
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import torch
from PIL import Image

from holotorch.experiments.execute import execute
from holotorch.experiments.registry import load_config
from holotorch.experiments.streaming.aligning import Aligner
from holotorch.experiments.streaming.chromium import Tab, browser
from holotorch.experiments.streaming.page import PageServer
from holotorch.experiments.streaming.pictures import PanelSource
from holotorch.experiments.streaming.registered import RegisteredVolume, register
from holotorch.experiments.view.opening import open_viewer
from holotorch.experiments.view.server import ViewServer
from holotorch.io.bundled import find_config
from holotorch.io.volumes import load_volume
from holotorch.scene.phantoms import marschner_lobb
from holotorch.scene.volume import Volume
from holotorch.tracking import THESIS, CatheterTracker, ChannelOrder
from holotorch.tracking.pose.status import Pose, Status
from holotorch.tracking.simulation.world import World
from holotorch.tracking.streaming.packet import now

ROOT = Path(__file__).parents[1]
SIZE = 800, 600


def registered(path: Path | None, tip: torch.Tensor) -> RegisteredVolume:
    """A volume of 0.2 m around the tip; heads are shown upright."""
    volume = marschner_lobb(96) if path is None else load_volume(path)
    step = 0.2 / max(volume.extent)
    z, y, x = (each * step for each in volume.spacing)
    volume = Volume(volume.values, (z, y, x), "m")
    place = torch.eye(4, dtype=torch.float64)
    place[:3, :3] = torch.tensor([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])  # slices lie level
    middle = torch.tensor([x, y, z], dtype=torch.float64) * torch.tensor(volume.shape).flip(0) / 2
    place[:3, 3] = tip - place[:3, :3] @ middle
    return register(volume, place)


async def taken(folder: Path, head: Path | None) -> list[bytes]:
    """The six screenshots."""
    world, pictures = World(), []
    case = world.still(depth=0.52, tilt=0.35, count=1)[0]
    frame = torch.as_tensor(case.frame())
    camera = replace(world.camera, size=tuple(frame.shape[-2:]))
    pose = CatheterTracker(camera, THESIS, channels=ChannelOrder.RGB)(frame[None])[0]
    wide = replace(pose, covariance=torch.eye(6, dtype=torch.float64) * 1.5e-3**2)
    refused = Pose.refused(Status.NO_CATHETER, "no bands are seen")
    volume = registered(head, pose.tip)
    script = (ROOT / "tests" / "emulated_headset.js").read_text()

    async def take(tab: Tab, server: PageServer, *clicks: str, given: Pose = pose, wait: str = "true") -> None:
        for name in clicks:
            await tab.value(f"document.getElementById('{name}').click()")
        for _ in range(10):
            server.send(given, now() + 0.1)
            server.see(frame, given, now())
            await asyncio.sleep(0.1)
        await tab.until(wait)
        shot = await tab.call("Page.captureScreenshot")
        pictures.append(base64.b64decode(shot["data"]))

    async with browser(folder, SIZE) as open_tab:
        aligner = Aligner(folder / "headset.yaml")
        panel = PanelSource("pattern")
        async with PageServer(THESIS, camera, port=0, panel=panel, volume=volume, aligner=aligner) as server:
            tab = await open_tab(server.address, script)
            await tab.until("view.state.setup !== null && view.state.offset !== null")
            await take(tab, server, "panel", wait="view.pictures.pictures.camera && view.pictures.pictures.panel")
            await take(tab, server, "panel", "space", "slice", "slice", given=wide)
            await take(tab, server, "slice", "slice", "slice", "camera", given=refused)
            await take(tab, server, "align", "headset", given=wide, wait="view.state.headset === 'immersive-vr'")
        async with PageServer(THESIS, frame="headset_from_tool", port=0, volume=volume) as server:
            tab = await open_tab(server.address, script)
            await tab.until("!document.getElementById('headset').disabled && view.state.offset !== null")
            await take(tab, server, "slice", "slice", "slice", given=wide)
            await take(tab, server, "headset", given=wide, wait="view.state.headset === 'immersive-vr'")
    return pictures


async def taken_of_run(folder: Path) -> bytes:
    """The page of the demo's volume, refocused to its front half and turned."""
    config = find_config("configs/demo_volume.yaml")
    assert config is not None
    run, _ = execute(load_config(config, ["report.seeds=1"]), folder / "run")
    async with ViewServer(open_viewer(run)) as server, browser(folder, (1280, 820)) as open_tab:
        tab = await open_tab(server.address)
        await tab.until("view.state.drawn > 0")
        await tab.value("view.set('azimuth', 40); view.set('focus', 8); view.set('radius', 2)")
        await tab.until("view.state.drawn === view.state.asked && !view.state.coarse")
        shot = await tab.call("Page.captureScreenshot")
    return base64.b64decode(shot["data"])


def small(picture: Image.Image, name: str) -> None:
    """Write a picture of two thirds the size into the gallery."""
    size = picture.width * 2 // 3, picture.height * 2 // 3
    picture.resize(size, Image.Resampling.LANCZOS).save(ROOT / "scripts" / "gallery" / name)


def main(head: Path | None) -> None:
    """Write view.png and view_run.png to scripts/gallery."""
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        shots = asyncio.run(taken(Path(folder), head))
    pictures = [Image.open(io.BytesIO(shot)).convert("RGB") for shot in shots]
    sheet = Image.new("RGB", (3 * SIZE[0] + 16, 2 * SIZE[1] + 8), "white")
    for i, picture in enumerate(pictures):
        sheet.paste(picture, (i % 3 * (SIZE[0] + 8), i // 3 * (SIZE[1] + 8)))
    small(sheet, "view.png")
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        small(Image.open(io.BytesIO(asyncio.run(taken_of_run(Path(folder))))).convert("RGB"), "view_run.png")


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else None)
