// Moving over a flat scene: a view is {x, y, zoom, tilt_deg, azimuth_deg}: the point in the middle, how much larger than
// fitted, and where the eye stands: so far from the front, towards this direction, from the right upwards.
import { MOST_TILT } from "viewer/plane_view";

const MOST_ZOOM = 400, LEAST_ZOOM = 0.5;

/** `state.view` with the point at (x, y) of the canvas kept in its place, `factor` times larger. */
export function zoomed(scene, state, factor, x, y) {
  const zoom = Math.min(Math.max(state.view.zoom * factor, LEAST_ZOOM), MOST_ZOOM);
  return inside(scene, enlarged(scene, state, zoom / state.view.zoom, [x, y], [x, y]).view);
}

/** A state whose picture is so many times larger, with the place at the pixel `from` of the canvas at `to`. */
export function enlarged(scene, state, times, from, to) {
  const view = { ...state.view, zoom: times * state.view.zoom };
  const [px, py] = scene.toScene(...from, state), [qx, qy] = scene.toScene(...to, { ...state, view });
  return { ...state, view: { ...view, x: view.x + px - qx, y: view.y + py - qy } };
}

/** `state.view` moved by (dx, dy) pixels of the canvas. */
export function panned(scene, state, dx, dy) {
  const [x0, y0] = scene.toScene(0, 0, state), [x1, y1] = scene.toScene(dx, dy, state);
  return inside(scene, { ...state.view, x: state.view.x - (x1 - x0), y: state.view.y - (y1 - y0) });
}

/** `state.view` with the eye moved by so many degrees to the right and up. */
export function tilted({ view }, right, up) {
  const azimuth = (view.azimuth_deg * Math.PI) / 180;
  const x = view.tilt_deg * Math.cos(azimuth) + right, y = view.tilt_deg * Math.sin(azimuth) + up;
  return { ...view, tilt_deg: Math.min(Math.hypot(x, y), MOST_TILT), azimuth_deg: ((Math.atan2(y, x) * 180) / Math.PI + 360) % 360 };
}

/** The middle stays on the object. */
function inside(scene, view) {
  const { width_mm, height_mm } = scene.bounds();
  const within = (value, half) => Math.min(Math.max(value, -half), half);
  return { ...view, x: within(view.x, width_mm / 2), y: within(view.y, height_mm / 2) };
}
