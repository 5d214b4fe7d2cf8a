// The page: one scene on a canvas, its state, and the panel that changes the state.
import { Annotations } from "viewer/annotations";
import { Beside, follow, pageBeside } from "viewer/beside";
import { afterPicture, element } from "viewer/dom";
import { lampsSection } from "viewer/lamps";
import { layersSection, presets, showLegend } from "viewer/layers";
import { lensOf } from "viewer/lens";
import { Loader } from "viewer/loader";
import { drawOverlay, written } from "viewer/overlay";
import { probeSection } from "viewer/probe";
import { RoundTools } from "viewer/round_tools";
import { download, pictureOf } from "viewer/save";
import { bookmark, copy, firstState, fromBookmark } from "viewer/state";
import { LANGUAGES, preferred, speak, text } from "viewer/texts";
import { actions, FlatTools, toolbar, toolsOf } from "viewer/tools";

const BOOKMARK_AFTER = 400; // ms without a change
const MOST_RATIO = 2; // pixels of the canvas to one of CSS
const PREVIEW = 1 / 3; // of the canvas's width and height in the first picture of a painting
const by = (id) => document.getElementById(id);
const canvas = /** @type {HTMLCanvasElement} */ (by("canvas"));

class App {
  showLamp; // shows where the lamp is that moved; of the section of the panel that is there
  /** Scene: class of what is shown. */
  constructor(manifest, Scene) {
    this.manifest = manifest;
    this.Scene = Scene;
    this.flat = manifest.chain === "painting";
    this.tool = manifest.chain === "painting" ? "light" : "move";
    this.preview = this.flat; // until the first picture is drawn
    this.lamp = 0;
    this.ruler = [];
    this.place = null;
    this.mark = null;
    this.lens = null;
    this.probed = undefined;
    this.probes = 0;
    this.asked = false;
    this.opened = new Set(["light"]);
  }

  async open() {
    speak(preferred());
    by("busy").textContent = text("busy");
    this.resize();
    this.scene = await this.Scene.open(canvas, this.manifest, new Loader());
    this.first = { ...firstState(this.scene.firstView?.() ?? { x: 0, y: 0, zoom: 1, tilt_deg: 0, azimuth_deg: 0 }, preferred()), ...this.scene.firstState?.() };
    const { searchParams } = new URL(location.href);
    const address = searchParams.get("beside"), other = address === null ? null : pageBeside(address);
    if (other) this.first.compare = { divider: 0.5, state: null };
    this.state = fromBookmark(location.hash, this.first);
    this.scene.onready = () => this.redraw();
    this.annotations = this.scene.pointAt ? new Annotations(this) : null;
    this.bare = searchParams.has("embed");
    if (searchParams.has("part")) follow(this);
    else if (other) this.beside = new Beside(this, other);
    if (this.flat) new FlatTools(this, canvas);
    else new RoundTools(this, canvas);
    addEventListener("resize", () => (this.resize(), this.redraw()));
    addEventListener("hashchange", () => {
      if (location.hash.slice(1) !== bookmark(this.state, this.first)) this.set(fromBookmark(location.hash, this.first));
    });
    this.wireDivider();
    by("sheet").onclick = () => this.toggleSheet();
    document.addEventListener("fullscreenchange", () => this.showPanel());
    this.showPanel();
    this.rebuild();
    if (!searchParams.has("part")) await this.annotations?.open();
    if (address !== null && !other) this.say(text("beside.refused", { address }));
  }

  resize() {
    this.ratio = Math.min(devicePixelRatio || 1, MOST_RATIO) * (this.preview ? PREVIEW : 1);
    canvas.width = Math.max(Math.round(canvas.clientWidth * this.ratio), 1);
    canvas.height = Math.max(Math.round(canvas.clientHeight * this.ratio), 1);
  }

  /** The state changed: draw it, and keep it in the address. */
  change() {
    this.redraw();
    clearTimeout(this.keeping);
    this.keeping = setTimeout(() => history.replaceState(null, "", `#${bookmark(this.state, this.first)}`), BOOKMARK_AFTER);
  }

