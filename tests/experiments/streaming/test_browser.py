"""The page in a real browser: where the tip appears, refusals, and connections that break. Skipped without Chromium."""

import asyncio
import math
from dataclasses import replace

import pytest
import torch
from browser import CHROMIUM, browser

from holotorch.experiments.streaming import page as module
from holotorch.experiments.streaming.page import PageServer
from holotorch.tracking import THESIS, Camera
from holotorch.tracking.pose.status import Pose, Status
from holotorch.tracking.streaming.packet import now

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no chromium, chromium-browser or google-chrome on the path")

MATRIX = torch.tensor([[800.0, 0, 310.0], [0, 780, 250.0], [0, 0, 1]], dtype=torch.float64)
CAMERA = Camera(MATRIX, torch.zeros(5, dtype=torch.float64), "srgb", (480, 640))
# Middle in pixels of the picture of all pixels of the uncertainty's colour, and how many they are.
SPOT = """(() => {
  const canvas = document.getElementById("canvas"), gl = canvas.getContext("webgl2");
  const [width, height] = [canvas.width, canvas.height], data = new Uint8Array(4 * width * height);
  gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, data);
  let [count, x, y] = [0, 0, 0];
  for (let i = 0; i < width * height; i++)
    if (data[4 * i] > data[4 * i + 2] + 30 && data[4 * i + 1] > data[4 * i + 2] + 15) {
      count += 1; x += i % width; y += height - 1 - Math.floor(i / width);
    }
  return [x / count, y / count, count];
})()"""


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
    """200 poses by what the page computes, and every tenth by the pixels that it draws; 640 x 480 px fill 800 x 600."""

    async def test(server):
        async with browser(tmp_path) as open_tab:
            tab = await open_tab(server.address)
            await tab.until("view.state.setup !== null && view.state.offset !== null")
            worst = by_pixels = 0.0
            for i in range(200):
                given = pose(i)
                await shown(server, tab, given)
                x, y = CAMERA.project(given.tip).tolist()
                u, v = await tab.value("view.tipOnScreen()")
                worst = max(worst, math.hypot(u - x, v - y))
                if i % 10 == 0:
                    u, v, count = await tab.value(SPOT)
                    assert count > 20
                    scale = 800 / 640
                    middle = ((u + 0.5) / scale - 0.5, (v + 0.5) / scale - 0.5)
                    by_pixels = max(by_pixels, math.dist(middle, (x, y)))
            assert worst < 1e-3 and by_pixels < 1, by_pixels
            assert await tab.value("view.state.lost") == 0 == await tab.value("view.state.malformed")

    run(test)


def test_a_refusal_is_said_and_an_old_pose_fades_and_goes(tmp_path):
    async def test(server):
        async with browser(tmp_path) as open_tab:
            tab = await open_tab(server.address)
            await tab.until("view.state.setup !== null && view.state.offset !== null")
            await shown(server, tab, pose(0), ahead=3)
            assert await tab.value("view.state.drawn && view.state.alpha > 0.5")
            server.send(Pose.refused(Status.NO_CATHETER, "<b>nothing</b> has its colours"), now())
            words = 'document.getElementById("reason").textContent'
            await tab.until(f"{words} === 'NO_CATHETER: <b>nothing</b> has its colours'")
            await tab.until("!view.state.drawn && view.tipOnScreen() === null")  # no pose is shown beyond a second
            await shown(server, tab, pose(3), ahead=3)
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
            await server.__aexit__()
            words = 'document.getElementById("reason").textContent'
            for tab in tabs:
                await tab.until(f"!view.state.connected && {words}.startsWith('no connection')")
            async with PageServer(THESIS, CAMERA, port=server.port) as other:
                for tab in tabs:
                    await tab.until("view.state.connected && view.state.offset !== null")
                    await shown(other, tab, pose(9))
                    assert await tab.value("view.state.drawn")

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


