// From spectra to the display's sRGB, as nishiki.colour and nishiki.render.display compute it.
// Matrices are arrays of rows.

const PRIMARIES = [[0.64, 0.33], [0.3, 0.6], [0.15, 0.06]]; // IEC 61966-2-1
const WHITE = [0.3127 / 0.329, 1, (1 - 0.3127 - 0.329) / 0.329];
const BRADFORD = [[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]];
const LEAST_CONE = 0.01; // response of a lamp's white, relative to that of the white that it is brought to
const SECOND_RADIATION = 1.438777e7; // nm K, Planck's law
export const ADAPTED = { percentile: 0.98, level: 0.8, bounds: [0.5, 8] };

export const apply = (matrix, vector) => matrix.map((row) => row.reduce((sum, value, k) => sum + value * vector[k], 0));
export const product = (a, b) => a.map((row) => b[0].map((_, j) => row.reduce((sum, value, k) => sum + value * b[k][j], 0)));

/** Inverse of a 3 x 3 matrix. */
export function inverse(m) {
  const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
  const columns = [cross(m[1], m[2]), cross(m[2], m[0]), cross(m[0], m[1])];
  const determinant = m[0].reduce((sum, value, k) => sum + value * columns[0][k], 0);
  return [0, 1, 2].map((i) => columns.map((column) => column[i] / determinant));
}

/** (3, 3) from XYZ, relative to D65, to linear sRGB. */
export function srgbMatrix() {
  const xyz = [0, 1, 2].map((i) => PRIMARIES.map(([x, y]) => [x, y, 1 - x - y][i]));
  const scale = apply(inverse(xyz), WHITE);
  return inverse(xyz.map((row) => row.map((value, k) => value * scale[k])));
}

/** (3, 3) Bradford adaptation of XYZ from one white to another; of the luminance alone for lamps that show no white. */
export function adaptation(from, to = WHITE) {
  const source = apply(BRADFORD, from), goal = apply(BRADFORD, to);
  if (!source.every((value, k) => value * to[1] > LEAST_CONE * goal[k] * from[1])) {
    return [0, 1, 2].map((i) => [0, 1, 2].map((j) => (i === j ? to[1] / from[1] : 0)));
  }
  return product(inverse(BRADFORD), BRADFORD.map((row, k) => row.map((value) => (value * goal[k]) / source[k])));
}

/** XYZ (3, K) of K spectra on the working grid under a lamp, Y = 1 for the perfect white. cmf: (61, 3). */
export function xyzMatrix(lamp, spectra, cmf) {
  const total = lamp.reduce((sum, power, k) => sum + power * cmf[k][1], 0);
  return [0, 1, 2].map((c) => spectra.map((s) => s.reduce((sum, value, k) => sum + value * lamp[k] * cmf[k][c], 0) / total));
}

/** XYZ of the perfect white under a lamp. */
export const whiteOf = (lamp, cmf) => xyzMatrix(lamp, [lamp.map(() => 1)], cmf).map((row) => row[0]);

/** Power (61) of a lamp: a name of the manifest's illuminants, {kelvin} of a black body, or {csv: {nm, power}}. */
export function powerOf(choice, manifest) {
  const grid = manifest.wavelengths_nm;
  if (typeof choice === "string") {
    const known = manifest.illuminants[choice];
    if (!known) throw new Error(`unknown illuminant ${choice}`);
    return interpolated(known.nm, known.power, grid);
  }
  if (choice.kelvin) {
    const planck = (nm) => (560 / nm) ** 5 * (Math.expm1(SECOND_RADIATION / (choice.kelvin * 560)) / Math.expm1(SECOND_RADIATION / (choice.kelvin * nm)));
    return grid.map((nm) => 100 * planck(nm));
  }
  return interpolated(choice.csv.nm, choice.csv.power, grid);
}

/** Linear interpolation of a table at the nodes of a grid; held at its ends. */
function interpolated(nm, power, grid) {
  let k = 0;
  return grid.map((at) => {
    while (k < nm.length - 2 && nm[k + 1] < at) k++;
    const share = nm.length > 1 ? (at - nm[k]) / (nm[k + 1] - nm[k]) : 0;
    const clamped = Math.min(Math.max(share, 0), 1);
    return power[k] * (1 - clamped) + (power[k + 1] ?? 0) * clamped;
  });
}

/** Factor at which an eye adapted to the light sees a picture, two digits. bright: the percentile of its luminance. */
export function adaptedExposure(bright, sheet) {
  if (!(sheet > 0)) return 1;
  const [low, high] = ADAPTED.bounds.map((bound) => bound / sheet);
  const factor = bright > 0 ? ADAPTED.level / bright : Infinity;
  return Number(Math.min(Math.max(factor, low), high).toPrecision(2));
}

/** Code 0 ... 1 of linear sRGB, clipped. */
export function encode(linear) {
  const value = Math.min(Math.max(linear, 0), 1);
  return value <= 0.0031308 ? 12.92 * value : 1.055 * value ** (1 / 2.4) - 0.055;
}

/** Linear light of an sRGB code, 0..1 (IEC 61966-2-1). */
export const decode = (code) => (code <= 0.04045 ? code / 12.92 : ((code + 0.055) / 1.055) ** 2.4);
