// Control of a camera that goes round an object: drag turns, two fingers or the shift key move, wheel and pinch zoom,
// arrow keys turn, page keys step through the captured views.

import { add, apply, cross, dot, norm, normalised, rotationMatrix, scale, subtract } from "viewer/matrices";

const TURN = Math.PI; // of a drag over the whole height of the canvas
const KEY_STEP = 0.08; // of the canvas, a key
const NEAREST = 1.2; // distance of the eye from the target, at least, in radii of the object
const STEEPEST = 0.985; // cosine of the angle between line of sight and axis, at most

/** `view` turned by a drag of (x, y) heights of the canvas about the axis through the target. */
export function orbited(view, axis, x, y) {
  const upwards = dot(axis, view.up) < 0 ? scale(axis, -1) : axis;
  const spin = rotationMatrix(scale(upwards, -x * TURN));
  let away = apply(spin, subtract(view.eye, view.target));
  const right = normalised(cross(upwards, away));
  const tilted = apply(rotationMatrix(scale(right, -y * TURN)), away);
  if (Math.abs(dot(normalised(tilted), upwards)) < STEEPEST) away = tilted;
  return { ...view, captured: null, eye: add(view.target, away), up: upwards };
}

/** `view` with its target and eye moved by (x, y) heights of the canvas across the line of sight. */
export function panned(view, x, y) {
  const away = subtract(view.eye, view.target), height = 2 * norm(away) * Math.tan((view.fov_deg * Math.PI) / 360);
  const right = normalised(cross(view.up, away)), up = normalised(cross(away, right));
  const by = add(scale(right, -x * height), scale(up, y * height));
  return { ...view, captured: null, eye: add(view.eye, by), target: add(view.target, by) };
}

/** `view` from `factor` times the distance, no nearer to the target than the object's radius allows. */
export function zoomed(view, factor, radius) {
  const away = subtract(view.eye, view.target), length = Math.max(norm(away) * factor, NEAREST * radius);
  return { ...view, captured: null, eye: add(view.target, scale(normalised(away), length)) };
}

/** Listens on a canvas and asks `change(view)` for a redraw. `scene` gives axis, radius, freeViewOf and, where there
 * are captured views, capturedView; turns(): whether a drag with one pointer turns now. */
export class Orbit {
  constructor(canvas, scene, current, change, turns = () => true) {
    this.canvas = canvas;
    this.scene = scene;
    this.current = current;
    this.change = change;
    this.turns = turns;
    this.pointers = new Map();
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      this.pointers.set(event.pointerId, [event.clientX, event.clientY]);
    });
    for (const name of ["pointerup", "pointercancel"]) {
      canvas.addEventListener(name, (event) => this.pointers.delete(event.pointerId));
    }
    canvas.addEventListener("pointermove", (event) => this.drag(event));
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      this.apply((view) => zoomed(view, Math.exp(event.deltaY * 0.001), this.scene.radius));
    }, { passive: false });
    canvas.addEventListener("keydown", (event) => this.key(event));
  }

  apply(turn) {
    this.change(turn(this.scene.freeViewOf(this.current())));
  }

  drag(event) {
    const before = this.pointers.get(event.pointerId);
    if (!before) return;
    const here = [event.clientX, event.clientY], height = this.canvas.clientHeight;
    this.pointers.set(event.pointerId, here);
    const [x, y] = subtract(here, before).map((v) => v / height);
    if (this.pointers.size === 2) {
      const other = [...this.pointers].find(([id]) => id !== event.pointerId)[1];
      const ratio = norm(subtract(before, other)) / Math.max(norm(subtract(here, other)), 1);
      this.apply((view) => zoomed(panned(view, x / 2, y / 2), ratio, this.scene.radius));
    } else if (event.shiftKey) {
      this.apply((view) => panned(view, x, y));
    } else if (this.turns()) {
      this.apply((view) => orbited(view, this.scene.axis, x, y));
    }
  }

  key(event) {
    if (event.defaultPrevented || event.ctrlKey || event.metaKey || event.altKey) return;
    const arrows = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[event.key];
    if (arrows) {
      const [x, y] = scale(arrows, KEY_STEP);
      this.apply((view) => (event.shiftKey ? panned(view, x, y) : orbited(view, this.scene.axis, x, y)));
    } else if (["+", "=", "-"].includes(event.key)) {
      this.apply((view) => zoomed(view, event.key === "-" ? 1.1 : 1 / 1.1, this.scene.radius));
    } else if (this.scene.capturedView && (event.key === "PageUp" || event.key === "PageDown")) {
      this.change(this.scene.capturedView(this.current(), event.key === "PageUp" ? 1 : -1));
    } else {
      return;
    }
    event.preventDefault();
  }
}
