// Vectors as arrays of three numbers; matrices of 4 x 4 by columns, as in WebGL. Metres.
export const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
export const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
export const scaled = (a, s) => a.map((x) => x * s);
export const plus = (a, b) => a.map((x, i) => x + b[i]);
export const minus = (a, b) => a.map((x, i) => x - b[i]);
export const unit = (a) => scaled(a, 1 / Math.hypot(...a));
export const columns = (x, y, z, t) => new Float64Array([...x, 0, ...y, 0, ...z, 0, ...t, 1]);

// WebXR's axes are x right, y up, z backward; ours x right, y down, z forward.
export const FLIP = new Float64Array([1, 0, 0, 0, 0, -1, 0, 0, 0, 0, -1, 0, 0, 0, 0, 1]);

export function times(a, b) {
  const out = new Float64Array(16);
  for (let c = 0; c < 4; c++) for (let r = 0; r < 4; r++)
    for (let k = 0; k < 4; k++) out[4 * c + r] += a[4 * k + r] * b[4 * c + k];
  return out;
}
export function apply(m, p) {  // homogeneous product with the point p
  return [0, 1, 2, 3].map((r) => m[r] * p[0] + m[4 + r] * p[1] + m[8 + r] * p[2] + m[12 + r]);
}
export const moved = (m, p) => apply(m, p).slice(0, 3);
export const turned = (m, p) => minus(moved(m, p), moved(m, [0, 0, 0]));
export function inverse(m) {  // of a rotation and a shift
  const rows = [0, 1, 2].map((c) => [m[4 * c], m[4 * c + 1], m[4 * c + 2]]), shift = [m[12], m[13], m[14]];
  const [x, y, z] = [0, 1, 2].map((r) => rows.map((row) => row[r]));
  return columns(x, y, z, rows.map((row) => -dot(row, shift)));
}
export function rotated(vector, axis, angle) {  // about a unit vector, right-handed
  const [c, s] = [Math.cos(angle), Math.sin(angle)];
  return plus(plus(scaled(vector, c), scaled(cross(axis, vector), s)), scaled(axis, dot(axis, vector) * (1 - c)));
}
export function cholesky(c) {  // of a symmetric 3 x 3 matrix, row by row; columns of the lower triangle
  const l = [[0, 0, 0], [0, 0, 0], [0, 0, 0]];
  for (let i = 0; i < 3; i++) for (let j = 0; j <= i; j++) {
    let s = c[3 * i + j];
    for (let k = 0; k < j; k++) s -= l[i][k] * l[j][k];
    l[i][j] = i === j ? Math.sqrt(Math.max(s, 1e-16)) : s / l[j][j];
  }
  return [[l[0][0], l[1][0], l[2][0]], [0, l[1][1], l[2][1]], [0, 0, l[2][2]]];
}
export function projection(near, far, fx, fy, cx, cy, width, height) {
  // Pixel (u, v) has its centre at u + 1/2, v + 1/2 of the picture.
  const a = (far + near) / (far - near), b = (-2 * far * near) / (far - near);
  return new Float64Array([
    2 * fx / width, 0, 0, 0, 0, -2 * fy / height, 0, 0,
    2 * (cx + 0.5) / width - 1, 1 - 2 * (cy + 0.5) / height, a, 1, 0, 0, b, 0,
  ]);
}
