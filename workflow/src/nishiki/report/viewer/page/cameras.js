// Cameras of a turntable, as nishiki.geometry has them: captured, between captured ones, and free.

import {
  add, apply, blend, cross, dot, multiply, norm, normalised, rotationMatrix, rotationVector, scale, subtract, transpose,
  twist,
} from "viewer/matrices";

export const centreOf = (camera) => scale(apply(transpose(camera.rotation), camera.translation), -1);

const moved = (camera, rotation, centre) => ({
  ...camera, rotation, translation: scale(apply(rotation, centre), -1),
});

function turned(camera, turn, angle) {
  const spin = rotationMatrix(scale(turn.axis, angle));
  const centre = add(apply(spin, subtract(centreOf(camera), turn.point)), turn.point);
  return moved(camera, multiply(camera.rotation, transpose(spin)), centre);
}

/** The camera at a place along the captured views: 3.25 is a quarter of the way from view 3 to the next. */
export function cameraAlong(views, turn, place) {
  const index = Math.floor(place) % views.length, fraction = place - Math.floor(place);
  if (fraction === 0) return views[index];
  const a = views[index], b = views[(index + 1) % views.length];
  const step = twist(multiply(transpose(b.rotation), a.rotation), turn.axis);
  const ahead = turned(a, turn, fraction * step), behind = turned(b, turn, (fraction - 1) * step);
  const between = rotationVector(multiply(behind.rotation, transpose(ahead.rotation)));
  const rotation = multiply(rotationMatrix(scale(between, fraction)), ahead.rotation);
  const camera = moved(a, rotation, blend(centreOf(ahead), centreOf(behind), fraction));
  return {
    ...camera,
    intrinsics: blend(a.intrinsics, b.intrinsics, fraction),
    distortion: blend(a.distortion, b.distortion, fraction),
  };
}

/** Radians along the turn of a place along the captured views. */
export function positionAlong(turn, place) {
  const index = Math.floor(place) % turn.position.length, fraction = place - Math.floor(place);
  const next = index + 1 < turn.position.length ? turn.position[index + 1] : turn.length;
  return turn.position[index] + fraction * (next - turn.position[index]);
}

/** Radians along the turn at which an eye stands, by its angle about the axis. */
export function positionOfEye(turn, views, eye) {
  const across = (point) => {
    const away = subtract(point, turn.point);
    return subtract(away, scale(turn.axis, dot(away, turn.axis)));
  };
  const first = across(centreOf(views[0])), here = across(eye);
  let angle = Math.atan2(dot(cross(first, here), turn.axis), dot(first, here));
  if (turn.closed) return ((angle % turn.length) + turn.length) % turn.length;
  const middle = turn.length / 2;
  while (angle < middle - Math.PI) angle += 2 * Math.PI;
  return Math.min(Math.max(angle, 0), turn.length);
}

/** Captured views around a position and their weights: the nearest one to each side, or the one that stands there. */
export function neighbours(turn, position, without = []) {
  let places = turn.position.map((at, view) => ({ view, offset: at - position }));
  places = places.filter(({ view }) => !without.includes(view));
  if (turn.closed) {
    for (const place of places) {
      const shifted = (place.offset + turn.length / 2) % turn.length;
      place.offset = ((shifted + turn.length) % turn.length) - turn.length / 2;
    }
  }
  places.sort((a, b) => a.offset - b.offset);
  const exact = places.find(({ offset }) => Math.abs(offset) <= 1e-9 * turn.length);
  if (exact || places.length === 1) return [{ view: (exact || places[0]).view, weight: 1 }];
  const after = places.findIndex(({ offset }) => offset >= 0);
  let before = (after < 0 ? places.length : after) - 1;
  if (!turn.closed && (before < 0 || after < 0)) {
    return [{ view: places[before < 0 ? 0 : places.length - 1].view, weight: 1 }];
  }
  const later = after < 0 ? { ...places[0], offset: places[0].offset + turn.length } : places[after];
  const earlier = before < 0
    ? { ...places[places.length - 1], offset: places[places.length - 1].offset - turn.length } : places[before];
  const span = later.offset - earlier.offset;
  return [{ view: earlier.view, weight: later.offset / span }, { view: later.view, weight: -earlier.offset / span }];
}

