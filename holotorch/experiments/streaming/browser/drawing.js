// WebGL: the catheter, its virtual twin, the ellipsoid of the tip, pictures, and slices of a volume.
import { cholesky, columns, cross, plus, scaled, unit } from "./algebra.js";
import { current, state } from "./state.js";

const INSIDE = Math.sqrt(7.815);  // radius of the 95 % ellipsoid of three dimensions in standard deviations
export const canvas = document.getElementById("canvas");
export const gl = canvas.getContext("webgl2", { antialias: true, preserveDrawingBuffer: true });

const solid = build(`#version 300 es
in vec3 place; uniform mat4 toScreen; uniform mat4 toScene; out vec3 normal;
uniform float round; void main() {
  normal = mat3(toScene) * vec3(place.xy, place.z * round);
  gl_Position = toScreen * toScene * vec4(place, 1.0); }`, `#version 300 es
precision highp float; in vec3 normal; uniform vec4 colour; out vec4 shown;
void main() { float lit = 0.45 + 0.55 * abs(normalize(normal).z); shown = vec4(colour.rgb * lit, colour.a); }`);
// A rectangle from a corner along two sides; the textures' rows run from the top down.
const RECTANGLE = `#version 300 es
in vec3 place; uniform mat4 toScreen; uniform vec3 corner, right, down; out vec2 at; out vec3 point;
void main() { at = place.xy; point = corner + at.x * right + at.y * down; gl_Position = toScreen * vec4(point, 1.0); }`;
const flat = build(RECTANGLE, `#version 300 es
precision highp float; in vec2 at; uniform sampler2D picture; uniform float alpha; out vec4 shown;
void main() { vec4 c = texture(picture, at); shown = vec4(c.rgb, c.a * alpha); }`);
const cut = build(RECTANGLE, `#version 300 es
precision highp float; precision highp sampler3D; in vec3 point; uniform sampler3D volume; uniform mat4 toTexture;
uniform float low, span, alpha; out vec4 shown; void main() {
  vec3 t = (toTexture * vec4(point, 1.0)).xyz;
  if (any(lessThan(t, vec3(0.0))) || any(greaterThan(t, vec3(1.0)))) discard;
  shown = vec4(vec3(clamp((texture(volume, t).r - low) / span, 0.0, 1.0)), alpha); }`);
const meshes = {
  tube: mesh(tube(40)), ball: mesh(ball(24)),
  square: mesh([0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 1, 0, 1, 0, 0, 1, 1, 0]),
};

function build(...sources) {
  const made = gl.createProgram();
  [gl.VERTEX_SHADER, gl.FRAGMENT_SHADER].forEach((kind, i) => {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, sources[i]);
    gl.compileShader(shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
    gl.attachShader(made, shader);
  });
  gl.bindAttribLocation(made, 0, "place");
  gl.linkProgram(made);
  return made;
}
function tube(n) {  // radius 1 about z, from 0 to 1
  const out = [];
  for (let i = 0; i < n; i++) {
    const [a, b] = [2 * Math.PI * i / n, 2 * Math.PI * (i + 1) / n];
    const [p, q] = [[Math.cos(a), Math.sin(a)], [Math.cos(b), Math.sin(b)]];
    out.push(...p, 0, ...q, 0, ...p, 1, ...q, 0, ...q, 1, ...p, 1, 0, 0, 0, ...q, 0, ...p, 0, 0, 0, 1, ...p, 1, ...q, 1);
  }
  return out;
}
function ball(n) {
  const at = (i, j) => {
    const [a, b] = [Math.PI * i / n, 2 * Math.PI * j / n];
    return [Math.sin(a) * Math.cos(b), Math.sin(a) * Math.sin(b), Math.cos(a)];
  };
  const out = [];
  for (let i = 0; i < n; i++) for (let j = 0; j < n; j++)
    out.push(...at(i, j), ...at(i + 1, j), ...at(i, j + 1), ...at(i, j + 1), ...at(i + 1, j), ...at(i + 1, j + 1));
  return out;
}
function mesh(corners) {
  const array = gl.createVertexArray();
  gl.bindVertexArray(array);
  gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
  gl.bufferData(gl.ARRAY_BUFFER, new Float32Array(corners), gl.STATIC_DRAW);
  gl.enableVertexAttribArray(0);
  gl.vertexAttribPointer(0, 3, gl.FLOAT, false, 0, 0);
  return { array, count: corners.length / 3 };
}
function draw(program, shape, uniforms) {  // numbers, vectors and matrices by the names of the shader
  gl.useProgram(program);
  for (const [name, value] of Object.entries(uniforms)) {
    const place = gl.getUniformLocation(program, name), size = value.length;
    if (size === undefined) gl.uniform1f(place, value);
    else if (size === 16) gl.uniformMatrix4fv(place, false, new Float32Array(value));
    else gl[`uniform${size}fv`](place, value);
  }
  gl.bindVertexArray(meshes[shape].array);
  gl.drawArrays(gl.TRIANGLES, 0, meshes[shape].count);
}

