// What a pointer and the keys do on a flat picture: light, move, tilt, probe, ruler, notes, lens. Wheel and pinch zoom with every tool;
// the right or middle button moves the picture.
import { drawing, element } from "viewer/dom";
import { panned, tilted, zoomed } from "viewer/flat";
import { KeyPlace } from "viewer/key_place";
import { directionAt, pointOf } from "viewer/lamps";
import { followPointer } from "viewer/lens";
import { text } from "viewer/texts";

const ICONS = {
  light: "M12 3v2M12 19v2M3 12h2M19 12h2M5.6 5.6l1.4 1.4M17 17l1.4 1.4M5.6 18.4L7 17M17 7l1.4-1.4M12 8a4 4 0 1 0 0 8a4 4 0 1 0 0-8",
  move: "M12 3v18M3 12h18M12 3l-3 3M12 3l3 3M12 21l-3-3M12 21l3-3M3 12l3-3M3 12l3 3M21 12l-3-3M21 12l-3 3",
  tilt: "M4 9l16-4v10L4 19zM12 2v2M12 21v-2M9 5l3-3l3 3",
  probe: "M12 2v7M12 15v7M2 12h7M15 12h7M12 11.5v1",
  ruler: "M3 16L16 3l5 5L8 21zM6 13l2 2M9 10l3 3M12 7l2 2",
  annotate: "M4 20l1-5L16 4l4 4L9 19zM14 6l4 4",
  lens: "M4 4h11v11H4zM15 15l6 6M7 9.5h5M9.5 7v5",
  save: "M12 3v11M8 10l4 4l4-4M4 16v5h16v-5",
  full: "M3 9V3h6M15 3h6v6M21 15v6h-6M9 21H3v-6",
  next: "M9 5l7 7l-7 7",
  previous: "M15 5l-7 7l7 7",
  fit: "M4 5h16v14H4zM8 12h8M10 10l-2 2l2 2M14 10l2 2l-2 2",
};
const KEYS = { l: "light", m: "move", t: "tilt", p: "probe", r: "ruler", a: "annotate", g: "lens" };
const KEY_ZOOM = 1.25, KEY_PAN = 60, KEY_LAMP = 0.05, KEY_TILT = 5; // factor; pixels; of the unit disc; degrees
const TILT = 180; // degrees of a drag over the whole height of the canvas
const CLICK = 5; // pixels that a click may wander

/** Tools that a scene has use for, by their keys. */
export function toolsOf({ flat, scene }) {
  const useful = { light: flat, tilt: flat, ruler: flat || scene.offers.includes("ruler"), annotate: Boolean(scene.pointAt) };
  return Object.fromEntries(Object.entries(KEYS).filter(([, name]) => useful[name] ?? true));
}

/** The buttons on the picture. app: {tool, chooseTool(name), fit()} */
export function toolbar(app) {
  return Object.values(toolsOf(app)).map((name) => button(name, () => app.chooseTool(name), app.tool === name));
}

/** The buttons that do something at once. app: {scene, fit(), setView(view), savePicture(), toggleFullScreen()} */
export function actions(app) {
  const step = (by) => () => app.setView(app.scene.capturedView(app.state, by));
  return [
    button("fit", () => app.fit()),
    ...(app.scene.capturedView ? [button("previous", step(-1)), button("next", step(1))] : []),
    button("save", () => app.savePicture()),
    ...(document.fullscreenEnabled ? [button("full", () => app.toggleFullScreen())] : []),
  ];
}

function button(name, onclick, pressed) {
  const icon = drawing("svg", { viewBox: "0 0 24 24", "aria-hidden": "true" }, drawing("path", { d: ICONS[name] })), title = text(`tool.${name}`);
  return element("button", { type: "button", title, "aria-label": title, "aria-pressed": pressed === undefined ? null : `${pressed}`, onclick }, icon);
}