/** Column and row of a point in a camera's picture, by Brown's distortion. */
export function projected(camera, point) {
  const { intrinsics: k, distortion: [k1, k2, p1, p2, k3] } = camera;
  const [x, y, depth] = add(apply(camera.rotation, point), camera.translation), [u, v] = [x / depth, y / depth];
  const square = u * u + v * v, radial = 1 + square * (k1 + square * (k2 + square * k3));
  const a = u * radial + 2 * p1 * u * v + p2 * (square + 2 * u * u), b = v * radial + p1 * (square + 2 * v * v) + 2 * p2 * u * v;
  return [k[0][0] * a + k[0][1] * b + k[0][2], k[1][1] * b + k[1][2]];
}

/** A pinhole camera at `eye` towards `target`; fov_deg: vertical. */
export function lookAt({ eye, target, up, fov_deg }, rows, columns) {
  const ahead = normalised(subtract(target, eye));
  const right = normalised(cross(ahead, up));
  const rotation = [right, scale(cross(right, ahead), -1), ahead];
  const focal = rows / (2 * Math.tan((fov_deg * Math.PI) / 360));
  const intrinsics = [[focal, 0, (columns - 1) / 2], [0, focal, (rows - 1) / 2], [0, 0, 1]];
  const translation = scale(apply(rotation, eye), -1);
  return { intrinsics, rotation, translation, distortion: [0, 0, 0, 0, 0], rows, columns };
}

/** The same camera with its picture fitted into the middle of a region of other size. */
export function fitted(camera, rows, columns) {
  const factor = Math.min(rows / camera.rows, columns / camera.columns);
  const shift = (size, own) => 0.5 * factor - 0.5 + (size - factor * own) / 2;
  const change = [[factor, 0, shift(columns, camera.columns)], [0, factor, shift(rows, camera.rows)], [0, 0, 1]];
  return { ...camera, intrinsics: multiply(change, camera.intrinsics), rows, columns };
}

/** The same camera with its picture {width, height} so many times larger, the place `from` brought to `to`: both [x, y] as
 * parts of the picture. */
export function enlarged(camera, { times, from, to }, { width, height }) {
  const shift = (k, size) => (to[k] - times * from[k]) * size + 0.5 * (times - 1);
  return { ...camera, intrinsics: multiply([[times, 0, shift(0, width)], [0, times, shift(1, height)], [0, 0, 1]], camera.intrinsics) };
}

/** Eye, target, up and field of view of a camera whose target lies beside `centre`. */
export function freeView(camera, centre) {
  const eye = centreOf(camera), [, down, ahead] = camera.rotation;
  const target = add(eye, scale(ahead, Math.max(dot(subtract(centre, eye), ahead), 1e-6 * norm(eye))));
  const fov_deg = (360 / Math.PI) * Math.atan(camera.rows / (2 * camera.intrinsics[1][1]));
  return { eye, target, up: scale(down, -1), fov_deg, captured: null };
}

/** Matrix from the scene to a picture {width, height} of a camera, or to a part of it with its corner {x, y}; shift: in
 * pixels; near, far: depths between which something is drawn. */
export function screenMatrix({ intrinsics, rotation, translation }, { width, height, x = 0, y = 0 }, shift, near, far) {
  const [columns, rows] = [intrinsics[0][2] + 0.5 - x + shift[0], intrinsics[1][2] + 0.5 - y + shift[1]];
  const lens = [
    [(2 * intrinsics[0][0]) / width, 0, (2 * columns) / width - 1],
    [0, (-2 * intrinsics[1][1]) / height, 1 - (2 * rows) / height],
    [0, 0, (far + near) / (far - near)], [0, 0, 1],
  ];
  const world = rotation.map((row, n) => [...row, translation[n]]);
  return lens.map((row, n) => [0, 1, 2, 3].map((c) => row.reduce((sum, v, m) => sum + v * world[m][c], n === 2 && c === 3 ? (-2 * far * near) / (far - near) : 0)));
}
