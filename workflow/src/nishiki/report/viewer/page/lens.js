// @ts-check
// The lens: a square of the picture, larger around the place under the pointer.

const LARGER = 3;

/** State and part of the canvas {x, y, width, height} that a lens shows, in pixels of the canvas.
 * @param {any} scene with toScene and canvas @param {any} state
 * @param {{at: number[], size: number, raised: boolean}} lens raised: above the place, which a finger covers */
export function lensOf(scene, state, { at: [x, y], size, raised }) {
  const side = Math.round(size), middle = [x, raised ? y - 0.75 * side : y], view = { ...state.view, zoom: LARGER * state.view.zoom };
  const [px, py] = scene.toScene(x, y, state), [qx, qy] = scene.toScene(...middle, { ...state, view });
  const [left, top] = middle.map((v) => Math.round(v - side / 2));
  const [right, bottom] = [Math.min(left + side, scene.canvas.width), Math.min(top + side, scene.canvas.height)];
  const region = { x: Math.max(left, 0), y: Math.max(top, 0), width: 0, height: 0 };
  Object.assign(region, { width: Math.max(right - region.x, 0), height: Math.max(bottom - region.y, 0) });
  return { state: { ...state, compare: null, view: { ...view, x: view.x + px - qx, y: view.y + py - qy } }, region };
}