  /** The state changed in a way that the panel shows with other controls. */
  rebuild() {
    const active = document.activeElement?.getAttribute("aria-label") ?? document.activeElement?.textContent;
    const inside = ["tools", "actions", "panel"].find((name) => by(name).contains(document.activeElement));
    speak(this.state.language);
    document.title = this.manifest.title;
    canvas.setAttribute("aria-label", text(this.flat ? "canvas.flat" : "canvas.object", { title: this.manifest.title }));
    canvas.setAttribute("role", "application");
    canvas.dataset.tool = this.tool;
    by("tools").setAttribute("aria-label", text("tools"));
    by("tools").replaceChildren(...toolbar(this));
    by("actions").replaceChildren(...actions(this));
    by("divider").setAttribute("aria-label", text("divider"));
    by("sheet").textContent = text("controls");
    by("panel").replaceChildren(...this.panel());
    if (inside) [.../** @type {NodeListOf<HTMLElement>} */ (by(inside).querySelectorAll("button,select,input,svg"))].find((each) => (each.getAttribute("aria-label") ?? each.textContent) === active)?.focus();
    this.change();
  }

  panel() {
    const { title, scene, key, version } = this.manifest;
    return [
      element("h1", {}, title),
      element("p", { className: "from" }, text("from", { scene, key, version })),
      presets(this),
      this.section("light", lampsSection(this)),
      this.section("layers", layersSection(this)),
      this.section("probe", probeSection(this)),
      this.annotations && this.section("annotations", this.annotations.section()),
      this.section("compare", this.compareSection()),
      this.section("bookmark", this.bookmarkSection()),
      this.section("help", this.helpSection()),
    ].filter(Boolean);
  }

  section(name, children) {
    const keep = (open) => (open ? this.opened.add(name) : this.opened.delete(name));
    // a click counts at once: the panel may be made anew before the event `toggle` comes
    const summary = element("summary", { onclick: () => keep(!made.open) }, text(`section.${name}`));
    const made = element("details", { open: this.opened.has(name), "data-section": name, ontoggle: () => made.isConnected && keep(made.open) }, summary, ...children);
    return made;
  }

  compareSection() {
    const { compare } = this.state;
    if (this.beside) return [element("p", { className: "hint" }, text("beside.left", this.beside.told))];
    const keep = element("button", { type: "button", onclick: () => {
      const { view, compare: before, note, language, ...kept } = copy(this.state);
      this.state.compare = { divider: before?.divider ?? 0.5, state: kept };
      this.rebuild();
    } }, text(compare ? "compare.again" : "compare.keep"));
    const stop = compare && element("button", { type: "button", onclick: () => ((this.state.compare = null), this.rebuild()) }, text("compare.stop"));
    const change = compare && element("button", { type: "button", onclick: () => {
      const { view, compare: pair, note, language, ...now } = copy(this.state);
      Object.assign(this.state, copy(pair.state), { compare: { ...pair, state: now } });
      this.rebuild();
    } }, text("compare.swap"));
    return [element("p", { className: "hint" }, text(compare ? "compare.on" : "compare.hint")), element("div", { className: "buttons" }, [keep, change, stop])];
  }

  bookmarkSection() {
    const note = element("textarea", { value: this.state.note, "aria-label": text("note"), placeholder: text("note"), oninput: () => ((this.state.note = note.value), this.change()) });
    return [
      note,
      element("div", { className: "buttons" },
        element("button", { type: "button", onclick: () => this.copyAddress() }, text("bookmark.copy")),
        element("button", { type: "button", onclick: () => this.set(copy(this.first)) }, text("reset"))),
      element("p", { className: "hint" }, text("bookmark.hint")),
    ];
  }

