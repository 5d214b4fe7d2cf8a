// Values under the cursor: position, normal, layers, spectrum with its band of error, gloss, the photographs' values.
import { drawing, element } from "viewer/dom";
import { text } from "viewer/texts";

const [WIDE, TALL, LEFT, BELOW] = [280, 130, 26, 16];

/** The section "probe"; app.probed: what scene.probe gave, null beside the object, undefined before the first probe. */
export function probeSection(app) {
  const { probed } = app;
  if (probed === undefined) return [element("p", { className: "hint" }, text("probe.hint"))];
  if (probed === null) return [element("p", { className: "hint" }, text("probe.nothing"))];
  const { unit } = app.scene.bounds(), rows = [];
  const number = (value, digits = 3) => (value === null || value === undefined ? "–" : `${Number(value.toPrecision(digits))}`);
  if (probed.position_mm) rows.push([text("probe.position"), `${probed.position_mm.slice(0, app.flat ? 2 : 3).map((v) => number(v, 4)).join(", ")} ${unit}`]);
  if (probed.normal) {
    rows.push([text("layer.normals"), probed.normal.map((v) => v.toFixed(3)).join(", ")]);
    rows.push([text("probe.tilt"), `${((Math.acos(Math.min(probed.normal[2], 1)) * 180) / Math.PI).toFixed(1)}°`]);
  }
  for (const layer of app.scene.layers()) {
    if (layer.name in (probed.layers ?? {})) rows.push([text(layer.label_key ?? `layer.${layer.name}`), `${[probed.layers[layer.name]].flat().map((v) => number(v)).join(", ")} ${layer.unit ?? ""}`]);
  }
  for (const [name, value] of Object.entries(probed.gloss ?? {})) rows.push([text(`gloss.${name}`), [value].flat().map((v) => number(v)).join(", ")]);
  return [
    element("dl", { className: "values" }, rows.flatMap(([name, value]) => [element("dt", {}, name), element("dd", {}, value)])),
    probed.spectrum && spectrumPlot(probed.spectrum),
    probed.photographs?.length && photographsPlot(probed.photographs, text(`probe.${app.flat ? "photographs" : "views"}`)),
    probed.sample_pixels !== undefined && element("p", { className: "hint" }, text("probe.sample", { pixels: Math.round(probed.sample_pixels) })),
  ].filter(Boolean);
}

const axis = (x1, y1, x2, y2) => drawing("line", { x1, y1, x2, y2, stroke: "#555" });
const path = (points, attributes) => drawing("path", { d: `M${points.map(([x, y]) => `${x.toFixed(1)} ${y.toFixed(1)}`).join("L")}`, fill: "none", stroke: "#fff", "stroke-width": 1.6, ...attributes });

function spectrumPlot({ nm, reflectance, sigma }) {
  const high = Math.max(0.2, Math.ceil(Math.max(...reflectance) * 5) / 5);
  const x = (value) => LEFT + ((value - nm[0]) / (nm.at(-1) - nm[0])) * (WIDE - LEFT - 8);
  const y = (value) => TALL - BELOW - (Math.min(Math.max(value, 0), high) / high) * (TALL - BELOW - 8);
  const band = sigma && drawing("path", { fill: "#fff", opacity: 0.22, d: `M${[...nm.map((v, k) => [x(v), y(reflectance[k] + sigma[k])]), ...nm.map((v, k) => [x(v), y(reflectance[k] - sigma[k])]).reverse()].map((p) => p.map((v) => v.toFixed(1)).join(" ")).join("L")}Z` });
  return drawing("svg", { class: "plot", viewBox: `0 0 ${WIDE} ${TALL}`, role: "img", "aria-label": text("probe.spectrum") },
    drawing("title", {}, text("probe.spectrum")), axis(LEFT, TALL - BELOW, WIDE - 8, TALL - BELOW), axis(LEFT, 8, LEFT, TALL - BELOW), band,
    path(nm.map((v, k) => [x(v), y(reflectance[k])])),
    ...[400, 500, 600, 700].map((v) => drawing("text", { x: x(v), y: TALL - 4, "text-anchor": v === 700 ? "end" : "middle" }, `${v}${v === 700 ? " nm" : ""}`)),
    drawing("text", { x: LEFT - 3, y: 15, "text-anchor": "end" }, high.toFixed(1)), drawing("text", { x: LEFT - 3, y: TALL - BELOW, "text-anchor": "end" }, "0"));
}

function photographsPlot(photographs, name) {
  const mean = (values) => values.reduce((sum, value) => sum + value, 0) / values.length;
  const pairs = photographs.filter(({ values, predicted }) => values && predicted).map(({ values, predicted }) => [mean(values), mean(predicted)]);
  if (!pairs.length) return null;
  const high = Math.max(...pairs.flat(), 1e-6), step = (WIDE - LEFT - 8) / pairs.length;
  const y = (value) => TALL - BELOW - (Math.max(value, 0) / high) * (TALL - BELOW - 8);
  return drawing("svg", { class: "plot", viewBox: `0 0 ${WIDE} ${TALL}`, role: "img", "aria-label": name },
    drawing("title", {}, name), axis(LEFT, TALL - BELOW, WIDE - 8, TALL - BELOW),
    ...pairs.map(([value], k) => drawing("circle", { cx: LEFT + (k + 0.5) * step, cy: y(value), r: 2.2, fill: "#f2c14e" })),
    path(pairs.map(([, predicted], k) => [LEFT + (k + 0.5) * step, y(predicted)])),
    drawing("text", { x: LEFT, y: TALL - 4 }, name), drawing("text", { x: LEFT - 3, y: 15, "text-anchor": "end" }, Number(high.toPrecision(2))));
}
