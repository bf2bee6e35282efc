// What the page knows, and the newest pose at the time of a frame. Seconds.
import { unit } from "./algebra.js";

const FADES = 0.25, GONE = 1.0;  // age of a pose at which it begins to fade, and is no longer drawn
const AHEAD = 0.1, GAP = 0.25;   // longest prediction, and longest time between two poses that give a speed

export const state = {
  connected: false, setup: null, pose: null, answered: null, received: 0, lost: 0, malformed: 0, sequence: null,
  offset: null, roundTrip: Infinity, latency: null, rate: 0, mode: "camera", drawn: false, alpha: 0, error: "",
  refused: false, headset: "", predict: false, earlier: null,
  aligning: false, twin: null, alignment: null, slice: "none", level: 0, window: 1, panel: false,
};

export function now() { return (performance.timeOrigin + performance.now()) / 1000; }

export function freshness() {  // how visible the newest pose is: fully, fading, not at all
  const pose = state.answered;
  const age = pose && state.offset !== null ? now() + state.offset - pose.captured : Infinity;
  state.refused = Boolean(state.pose) && !state.pose.answered;
  const fade = age < FADES ? 1 : Math.max(0, 1 - (age - FADES) / (GONE - FADES));
  state.alpha = state.refused ? 0.35 * fade : fade;
  state.drawn = Boolean(pose && state.setup && state.alpha > 0);
  if (state.pose && state.offset !== null) state.latency = now() + state.offset - state.pose.captured;
}

export function current() {  // the newest pose, with prediction moved on to now at constant velocity
  const { answered: pose, earlier, offset } = state;
  const since = pose && earlier ? pose.captured - earlier.captured : 0;
  if (!state.predict || state.refused || offset === null || !(since > 0 && since <= GAP)) return pose;
  const share = Math.min(Math.max(now() + offset - pose.captured, 0), AHEAD) / since;
  const on = (one, other) => one.map((v, i) => v + share * (v - other[i]));
  const covariance = pose.covariance.map((v, i) => (1 + share) ** 2 * v + share ** 2 * earlier.covariance[i]);
  return { ...pose, tip: on(pose.tip, earlier.tip), direction: unit(on(pose.direction, earlier.direction)), covariance };
}