  helpSection() {
    const tools = toolsOf(this), common = ["f s", "← → ↑ ↓", "⇧ ← → ↑ ↓", "Enter", "+ −", "0"];
    const keys = [
      [Object.keys(tools).join(" "), Object.values(tools).map((name) => text(`key.${name}`)).join(", ")],
      ...common.map((key) => [key, text(`keys.${this.flat ? "" : "object."}${key}`)]),
    ];
    const { width_mm, height_mm, unit } = this.scene.bounds(), size = [width_mm, height_mm].map((length) => written(length, unit)).join(" × ");
    const languages = element("select", { "aria-label": text("language"), onchange: () => ((this.state.language = languages.value), this.rebuild()) },
      Object.entries(LANGUAGES).map(([code, name]) => element("option", { value: code, selected: code === this.state.language }, name)));
    return [
      element("label", {}, text("language"), languages),
      element("dl", { className: "values keys" }, keys.flatMap(([key, what]) => [element("dt", {}, element("kbd", {}, key)), element("dd", {}, what)])),
      element("p", { className: "hint" }, text("size", { size }), unit === "mm" ? "" : ` ${text(unit === "px" ? "no.scale" : "no.unit")}`),
    ];
  }

  async copyAddress() {
    const address = `${location.href.split("#")[0]}#${bookmark(this.state, this.first)}`;
    try {
      await navigator.clipboard.writeText(address);
      this.say(text("bookmark.copied"));
    } catch { // no permission: the address bar has it
      history.replaceState(null, "", address);
      this.say(text("bookmark.kept"));
    }
  }

  /** Said to screen readers, and shown for a moment. */
  say(words) {
    by("spoken").textContent = words;
    by("busy").textContent = words;
    clearTimeout(this.saying);
    this.saying = setTimeout(() => {
      this.saying = null;
      this.showBusy();
    }, 2500);
  }

  chooseTool(name) {
    this.tool = name;
    if (name === "probe") this.opened.add("probe");
    this.rebuild();
  }

  async savePicture() {
    const { manifest, state } = this, [lamp] = state.lamps;
    const name = [manifest.scene, state.layer !== "appearance" ? state.layer : lamp && `${Math.round(lamp.azimuth_deg)}-${Math.round(lamp.elevation_deg)}`];
    download(`${name.filter(Boolean).join("-")}.png`, "image/png", await pictureOf(this, by("overlay")));
    if (this.beside) this.say(text("save.alone"));
  }

  toggleFullScreen() {
    if (document.fullscreenElement) document.exitFullscreen();
    else document.documentElement.requestFullscreen().catch((error) => this.say(error.message));
  }

  /** The controls stand beside the picture, unless it fills a screen or a frame: then a button brings them. */
  showPanel() {
    document.body.classList.toggle("bare", this.bare || Boolean(document.fullscreenElement));
    this.resize();
    this.redraw();
  }

  fit() {
    this.setView(copy(this.first.view));
  }

  setView(view) {
    this.state.view = view;
    this.change();
  }

  moveLamp(direction, spoken = false) {
    if (!this.state.lamps.length) return;
    Object.assign(this.state.lamps[this.lamp], direction);
    this.showLamp?.();
    this.change();
    if (spoken) this.say(text("lamp.at", { azimuth: Math.round(direction.azimuth_deg), elevation: Math.round(direction.elevation_deg) }));
  }

  measure(points) {
    this.ruler = points;
    this.change();
  }

  rulerText() {
    const [from, to] = this.ruler;
    return written(Math.hypot(...from.map((v, k) => v - to[k])), this.scene.bounds().unit);
  }

  async probe(x, y) {
    const number = ++this.probes, mark = this.flat ? this.scene.pointAt(x, y, this.state) : null;
    const probed = await this.scene.probe(x, y, this.state);
    if (number !== this.probes) return; // another place was asked for in the meantime
    Object.assign(this, { probed, mark });
    this.opened.add("probe");
    this.rebuild();
    if (!this.place) this.reveal("probe"); // the picture would become smaller under a cross that keys move
  }

  /** Bring a section of the panel into sight, which a narrow page hides. */
  reveal(name) {
    if (getComputedStyle(by("panel")).visibility === "hidden") this.toggleSheet(true);
    by("panel").querySelector(`[data-section=${name}]`).scrollIntoView({ block: "nearest" });
  }

