// Notes drawn on the picture, each with the lamps and the view in which it was drawn. They are kept by the browser, or by a
// server in annotations.json beside the page (`nishiki view SCENE --serve`), and given and taken as a file of that form.
import { notesOf, pageOf } from "viewer/annotation_json";
import { drawing, element } from "viewer/dom";
import { download } from "viewer/save";
import { copy } from "viewer/state";
import { text } from "viewer/texts";

const APART = 4; // CSS pixels between the corners of an outline
const FILE = "annotations.json";

const titled = ({ text: words }, number) => `${number + 1}  ${words.split("\n")[0] || "–"}`;

export class Annotations {
  /** app: {scene, manifest, state, first, ratio, flat, set, say, change, rebuild, opened} */
  constructor(app) {
    this.app = app;
    this.notes = [];
    this.chosen = null;
    this.drawn = null;
    this.last = null;
    this.served = location.protocol.startsWith("http");
    this.plane = app.flat ? app.manifest : null;
    this.name = `nishiki annotations ${app.manifest.scene}`;
  }

  /** Read what the server, or else this browser, keeps. */
  async open() {
    const read = () => fetch(FILE, { cache: "no-cache" }).then((answer) => (answer.ok ? answer.text() : ""));
    const kept = this.served ? await read().catch(() => "") : localStorage.getItem(this.name);
    if (kept) this.#take(kept);
    if (this.notes.length) this.app.rebuild();
  }

  #take(content) {
    try {
      const { manifest } = this.app, known = new Set(this.notes.map(({ id }) => id));
      this.notes.push(...notesOf(JSON.parse(content), manifest.scene, this.plane).filter(({ id }) => !known.has(id)));
    } catch (error) {
      this.app.say(text("annotations.refused", { reason: error.message }));
    }
  }

  #page() {
    return JSON.stringify(pageOf(this.notes, this.app.manifest.scene, this.plane), null, 1);
  }

  /** Keep the notes after a change. */
  async #keep() {
    if (!this.served) return localStorage.setItem(this.name, this.#page());
    const answer = await fetch(FILE, { method: "PUT", body: this.#page() });
    if (!answer.ok) this.app.say(text("annotations.unkept"));
  }

  /** Begin, go on or end an outline at CSS pixels of the canvas; an outline that went nowhere is a point. */
  begin(x, y) {
    this.drawn = [];
    this.extend(x, y);
  }

  extend(x, y) {
    const { app } = this, far = !this.drawn?.length || Math.hypot(x - this.last[0], y - this.last[1]) >= APART;
    const point = this.drawn && far && app.scene.pointAt(x * app.ratio, y * app.ratio, app.state);
    if (!point) return;
    this.drawn.push(point);
    this.last = [x, y];
    app.redraw();
  }

  end() {
    const { app, drawn } = this;
    this.drawn = null;
    if (!drawn?.length) return;
    const { compare, note, language, ...state } = copy(app.state), now = new Date();
    this.notes.push({ id: `urn:nishiki:note:${now.getTime()}`, created: now.toISOString(), text: "", points: drawn.length > 2 ? drawn : drawn.slice(0, 1), state });
    this.#keep();
    app.opened.add("annotations");
    this.choose(this.notes.length - 1, false);
    app.reveal("annotations");
    /** @type {HTMLElement} */ (document.querySelector("[data-section=annotations] textarea")).focus({ preventScroll: true });
  }

  /** Mark a note; seen: under its own lamps, from where it was drawn. */
  choose(number, seen = true) {
    const { app } = this, { state } = this.notes[number];
    this.chosen = number;
    app.opened.add("annotations");
    app.set(seen ? copy(Object.fromEntries(Object.entries(state).filter(([key]) => key in app.first))) : {});
  }

  #remove(number) {
    this.notes.splice(number, 1);
    this.chosen = null;
    this.#keep();
    this.app.rebuild();
  }

  /** The section of the panel. */
  section() {
    const { app, notes, chosen } = this;
    const file = element("input", { type: "file", accept: ".json,application/json", hidden: true, "aria-label": text("annotations.import"), onchange: async () => {
      this.#take(await file.files[0].text());
      this.#keep();
      app.rebuild();
    } });
    const list = notes.map((each, number) => element("li", {},
      element("button", { type: "button", "aria-pressed": number === chosen, onclick: () => this.choose(number) }, titled(each, number))));
    const note = notes[chosen], words = note && element("textarea", { value: note.text, "aria-label": text("annotations.text"), placeholder: text("annotations.text"),
      oninput: () => {
        note.text = words.value;
        list[chosen].firstChild.textContent = titled(note, chosen);
      }, onchange: () => this.#keep() });
    return [
      element("p", { className: "hint" }, text(notes.length ? (this.served ? "annotations.served" : "annotations.browser") : "annotations.hint")),
      notes.length > 0 && element("ol", { className: "notes" }, list), words,
      element("div", { className: "buttons" },
        note && element("button", { type: "button", onclick: () => this.#remove(chosen) }, text("annotations.remove")),
        notes.length > 0 && element("button", { type: "button", onclick: () => download(`${app.manifest.scene}-${FILE}`, "application/ld+json", this.#page()) }, text("annotations.export")),
        element("button", { type: "button", onclick: () => file.click() }, text("annotations.import")), file),
    ].filter(Boolean);
  }

  /** Elements over the picture; at(point): CSS pixels. */
  marks(at) {
    const outline = (points) => `M${points.map((point) => at(point).map((v) => v.toFixed(1)).join(" ")).join("L")}`;
    const lines = (d) => ["shade", "line"].map((name) => drawing("path", { class: name, d }));
    const made = this.notes.map(({ points, text: words }, number) => {
      const [x, y] = at(points[0]);
      return drawing("g", { class: "note", "aria-current": number === this.chosen, onclick: () => this.choose(number) },
        points.length > 1 && lines(`${outline(points)}Z`), drawing("circle", { cx: x, cy: y, r: 9 }), drawing("text", { x, y }, `${number + 1}`), words && drawing("title", {}, words));
    });
    return this.drawn ? [...made, ...lines(outline(this.drawn))] : made;
  }
}
