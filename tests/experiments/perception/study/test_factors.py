"""Contrast and motion in the study: its design, its screen, its log, and its page in Chromium (skipped without one)."""

import asyncio
import json
import math
from collections import Counter

import pytest
from paths import ROOT
from study_client import TINY, Runner

from holotorch.experiments.config.errors import ConfigError
from holotorch.experiments.perception.analysis.curves import read_responses
from holotorch.experiments.perception.study.config import TRAVEL_DEG, beyond_screen, build_screen, load_study
from holotorch.experiments.perception.study.design import Design, make_design
from holotorch.experiments.perception.study.log import read_log
from holotorch.experiments.streaming.chromium import CHROMIUM, browser

CONFIG = ROOT / "configs" / "perception" / "factors.yaml"
# Once a pattern is shown, the page's frames of one second in steps of 50 ms, whatever the machine is busy with:
# rows of the pattern's colour, all away from the fixation point, together with where it should be.
FRAMES = """(() => {
  const next = window.requestAnimationFrame.bind(window);
  const rows = () => {
    const side = trial.side === "left" ? -1 : 1, left = side < 0 ? 0 : canvas.width / 2 + 40;
    const wide = canvas.width / 2 - 40, data = pen.getImageData(left, 0, wide, canvas.height).data;
    let [low, high] = [canvas.height, -1];
    for (let y = 0; y < canvas.height; y++) for (let x = 0; x < wide; x++)
      if (Math.abs(data[4 * (y * wide + x)] - GREY) <= 1)
        [low, high] = [Math.min(low, y), Math.max(high, y)];
    return [low, high, up, trial.eccentricity_deg, (last - onset) / 1000];
  };
  window.requestAnimationFrame = call => next(t => {
    call(t);
    if (window.frames_drawn || document.body.dataset.state !== "shown") return;
    const usual = window.requestAnimationFrame;
    window.requestAnimationFrame = () => 0;
    window.frames_drawn = Array.from({length: 20}, (_, i) => { tick(onset + 50 * (i + 1)); return rows(); });
    window.requestAnimationFrame = usual;
  });
})()"""
PRESS = "dispatchEvent(new KeyboardEvent('keydown', {key: ' ', code: 'Space'}))"
FACTORS = TINY + "contrasts: 0.3\nspeeds_deg_s: 20\ntiming: {wait_s: [0.05, 0.1], show_s: 1.2, feedback_s: 0.05}\n"


def test_the_designs_of_present_studies_are_unchanged():
    """Hashes of the program before it knew contrast and motion: begun logs go on."""
    orders = ("thesis", "williams")
    names = [make_design(person, order=order, seed=2022).name for person in (1, 2, 3) for order in orders]
    assert names == [
        "eec47385d8b7", "69436f61fa66", "62ce8eded514", "a7194b8270a3", "4534ee259efb", "39998597c244"]  # fmt: skip
    assert "contrast" not in json.dumps(make_design(1).to_json())


def test_every_condition_comes_with_every_contrast_and_speed():
    variants = [(1.0, 0.0), (0.3, 0.0), (1.0, 10.0), (0.3, 10.0)]
    design = make_design(1, [(40.0, 8.0), (100.0, 8.0)], variants=variants, practice=5, seed=3)
    trials = [t for t in design.trials if not t.practice]
    count = Counter((t.eccentricity_deg, t.contrast, t.speed_deg_s, t.pattern, t.target) for t in trials)
    assert count == {
        (e, c, v, pattern, target): 5 if target else 2
        for e in (40, 100) for c, v in variants for pattern in ("cross", "circle") for target in (True, False)
    }  # fmt: skip
    assert Design.from_json(json.loads(json.dumps(design.to_json()))) == design
    for wrong in ([], [(1.0, 0.0)] * 2, [(0.0, 0.0)], [(1.2, 0.0)], [(1.0, -1.0)]):
        with pytest.raises(ValueError, match="variants: expected"):
            make_design(1, variants=wrong)


def test_the_study_beyond_80_deg():
    settings = load_study(CONFIG)
    assert settings.trials == 720 == len([t for t in settings.design(1).trials if not t.practice])
    assert max(e for e, _ in settings.conditions) == 105 and not beyond_screen(settings)
    assert build_screen(settings.screen).field_deg[1] == pytest.approx(240, abs=0.1)
    assert "contrast" in settings.design(1).to_json()["trials"][0]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("contrasts=[0]", "expected a contrast between 0.02 and 1"),
        ("contrasts=[30]", "expected a contrast between 0.02 and 1"),
        ("contrasts=[1, 1]", "contrasts: expected different numbers"),
        ("speeds_deg_s=[-1]", "expected a speed between 0 and 60"),
        ("speeds_deg_s=[]", "speeds_deg_s: expected at least 1"),
        ("repeats.target=100", "at most 10000 trials"),
        ("patterns=[{eccentricities_deg: 118, sizes_deg: 8}]", "reaches 122 deg and the screen 120.0"),
    ],
)
def test_mistakes_in_the_factors(change, message):
    with pytest.raises(ConfigError, match=message):
        load_study(CONFIG, [change])


