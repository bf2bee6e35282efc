"""The page in a real browser: where the tip appears, refusals, and connections that break. Skipped without Chromium."""

import asyncio
import csv
import math
import threading
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from oracles import boards as oracle
from scipy.ndimage import map_coordinates

from holotorch.experiments.streaming import page as module
from holotorch.experiments.streaming.aligning import Aligner
from holotorch.experiments.streaming.chromium import CHROMIUM, BrowserError, browser
from holotorch.experiments.streaming.opening import open_page
from holotorch.experiments.streaming.page import PageServer
from holotorch.experiments.streaming.pictures import PanelSource
from holotorch.experiments.streaming.registered import register
from holotorch.experiments.streaming.stream import stream
from holotorch.experiments.tracking.devices import build_headset, load_headset, save_camera
from holotorch.experiments.tracking.report import COLUMNS, Tracked, row
from holotorch.io.video import Frame
from holotorch.scene.volume import Volume
from holotorch.tracking import THESIS, Camera
from holotorch.tracking.pose.status import Pose, Status
from holotorch.tracking.streaming.packet import now

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no chromium, chromium-browser or google-chrome on the path")

MATRIX = torch.tensor([[800.0, 0, 310.0], [0, 780, 250.0], [0, 0, 1]], dtype=torch.float64)
CAMERA = Camera(MATRIX, torch.zeros(5, dtype=torch.float64), "srgb", (480, 640))
YELLOW = "data[4 * i] > data[4 * i + 2] + 30 && data[4 * i + 1] > data[4 * i + 2] + 15"
# Middle in pixels of the picture of all pixels of the uncertainty's colour, and how many they are.
SPOT = """(() => {
  const canvas = document.getElementById("canvas"), gl = canvas.getContext("webgl2");
  const [width, height] = [canvas.width, canvas.height], data = new Uint8Array(4 * width * height);
  gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, data);
  let [count, x, y] = [0, 0, 0];
  for (let i = 0; i < width * height; i++)
    if (YELLOW) {
      count += 1; x += i % width; y += height - 1 - Math.floor(i / width);
    }
  return [x / count, y / count, count];
})()""".replace("YELLOW", YELLOW)


def pose(i: int, sd: float = 1.5e-3) -> Pose:
    turn = 2 * math.pi * i / 200
    tip = torch.tensor([0.1 * math.cos(turn), 0.07 * math.sin(turn), 0.45 + 0.15 * math.sin(3 * turn)]).double()
    direction = torch.tensor([0.8 * math.cos(2 * turn), 0.8 * math.sin(2 * turn), 0.6]).double()
    zero = torch.zeros((), dtype=torch.float64)
    return Pose(tip, direction, torch.eye(6, dtype=torch.float64) * sd**2, zero, zero, Status.OK)


def run(test, camera: Camera | None = CAMERA, **options):
    async def all_of_it():
        async with PageServer(THESIS, camera, port=0, **options) as server:
            await asyncio.wait_for(test(server), 120)

    asyncio.run(all_of_it())


async def shown(server, tab, given: Pose, ahead: float = 60.0) -> None:
    """Send a pose, which fades ``ahead`` seconds later than usual, and wait until the tab has drawn it."""
    await tab.call("Page.bringToFront")  # a tab in the background draws nothing
    number = server.send(given, now() + ahead)
    two_frames = "requestAnimationFrame(() => requestAnimationFrame(() => done(1)))"
    arrived = f"view.state.sequence === {number} ? {two_frames} : setTimeout(wait, 2)"
    await tab.value(f"new Promise((done) => {{ const wait = () => {{ {arrived}; }}; wait(); }})")


