// Alignment in the view: the user puts the catheter on its virtual twin, and the server fits the map to the headset.
import { dot, minus, moved, plus, rotated, scaled, turned, unit } from "./algebra.js";
import { send } from "./connection.js";
import { now, state } from "./state.js";

// Twins that are offered one after the other: the tip, and the direction to the rear. Lines of the first three are 60
// degrees apart.
const OFFERED = [
  [[0.00, 0.02, 0.45], [0.92, 0.10, -0.38]], [[0.05, -0.03, 0.50], [0.42, -0.82, 0.38]],
  [[-0.05, 0.00, 0.40], [0.42, 0.84, -0.34]], [[0.04, 0.04, 0.42], [-0.90, -0.20, -0.38]],
  [[-0.04, -0.04, 0.50], [-0.50, 0.80, 0.33]], [[0.00, 0.00, 0.46], [-0.45, -0.85, -0.28]],
].map(([tip, direction]) => ({ tip, direction: unit(direction) }));
const FLASH = 0.5;  // seconds
let answered = 0;

const byId = (id) => document.getElementById(id);
export function offerAlignment(setup) {
  byId("align").hidden = !setup.align;
  if (!setup.align) switchAlignment(false);
}
export function switchAlignment(on) {
  state.aligning = on;
  byId("aligning").hidden = !on;
  byId("align").setAttribute("aria-pressed", String(on));
  if (on && !state.twin) offer();
}
function offer() {
  const count = state.alignment ? state.alignment.count : 0;
  state.twin = structuredClone(OFFERED[count % OFFERED.length]);
}
export function aligned() {
  if (state.aligning) send({ kind: "aligned", tip: state.twin.tip, direction: state.twin.direction });
}
export function takeAlignment(message) {
  const more = !state.alignment || message.count > state.alignment.count;
  state.alignment = message;
  answered = now();
  if (more && message.count) offer();
}
export function twinColour() {  // green or red for a moment after an answer
  if (now() - answered > FLASH) return [0.9, 0.4, 0.9];
  return state.alignment.error ? [1, 0.2, 0.2] : [0.2, 1, 0.3];
}
export function alignmentText() {
  if (!state.aligning) return "";
  const help = "hold the catheter on its virtual twin and press aligned";
  const answer = state.alignment;
  if (!answer) return help;
  const saved = answer.saved ? `\nsaved to ${answer.saved}` : "";
  return `${answer.error ? `${answer.error}\n` : ""}${answer.text}${saved}`;
}

export function dragTwin(view, right, down, turn) {  // pixels; view: as `looking` of view.js returns it
  const twin = state.twin, depth = dot(view.forward, minus(twin.tip, view.from));
  if (turn) twin.direction = unit(rotated(rotated(twin.direction, view.down, right / 200), view.right, -down / 200));
  else twin.tip = plus(twin.tip, plus(scaled(view.right, right * depth / view.focal[0]), scaled(view.down, down * depth / view.focal[1])));
}
export function pushTwin(view, factor) {  // along the line of sight
  const { twin } = state;
  twin.tip = plus(view.from, scaled(minus(twin.tip, view.from), factor));
}
export function carryTwin(start, change) {  // by the motion of a controller or hand since it took hold
  state.twin = { tip: moved(change, start.tip), direction: unit(turned(change, start.direction)) };
}

byId("align").onclick = () => switchAlignment(!state.aligning);
byId("aligned").onclick = aligned;
byId("undo").onclick = () => send({ kind: "undo" });
byId("save").onclick = () => send({ kind: "save" });
