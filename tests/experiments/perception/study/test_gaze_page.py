"""The page with the mouse in place of an eye tracker, in a real browser: skipped where there is no Chromium."""

import asyncio
import math

import pytest
from study_client import TINY, Runner

from holotorch.experiments.perception.study.gaze import GazeSettings, read_gaze
from holotorch.experiments.perception.study.log import read_log
from holotorch.experiments.streaming.chromium import CHROMIUM, browser

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no chromium, chromium-browser or google-chrome on the path")
STUDY = (
    TINY
    + """
timing: {wait_s: [0.05, 0.1], show_s: 0.8, feedback_s: 0.05}
gaze: {source: mouse, attempts: 3}
"""
)
PRESS = "dispatchEvent(new KeyboardEvent('keydown', {key: ' ', code: 'Space'}))"
STATE = "document.body.dataset.state"
# Red and green of the ring of the fixation point, 0.2 to 0.7 deg wide: 2.5 pixels from the middle of 800 x 600.
COLOUR = "[...pen.getImageData(402, 300, 1, 1).data].slice(0, 2)"
SCREENS = [
    {"kind": "flat", "shape": [600, 800], "size": [0.3, 0.4], "distance": 0.25},
    {"kind": "curved", "shape": [1000, 4000], "size": [1.0, 4.0], "distance": 1.2, "radius": 1.5},
]


def test_a_pattern_waits_for_fixation_and_a_broken_trial_comes_again(tmp_path):
    runner = Runner(tmp_path, text=STUDY)

    async def move(tab, x, y):
        await tab.call("Input.dispatchMouseEvent", type="mouseMoved", x=x, y=y)

    async def take():
        async with browser(tmp_path / "browser") as open_tab:
            tab = await open_tab(f"{runner.server.address}#{runner.token}", "window.view = true;")
            for k, screen in enumerate(SCREENS):
                x, y = math.radians(25 - 40 * k), math.radians(7)
                direction = [math.cos(y) * math.sin(x), math.sin(y), math.cos(y) * math.cos(x)]
                found = await tab.value(f"toAngles({screen}, ...toPixels({screen}, ...{direction}))")
                assert found == pytest.approx([25 - 40 * k, 7], abs=1e-9)
            advance = f"{STATE} === 'message' && {PRESS}, {STATE}"
            await tab.until(f"({advance}) === 'wait'")
            await asyncio.sleep(0.6)  # the mouse has not moved: nobody looks, and the pattern waits
            assert await tab.value(STATE) == "wait" and max(await tab.value(COLOUR)) < 40
            broken, colours = False, []
            await move(tab, 401, 301)
            while len(runner.server.session.log.trials) < 4:
                await tab.until(f"({advance}) === 'shown' || {STATE} === 'end'")
                if await tab.value(STATE) == "end":
                    break
                colours.append(await tab.value(COLOUR))
                if await tab.value("index") == 1 and not broken:
                    await move(tab, 600, 300)  # 21.8 deg to the right, until the pattern has gone
                    broken = True
                    await tab.until(f"{STATE} !== 'shown'")
                    await move(tab, 401, 301)
                else:
                    await tab.value(f"new Promise(done => setTimeout(() => {{ {PRESS}; done(1); }}, 150))")
                await tab.until(f"{STATE} !== 'shown'")
            assert all(green > red + 60 for red, green in colours), colours

    asyncio.run(asyncio.wait_for(take(), 60))
    runner.thread.join(10)
    assert runner.status == 0
    lines = read_log(runner.log).trials
    assert [(t["round"], t["attempt"], t["fixated"]) for t in lines] == [
        (0, 1, True), (1, 1, False), (1, 2, True), (2, 1, True)]  # fmt: skip
    assert {t["fixation"]["source"] for t in lines} == {"mouse"}
    assert [t["responded"] for t in lines] == [True, False, True, True]
    assert read_gaze(runner.log.with_suffix(".gaze.csv"), GazeSettings(source="mouse")).accepted > 50
