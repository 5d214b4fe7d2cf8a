// The lens: a square of the picture, larger around the place under the pointer.

const LARGER = 3;
const SIDE = 220; // CSS pixels

/** State and part of the canvas {x, y, width, height} that a lens shows, in pixels of the canvas.
 * @param {any} scene with enlarged and canvas @param {any} state
 * @param {{at: number[], size: number, raised: boolean}} lens raised: above the place, which a finger covers */
export function lensOf(scene, state, { at: [x, y], size, raised }) {
  const side = Math.round(size), middle = [x, raised ? y - 0.75 * side : y];
  const [left, top] = middle.map((v) => Math.round(v - side / 2));
  const [right, bottom] = [Math.min(left + side, scene.canvas.width), Math.min(top + side, scene.canvas.height)];
  const region = { x: Math.max(left, 0), y: Math.max(top, 0), width: 0, height: 0 };
  Object.assign(region, { width: Math.max(right - region.x, 0), height: Math.max(bottom - region.y, 0) });
  return { state: { ...scene.enlarged(state, LARGER, [x, y], middle), compare: null }, region };
}

/** Let the lens go with the pointer while it is the tool; two fingers and the other buttons move the picture.
 * @param {any} app {tool, ratio, lens, redraw} @param {HTMLElement} canvas */
export function followPointer(app, canvas) {
  const pressed = new Set();
  const show = (lens) => {
    app.lens = lens;
    app.redraw();
  };
  const follow = ({ offsetX, offsetY, buttons, pointerType }) => {
    if (app.tool !== "lens" || pressed.size > 1 || buttons > 1) return;
    show({ at: [offsetX * app.ratio, offsetY * app.ratio], size: SIDE * app.ratio, raised: pointerType === "touch" });
  };
  canvas.addEventListener("pointerdown", (event) => (pressed.add(event.pointerId), follow(event)));
  canvas.addEventListener("pointermove", follow);
  for (const name of ["pointerup", "pointercancel"]) {
    canvas.addEventListener(name, (/** @type {PointerEvent} */ { pointerId, pointerType }) => {
      pressed.delete(pointerId);
      if (pointerType === "touch" && app.lens) show(null);
    });
  }
  canvas.addEventListener("pointerleave", () => app.lens && show(null));
}