def test_the_tip_appears_where_the_camera_sees_it(tmp_path):
    """50 poses by what the page computes, and every fifth by the pixels that it draws; 640 x 480 px fill 800 x 600."""

    async def test(server):
        async with browser(tmp_path) as open_tab:
            tab = await open_tab(server.address)
            await tab.until("view.state.setup !== null && view.state.offset !== null")
            worst = by_pixels = 0.0
            for i in range(0, 200, 4):
                given = pose(i)
                await shown(server, tab, given)
                x, y = CAMERA.project(given.tip).tolist()
                u, v = await tab.value("view.tipOnScreen()")
                worst = max(worst, math.hypot(u - x, v - y))
                if i % 20 == 0:
                    u, v, count = await tab.value(SPOT)
                    assert count > 20
                    scale = 800 / 640
                    middle = ((u + 0.5) / scale - 0.5, (v + 0.5) / scale - 0.5)
                    by_pixels = max(by_pixels, math.dist(middle, (x, y)))
            assert worst < 1e-3 and by_pixels < 1, by_pixels
            assert await tab.value("view.state.lost") == 0 == await tab.value("view.state.malformed")

    run(test)


def test_a_replayed_run_is_drawn_where_its_poses_are(tmp_path):
    """From poses.csv through `stream --view --replay` to the screen: 200 frames, each as it was drawn."""
    save_camera(tmp_path / "camera.yaml", CAMERA, CAMERA.size)
    given = [pose(i) for i in range(200)]
    with open(tmp_path / "poses.csv", "w", newline="") as file:
        table = csv.writer(file)
        table.writerow(COLUMNS)
        for i, each in enumerate(given):
            frame = Frame(i / 20, torch.zeros(3, 1, 1, dtype=torch.uint8))
            table.writerow(row(Tracked(i, frame, each, 0.0, {})))
    server = open_page(str(tmp_path / "poses.csv"))
    server.port = 0
    seen: dict[int, list[float]] = {}
    record = """window.drawn = {}; const note = () => { const at = window.view && view.tipOnScreen();
      if (at) drawn[view.state.sequence] = at; requestAnimationFrame(note); }; requestAnimationFrame(note);"""

    async def watch():
        async with browser(tmp_path) as open_tab:
            while server.port == 0:
                await asyncio.sleep(0.02)
            tab = await open_tab(server.address, record)
            await tab.until("Object.keys(drawn).length >= 200", 60)
            seen.update({int(key): value for key, value in (await tab.value("drawn")).items()})

    def watching():
        try:
            asyncio.run(asyncio.wait_for(watch(), 90))
        finally:
            over.set()

    over, send = threading.Event(), server.send

    def until_seen(*words, **names) -> int:
        if over.is_set():
            raise KeyboardInterrupt  # as a user ends a replay
        return send(*words, **names)

    server.send = until_seen
    watcher = threading.Thread(target=watching, daemon=True)
    watcher.start()
    streamed = stream([str(tmp_path / "poses.csv")], page=server, repeat=True, rate=40, show=lambda line: None)
    watcher.join(30)
    assert streamed.frames >= 200 and len(seen) >= 200
    for number, (u, v) in seen.items():
        x, y = CAMERA.project(given[number % 200].tip).tolist()
        assert math.hypot(u - x, v - y) < 1e-3, number


def test_a_refusal_is_said_and_an_old_pose_fades_and_goes(tmp_path):
    async def test(server):
        async with browser(tmp_path) as open_tab:
            tab = await open_tab(server.address)
            await tab.until("view.state.setup !== null && view.state.offset !== null")
            await shown(server, tab, pose(0), ahead=2)
            assert await tab.value("view.state.drawn && view.state.alpha > 0.5")
            server.send(Pose.refused(Status.NO_CATHETER, "<b>nothing</b> has its colours"), now())
            words = 'document.getElementById("reason").textContent'
            await tab.until(f"{words} === 'NO_CATHETER: <b>nothing</b> has its colours'")
            await tab.until("!view.state.drawn && view.tipOnScreen() === null")  # no pose is shown beyond a second
            await shown(server, tab, pose(3), ahead=2)
            assert await tab.value("view.state.drawn")
            await tab.until(f"{words} === 'the newest pose is old'")

    run(test)


