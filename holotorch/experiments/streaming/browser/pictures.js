// Pictures of the server: the tracked frame behind the catheter, and the panel that the user places.
import { cross, dot, minus, moved, plus, scaled, turned, unit } from "./algebra.js";
import { checked } from "./connection.js";
import { picture, textures, upload } from "./drawing.js";
import { now, state } from "./state.js";

const NAMES = ["camera", "panel"], STALE = 1.0;  // seconds after which a picture is no longer shown
const HEADER = 11;  // bytes before the pose: channel, time of capture, length of the pose
export const pictures = {};  // by name: { captured, pose, latency, count }
// Of the window: place of the left upper corner and width, in shares of it. In a headset: metres, x right, y down, z forward.
export const onScreen = { x: 0.62, y: 0.05, width: 0.35 };
export const inSpace = { middle: [0.25, -0.12, 0.9], right: [1, 0, 0], down: [0, 1, 0], width: 0.4 };

let busy = {};
export async function takePicture(buffer) {
  const header = new DataView(buffer), name = NAMES[header.getUint8(0)], captured = header.getFloat64(1, true);
  if (!name) throw new Error("a picture of an unknown channel");
  const start = HEADER + header.getUint16(HEADER - 2, true), words = new Uint8Array(buffer, HEADER, start - HEADER);
  const pose = words.length ? checked(JSON.parse(new TextDecoder().decode(words))) : null;
  if (busy[name]) return;  // decoding takes longer than a frame: show the next one
  busy[name] = true;
  try {
    const bitmap = await createImageBitmap(new Blob([new Uint8Array(buffer, start)], { type: "image/jpeg" }));
    upload(name, bitmap);
    bitmap.close();
    const latency = state.offset === null ? null : now() + state.offset - captured;
    pictures[name] = { captured, pose, latency, count: (pictures[name] ? pictures[name].count : 0) + 1 };
  } finally { busy[name] = false; }
}
export const fresh = (name) => pictures[name] && state.offset !== null && now() + state.offset - pictures[name].captured < STALE;
const SCREEN = new Float64Array([2, 0, 0, 0, 0, -2, 0, 0, 0, 0, 1, 0, -1, 1, 0, 1]);  // shares of the window

export function background() {  // the tracked frame fills the picture of the camera
  if (fresh("camera")) picture("camera", SCREEN, [0, 0, 0], [1, 0, 0], [0, 1, 0], 1, true);
}
function height(width) { return width * textures.panel.height / textures.panel.width; }
export function panelOnScreen(canvasWidth, canvasHeight) {
  if (!state.panel || !fresh("panel")) return;
  const { x, y, width } = onScreen, tall = height(width) * canvasWidth / canvasHeight;
  picture("panel", SCREEN, [x, y, 0], [width, 0, 0], [0, tall, 0], 1, true);
}
export function panelInSpace(toScreen) {
  if (!state.panel || !fresh("panel")) return;
  const right = scaled(inSpace.right, inSpace.width), down = scaled(inSpace.down, height(inSpace.width));
  picture("panel", toScreen, plus(inSpace.middle, plus(scaled(right, -0.5), scaled(down, -0.5))), right, down);
}

export function onPanel(x, y, canvasWidth, canvasHeight) {  // whether a point of the window, in shares, is on the panel
  if (!state.panel || !textures.panel) return false;
  const tall = height(onScreen.width) * canvasWidth / canvasHeight;
  return x >= onScreen.x && x <= onScreen.x + onScreen.width && y >= onScreen.y && y <= onScreen.y + tall;
}
export function scalePanel(factor) {  // about its middle
  const width = Math.min(1, Math.max(0.1, onScreen.width * factor));
  onScreen.x += (onScreen.width - width) / 2;
  onScreen.width = width;
}
export function hitsPanel(from, towards) {  // whether a ray of a controller meets the panel in space
  if (!state.panel || !textures.panel) return false;
  const normal = cross(inSpace.right, inSpace.down), slope = dot(normal, towards);
  const distance = dot(normal, minus(inSpace.middle, from)) / slope;
  if (!(distance > 0)) return false;
  const at = minus(plus(from, scaled(towards, distance)), inSpace.middle);
  return Math.abs(dot(at, inSpace.right)) < inSpace.width / 2 && Math.abs(dot(at, inSpace.down)) < height(inSpace.width) / 2;
}
export function carryPanel(start, change, scale) {  // by the motion of a controller since it took hold
  Object.assign(inSpace, {
    middle: moved(change, start.middle), right: unit(turned(change, start.right)), down: unit(turned(change, start.down)),
    width: Math.min(3, Math.max(0.1, start.width * scale)),
  });
}
