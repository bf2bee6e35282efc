// The view in a WebXR headset, and its controllers and hands.
import { FLIP, inverse, minus, moved, times, turned } from "./algebra.js";
import { aligned, alignmentText, carryTwin, twinColour } from "./aligning.js";
import { catheter, clear, gl, picture, twin, upload } from "./drawing.js";
import { carryPanel, hitsPanel, inSpace, panelInSpace } from "./pictures.js";
import { sliceInPlace } from "./slices.js";
import { freshness, state } from "./state.js";

const TAP = 0.3, STILL = 0.005;  // seconds and metres: a shorter press at one place means "aligned"
const button = document.getElementById("headset");
let immersed = null;  // { session, space }
let held = new Map();  // by input source: what it carries, its first and newest place, and the time of the press

export const isImmersed = () => immersed !== null;

export async function offerHeadset() {
  const { frame, align } = state.setup;
  let missing = "";
  if (!window.isSecureContext) missing = "WebXR needs a secure page: https (--tls), or localhost";
  else if (!navigator.xr) missing = "this browser has no WebXR";
  else if (frame.startsWith("camera") && !align)
    missing = "poses are in the camera's frame: stream with --headset FILE, or with --align FILE to make it";
  else {
    const modes = ["immersive-ar", "immersive-vr"];
    const can = await Promise.all(modes.map((mode) => navigator.xr.isSessionSupported(mode)));
    button.dataset.mode = modes[can.indexOf(true)] || "";
    if (!button.dataset.mode) missing = "no headset is connected";
  }
  button.disabled = Boolean(missing);
  button.title = missing || "see the catheter in the headset";
}
async function enter() {
  const overlay = { root: document.getElementById("modes") };  // the buttons, on a telephone
  const options = { optionalFeatures: ["local", "hand-tracking", "dom-overlay"], domOverlay: overlay };
  const session = await navigator.xr.requestSession(button.dataset.mode, options);
  await gl.makeXRCompatible();
  session.updateRenderState({ baseLayer: new XRWebGLLayer(session, gl, { alpha: true }) });
  // A camera on the headset moves with it, as its alignment does; a camera in the room stays.
  const moves = state.setup.align || state.setup.frame.startsWith("headset");
  const space = await session.requestReferenceSpace(moves ? "viewer" : "local");
  immersed = { session, space };
  held = new Map();
  state.headset = button.dataset.mode;
  session.addEventListener("end", () => { immersed = null; state.headset = ""; });
  session.addEventListener("selectstart", ({ inputSource }) => { held.set(inputSource, null); });
  session.addEventListener("selectend", ({ inputSource }) => release(inputSource));
  session.addEventListener("squeeze", aligned);
  session.requestAnimationFrame(immersive);
}
button.onclick = () => {
  if (immersed) immersed.session.end();
  else enter().catch((error) => { state.error = String(error); button.title = state.error; });
};

function place(moment, space) {  // matrix of a space of an input source in our axes, or null while it is not tracked
  const pose = space && moment.getPose(space, immersed.space);
  return pose ? times(times(FLIP, pose.transform.matrix), FLIP) : null;
}
function carry(moment) {
  for (const [source, grip] of held) {
    const at = place(moment, source.gripSpace || source.targetRaySpace);
    if (!at) continue;
    if (!grip) { held.set(source, grasp(moment, source, at)); continue; }
    grip.at = at;
    const change = times(at, inverse(grip.start));
    if (grip.panel) {
      const others = [...held.values()].filter((other) => other && other !== grip);
      const apart = (key) => Math.hypot(...minus(moved(others[0][key], [0, 0, 0]), moved(grip[key], [0, 0, 0])));
      carryPanel(grip.panel, change, others.length ? apart("at") / apart("start") : 1);  // a second hand scales it
    } else if (grip.twin) carryTwin(grip.twin, change);
  }
}
function grasp(moment, source, at) {
  const ray = place(moment, source.targetRaySpace) || at;
  const panel = hitsPanel(moved(ray, [0, 0, 0]), turned(ray, [0, 0, 1])) ? { ...inSpace } : null;
  const carried = state.aligning && !panel && ![...held.values()].some((other) => other && other.twin);
  return { start: at, at, panel, twin: carried ? { ...state.twin } : null, since: performance.now() / 1000 };
}
function release(source) {
  const grip = held.get(source);
  held.delete(source);
  if (!grip || !grip.twin || performance.now() / 1000 - grip.since > TAP) return;
  if (Math.hypot(...minus(moved(grip.at, [0, 0, 0]), moved(grip.start, [0, 0, 0]))) < STILL) aligned();
}

const board = Object.assign(document.createElement("canvas"), { width: 1024, height: 384 });
let written = "";
function words(toScreen) {  // what the page says of the alignment, below the middle of the view
  const text = alignmentText();
  if (!text) return;
  if (text !== written) {
    const pen = board.getContext("2d");
    pen.clearRect(0, 0, board.width, board.height);
    pen.fillStyle = "rgba(20, 23, 28, 0.7)";
    pen.fillRect(0, 0, board.width, board.height);
    pen.fillStyle = "#e8eef9";
    pen.font = "26px sans-serif";
    text.split("\n").slice(0, 11).forEach((line, i) => pen.fillText(line, 12, 32 + 32 * i, board.width - 24));
    upload("words", board);
    written = text;
  }
  picture("words", toScreen, [-0.25, 0.12, 0.8], [0.5, 0, 0], [0, 0.1875, 0], 1, true);
}
function immersive(time, moment) {
  if (!immersed) return;
  immersed.session.requestAnimationFrame(immersive);
  const layer = immersed.session.renderState.baseLayer, viewer = moment.getViewerPose(immersed.space);
  carry(moment);
  gl.bindFramebuffer(gl.FRAMEBUFFER, layer.framebuffer);
  freshness();
  for (const view of viewer ? viewer.views : []) {
    const { x, y, width, height } = layer.getViewport(view);
    clear([x, y, width, height], [0, 0, 0, 0]);  // what is transparent shows the room
    const toScreen = times(times(view.projectionMatrix, view.transform.inverse.matrix), FLIP);
    const registered = !state.setup.frame.startsWith("camera");
    if (registered) sliceInPlace(toScreen);
    if (state.drawn && registered) catheter(toScreen);
    if (state.aligning) twin(toScreen, twinColour());
    panelInSpace(toScreen);
    words(toScreen);
  }
}
