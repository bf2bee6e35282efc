// Dragging a picture, or its arrow keys, turns the volume.
import { has, set, values } from "./controls.js";

const PER_PIXEL = 0.5, PER_KEY = 5;  // degrees
const KEYS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };

function turn(right, down) {
  const { azimuth, elevation } = values();
  const whole = (angle) => ((angle + 180) % 360 + 360) % 360 - 180;  // a volume turns on and on about the vertical
  const slider = document.getElementById("azimuth"), middle = (Number(slider.min) + Number(slider.max)) / 2;
  set("azimuth", middle + whole(azimuth + right - middle));
  set("elevation", elevation + down);
}

export function offerTurning(canvas) {
  if (!has("azimuth")) return;
  let rest = [0, 0];  // degrees that are less than a step of the sliders
  canvas.classList.add("turns");
  canvas.tabIndex = 0;
  canvas.title = "drag, or use the arrow keys, to turn the volume";
  canvas.onpointerdown = (event) => { canvas.setPointerCapture(event.pointerId); rest = [0, 0]; };
  canvas.onpointermove = (event) => {
    if (!event.buttons) return;
    rest = [rest[0] + PER_PIXEL * event.movementX, rest[1] + PER_PIXEL * event.movementY];
    const [right, down] = rest.map(Math.trunc);
    if (right || down) turn(right, down);
    rest = [rest[0] - right, rest[1] - down];
  };
  canvas.onkeydown = (event) => {
    if (!(event.key in KEYS)) return;
    event.preventDefault();
    turn(...KEYS[event.key].map((sign) => sign * PER_KEY));
  };
}
