// A headset of two eyes, 60 mm apart, turned and shifted in its space, and a controller, for pages that ask for WebXR.
// It draws into the halves of the canvas.
const eye = (x) => {
  const [c, s] = [Math.cos(0.1), Math.sin(0.1)];
  // Rows of the map from the eye to the space: a turn about y, and the place of the eye.
  const to = [[c, 0, -s, x], [0, 1, 0, 0.02], [s, 0, c, 0.05], [0, 0, 0, 1]];
  const back = [0, 1, 2].map((i) => [to[0][i], to[1][i], to[2][i],
                                     -(to[0][i] * to[0][3] + to[1][i] * to[1][3] + to[2][i] * to[2][3])]);
  const all = [0, 1, 2, 3], flat = (rows) => new Float32Array(
    all.flatMap((column) => all.map((row) => (rows[row] || [0, 0, 0, 1])[column])));
  const [f, near, far] = [1.1, 0.01, 20];
  const projection = [[f, 0, 0.05 * Math.sign(x), 0], [0, 1.3, 0, 0],
                      [0, 0, (far + near) / (near - far), 2 * far * near / (near - far)], [0, 0, -1, 0]];
  return { right: x > 0, projectionMatrix: flat(projection), transform: { inverse: { matrix: flat(back) } } };
};
window.asked = [];
window.hand = { gripSpace: { matrix: null }, targetRaySpace: { matrix: null } };  // a controller; matrices of WebXR
window.XRWebGLLayer = class {
  constructor(session, gl) { this.framebuffer = null; this.canvas = gl.canvas; }
  getViewport(view) {
    const [width, height] = [this.canvas.width / 2, this.canvas.height];
    return { x: view.right ? width : 0, y: 0, width, height };
  }
};
Object.defineProperty(navigator, "xr", { value: {
  isSessionSupported: async (mode) => mode === "immersive-vr",
  requestSession: async (mode) => {
    const session = new EventTarget(), views = [eye(-0.03), eye(0.03)];
    let over = false;
    session.renderState = {};
    session.updateRenderState = (given) => Object.assign(session.renderState, given);
    session.requestReferenceSpace = async (kind) => { asked.push(mode, kind); return { kind }; };
    session.requestAnimationFrame = (draw) => requestAnimationFrame(
      (time) => { if (!over) draw(time, { getViewerPose: () => ({ views }),
        getPose: ({ matrix }) => matrix && { transform: { matrix } } }); });
    window.press = (name) => session.dispatchEvent(Object.assign(new Event(name), { inputSource: hand }));
    session.end = () => { over = true; session.dispatchEvent(new Event("end")); };
    return session;
  },
} });
WebGL2RenderingContext.prototype.makeXRCompatible = async () => {};
