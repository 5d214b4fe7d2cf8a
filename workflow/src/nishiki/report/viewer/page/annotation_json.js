// Annotations as an AnnotationPage of the W3C Web Annotation Data Model (2017). Of a flat object the target is an SvgSelector
// with a path in pixels of the maps from their upper left corner; of others it is a list of points of the surface.

const CONTEXT = ["http://www.w3.org/ns/anno.jsonld", { nishiki: "urn:nishiki:" }];
const POINTS = "nishiki:SurfacePoints", STATE = "nishiki:ViewState";

/** @typedef {{id: string, created: string, text: string, points: number[][], state: object}} Note a point, or the corners of
 * an outline, and the state (lamps, view, layer) in which it was drawn
 * @typedef {{rows: number, columns: number, pitch_mm?: number}} Plane of a flat object; its points are [x, y, height] from the middle,
 * x to the right, y up, in mm, or in pixels where there is no pitch */

/** Address that stands for a scene. @param {string} scene */
const sourceOf = (scene) => `urn:nishiki:${encodeURIComponent(scene)}`;

/** The page of a scene's notes, as an object for JSON. @param {Note[]} notes @param {string} scene @param {Plane | null} plane */
export function pageOf(notes, scene, plane) {
  const source = sourceOf(scene);
  return {
    "@context": CONTEXT, id: `${source}:annotations`, type: "AnnotationPage",
    items: notes.map(({ id, created, text, points, state }) => ({
      id, type: "Annotation", motivation: "commenting", created,
      body: { type: "TextualBody", format: "text/plain", value: text },
      target: { source, selector: plane ? pathOf(points, plane) : { type: POINTS, value: points }, state: { type: STATE, value: state } },
    })),
  };
}

/** Notes of a page that pageOf, or another program, wrote; an Error says what cannot be used.
 * @param {any} page @param {string} scene @param {Plane | null} plane @returns {Note[]} */
export function notesOf(page, scene, plane) {
  const items = Array.isArray(page) ? page : page?.items ?? page?.first?.items;
  if (!Array.isArray(items)) throw new Error("expected an AnnotationPage with items");
  return items.map((item, number) => {
    const target = [item.target].flat()[0], source = target?.source?.id ?? target?.source, body = [item.body ?? []].flat();
    if (typeof source === "string" && source.startsWith("urn:nishiki:") && source !== sourceOf(scene)) throw new Error(`annotation ${number + 1} belongs to ${decodeURIComponent(source.slice(12))}, not to ${scene}`);
    const points = pointsOf([target?.selector].flat(), typeof target === "string" ? target : "", plane);
    if (!points?.length) throw new Error(`annotation ${number + 1}: expected ${plane ? "an SvgSelector with a path or polygon, or #xywh=" : "points of a surface"}`);
    const state = [target.state].flat().find((each) => each?.type === STATE)?.value ?? {};
    return { id: `${item.id ?? `urn:nishiki:note:${number}`}`, created: `${item.created ?? ""}`, text: body.map((each) => each.value ?? each).join("\n"), points, state };
  });
}

/** @param {number[][]} points @param {Plane} plane */
function pathOf(points, { rows, columns, pitch_mm }) {
  const pitch = pitch_mm ?? 1, corners = points.map(([x, y]) => [x / pitch + columns / 2, rows / 2 - y / pitch].map((v) => Number(v.toFixed(2))).join(" "));
  return { type: "SvgSelector", value: `<svg xmlns="http://www.w3.org/2000/svg"><path d="M${corners.join("L")}${points.length > 1 ? "Z" : ""}"/></svg>` };
}

/** @param {any[]} selectors @param {string} address @param {Plane | null} plane @returns {number[][] | null} */
function pointsOf(selectors, address, plane) {
  if (!plane) return selectors.find((each) => each?.type === POINTS)?.value.map((/** @type {any[]} */ point) => point.map(Number)) ?? null;
  const { rows, columns, pitch_mm } = plane, pitch = pitch_mm ?? 1;
  const fragment = /xywh=(?:pixel:)?([\d.,]+)/.exec([address, ...selectors.map((each) => each?.value)].join(" "));
  const path = /\s(?:d|points)="([^"]*)"/.exec(selectors.find((each) => each?.type === "SvgSelector")?.value ?? "");
  let numbers = (path?.[1].match(/-?\d*\.?\d+(?:e-?\d+)?/gi) ?? []).map(Number);
  if (path && /[^MLZ\s\d.,e-]/i.test(path[1])) return null; // curves, and coordinates relative to the last
  if (path && /[mlz]/.test(path[1].replace(/^m|z$/g, ""))) return null;
  if (!path && fragment) {
    const [x, y, w, h] = fragment[1].split(",").map(Number);
    numbers = [x, y, x + w, y, x + w, y + h, x, y + h];
  }
  if (numbers.length % 2 || !numbers.every(Number.isFinite)) return null;
  return Array.from({ length: numbers.length / 2 }, (_, k) => [(numbers[2 * k] - columns / 2) * pitch, (rows / 2 - numbers[2 * k + 1]) * pitch, 0]);
}
