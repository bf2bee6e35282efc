// What the page knows, and the pose that a frame shows: that of the picture behind it, otherwise the newest. Seconds.
import { unit } from "./algebra.js";

const FADES = 0.25, GONE = 1.0;  // age of a pose at which it begins to fade, and is no longer drawn
const AHEAD = 0.1, GAP = 0.25;   // longest prediction, and longest time between two poses that give a speed

export const state = {
  connected: false, ended: false, setup: null, pose: null, answered: null, received: 0, lost: 0, malformed: 0, sequence: null,
  pictured: null, shown: null, placed: null,  // pose of the picture, newest pose or refusal shown, pose drawn
  offset: null, roundTrip: Infinity, latency: null, rate: 0, mode: "camera", drawn: false, alpha: 0, error: "",
  refused: false, headset: "", predict: false, earlier: null,
  aligning: false, twin: null, alignment: null, slice: "none", level: 0, window: 1, panel: false,
};

export function now() { return (performance.timeOrigin + performance.now()) / 1000; }

// Chooses the pose of a frame, and how visible it is: fully, fading, not at all. `pictured` is the pose in the picture
// behind it, which arrives later than the newest pose; null without a picture.
export function freshness(pictured = null) {
  state.pictured = pictured;
  state.shown = pictured || state.pose;
  if (!pictured) state.placed = state.answered;
  else if (pictured.answered) state.placed = pictured;  // after a refusal the last one stays for a moment
  const pose = state.placed, time = pictured ? pictured.captured : now() + state.offset;
  const age = pose && state.offset !== null ? time - pose.captured : Infinity;
  state.refused = Boolean(state.shown) && !state.shown.answered;
  const fade = age < FADES ? 1 : Math.max(0, 1 - (age - FADES) / (GONE - FADES));
  state.alpha = state.refused ? 0.35 * fade : fade;
  state.drawn = Boolean(pose && state.setup && state.alpha > 0);
  if (state.shown && state.offset !== null) state.latency = now() + state.offset - state.shown.captured;
}

export function current() {  // the pose of the frame; the newest one, with prediction, moved on to now at constant velocity
  const { earlier, offset } = state, pose = state.pictured === null ? state.answered : state.placed;
  const since = pose && earlier ? pose.captured - earlier.captured : 0;
  if (!state.predict || state.pictured !== null || state.refused || offset === null || !(since > 0 && since <= GAP)) return pose;
  const share = Math.min(Math.max(now() + offset - pose.captured, 0), AHEAD) / since;
  const on = (one, other) => one.map((v, i) => v + share * (v - other[i]));
  const covariance = pose.covariance.map((v, i) => (1 + share) ** 2 * v + share ** 2 * earlier.covariance[i]);
  return { ...pose, tip: on(pose.tip, earlier.tip), direction: unit(on(pose.direction, earlier.direction)), covariance };
}