def test_two_pages_lost_messages_and_a_server_that_dies(tmp_path, monkeypatch):
    offer, count = module._Client.offer, [0]

    def lossy(self, text):
        count[0] += 1
        if count[0] % 5:
            offer(self, text)

    async def test(server):
        async with browser(tmp_path) as open_tab:
            tabs = [await open_tab(server.address) for _ in range(2)]
            for tab in tabs:
                await tab.until("view.state.setup !== null && view.state.offset !== null")
            for i in range(3):
                for tab in tabs:
                    await shown(server, tab, pose(i))
            monkeypatch.setattr(module._Client, "offer", lossy)
            for i in range(100):
                server.send(pose(i), now())
                await asyncio.sleep(0.01)
            monkeypatch.setattr(module._Client, "offer", offer)
            for tab in tabs:
                await shown(server, tab, pose(7))
                received, lost = await tab.value("[view.state.received, view.state.lost]")
                assert received + lost >= 100 and 10 <= lost <= 60, (received, lost)
                x, y = CAMERA.project(pose(7).tip).tolist()
                found = await tab.value("view.tipOnScreen()")
                assert math.dist(found, (x, y)) < 1e-3
            with monkeypatch.context() as patch:
                patch.setattr(module, "_ENDED", b"")  # as a server that dies
                await server.__aexit__()
            words = 'document.getElementById("reason").textContent'
            for tab in tabs:
                await tab.until(f"!view.state.connected && {words}.startsWith('no connection')")
            async with PageServer(THESIS, CAMERA, port=server.port) as other:
                for tab in tabs:
                    await tab.until("view.state.connected && view.state.offset !== null")
                    await shown(other, tab, pose(9))
                    assert await tab.value("view.state.drawn")
            for tab in tabs:
                await tab.until(f"!view.state.connected && {words} === 'the stream has ended'")
            await asyncio.sleep(1.5)  # it tries again, in vain
            assert await tabs[0].value(words) == "the stream has ended"

    run(test)


