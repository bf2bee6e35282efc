// The connection to the server: one request at a time is on its way, and only the newest one is worth an answer.

// handlers: setup (the controls), picture (header, PNG files), refused (the reason), changed (connected or not)
export function connect(handlers, link = { send: () => false }, wait = 250) {
  const address = new URL("pictures" + location.search, location.href);
  address.protocol = "ws:";
  const socket = new WebSocket(address);
  socket.binaryType = "arraybuffer";
  socket.onopen = () => {
    link.send = (message) => {
      if (socket.readyState !== 1) return false;
      socket.send(JSON.stringify(message));
      return true;
    };
    handlers.changed(true);
    wait = 250;
  };
  socket.onmessage = (event) => {
    if (event.data instanceof ArrayBuffer) return handlers.picture(...unpacked(event.data));
    const message = JSON.parse(event.data);
    return handlers[message.kind](message);
  };
  socket.onclose = () => {
    link.send = () => false;
    handlers.changed(false);
    setTimeout(() => connect(handlers, link, Math.min(2 * wait, 4000)), wait);
  };
  return link;
}

// The header of a binary message, and its files; see server.py.
function unpacked(buffer) {
  const length = new DataView(buffer).getUint32(0, true);
  const header = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, length)));
  let at = 4 + length;
  const files = header.pictures.map(({ bytes }) => {
    at += bytes;
    return new Blob([new Uint8Array(buffer, at - bytes, bytes)], { type: "image/png" });
  });
  return [header, files];
}
