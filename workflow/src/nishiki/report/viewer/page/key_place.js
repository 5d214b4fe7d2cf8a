// A cross that the arrow keys move over the picture, for whoever uses no pointer: Enter reads the values under it, or puts an
// end of the ruler or a note there.
import { text } from "viewer/texts";

const STEP = 8; // CSS pixels of an arrow key
const ARROWS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };

export class KeyPlace {
  /** app: {scene, state, tool, ratio, ruler, flat, place, probe, measure, say, rulerText, redraw}; app.place: CSS pixels of the
   * cross from the canvas's upper left corner, null while a pointer is in use. */
  constructor(app, canvas) {
    this.app = app;
    this.canvas = canvas;
    this.measuring = false;
    canvas.addEventListener("pointerdown", () => {
      app.place = null;
      this.measuring = false;
    });
  }

  /** What a key does with the tools for values and for the ruler; whether it did anything. */
  key({ key, shiftKey }) {
    const { app, canvas } = this, step = ARROWS[key];
    if (!["probe", "ruler", "annotate"].includes(app.tool) || shiftKey || !(step || key === "Enter")) return false;
    const most = [canvas.clientWidth - 1, canvas.clientHeight - 1];
    const from = app.place ?? most.map((length) => length / 2);
    app.place = step ? from.map((v, k) => Math.min(Math.max(v + STEP * step[k], 0), most[k])) : from;
    if (app.tool === "annotate") {
      if (key === "Enter") app.annotations.begin(...app.place), app.annotations.end();
    } else if (app.tool === "ruler") this.#measure(key === "Enter");
    else if (key === "Enter" || app.flat) app.probe(...this.#pixel()); // an object's values take a while
    app.redraw();
    return true;
  }

  #pixel() {
    return this.app.place.map((v) => v * this.app.ratio);
  }

  /** The ruler to the cross, or from it; entered: whether one of its ends is put there. */
  #measure(entered) {
    const { app } = this, begun = this.measuring && app.ruler.length;
    if (!begun && !entered) return;
    const point = app.scene.pointAt(...this.#pixel(), app.state);
    if (!point) return void app.say(text("probe.nothing"));
    app.measure(begun ? [app.ruler[0], point] : [point]);
    if (begun) app.say(app.rulerText());
    this.measuring = !begun || !entered;
  }
}