def test_prediction_follows_a_steady_motion_to_now_and_stops_at_its_limit(tmp_path):
    """Poses that are 40 ms late at 200 mm/s: 8 mm behind without prediction."""
    speed, late = torch.tensor([0.2, 0.0, 0.0], dtype=torch.float64), 0.04

    def at(time: float) -> Pose:
        given = pose(0)
        return replace(given, tip=torch.tensor([-0.2, 0.0, 0.5]).double() + speed * time)

    async def test(server):
        async with browser(tmp_path) as open_tab:
            tab = await open_tab(server.address)
            await tab.until("view.state.setup !== null && view.state.roundTrip < 0.003")
            begin = captured = now()
            errors: dict[bool, list[float]] = {False: [], True: []}
            for turn in range(60):
                captured = now() - late
                number = server.send(at(captured - begin), captured)
                if turn == 30:
                    await tab.value("document.getElementById('predict').click()")
                await tab.until(f"view.state.sequence === {number}")
                predict, tip, time = await tab.value(
                    "[view.state.predict, view.current().tip, view.now() + view.state.offset]"
                )
                if turn > 2:
                    errors[predict].append(abs(tip[0] - float(at(time - begin).tip[0])))
            behind, ahead = (sorted(errors[each])[len(errors[each]) // 2] for each in (False, True))
            assert behind > 7.5e-3 and ahead < 1e-3, (behind, ahead)
            newest, tip = at(captured - begin).tip, None
            await asyncio.sleep(0.3)
            tip = await tab.value("view.current().tip")
            assert 0.015 < tip[0] - float(newest[0]) < 0.021  # a tenth of a second at 200 mm/s, and no farther
            server.send(Pose.refused(Status.NO_CATHETER, "gone"), now())
            await tab.until("view.state.refused && view.state.earlier === null")
            assert await tab.value("view.current().tip[0]") == pytest.approx(float(newest[0]))

    run(test)


HEADSET = (Path(__file__).parents[2] / "emulated_headset.js").read_text()
EYES = """(() => {
  const canvas = document.getElementById("canvas"), gl = canvas.getContext("webgl2");
  const [width, height] = [canvas.width, canvas.height], data = new Uint8Array(4 * width * height);
  gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, data);
  const sums = [[0, 0, 0], [0, 0, 0]];
  for (let i = 0; i < width * height; i++)
    if (YELLOW) {
      const x = i % width, sum = sums[Number(x >= width / 2)];
      sum[0] += 1; sum[1] += x + 0.5; sum[2] += Math.floor(i / width) + 0.5;
    }
  return sums.map(([count, x, y]) => [count, x / count, y / count]);
})()""".replace("YELLOW", YELLOW)


def in_eye(tip, x: float, width: int, height: int) -> tuple[float, float]:
    """Pixels from the left and the bottom of a point (x right, y down, z forward) in the eye at x of ``HEADSET``."""
    right, up, back = tip[0] - x, -tip[1] - 0.02, -tip[2] - 0.05
    c, s = math.cos(0.1), math.sin(0.1)
    right, back = c * right + s * back, -s * right + c * back
    u, v = (1.1 * right + math.copysign(0.05, x) * back) / -back, 1.3 * up / -back
    return (u + 1) / 2 * width / 2 + (width / 2 if x > 0 else 0), (v + 1) / 2 * height


async def immersed(open_tab, server):
    """A tab in which the session of the emulated headset has started."""
    tab = await open_tab(server.address, HEADSET)
    await tab.until("view.state.offset !== null && !document.getElementById('headset').disabled")
    await tab.value("document.getElementById('headset').click()")
    await tab.until("view.state.headset === 'immersive-vr'")
    assert await tab.value("asked") == ["immersive-vr", "viewer"]
    return tab


def test_both_eyes_of_a_headset_see_the_tip_where_it_is(tmp_path):
    """An emulated headset: the session starts, both eyes are drawn with their own matrices, and it ends."""

    async def test(server):
        async with browser(tmp_path) as open_tab:
            tab = await immersed(open_tab, server)
            for i in (0, 30, 77, 140):
                given = pose(i, 4e-3)
                await shown(server, tab, given)
                width, height = await tab.value(
                    "[document.getElementById('canvas').width, document.getElementById('canvas').height]"
                )
                for x, (count, u, v) in zip((-0.03, 0.03), await tab.value(EYES), strict=True):
                    assert count > 30
                    assert math.dist((u, v), in_eye(given.tip.tolist(), x, width, height)) < 1.5
            await tab.value("document.getElementById('headset').click()")
            await tab.until("view.state.headset === ''")
            await shown(server, tab, pose(3))  # the page draws its own picture again
            assert await tab.value("view.state.drawn && view.state.error === ''")

    run(test, camera=None, frame="headset_from_tool")


FRAMES = "new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(() => done(1))))"
FLIP = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64))


def rigid(turn, shift) -> torch.Tensor:
    matrix = torch.eye(4, dtype=torch.float64)
    matrix[:3, :3], matrix[:3, 3] = torch.tensor(oracle.rotation(turn)), torch.tensor(shift, dtype=torch.float64)
    return matrix


def carried(tip, direction, new_tip, new_direction) -> torch.Tensor:
    """A rigid motion that takes a place and a direction to others."""
    matrix = torch.eye(4, dtype=torch.float64)
    axis = torch.linalg.cross(direction, new_direction)
    sine, cosine = float(axis.norm()), float(direction @ new_direction)
    if sine > 1e-9:
        matrix[:3, :3] = torch.tensor(oracle.rotation((axis / sine * math.atan2(sine, cosine)).tolist()))
    matrix[:3, 3] = new_tip - matrix[:3, :3] @ tip
    return matrix