def test_a_moving_pattern_needs_room_above():
    """50 deg of height: 46 deg fit at rest, and 46 + 2 x 2.5 deg do not."""
    height = 2 * 0.5 * math.tan(math.radians(25))
    screen = f"screen={{kind: flat, shape: [1000, 2000], size: [{height}, 3.0], distance: 0.5}}"
    rest = [screen, "patterns=[{eccentricities_deg: 0, sizes_deg: 46}]", "speeds_deg_s=[0]"]
    assert not beyond_screen(load_study(CONFIG, rest))
    with pytest.raises(ConfigError, match="pixels in height and the screen has 1000"):
        load_study(CONFIG, [*rest[:2], "speeds_deg_s=[0, 5]"])


def test_contrast_and_speed_reach_the_log_and_the_analysis(tmp_path):
    runner = Runner(tmp_path, text=FACTORS)
    _, session = runner.ask("POST", "/session", {"window": "w"})
    assert session["travel_deg"] == TRAVEL_DEG and session["trials"][0]["contrast"] == 0.3
    for number in range(3):
        runner.send(number)
    runner.thread.join(10)
    assert [(t["contrast"], t["speed_deg_s"]) for t in read_log(runner.log).trials] == [(0.3, 20)] * 3
    made = read_responses([str(runner.log)])
    assert made.contrast is not None and made.contrast.tolist() == [0.3, 0.3]
    assert made.speed_deg_s is not None and made.speed_deg_s.tolist() == [20, 20]
    runner.log.write_text(runner.log.read_text().replace('"contrast": 0.3', '"contrast": 3'))
    with pytest.raises(ConfigError, match="contrast: expected a number above 0 and at most 1, got 3"):
        read_log(runner.log)


@pytest.mark.skipif(CHROMIUM is None, reason="no chromium, chromium-browser or google-chrome on the path")
def test_the_page_draws_contrast_and_motion(tmp_path):
    runner = Runner(tmp_path, text=FACTORS)

    async def take():
        async with browser(tmp_path / "browser") as open_tab:
            tab = await open_tab(f"{runner.server.address}#{runner.token}", "window.view = true;")
            await tab.until("document.body.dataset.state === 'message'")
            # Luminance of sRGB levels: 1 - C times that of the background, to one level.
            for contrast in (1, 0.3, 0.1, 0.02):
                level = int((await tab.value(f"grey({contrast})")).split(",")[1])
                levels = [linear(level + step) / linear(0xC4) for step in (-0.51, 0.51)]
                assert levels[0] <= 1 - contrast <= levels[1]
            # Up, down and back at constant speed: 2.5 deg in 0.25 s at 10 deg/s.
            path = await tab.value("[0, 0.125, 0.25, 0.5, 0.75, 1, 1.25].map(s => height(10, s))")
            assert path == pytest.approx([0, 1.25, 2.5, 0, -2.5, 0, 2.5])
            grey = int((await tab.value("grey(0.3)")).split(",")[1])
            await tab.value(FRAMES.replace("GREY", str(grey)))
            await tab.until(f"document.body.dataset.state === 'message' && {PRESS}, window.frames_drawn")
            return await tab.value("frames_drawn")

    seen = asyncio.run(asyncio.wait_for(take(), 60))
    runner.stop()
    assert len(seen) == 20 and max(s[2] for s in seen) - min(s[2] for s in seen) > 3, seen
    for low, high, up, angle, seconds in seen:
        # A triangle of 2.5 deg up and down at 20 deg/s has a period of 0.5 s.
        assert up == pytest.approx(5 / math.pi * math.asin(math.sin(4 * math.pi * seconds)), abs=1e-6)
        # The middle of a pattern on a flat screen of 2000 px/m at 0.25 m, 20 deg to the side and ``up`` above.
        centre = 300 - 500 * math.tan(math.radians(up)) / math.cos(math.radians(angle))
        assert (low + high + 1) / 2 == pytest.approx(centre, abs=1.5)


def linear(level: float) -> float:
    """Luminance of an sRGB level, 0 to 255, relative to white."""
    s = level / 255
    return s / 12.92 if s <= 0.04045 else ((s + 0.055) / 1.055) ** 2.4