/** Listens on the canvas of a flat scene. */
export class FlatTools {
  constructor(app, canvas) {
    this.app = app;
    this.canvas = canvas;
    this.pointers = new Map();
    this.keys = new KeyPlace(app, canvas);
    followPointer(app, canvas);
    canvas.addEventListener("pointerdown", (event) => this.down(event));
    canvas.addEventListener("pointermove", (event) => this.move(event));
    for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, (event) => this.up(event));
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    canvas.addEventListener("keydown", (event) => this.key(event));
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      this.zoom(Math.exp(-event.deltaY * (event.ctrlKey ? 0.01 : 0.0015)), ...this.at(event));
    }, { passive: false });
  }

  /** Pixel of the canvas under an event. */
  at({ offsetX, offsetY }) {
    return [offsetX * this.app.ratio, offsetY * this.app.ratio];
  }

  zoom(factor, x = this.canvas.width / 2, y = this.canvas.height / 2) {
    this.app.setView(zoomed(this.app.scene, this.app.state, factor, x, y));
  }

  pan(dx, dy) {
    this.app.setView(panned(this.app.scene, this.app.state, dx, dy));
  }

  tilt(dx, dy) {
    this.app.setView(tilted(this.app.state, dx, dy));
  }

  down(event) {
    this.canvas.setPointerCapture(event.pointerId);
    this.pointers.set(event.pointerId, this.at(event));
    this.started = this.at(event);
    this.moves = event.button > 0;
    if (this.pointers.size > 1 || this.moves) return;
    if (this.app.tool === "ruler") this.app.measure([this.app.scene.pointAt(...this.at(event), this.app.state)]);
    else if (this.app.tool === "light") this.light(event);
    else if (this.app.tool === "annotate") this.app.annotations.begin(event.offsetX, event.offsetY);
  }

  move(event) {
    const before = this.pointers.get(event.pointerId);
    if (!before) return;
    const here = this.at(event), [dx, dy] = [here[0] - before[0], here[1] - before[1]];
    this.pointers.set(event.pointerId, here);
    const { tool, scene, state } = this.app;
    if (this.pointers.size > 1) {
      this.app.annotations.drawn = null;
      const [, other] = [...this.pointers].find(([id]) => id !== event.pointerId);
      const reach = (point) => Math.max(Math.hypot(point[0] - other[0], point[1] - other[1]), 1);
      this.pan(dx / 2, dy / 2);
      this.zoom(reach(here) / reach(before), (here[0] + other[0]) / 2, (here[1] + other[1]) / 2);
    } else if (tool === "move" || this.moves) this.pan(dx, dy);
    else if (tool === "light") this.light(event);
    else if (tool === "tilt") this.tilt((-dx * TILT) / this.canvas.height, (dy * TILT) / this.canvas.height);
    else if (tool === "annotate") this.app.annotations.extend(event.offsetX, event.offsetY);
    else if (tool === "ruler") this.app.measure([this.app.ruler[0], scene.pointAt(...here, state)]);
  }

  up(event) {
    if (!this.pointers.delete(event.pointerId)) return;
    if (event.type === "pointercancel") this.app.annotations.drawn = null;
    this.app.annotations.end();
    const here = this.at(event), wandered = Math.hypot(here[0] - this.started[0], here[1] - this.started[1]);
    if (this.app.tool === "probe" && wandered < CLICK * this.app.ratio && !this.moves) this.app.probe(...here);
    if (this.app.tool === "ruler" && this.app.ruler.length === 2) this.app.say(this.app.rulerText());
  }

  light({ offsetX, offsetY }) {
    const { clientWidth, clientHeight } = this.canvas, reach = Math.min(clientWidth, clientHeight) / 2;
    this.app.moveLamp(directionAt((offsetX - clientWidth / 2) / reach, (clientHeight / 2 - offsetY) / reach));
  }

  key(event) {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    if (this.keys.key(event)) return void event.preventDefault();
    const { app } = this;
    const arrow = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] }[event.key];
    if (event.key in KEYS) app.chooseTool(KEYS[event.key]);
    else if (event.key === "+" || event.key === "=") this.zoom(KEY_ZOOM);
    else if (event.key === "-") this.zoom(1 / KEY_ZOOM);
    else if (event.key === "0") app.fit();
    else if (event.key === "f") app.toggleFullScreen();
    else if (event.key === "s") app.savePicture();
    else if (arrow) this.arrow(arrow, event.shiftKey);
    else return;
    event.preventDefault();
  }

  arrow([x, y], shift) {
    const { app } = this;
    if (app.tool === "light" && !shift && app.state.lamps.length) {
      const [px, py] = pointOf(app.state.lamps[app.lamp]);
      app.moveLamp(directionAt(px + KEY_LAMP * x, py + KEY_LAMP * y), true);
    } else if (app.tool === "tilt" && !shift) {
      this.tilt(KEY_TILT * x, KEY_TILT * y);
      app.say(text("tilt.at", { tilt: Math.round(app.state.view.tilt_deg), azimuth: Math.round(app.state.view.azimuth_deg) }));
    } else this.pan(-KEY_PAN * app.ratio * x, KEY_PAN * app.ratio * y);
  }
}