def test_alignment_by_a_controller_puts_the_catheter_where_it_is(tmp_path):
    """The virtual catheter is dragged onto the seen one six times; then both eyes see it where the fit says."""
    truth = rigid((0.2, -0.3, 0.1), (0.02, -0.05, 0.04))
    aligner, generator = Aligner(tmp_path / "headset.yaml"), torch.Generator().manual_seed(0)

    def seen(i: int) -> Pose:  # in the camera's frame
        inverse = torch.linalg.inv(truth)
        place = torch.tensor([0.03 * math.cos(i), 0.03 * math.sin(2 * i), 0.45 + 0.02 * i], dtype=torch.float64)
        turn, slant = math.pi * i / 3 + 0.2, 0.4 * (-1) ** i
        along = torch.tensor([math.cos(turn), math.sin(turn), slant], dtype=torch.float64)
        tip, direction = inverse[:3, :3] @ place + inverse[:3, 3], inverse[:3, :3] @ along / along.norm()
        return replace(pose(0, 2e-3), tip=tip, direction=direction)

    async def drag(tab, change: torch.Tensor) -> None:
        start = rigid((0.1, 0.2 + float(torch.rand((), generator=generator)), 0.3), (0.1, -0.2, 0.3))
        for event, place in (("selectstart", start), ("selectend", change @ start)):
            matrix = (FLIP @ place @ FLIP).mT.flatten().tolist()
            await tab.value(f"hand.gripSpace.matrix = {matrix}; hand.targetRaySpace.matrix = {matrix}; {FRAMES}")
            await tab.value(FRAMES)
            await tab.value(f"press('{event}')")
            await tab.value(FRAMES)

    async def test(server):
        async with browser(tmp_path) as open_tab:
            tab = await immersed(open_tab, server)
            await tab.value("document.getElementById('align').click()")
            answer: dict = {}
            for i in range(6):
                given = seen(i)
                await shown(server, tab, aligner(given))
                target = truth[:3, :3] @ given.tip + truth[:3, 3], truth[:3, :3] @ given.direction
                first = await tab.value("[view.state.twin.tip, view.state.twin.direction]")
                tip, direction = (torch.tensor(each, dtype=torch.float64) for each in first)
                await drag(tab, carried(tip, direction, *target))
                after = await tab.value("[view.state.twin.tip, view.state.twin.direction]")
                for now_, wanted in zip(after, target, strict=True):
                    assert math.dist(now_, wanted.tolist()) < 1e-6
                for _ in range(20):  # a squeeze, at last a short pinch at one place; a slow computer may miss its time
                    server.send(aligner(given), now())
                    if i < 5:
                        await tab.value("press('squeeze')")
                    else:
                        await tab.value(f"press('selectstart'); {FRAMES}")
                        await tab.value("press('selectend')")
                    with suppress(BrowserError):
                        await tab.until(f"view.state.alignment && view.state.alignment.count === {i + 1}", 2.0)
                        break
                answer = await tab.until(
                    f"view.state.alignment && view.state.alignment.count === {i + 1} && view.state.alignment"
                )
                assert not answer["error"], answer["error"]
            assert answer["solved"] and answer["rms"] < 1e-6
            await tab.value("document.getElementById('save').click()")
            saved = await tab.until("view.state.alignment.saved")
            assert saved == str(aligner.out)
            matrix = build_headset(load_headset(aligner.out))
            torch.testing.assert_close(matrix, truth, rtol=0, atol=1e-6)
            await tab.value("document.getElementById('align').click()")
            given = seen(2)
            await shown(server, tab, aligner(given))
            assert await tab.value("view.state.setup.frame") == "headset_from_tool"
            place = truth[:3, :3] @ given.tip + truth[:3, 3]
            width, height = await tab.value(
                "[document.getElementById('canvas').width, document.getElementById('canvas').height]"
            )
            for x, (count, u, v) in zip((-0.03, 0.03), await tab.value(EYES), strict=True):
                assert count > 15
                assert math.dist((u, v), in_eye(place.tolist(), x, width, height)) < 1.5
            await tab.value("document.getElementById('headset').click()")
            await tab.until("view.state.headset === '' && view.state.error === ''")

    run(test, camera=CAMERA, aligner=aligner)


