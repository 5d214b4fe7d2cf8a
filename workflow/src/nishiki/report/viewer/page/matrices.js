// Vectors of three numbers and matrices as arrays of rows.

export const add = (a, b) => a.map((v, n) => v + b[n]);
export const subtract = (a, b) => a.map((v, n) => v - b[n]);
export const scale = (a, factor) => a.map((v) => v * factor);
export const dot = (a, b) => a.reduce((sum, v, n) => sum + v * b[n], 0);
export const norm = (a) => Math.sqrt(dot(a, a));
export const normalised = (a) => scale(a, 1 / (norm(a) || 1));
export const cross = (a, b) => [
  a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0],
];
export const transpose = (m) => m[0].map((_, j) => m.map((row) => row[j]));
export const apply = (m, v) => m.map((row) => dot(row, v));
export const multiply = (a, b) => {
  const columns = transpose(b);
  return a.map((row) => columns.map((column) => dot(row, column)));
};
export const blend = (a, b, part) =>
  Array.isArray(a) ? a.map((v, n) => blend(v, b[n], part)) : (1 - part) * a + part * b;

/** Rotation about a vector by its length in radians (Rodrigues). */
export function rotationMatrix(vector) {
  const angle = norm(vector);
  const ratio = angle > 1e-9 ? Math.sin(angle) / angle : 1;
  const half = angle > 1e-9 ? (1 - Math.cos(angle)) / angle ** 2 : 0.5;
  const [x, y, z] = vector;
  const turn = [[0, -z, y], [z, 0, -x], [-y, x, 0]];
  const square = multiply(turn, turn);
  return turn.map((row, i) => row.map((v, j) => (i === j ? 1 : 0) + ratio * v + half * square[i][j]));
}

/** Axis times angle of a rotation, radians. */
export function rotationVector(m) {
  const skew = [m[2][1] - m[1][2], m[0][2] - m[2][0], m[1][0] - m[0][1]].map((v) => v / 2);
  const sine = norm(skew), cosine = (m[0][0] + m[1][1] + m[2][2] - 1) / 2;
  const angle = Math.atan2(sine, cosine);
  if (sine > 1e-6) return scale(skew, angle / sine);
  if (cosine > 0) return skew;
  // half a turn: the rotation is 2 a a^T - 1
  const outer = m.map((row, i) => row.map((v, j) => (v + (i === j ? 1 : 0)) / 2));
  const largest = [0, 1, 2].reduce((best, k) => (outer[k][k] > outer[best][best] ? k : best), 0);
  return scale(normalised(outer.map((row) => row[largest])), angle);
}

/** Angle (-pi..pi) of the part of a rotation about a unit axis (swing-twist decomposition). */
export function twist(rotation, axis) {
  const vector = rotationVector(rotation), angle = norm(vector);
  if (angle < 1e-12) return 0;
  return 2 * Math.atan2(Math.sin(angle / 2) * dot(vector, axis) / angle, Math.cos(angle / 2));
}
