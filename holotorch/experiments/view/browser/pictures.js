// The pictures with their captions, and the numbers below them.

const box = document.getElementById("pictures"), list = document.getElementById("numbers");
const shown = new Map();  // canvas and caption by the name of a picture

// made(canvas): called for each new canvas
export async function draw(header, files, made) {
  const bitmaps = await Promise.all(files.map((file) => createImageBitmap(file)));
  const names = header.pictures.map(({ name }) => name);
  // While a control moves, only some pictures follow; the others stay.
  const stays = header.coarse && names.every((name) => shown.has(name));
  for (const [name, { figure }] of shown) {
    if (!stays && !names.includes(name)) { figure.remove(); shown.delete(name); }
  }
  header.pictures.forEach(({ name, caption }, i) => {
    if (!shown.has(name)) shown.set(name, figure(made));
    const { figure: place, canvas, words } = shown.get(name);
    if (canvas.width !== bitmaps[i].width || canvas.height !== bitmaps[i].height) {
      [canvas.width, canvas.height] = [bitmaps[i].width, bitmaps[i].height];
    }
    canvas.getContext("2d").drawImage(bitmaps[i], 0, 0);
    canvas.id = `picture-${name}`;
    canvas.setAttribute("aria-label", caption);
    words.textContent = caption;
    if (!place.isConnected) box.append(place);
  });
  list.replaceChildren(...header.numbers.map(([name, value]) => {
    const row = document.createElement("div"), term = document.createElement("dt"), text = document.createElement("dd");
    [term.textContent, text.textContent] = [name, value];
    row.append(term, text);
    return row;
  }));
}

function figure(made) {
  const place = document.createElement("figure"), canvas = document.createElement("canvas");
  const words = document.createElement("figcaption");
  canvas.setAttribute("role", "img");
  place.append(canvas, words);
  made(canvas);
  return { figure: place, canvas, words };
}