def test_a_mouse_moves_and_turns_the_virtual_catheter(tmp_path):
    """In the camera's picture: a drag by pixels moves its image by them, and with shift it turns about its tip."""

    async def test(server):
        async with browser(tmp_path) as open_tab:
            tab = await open_tab(server.address)
            await tab.until("view.state.offset !== null && !document.getElementById('align').hidden")
            await shown(server, tab, pose(0))
            await tab.value("document.getElementById('align').click()")
            before = await tab.value("[view.onScreen(view.state.twin.tip), view.state.twin.direction]")

            async def drag(modifiers: int) -> None:
                for kind, x, y in (("mousePressed", 300, 300), ("mouseMoved", 340, 280), ("mouseReleased", 340, 280)):
                    await tab.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", buttons=1,
                                   modifiers=modifiers, clickCount=1)  # fmt: skip

            await drag(0)
            moved = await tab.value("[view.onScreen(view.state.twin.tip), view.state.twin.direction]")
            ratio = 800 / 640  # pixels of the window for one of the camera
            assert moved[0] == pytest.approx([before[0][0] + 40 / ratio, before[0][1] - 20 / ratio], abs=0.05)
            assert moved[1] == before[1]
            await drag(8)  # shift
            turned = await tab.value("[view.onScreen(view.state.twin.tip), view.state.twin.direction]")
            assert turned[0] == pytest.approx(moved[0]) and math.dist(turned[1], moved[1]) > 0.05
            assert math.hypot(*turned[1]) == pytest.approx(1)

    run(test, aligner=Aligner(tmp_path / "headset.yaml"))


def test_a_slice_shows_the_volume_at_its_place(tmp_path):
    """Grey levels of an oblique volume against SciPy's interpolation at the points of the slice, in three planes."""
    shape, spacing, origin = (20, 24, 28), (4e-3, 5e-3, 6e-3), (-0.03, 0.01, 0.02)
    z, y, x = np.meshgrid(*(np.arange(n) / n for n in shape), indexing="ij")
    values = 500 * np.sin(2 * np.pi * x) + 400 * np.cos(3 * y + z) - 300 * z
    axes = np.array(oracle.rotation((0.2, 0.1, -0.3)))  # rows: directions of z, y, x in coordinates (z, y, x)
    a, b, c = ((row[0], row[1], row[2]) for row in axes.tolist())
    volume = Volume(torch.tensor(values, dtype=torch.float32), spacing, "m", origin, (a, b, c))
    corner = np.array(origin) + axes.T @ (np.array(spacing) * np.array(shape) / 2)  # near the middle, (z, y, x)
    middle = torch.tensor([0.0, 0.01, 0.5], dtype=torch.float64)
    frame_from_volume = rigid((0.1, 0.25, 0.05), (0, 0, 0))
    frame_from_volume[:3, 3] = middle - frame_from_volume[:3, :3] @ torch.tensor(corner[::-1].copy())
    level, window = 50.0, 1200.0
    given = replace(pose(0, 1e-4), tip=middle, direction=torch.tensor([0.0, -0.6, 0.8], dtype=torch.float64))

    def grey(point: np.ndarray) -> float:
        inside = np.linalg.inv(frame_from_volume.numpy()) @ np.append(point, 1.0)
        index = axes @ (inside[:3][::-1] - np.array(origin)) / np.array(spacing)
        value = map_coordinates(values, index[:, None], order=1, mode="nearest")[0]
        return float(np.clip((value - level + window / 2) / window, 0, 1))

    async def test(server):
        async with browser(tmp_path) as open_tab:
            tab = await open_tab(server.address)
            await tab.until("view.state.offset !== null && !document.getElementById('slices').hidden")
            await asyncio.sleep(0.3)  # the samples arrive
            for rows in ((2, 1), (2, 0), (1, 0)):  # axial, coronal, sagittal: which axes of the volume span the slice
                await tab.value("document.getElementById('slice').click()")
                await shown(server, tab, given)
                across, down = (frame_from_volume[:3, :3].numpy() @ axes[row][::-1] for row in rows)
                compared = 0
                for angle in np.arange(0, 2 * np.pi, np.pi / 8):
                    point = middle.numpy() + 0.03 * (np.cos(angle) * across + np.sin(angle) * down)
                    u, v = CAMERA.project(torch.tensor(point)).tolist()
                    shaft = [CAMERA.project(given.tip + s * given.direction).tolist() for s in np.linspace(0, 0.2, 100)]
                    if min(math.dist((u, v), place) for place in shaft) < 8:
                        continue  # the catheter is drawn there
                    place = [(u + 0.5) * 800 / 640, 600 - (v + 0.5) * 800 / 640]
                    red, green, blue = await tab.value(PIXEL % tuple(place))
                    expected = 255 * (0.9 * grey(point) + 0.1 * np.array([0.13, 0.15, 0.18]))
                    assert np.abs(np.array([red, green, blue]) - expected).max() < 4, (rows, angle)
                    compared += 1
                assert compared > 8

    run(test, volume=register(volume, frame_from_volume, level, window))


