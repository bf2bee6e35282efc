// The page of `holotorch stream SOURCE --view`. Frames are right-handed, x right, y down, z forward; metres and seconds.
import { apply, columns, cross, dot, plus, projection, scaled, times, unit } from "./algebra.js";
import * as aligning from "./aligning.js";
import { connect } from "./connection.js";
import { canvas, catheter, clear, gl, twin } from "./drawing.js";
import { isImmersed, offerHeadset } from "./headset.js";
import * as pictures from "./pictures.js";
import { offerSlices, sliceInCorner, sliceInPlace } from "./slices.js";
import { current, freshness, now, state } from "./state.js";

const byId = (id) => document.getElementById(id);
window.view = { state, tipOnScreen, now, current, pictures, onScreen: (point) => onScreen(point) };

// ---- where the page looks from
const orbit = { yaw: 0.6, pitch: 0.35, distance: 0.6, middle: [0, 0, 0.5] };
const camera = () => (state.mode === "camera" && state.setup ? state.setup.camera : null);
function area() {  // the rectangle of the canvas that shows the scene: x, y from the left and bottom, size
  const lens = camera();
  if (!lens) return [0, 0, canvas.width, canvas.height];
  const scale = Math.min(canvas.width / lens.width, canvas.height / lens.height);
  const width = Math.round(lens.width * scale), height = Math.round(lens.height * scale);
  return [Math.round((canvas.width - width) / 2), Math.round((canvas.height - height) / 2), width, height];
}
function looking() {  // the matrix to the screen, the place and axes of the view, and its focal lengths in canvas pixels
  const lens = camera(), [, , width, height] = area();
  if (lens) {
    const matrix = projection(0.01, 20, lens.fx, lens.fy, lens.cx, lens.cy, lens.width, lens.height);
    const focal = [lens.fx * width / lens.width, lens.fy * height / lens.height];
    return { matrix, from: [0, 0, 0], right: [1, 0, 0], down: [0, 1, 0], forward: [0, 0, 1], focal };
  }
  const { yaw, pitch, distance, middle } = orbit;
  const forward = [Math.sin(yaw) * Math.cos(pitch), Math.sin(pitch), Math.cos(yaw) * Math.cos(pitch)];
  const right = unit(cross([0, 1, 0], forward)), down = cross(forward, right);
  const from = plus(middle, scaled(forward, -distance));
  const turn = columns([right[0], down[0], forward[0]], [right[1], down[1], forward[1]],
    [right[2], down[2], forward[2]], [-dot(right, from), -dot(down, from), -dot(forward, from)]);
  const focal = 1.2 * height;
  const matrix = times(projection(0.01, 20, focal, focal, width / 2 - 0.5, height / 2 - 0.5, width, height), turn);
  return { matrix, from, right, down, forward, focal: [focal, focal] };
}
function onScreen(point) {  // in pixels of the picture, as the camera counts them
  const v = apply(looking().matrix, point), [, , w, h] = area(), { width, height } = camera() || { width: w, height: h };
  return [(v[0] / v[3] + 1) / 2 * width - 0.5, (1 - v[1] / v[3]) / 2 * height - 0.5];
}
function tipOnScreen() { return state.drawn && current() ? onScreen(current().tip) : null; }  // null: not drawn

function scene() {
  const ratio = window.devicePixelRatio || 1;
  canvas.width = Math.round(canvas.clientWidth * ratio);
  canvas.height = Math.round(canvas.clientHeight * ratio);
  gl.bindFramebuffer(gl.FRAMEBUFFER, null);
  const all = [0, 0, canvas.width, canvas.height];
  clear(all, [0.08, 0.09, 0.11, 1]);
  clear(area(), [0.13, 0.15, 0.18, 1]);
  freshness(camera() && pictures.fresh("camera") ? pictures.pictures.camera.pose : null);
  const { matrix } = looking();
  if (camera()) pictures.background();
  sliceInPlace(matrix);
  if (state.drawn) catheter(matrix);
  if (state.aligning) twin(matrix, aligning.twinColour());
  if (state.drawn) sliceInCorner(canvas.width, canvas.height);
  gl.viewport(...all);
  gl.scissor(...all);
  pictures.panelOnScreen(canvas.width, canvas.height);
}

