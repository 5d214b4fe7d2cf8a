// Two pages under one divider: results of two settings, or of two scenes of one object. The page that was opened holds the
// other in a frame on the left of its divider, and tells it its state; ?beside=ADDRESS names that page.
import { copy } from "viewer/state";

/** The page at an address that stands where this one does, on the disk or on one site; null for any other. */
export function pageBeside(address) {
  try {
    const other = new URL(address, location.href), { protocol, host } = location;
    return other.protocol === protocol && other.host === host ? other : null;
  } catch { // no address
    return null;
  }
}

/** In the page that was opened. */
export class Beside {
  /** app: whose first state has a divider; page: the other's URL. */
  constructor(app, page) {
    this.app = app;
    this.sent = "";
    this.number = 0;
    this.share = 0;
    this.told = { title: page.pathname, scene: "", key: "" };
    this.rested = 0; // number of the last state whose picture is complete
    page.searchParams.set("part", "");
    this.frame = document.createElement("iframe");
    Object.assign(this.frame, { id: "beside", src: page.href, title: page.pathname, tabIndex: -1 });
    document.getElementById("canvas").after(this.frame);
    addEventListener("message", ({ source, data }) => {
      if (source !== this.frame.contentWindow) return;
      if (data.opened) {
        Object.assign(this, { told: data.opened, sent: "" });
        app.rebuild();
      } else if (data.rested) {
        this.rested = Math.max(this.rested, data.rested);
        app.showBusy();
      }
    });
  }

  /** Whether the other page is still drawing the state that it was told last; one of which nothing is seen does not draw. */
  get busy() {
    return this.share > 0 && this.rested !== this.number;
  }

  /** Show the share of the picture that lies left of the divider, in the state of this page and at its exposure. */
  show(share) {
    const { state, scene } = this.app, { compare, language, note, ...seen } = copy(state);
    this.share = share;
    this.frame.style.clipPath = `inset(0 ${100 * (1 - share)}% 0 0)`;
    if (seen.exposure === "auto") seen.exposure = scene.exposureShown ?? "auto";
    const message = JSON.stringify(seen);
    if (message === this.sent || !this.told.key) return;
    this.sent = message;
    this.frame.contentWindow.postMessage({ state: seen, number: ++this.number }, "*");
  }
}

/** In the page on the left: no panel, and the state that it is told. */
export function follow(app) {
  document.body.classList.add("part");
  app.resize();
  addEventListener("message", ({ source, data }) => {
    if (source !== parent || !data.state) return;
    for (const [key, value] of Object.entries(data.state)) if (key in app.first) app.state[key] = value;
    app.redraw();
    app.idle().then(() => parent.postMessage({ rested: data.number }, "*"));
  });
  const { title, scene, key } = app.manifest;
  parent.postMessage({ opened: { title, scene, key } }, "*");
}
