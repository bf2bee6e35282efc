// A participant for the browser test, put at the end of the study's page. It looks once per frame, presses by a plan, and
// tells COLLECTOR by its own clock when it first saw each pattern, when it pressed, and where the dark pixels were.
(() => {
  const PLAN = /*PLAN*/ [], COLLECTOR = /*COLLECTOR*/ "", SCREENS = /*SCREENS*/ [];
  const tell = facts => fetch(COLLECTOR, {method: "POST", mode: "no-cors", body: JSON.stringify(facts)}).catch(() => {});
  const press = () => {
    const at = performance.now();
    dispatchEvent(new KeyboardEvent("keydown", {key: " ", code: "Space"}));
    return at;
  };
  // Corners of the dark pixels, away from the fixation point in the middle.
  const dark = () => {
    const {width, height} = canvas, data = pen.getImageData(0, 0, width, height).data;
    let box = [width, height, -1, -1];
    for (let y = 0; y < height; y++) for (let x = 0; x < width; x++) {
      if (data[4 * (y * width + x)] > 98 || Math.hypot(x - width / 2, y - height / 2) < 12) continue;
      box = [Math.min(box[0], x), Math.min(box[1], y), Math.max(box[2], x), Math.max(box[3], y)];
    }
    return box;
  };
  let shown = null, before = 0;
  const watch = t => {
    requestAnimationFrame(watch);
    const state = document.body.dataset.state, frame = t - before;
    before = t;
    if (shown) shown.longest = Math.max(shown.longest, frame);
    if (state === "message") press();
    if (state === "drawn" || state === "shown") {
      if (shown) return;
      const seen = {index, seen: t, longest: frame};
      shown = seen;
      const delay = PLAN[index];
      if (delay === null) seen.dark = dark();
      else setTimeout(() => { seen.pressed = press(); }, t + delay - performance.now());
    } else if (shown) {
      tell({...shown, red: state === "red"});
      shown = null;
    }
  };
  requestAnimationFrame(watch);
  // Places of points of patterns on screens of all kinds, to be compared with numbers found otherwise.
  tell({places: SCREENS.map(([screen, ...direction]) => toPixels(screen, ...direction))});
})();