// ---- words
let frames = 0, counted = now(), written = 0;
function words() {
  const pose = state.shown || state.pose;
  const reason = !state.connected ? (state.ended ? "the stream has ended" : "no connection to the server; trying again")
    : !pose ? "waiting for a pose"
    : !pose.answered ? `${pose.status}: ${pose.reason}`
    : state.alpha < 1 ? "the newest pose is old" : "";
  byId("reason").textContent = reason;
  const ms = (seconds) => (seconds === null ? "-" : `${(1e3 * seconds).toFixed(0)} ms`);
  const tip = pose && pose.answered ? scaled(pose.tip, 1e3).map((v) => v.toFixed(1)).join(", ") : "-";
  const panel = pictures.pictures.panel && state.panel ? `\npanel: capture to frame ${ms(pictures.pictures.panel.latency)}` : "";
  byId("numbers").textContent =
    `tip ${tip} mm in the axes of the ${state.setup ? state.setup.frame.replace("_from_tool", "") : "-"}\n` +
    `capture to frame ${ms(state.latency)}, ${state.rate.toFixed(0)} frames/s, ${state.received} poses, ${state.lost} lost${panel}` +
    (camera() && state.setup.empty ? `\n${state.setup.empty}` : "");
  byId("alignment").textContent = aligning.alignmentText();
}
function frame() {
  if (!isImmersed()) scene();
  frames += 1;
  if (now() - counted > 0.5) {
    state.rate = frames / (now() - counted);
    [frames, counted] = [0, now()];
  }
  if (now() - written > 0.1) {
    written = now();
    words();
  }
  requestAnimationFrame(frame);
}

// ---- buttons, mouse and touch
for (const mode of ["camera", "space"]) {
  byId(mode).onclick = () => {
    state.mode = mode;
    if (mode === "space" && state.answered) orbit.middle = [...state.answered.tip];
    for (const each of ["camera", "space"]) byId(each).setAttribute("aria-pressed", String(each === mode));
  };
}
for (const name of ["predict", "panel"]) {
  byId(name).onclick = (event) => {
    state[name] = !state[name];
    event.target.setAttribute("aria-pressed", String(state[name]));
  };
}
const fingers = new Map();
let carried = "";  // what the pointer moves: panel, twin or view
function share(event) { return [event.clientX / canvas.clientWidth, event.clientY / canvas.clientHeight]; }
canvas.onpointerdown = (event) => {
  fingers.set(event.pointerId, true);
  canvas.setPointerCapture(event.pointerId);
  const panel = pictures.onPanel(...share(event), canvas.width, canvas.height);
  carried = panel ? "panel" : state.aligning ? "twin" : "view";
};
canvas.onpointerup = canvas.onpointercancel = (event) => { fingers.delete(event.pointerId); };
canvas.onpointermove = (event) => {
  if (!event.buttons) return;
  const { movementX: right, movementY: down } = event, ratio = window.devicePixelRatio || 1;
  if (carried === "panel") {
    pictures.onScreen.x += right / canvas.clientWidth;
    pictures.onScreen.y += down / canvas.clientHeight;
  } else if (carried === "twin") {
    aligning.dragTwin(looking(), right * ratio, down * ratio, event.shiftKey || event.buttons === 2 || fingers.size > 1);
  } else if (state.mode === "space") {
    orbit.yaw -= right / 200;
    orbit.pitch = Math.max(-1.5, Math.min(1.5, orbit.pitch + down / 200));
  }
};
canvas.oncontextmenu = (event) => event.preventDefault();  // the second button turns the twin
canvas.onwheel = (event) => {
  const factor = Math.exp(event.deltaY / 500);
  if (pictures.onPanel(...share(event), canvas.width, canvas.height)) pictures.scalePanel(1 / factor);
  else if (state.aligning) aligning.pushTwin(looking(), factor);
  else if (state.mode === "space") orbit.distance = Math.max(0.05, Math.min(5, orbit.distance * factor));
};
window.onkeydown = (event) => { if (event.key === "Enter" && event.target === document.body) aligning.aligned(); };

byId("camera").setAttribute("aria-pressed", "true");
connect({
  setup(message) {
    state.setup = message;
    byId("panel").hidden = !message.panel;
    offerHeadset();
    aligning.offerAlignment(message);
    offerSlices(message);
  },
  alignment(message) { aligning.takeAlignment(message); words(); },
  picture: (buffer) => pictures.takePicture(buffer).catch((error) => { state.malformed += 1; state.error = String(error); }),
  changed: words,
});
requestAnimationFrame(frame);
