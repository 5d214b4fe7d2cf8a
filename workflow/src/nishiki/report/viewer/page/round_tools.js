// What a pointer and the keys do on an object or a cloth besides turning it: values under a click, the ruler from point to
// point of the surface, notes, lens, choice of the tool.
import { KeyPlace } from "viewer/key_place";
import { followPointer } from "viewer/lens";
import { Orbit } from "viewer/orbit";
import { toolsOf } from "viewer/tools";

const CLICK = 5; // pixels that a click may wander

export class RoundTools {
  /** app: {scene, state, tool, ratio, ruler, chooseTool, setView, fit, probe, measure, say, rulerText} */
  constructor(app, canvas) {
    this.app = app;
    this.from = [];
    this.measuring = false;
    this.keys = new KeyPlace(app, canvas);
    canvas.addEventListener("keydown", (event) => this.key(event)); // before those of the camera
    new Orbit(canvas, app.scene, () => app.state, (view) => app.setView(view), () => !["ruler", "annotate", "lens"].includes(app.tool));
    followPointer(app, canvas);
    canvas.addEventListener("pointerdown", (event) => this.down(event));
    canvas.addEventListener("pointermove", (event) => {
      if (this.measuring) this.measure(event, [app.ruler[0]]);
      else if (app.tool === "annotate" && event.isPrimary) app.annotations.extend(event.offsetX, event.offsetY);
    });
    canvas.addEventListener("pointerup", (event) => this.up(event));
    canvas.addEventListener("pointercancel", () => {
      this.measuring = false;
      if (app.annotations) app.annotations.drawn = null;
    });
  }

  down(event) {
    this.from = [event.offsetX, event.offsetY];
    this.measuring = false;
    if (this.app.tool === "annotate" && event.isPrimary && !event.shiftKey) this.app.annotations.begin(...this.from);
    if (this.app.tool !== "ruler" || !event.isPrimary || event.shiftKey) return;
    this.app.measure([]);
    this.measuring = this.measure(event, []);
  }

  /** Put the point of the surface under an event at the end of the ruler; whether there is one. */
  measure({ offsetX, offsetY }, before) {
    const { app } = this, point = app.scene.pointAt(offsetX * app.ratio, offsetY * app.ratio, app.state);
    if (point) app.measure([...before, point]);
    return Boolean(point);
  }

  up({ offsetX, offsetY }) {
    const { app } = this, still = Math.hypot(offsetX - this.from[0], offsetY - this.from[1]) < CLICK;
    app.annotations?.end();
    if (still && app.tool === "probe") app.probe(offsetX * app.ratio, offsetY * app.ratio);
    if (this.measuring && app.ruler.length === 2) app.say(app.rulerText());
    this.measuring = false;
  }

  key(event) {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const { app } = this, tool = toolsOf(app)[event.key];
    if (event.key === "0") app.fit();
    else if (tool) app.chooseTool(tool);
    else if (event.key === "f") app.toggleFullScreen();
    else if (event.key === "s") app.savePicture();
    else if (!this.keys.key(event)) return;
    event.preventDefault();
  }
}