  toggleSheet(open = !by("panel").classList.contains("open")) {
    by("panel").classList.toggle("open", open);
    document.body.classList.toggle("sheet", open); // a narrow page shows the picture above the controls
    this.resize();
    this.redraw();
    by("sheet").setAttribute("aria-expanded", `${open}`);
  }

  wireDivider() {
    const divider = by("divider");
    const move = (share) => {
      this.state.compare.divider = Math.min(Math.max(share, 0), 1);
      this.change();
    };
    divider.addEventListener("pointerdown", (event) => divider.setPointerCapture(event.pointerId));
    divider.addEventListener("pointermove", (event) => event.buttons && move((event.clientX - canvas.getBoundingClientRect().left) / canvas.clientWidth));
    divider.addEventListener("keydown", (event) => {
      const step = { ArrowLeft: -0.02, ArrowRight: 0.02 }[event.key];
      if (step) move(this.state.compare.divider + step);
    });
  }

  set(changes) {
    Object.assign(this.state, changes);
    this.lamp = 0;
    this.rebuild();
  }

  redraw() {
    if (this.asked) return;
    this.asked = true;
    requestAnimationFrame(() => {
      this.asked = false;
      this.draw();
    });
  }

  /** Draw the next picture on the whole canvas: the first one is small, so that there is one soon. */
  sharpen() {
    this.preview = false;
    this.asked = true;
    afterPicture(() => {
      this.asked = false;
      this.resize();
      this.draw();
    });
  }

  draw() {
    const { scene, state } = this, { width, height } = canvas, { compare } = state;
    const cut = compare ? Math.round(compare.divider * width) : 0;
    const lens = this.tool === "lens" && this.lens && lensOf(scene, state, this.lens);
    const parts = {
      ...(cut < width && { main: [state, { x: cut, y: 0, width: width - cut, height }] }),
      ...(cut > 0 && !this.beside && { left: [{ ...state, ...compare.state, compare: null }, { x: 0, y: 0, width: cut, height }] }),
      ...(lens && { lens: [lens.state, lens.region] }),
    };
    scene.keepOnly?.(Object.keys(parts));
    for (const [part, [shown, region]] of Object.entries(parts)) scene.draw(shown, region, part);
    by("divider").hidden = !compare;
    if (compare) {
      by("divider").style.left = `${100 * compare.divider}%`;
      by("divider").setAttribute("aria-valuenow", `${Math.round(100 * compare.divider)}`);
    }
    this.beside?.show(cut / width);
    Object.assign(by("lens"), { hidden: !lens });
    if (lens) Object.assign(by("lens").style, Object.fromEntries(["x", "y", "width", "height"].map((side, k) => [["left", "top", "width", "height"][k], `${lens.region[side] / this.ratio}px`])));
    drawOverlay(this, by("overlay"));
    showLegend(this, by("legend"));
    if (this.preview) this.sharpen();
    this.showBusy();
  }

  /** Whether something that the picture needs is on its way. */
  get busy() {
    return this.scene.busy || Boolean(this.beside?.busy);
  }

  /** Say whether something is on its way, unless something else is being said. */
  showBusy() {
    if (!this.saying) by("busy").textContent = this.busy ? text("busy") : "";
  }

  /** Promise of a complete picture. */
  async idle() {
    do await new Promise((resolve) => setTimeout(resolve, 20));
    while (this.asked || this.busy);
  }
}

/** Open the page with a class of scenes. */
export async function start(Scene) {
  const app = new App(JSON.parse(by("manifest").textContent), Scene);
  try {
    await app.open();
    /** @type {any} */ (window).nishiki = {
      scene: app.scene,
      get state() {
        return app.state;
      },
      set: (changes) => app.set(changes),
      idle: () => app.idle(),
    };
  } catch (error) {
    by("busy").textContent = error.message;
    throw error;
  }
}
