// Moving over a flat scene: pan and zoom; a view is {x, y, zoom}: the point in the middle, and how much larger than fitted.

const MOST_ZOOM = 400, LEAST_ZOOM = 0.5;

/** `state.view` with the point at (x, y) of the canvas kept in its place, `factor` times larger. */
export function zoomed(scene, state, factor, x, y) {
  const [px, py] = scene.toScene(x, y, state);
  const zoom = Math.min(Math.max(state.view.zoom * factor, LEAST_ZOOM), MOST_ZOOM);
  const view = { ...state.view, zoom };
  const [qx, qy] = scene.toScene(x, y, { ...state, view });
  return inside(scene, { ...view, x: view.x + px - qx, y: view.y + py - qy });
}

/** `state.view` moved by (dx, dy) pixels of the canvas. */
export function panned(scene, state, dx, dy) {
  const [x0, y0] = scene.toScene(0, 0, state), [x1, y1] = scene.toScene(dx, dy, state);
  return inside(scene, { ...state.view, x: state.view.x - (x1 - x0), y: state.view.y - (y1 - y0) });
}

/** The middle stays on the object. */
function inside(scene, view) {
  const { width_mm, height_mm } = scene.bounds();
  const within = (value, half) => Math.min(Math.max(value, -half), half);
  return { ...view, x: within(view.x, width_mm / 2), y: within(view.y, height_mm / 2) };
}
