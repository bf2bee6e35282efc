// The page of `holotorch view`: it asks for pictures while a control moves, and for fine ones when it rests.
import { connect } from "./connection.js";
import { build, set, values } from "./controls.js";
import { draw } from "./pictures.js";
import { offerTurning } from "./turning.js";

const REST = 250;  // ms after the last movement until a fine picture is asked for
const status = document.getElementById("status");
const state = { asked: 0, drawn: 0, coarse: false, error: "", connected: false };
window.view = { state, set, values };
let timer = 0, queue = Promise.resolve();  // pictures are drawn in the order in which they come

function say(text, warn = false) {
  status.textContent = text;
  status.className = warn ? "warn" : "";
}
function ask(coarse) {
  state.asked += 1;
  link.send({ number: state.asked, values: values(), coarse });
}
function moved() {
  ask(true);
  clearTimeout(timer);
  timer = setTimeout(() => { if (state.coarse || state.drawn < state.asked) ask(false); }, REST);
}

async function picture(header, files) {
  if (header.number < state.drawn) return;
  await draw(header, files, offerTurning);
  Object.assign(state, { drawn: header.number, coarse: header.coarse, error: "" });
  say(`${(1e3 * header.seconds).toFixed(0)} ms${header.coarse ? ", coarse while it moves" : ""}`);
  // A coarse picture may come when nothing moves any more.
  if (header.coarse && header.number === state.asked) {
    clearTimeout(timer);
    timer = setTimeout(() => ask(false), REST);
  }
}

const link = connect({
  setup({ title, note, controls }) {
    document.title = `${title} - holotorch view`;
    document.getElementById("title").textContent = title;
    document.getElementById("note").textContent = note;
    build(controls, moved);
    say("computing");
    ask(false);
  },
  picture(header, files) {
    queue = queue.then(() => picture(header, files)).catch((error) => say(String(error), true));
  },
  refused({ number, text }) {
    if (number < state.drawn) return;
    Object.assign(state, { drawn: number, error: text });
    say(text, true);
  },
  changed(connected) {
    state.connected = connected;
    if (!connected) say("no connection: is holotorch view still running? Trying again.", true);
  },
});