PIXEL = """(() => {
  const gl = document.getElementById("canvas").getContext("webgl2"), data = new Uint8Array(4);
  gl.readPixels(Math.floor(%f), Math.floor(%f), 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, data);
  return [...data].slice(0, 3);
})()"""


def test_the_tracked_frame_lies_behind_the_catheter_without_its_distortion(tmp_path):
    camera = Camera(MATRIX, torch.tensor([-0.25, 0.08, 0.001, -0.002, 0.0]).double(), "srgb", (480, 640))
    given = replace(pose(20), tip=torch.tensor([0.14, 0.09, 0.5], dtype=torch.float64))
    x, y = camera.project(given.tip).tolist()  # where a distorted frame shows the tip
    columns, rows = torch.arange(640)[None], torch.arange(480)[:, None]
    frame = ((columns - x).square() + (rows - y).square() < 64).to(torch.uint8).mul(255).expand(3, 480, 640)

    async def test(server):
        async with browser(tmp_path) as open_tab:
            tab = await open_tab(server.address)
            await tab.until("view.state.offset !== null")
            server.see(frame, Pose.refused(Status.NO_CATHETER, "none"), now() + 60)
            await tab.until("view.pictures.pictures.camera")
            await tab.value(FRAMES)
            u, v, count = await tab.value(SPOT.replace(YELLOW, "data[4 * i] > 128"))
            pinhole = Camera(MATRIX, torch.zeros(5, dtype=torch.float64)).project(given.tip).tolist()
            scale = 800 / 640
            assert count > 100 and math.dist(((u + 0.5) / scale - 0.5, (v + 0.5) / scale - 0.5), pinhole) < 0.6
            assert math.dist((x, y), pinhole) > 5
            server.see(frame, given, now() + 61)
            await tab.until("view.state.pictured?.answered")
            assert await tab.value("view.tipOnScreen()") == pytest.approx(pinhole, abs=1e-3)

    run(test, camera=camera)


