// The slice of a registered volume at the tip of the catheter: in its place, and in a corner of the window.
import { cross, dot, minus, plus, scaled, unit } from "./algebra.js";
import { catheter, clear, gl, loadVolume, slice } from "./drawing.js";
import { current, state } from "./state.js";

const KINDS = ["none", "axial", "coronal", "sagittal", "along"];
const HALF = 0.06, INSET = 240;  // metres from the tip to the edge of a slice; pixels of the picture in the corner
let shown = "";  // what has been loaded

export function offerSlices(setup) {
  document.getElementById("slices").hidden = !setup.volume;
  const text = JSON.stringify(setup.volume);
  if (!setup.volume || text === shown) return;
  shown = text;
  loadVolume(setup.volume).catch((error) => { state.error = String(error); });
  const { low, high } = setup.volume;
  Object.assign(state, { level: setup.volume.level, window: setup.volume.window });
  for (const [name, least] of [["level", low], ["window", (high - low) / 256]]) {
    const input = document.getElementById(name);
    Object.assign(input, { min: least, max: high, step: (high - low) / 512 });
    if (name === "window") input.max = high - low;
    input.value = state[name];
    input.oninput = () => { state[name] = Number(input.value); };
  }
}
document.getElementById("slice").onclick = (event) => {
  state.slice = KINDS[(KINDS.indexOf(state.slice) + 1) % KINDS.length];
  event.target.textContent = `slice: ${state.slice}`;
};

export function plane() {  // right and down of the slice, unit vectors in the frame of the poses; null without a slice
  if (state.slice === "none" || !state.drawn || !state.setup.volume) return null;
  const m = state.setup.volume.matrix;  // its rows are the axes of the volume, each divided by a length
  const [x, y, z] = [0, 1, 2].map((r) => unit([m[r], m[4 + r], m[8 + r]]));
  if (state.slice === "axial") return [x, y];
  if (state.slice === "coronal") return [x, z];
  if (state.slice === "sagittal") return [y, z];
  const along = current().direction, aside = Math.abs(dot(along, x)) < 0.9 ? x : y;
  return [unit(minus(aside, scaled(along, dot(aside, along)))), along];
}
export function sliceInPlace(toScreen) {
  const sides = plane();
  if (!sides) return;
  const [right, down] = sides.map((side) => scaled(side, 2 * HALF));
  const corner = plus(current().tip, plus(scaled(right, -0.5), scaled(down, -0.5)));
  slice(toScreen, corner, right, down, 0.9);
}
export function sliceInCorner(width, height) {  // as seen along the normal of the plane, without perspective
  const sides = plane();
  if (!sides) return;
  const size = Math.min(INSET, width / 2, height / 2), [right, down] = sides, away = cross(right, down);
  const rows = [scaled(right, 1 / HALF), scaled(down, -1 / HALF), scaled(away, 0.2 / HALF)];
  const tip = current().tip, shift = rows.map((row) => -dot(row, tip));
  const toScreen = new Float64Array([0, 1, 2].flatMap((c) => [rows[0][c], rows[1][c], rows[2][c], 0]).concat([...shift, 1]));
  clear([12, 12, size, size], [0, 0, 0, 1]);
  sliceInPlace(toScreen);
  gl.clear(gl.DEPTH_BUFFER_BIT);  // the catheter is drawn over its slice
  catheter(toScreen);
}
