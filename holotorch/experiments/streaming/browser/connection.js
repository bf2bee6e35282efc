// The connection to the server: the newest pose only, the difference of the clocks, and pictures.
import { now, state } from "./state.js";

let socket = null;

export function send(message) {
  if (socket && socket.readyState === 1) socket.send(JSON.stringify(message));
}

// handlers: setup, alignment, picture (ArrayBuffer), changed (the connection opened or broke)
export function connect(handlers, wait = 250) {
  const address = new URL("poses" + location.search, location.href);
  address.protocol = location.protocol === "https:" ? "wss:" : "ws:";
  const opened = new WebSocket(address);
  let timer = 0;
  opened.binaryType = "arraybuffer";
  opened.onopen = () => {
    socket = opened;
    Object.assign(state, { connected: true, ended: false, sequence: null, roundTrip: Infinity });
    const ask = () => send({ kind: "clock", asked: now() });
    for (const later of [0, 50, 100, 200, 400]) setTimeout(ask, later);  // a busy page answers its first one late
    timer = setInterval(ask, 1000);
    handlers.changed();
  };
  opened.onmessage = (event) => {
    try {
      if (event.data instanceof ArrayBuffer) handlers.picture(event.data);
      else take(JSON.parse(event.data), handlers);
    } catch (error) { state.malformed += 1; state.error = String(error); }
  };
  opened.onclose = (event) => {
    clearInterval(timer);
    state.ended = event.reason === "ended" || (state.ended && event.code !== 1000);  // and the next tries fail
    state.connected = false;
    handlers.changed();
    setTimeout(() => connect(handlers, Math.min(2 * wait, 2000)), wait);
  };
}

function take(message, handlers) {
  if (message.kind === "setup" || message.kind === "alignment") handlers[message.kind](message);
  else if (message.kind === "clock") clock(message);
  else pose(message);
}
function clock(message) {
  const trip = now() - message.asked;
  if (trip <= state.roundTrip * 1.2) {  // the fastest replies tell the difference best
    state.roundTrip = Math.min(trip, state.roundTrip);
    state.offset = message.now - message.asked - trip / 2;
  }
}
function pose(message) {
  if (message.kind !== "pose" || !Number.isInteger(message.sequence)) throw new Error("not a pose");
  checked(message);
  if (state.sequence !== null) {
    if (message.sequence <= state.sequence) return;  // an older pose never replaces a newer one
    state.lost += message.sequence - state.sequence - 1;
  }
  state.sequence = message.sequence;
  state.received += 1;
  state.pose = message;
  if (message.answered) [state.earlier, state.answered] = [state.answered, message];
  else state.earlier = null;  // a speed is never taken across a refusal
}
export function checked(pose) {
  const numbers = pose.answered ? [...pose.tip, ...pose.direction, ...pose.covariance] : [];
  if (pose.answered && (numbers.length !== 15 || !numbers.every(Number.isFinite))) throw new Error("not finite");
  return pose;
}