def test_behind_the_catheter_is_the_picture_in_which_it_was_found(tmp_path):
    """However much later than the newest pose the picture comes; and the words are of the same frame."""
    given, black = [pose(i) for i in (0, 40)], torch.zeros(3, 480, 640, dtype=torch.uint8)
    first, second = (CAMERA.project(each.tip).tolist() for each in given)
    refused, words = Pose.refused(Status.NO_CATHETER, "none"), 'document.getElementById("reason").textContent'

    async def test(server):
        async with browser(tmp_path) as open_tab:
            tab = await open_tab(server.address)
            await tab.until("view.state.offset !== null")
            start = now() + 60  # so that nothing becomes too old

            async def tip_with(frame: int) -> list[float]:
                captured = ("view.pictures.pictures.camera?.captured", "view.state.pictured?.captured")
                await tab.until(" && ".join(f"{each} === {start + frame}" for each in captured))
                return await tab.value("view.tipOnScreen()")

            server.see(black, given[0], start)
            await shown(server, tab, given[1])
            assert await tip_with(0) == pytest.approx(first, abs=1e-3)
            server.see(black, given[1], start + 1)
            server.send(refused, start + 2)
            assert await tip_with(1) == pytest.approx(second, abs=1e-3)
            await tab.until(f"!view.state.refused && {words} === ''")
            server.see(black, refused, start + 2)
            assert await tip_with(2) is None  # a second after the last answer
            await tab.until(f"{words} === 'NO_CATHETER: none'")
            server.see(black, given[0], start + 3)
            assert await tip_with(3) == pytest.approx(first, abs=1e-3)
            assert await tab.value("view.state.malformed") == 0

    run(test)


def test_a_panel_shows_a_video_in_time_where_the_user_puts_it(tmp_path):
    """The test pattern, 1080p at 30 frames per second: grey steps at their places, and the time to the frame."""

    async def test(server):
        async with browser(tmp_path) as open_tab:
            tab = await open_tab(server.address)
            await tab.until("view.state.offset !== null && !document.getElementById('panel').hidden")
            await shown(server, tab, pose(0))
            await tab.value("document.getElementById('panel').click()")
            await tab.until("view.pictures.pictures.panel && view.pictures.pictures.panel.count > 3")
            delays = []
            for _ in range(40):
                delays.append(await tab.value("view.pictures.pictures.panel.latency"))
                await asyncio.sleep(0.03)
            assert 0 < sorted(delays)[20] < 5  # in seconds; how late it is depends on the computer

            async def steps() -> list[float]:
                left, top, width = await tab.value("Object.values(view.pictures.onScreen)")
                places = [
                    (800 * (left + width * (i + 0.5) / 16), 600 - 600 * top - 0.4 * 800 * width * 9 / 16)
                    for i in range(16)
                ]
                return [(await tab.value(PIXEL % place))[0] for place in places]

            async def in_place() -> None:
                """Wait until the steps are where the page says that the panel is, but for the bar over two of them."""
                while sum(abs(value - 15 - 15 * i) < 4 for i, value in enumerate(await steps())) < 14:
                    await asyncio.sleep(0.05)

            await asyncio.wait_for(in_place(), 20)
            left, top, _ = await tab.value("Object.values(view.pictures.onScreen)")
            x, y = 800 * left + 60, 600 * top + 40
            for kind, dx, dy in (("mousePressed", 0, 0), ("mouseMoved", -200, 150), ("mouseReleased", -200, 150)):
                await tab.call(
                    "Input.dispatchMouseEvent", type=kind, x=x + dx, y=y + dy, button="left", buttons=1, clickCount=1
                )
            moved = await tab.value("Object.values(view.pictures.onScreen)")
            assert moved[:2] == pytest.approx([left - 0.25, top + 0.25], abs=1e-3)
            await tab.call("Input.dispatchMouseEvent", type="mouseWheel", x=x - 200, y=y + 150, deltaX=0, deltaY=-200)
            await tab.until(f"view.pictures.onScreen.width > {moved[2]}")
            await tab.value(FRAMES)
            await asyncio.wait_for(in_place(), 20)
            assert await tab.value("view.state.malformed") == 0

    run(test, panel=PanelSource("pattern"))


def test_the_page_says_what_a_headset_needs(tmp_path):
    async def test(server):
        async with browser(tmp_path) as open_tab:
            tab = await open_tab(server.address, HEADSET)
            title = await tab.until("document.getElementById('headset').title")
            assert "stream with --headset FILE" in title
            assert await tab.value("document.getElementById('headset').disabled")

    run(test)
