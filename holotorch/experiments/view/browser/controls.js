// The sliders and choices of a run, with their labels, units and explanations.

const form = document.getElementById("controls");
let controls = [];

export function values() {
  return Object.fromEntries(controls.map((control) => [control.name, control.read()]));
}
export const has = (name) => controls.some((control) => control.name === name);

// Set a value, within the limits of its control, as a user would do.
export function set(name, value) {
  const { input } = controls.find((control) => control.name === name);
  input.value = value;
  input.dispatchEvent(new Event("input"));
}

// moved(): the user moves a control
export function build(described, moved) {
  controls = described.map((each) => control(each, moved));
  const reset = element("button", { type: "button", textContent: "As in the run" });
  reset.onclick = () => { for (const each of controls) each.reset(); moved(); };
  form.replaceChildren(...controls.map((each) => each.row), reset);
  for (const each of controls) each.write();
}
form.onsubmit = (event) => event.preventDefault();

function control(described, moved) {
  const { name, label, unit, kind } = described;
  const slider = kind === "slider";
  const input = slider
    ? element("input", { type: "range", min: described.low, max: described.high, step: described.step })
    : element("select", {}, described.options.map(([value, text]) => element("option", { value, textContent: text })));
  Object.assign(input, { id: name, value: described.value });
  const output = element("output", { htmlFor: name });
  const row = element("div", { className: "control" },
    [element("label", { htmlFor: name, textContent: label }), output, input]);
  if (described.explanation) {
    row.append(element("div", { className: "help", id: `${name}-help`, textContent: described.explanation }));
    input.setAttribute("aria-describedby", `${name}-help`);
  }
  let untouched = true;
  const digits = slider ? Math.max(0, Math.min(6, Math.ceil(-Math.log10(described.step) - 1e-9))) : 0;
  // The position of a slider is rounded to its step; the value at the start may lie between.
  const read = () => (!slider ? input.value : untouched ? described.value : Number(input.value));
  const write = () => {
    if (!slider) return;
    const text = `${read().toFixed(digits)}${unit ? " " + unit : ""}`;
    output.textContent = text;
    input.setAttribute("aria-valuetext", text);
  };
  input.oninput = () => { untouched = false; write(); moved(); };
  const reset = () => { untouched = true; input.value = described.value; write(); };
  return { name, input, row, read, write, reset };
}

function element(tag, properties, children = []) {
  const made = Object.assign(document.createElement(tag), properties);
  made.append(...children);
  return made;
}