# A headset of two eyes, 60 mm apart, turned and shifted in its space; it draws into the halves of the canvas.
HEADSET = """
const eye = (x) => {
  const [c, s] = [Math.cos(0.1), Math.sin(0.1)];
  // Rows of the map from the eye to the space: a turn about y, and the place of the eye.
  const to = [[c, 0, -s, x], [0, 1, 0, 0.02], [s, 0, c, 0.05], [0, 0, 0, 1]];
  const back = [0, 1, 2].map((i) => [to[0][i], to[1][i], to[2][i],
                                     -(to[0][i] * to[0][3] + to[1][i] * to[1][3] + to[2][i] * to[2][3])]);
  const all = [0, 1, 2, 3], flat = (rows) => new Float32Array(
    all.flatMap((column) => all.map((row) => (rows[row] || [0, 0, 0, 1])[column])));
  const [f, near, far] = [1.1, 0.01, 20];
  const projection = [[f, 0, 0.05 * Math.sign(x), 0], [0, 1.3, 0, 0],
                      [0, 0, (far + near) / (near - far), 2 * far * near / (near - far)], [0, 0, -1, 0]];
  return { right: x > 0, projectionMatrix: flat(projection), transform: { inverse: { matrix: flat(back) } } };
};
window.asked = [];
window.XRWebGLLayer = class {
  constructor(session, gl) { this.framebuffer = null; this.canvas = gl.canvas; }
  getViewport(view) {
    const [width, height] = [this.canvas.width / 2, this.canvas.height];
    return { x: view.right ? width : 0, y: 0, width, height };
  }
};
Object.defineProperty(navigator, "xr", { value: {
  isSessionSupported: async (mode) => mode === "immersive-vr",
  requestSession: async (mode) => {
    const session = new EventTarget(), views = [eye(-0.03), eye(0.03)];
    let over = false;
    session.renderState = {};
    session.updateRenderState = (given) => Object.assign(session.renderState, given);
    session.requestReferenceSpace = async (kind) => { asked.push(mode, kind); return { kind }; };
    session.requestAnimationFrame = (draw) => requestAnimationFrame(
      (time) => { if (!over) draw(time, { getViewerPose: () => ({ views }) }); });
    session.end = () => { over = true; session.dispatchEvent(new Event("end")); };
    return session;
  },
} });
WebGL2RenderingContext.prototype.makeXRCompatible = async () => {};
"""
EYES = """(() => {
  const canvas = document.getElementById("canvas"), gl = canvas.getContext("webgl2");
  const [width, height] = [canvas.width, canvas.height], data = new Uint8Array(4 * width * height);
  gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, data);
  const sums = [[0, 0, 0], [0, 0, 0]];
  for (let i = 0; i < width * height; i++)
    if (data[4 * i] > data[4 * i + 2] + 30 && data[4 * i + 1] > data[4 * i + 2] + 15) {
      const x = i % width, sum = sums[Number(x >= width / 2)];
      sum[0] += 1; sum[1] += x + 0.5; sum[2] += Math.floor(i / width) + 0.5;
    }
  return sums.map(([count, x, y]) => [count, x / count, y / count]);
})()"""


def in_eye(tip, x: float, width: int, height: int) -> tuple[float, float]:
    """Pixels from the left and the bottom of a point (x right, y down, z forward) in the eye at x of ``HEADSET``."""
    right, up, back = tip[0] - x, -tip[1] - 0.02, -tip[2] - 0.05
    c, s = math.cos(0.1), math.sin(0.1)
    right, back = c * right + s * back, -s * right + c * back
    u, v = (1.1 * right + math.copysign(0.05, x) * back) / -back, 1.3 * up / -back
    return (u + 1) / 2 * width / 2 + (width / 2 if x > 0 else 0), (v + 1) / 2 * height


def test_both_eyes_of_a_headset_see_the_tip_where_it_is(tmp_path):
    """An emulated headset: the session starts, both eyes are drawn with their own matrices, and it ends."""

    async def test(server):
        async with browser(tmp_path) as open_tab:
            tab = await open_tab(server.address, HEADSET)
            await tab.until("view.state.offset !== null && !document.getElementById('headset').disabled")
            await tab.value("document.getElementById('headset').click()")
            await tab.until("view.state.headset === 'immersive-vr'")
            assert await tab.value("asked") == ["immersive-vr", "viewer"]
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


def test_the_page_says_what_a_headset_needs(tmp_path):
    async def test(server):
        async with browser(tmp_path) as open_tab:
            tab = await open_tab(server.address, HEADSET)
            title = await tab.until("document.getElementById('headset').title")
            assert "stream with --headset FILE" in title
            assert await tab.value("document.getElementById('headset').disabled")

    run(test)
