// Drawn over the picture: scale bar, ruler, the place that was probed.
import { drawing } from "viewer/dom";

const LONGEST = 180; // CSS pixels of the scale bar
const BUTTON = 52; // CSS pixels of the button below the scale bar, where there is one

/** Redraw; app.ruler: [] or one or two points in the unit of the scene; app.mark: the point that was probed; app.place: CSS
 * pixels of the cross that keys move. */
export function drawOverlay(app, svg) {
  const { scene, state, ratio } = app;
  svg.replaceChildren();
  const at = (point) => scene.fromScene(point, state).map((v) => v / ratio);
  if (app.annotations) svg.append(...app.annotations.marks(at));
  if (app.place && ["probe", "ruler", "annotate"].includes(app.tool)) svg.append(...cross(app.place));
  if (!scaleOf(app)) return;
  const { unit } = scene.bounds(), scale = scaleOf(app) / ratio; // CSS pixels to the unit
  const width = svg.clientWidth, height = svg.clientHeight - (getComputedStyle(document.getElementById("sheet")).display === "none" ? 0 : BUTTON);
  const power = 10 ** Math.floor(Math.log10(LONGEST / scale));
  const length = [5, 2, 1].map((k) => k * power).find((each) => each * scale <= LONGEST) ?? power;
  svg.append(...segment([width - 16 - length * scale, height - 18], [width - 16, height - 18], true), words(width - 16 - (length * scale) / 2, height - 26, written(length, unit)));
  if (app.mark && app.tool !== "ruler") svg.append(...cross(at(app.mark)));
  const [from, to] = app.ruler;
  if (from && to) {
    const [a, b] = [at(from), at(to)];
    svg.append(...segment(a, b, true), words((a[0] + b[0]) / 2, (a[1] + b[1]) / 2 - 10, app.rulerText()));
  }
}

/** A length with its unit, the same one at every place of the page. */
export const written = (length, unit) => `${Number(length.toPrecision(4))} ${unit}`.trim();

/** Pixels of the canvas to the unit of the scene; null where nothing is measured. */
export function scaleOf({ scene, state, flat }) {
  if (flat) return (scene.fit() * state.view.zoom * scene.manifest.columns) / scene.bounds().width_mm;
  return scene.offers.includes("ruler") ? scene.scaleOf(state) : null;
}

const cross = ([x, y]) => ["shade", "line"].map((name) => drawing("path", { class: name, d: `M${x - 9} ${y}h6m6 0h6M${x} ${y - 9}v6m0 6v6` }));
const words = (x, y, text) => drawing("text", { x, y, "text-anchor": "middle" }, text);

function segment([x1, y1], [x2, y2], ends) {
  const length = Math.max(Math.hypot(x2 - x1, y2 - y1), 1e-6), [nx, ny] = [(-5 * (y2 - y1)) / length, (5 * (x2 - x1)) / length];
  const end = (x, y) => `M${x - nx} ${y - ny}L${x + nx} ${y + ny}`;
  const d = `M${x1} ${y1}L${x2} ${y2}${ends ? end(x1, y1) + end(x2, y2) : ""}`;
  return ["shade", "line"].map((name) => drawing("path", { class: name, d }));
}