export function clear([x, y, width, height], colour) {
  gl.viewport(x, y, width, height);
  gl.enable(gl.SCISSOR_TEST);
  gl.scissor(x, y, width, height);
  gl.clearColor(...colour);
  gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
}
function blended() {
  gl.enable(gl.DEPTH_TEST);
  gl.enable(gl.BLEND);
  gl.blendFunc(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA);
}

function tool(toScreen, { tip, direction }, parts) {  // parts: [from, to, colour, alpha] along the catheter
  const { radius } = state.setup.catheter;
  const x = unit(cross(Math.abs(direction[0]) < 0.9 ? [1, 0, 0] : [0, 1, 0], direction)), y = cross(direction, x);
  for (const [from, to, colour, alpha] of parts) {
    const start = plus(tip, scaled(direction, from));
    const toScene = columns(scaled(x, radius), scaled(y, radius), scaled(direction, to - from), start);
    draw(solid, "tube", { toScreen, toScene, colour: [...colour, alpha], round: 0 });
  }
}
export function catheter(toScreen) {
  blended();
  const pose = current(), { edges, colours, length } = state.setup.catheter;
  const shade = (colour) => (state.refused ? [0.5, 0.5, 0.5] : colour);
  const parts = edges.slice(0, -1).map((edge, i) => [edge, edges[i + 1], shade(colours[i].map((c) => c / 255)), state.alpha]);
  parts.push([edges.at(-1), length, shade([0.8, 0.8, 0.8]), state.alpha]);
  parts.push([0, edges[0], shade([0.45, 0.8, 1.0]), 0.55 * state.alpha]);  // hidden: from the tip to the first band
  tool(toScreen, pose, parts);
  const toScene = columns(...cholesky(pose.covariance).map((axis) => scaled(axis, INSIDE)), pose.tip);
  gl.depthMask(false);
  draw(solid, "ball", { toScreen, toScene, colour: [1.0, 0.85, 0.2, 0.4 * state.alpha], round: 1 });
  gl.depthMask(true);
}
export function twin(toScreen, colour) {  // the virtual catheter onto which the user puts the real one
  blended();
  const { edges, length } = state.setup.catheter, middle = edges[1];
  tool(toScreen, state.twin, [[0, edges[0], colour, 0.75], [edges[0], middle, [1, 1, 1], 0.6],
    [middle, edges.at(-1), colour, 0.6], [edges.at(-1), length, colour, 0.3]]);
}

export const textures = {};  // by name: { texture, width, height }
export function upload(name, source) {  // in a headset, where pictures are small, with reduced copies of them
  const { width, height } = source;
  const texture = (textures[name] || { texture: gl.createTexture() }).texture;
  textures[name] = { texture, width, height };
  gl.bindTexture(gl.TEXTURE_2D, texture);
  gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, gl.RGBA, gl.UNSIGNED_BYTE, source);
  const reduced = state.headset !== "";
  if (reduced) gl.generateMipmap(gl.TEXTURE_2D);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, reduced ? gl.LINEAR_MIPMAP_LINEAR : gl.LINEAR);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.LINEAR);
  for (const name of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(gl.TEXTURE_2D, name, gl.CLAMP_TO_EDGE);
}
export function picture(name, toScreen, corner, right, down, alpha = 1, behind = false) {
  blended();
  if (behind) gl.disable(gl.DEPTH_TEST);
  gl.bindTexture(gl.TEXTURE_2D, textures[name].texture);
  draw(flat, "square", { toScreen, corner, right, down, alpha });
}

let samples = null;
export async function loadVolume(volume) {  // half floats, x fastest
  const answer = await fetch("volume" + location.search);
  const data = new Uint16Array(await answer.arrayBuffer()), [depth, height, width] = volume.shape;
  samples = samples || gl.createTexture();
  gl.bindTexture(gl.TEXTURE_3D, samples);
  gl.pixelStorei(gl.UNPACK_ALIGNMENT, 2);
  gl.texImage3D(gl.TEXTURE_3D, 0, gl.R16F, width, height, depth, 0, gl.RED, gl.HALF_FLOAT, data);
  gl.pixelStorei(gl.UNPACK_ALIGNMENT, 4);
  for (const name of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_3D, name, gl.LINEAR);
  for (const name of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T, gl.TEXTURE_WRAP_R])
    gl.texParameteri(gl.TEXTURE_3D, name, gl.CLAMP_TO_EDGE);
}
export function slice(toScreen, corner, right, down, alpha) {
  const { volume } = state.setup, range = volume.high - volume.low;
  if (!samples) return;
  blended();
  gl.bindTexture(gl.TEXTURE_3D, samples);
  const low = (state.level - state.window / 2 - volume.low) / range;
  draw(cut, "square", { toScreen, corner, right, down, alpha, toTexture: volume.matrix, low, span: state.window / range });
}
