// Functions of the viewer that need no browser: node --import ./tests/javascript/modules.js --test tests/javascript/viewer.test.js
import assert from "node:assert/strict";
import { test } from "node:test";
import zlib from "node:zlib";

import { notesOf, pageOf } from "viewer/annotation_json";
import { lensOf } from "viewer/lens";
import { PlaneView } from "viewer/plane_view";
import { crc32, withTexts } from "viewer/png";
import { bookmark, firstState, fromBookmark } from "viewer/state";
import { enlarged, panned, tilted, zoomed } from "viewer/flat";
import { enlarged as nearer, lookAt, projected } from "viewer/cameras";
import { smoothed } from "viewer/coded_object";

const PLANE = { rows: 300, columns: 400, pitch_mm: 0.25 };
const near = (found, expected, reach = 1e-9) => found.forEach((value, k) => assert.ok(Math.abs(value - expected[k]) <= reach, `${found} is not ${expected}`));

/** A flat scene of 400 x 300 pixels of a quarter millimetre on a canvas of 800 x 600. */
function scene() {
  const canvas = { width: 800, height: 600 };
  const of = ({ view }) => new PlaneView({ rows: 300, columns: 400, pitch: 0.25 }, canvas, 2 * view.zoom, view);
  const toScene = (x, y, state) => {
    const [column, row] = of(state).toMap(x, y);
    return [(column - 200) * 0.25, (150 - row) * 0.25];
  };
  const made = { canvas, toScene, bounds: () => ({ width_mm: 100, height_mm: 75, unit: "mm" }), enlarged: (...asked) => enlarged(made, ...asked) };
  return made;
}
const state = { view: { x: 3, y: -7, zoom: 1.5, tilt_deg: 0, azimuth_deg: 0 }, compare: null };

test("the checksum of PNG is that of its specification", () => {
  assert.equal(crc32(new TextEncoder().encode("IEND")), 0xae426082);
  assert.equal(crc32(new TextEncoder().encode("123456789")), 0xcbf43926);
});

test("texts stand behind the header of a PNG and change nothing else", () => {
  const chunk = (type, data) => {
    const made = Buffer.alloc(12 + data.length);
    made.writeUInt32BE(data.length, 0);
    made.write(type, 4);
    Buffer.from(data).copy(made, 8);
    made.writeUInt32BE(crc32(made.subarray(4, 8 + data.length)), 8 + data.length);
    return made;
  };
  const header = chunk("IHDR", [0, 0, 0, 1, 0, 0, 0, 1, 8, 0, 0, 0, 0]), rest = [chunk("IDAT", zlib.deflateSync(Buffer.from([0, 7]))), chunk("IEND", [])];
  const png = Buffer.concat([Buffer.from([137, 80, 78, 71, 13, 10, 26, 10]), header, ...rest]);
  const made = Buffer.from(withTexts(png, { Title: "錦 “brocade”", Source: "Scene 1" })), found = {};
  for (let at = 8; at < made.length; ) {
    const length = made.readUInt32BE(at), type = made.toString("latin1", at + 4, at + 8), data = made.subarray(at + 8, at + 8 + length);
    assert.equal(made.readUInt32BE(at + 8 + length), crc32(made.subarray(at + 4, at + 8 + length)));
    if (type === "iTXt") found[data.toString("latin1", 0, data.indexOf(0))] = data.toString("utf8", data.indexOf(0) + 5);
    at += 12 + length;
  }
  assert.deepEqual(found, { Title: "錦 “brocade”", Source: "Scene 1" });
  assert.deepEqual(made.subarray(0, 33), png.subarray(0, 33));
  assert.deepEqual(made.subarray(-png.length + 33), png.subarray(33));
});

test("notes come back from the page of annotations that they make", () => {
  const notes = [
    { id: "urn:a", created: "2026-01-01T00:00:00Z", text: "crack\nof the ground", points: [[-10, 5, 0], [12.5, 5, 0], [0, -20.25, 0]], state: { ambient: 0.1 } },
    { id: "urn:b", created: "2026-01-02T00:00:00Z", text: "", points: [[49.99, -37.4, 0]], state: {} },
  ];
  const page = JSON.parse(JSON.stringify(pageOf(notes, "altar piece", PLANE))), back = notesOf(page, "altar piece", PLANE);
  assert.equal(page.type, "AnnotationPage");
  assert.ok(page["@context"].includes("http://www.w3.org/ns/anno.jsonld"));
  assert.ok(page.items.every(({ type, target }) => type === "Annotation" && target.selector.type === "SvgSelector"));
  back.forEach(({ points, ...rest }, k) => {
    const { points: expected, ...others } = notes[k];
    assert.deepEqual(rest, others);
    points.forEach((point, n) => near(point, expected[n], 0.01 * 0.25));
  });
  assert.throws(() => notesOf(page, "icon", PLANE), /altar piece/);
  const round = notes.map((each) => ({ ...each, points: [[1.5, 2.5, -3.5]] }));
  assert.deepEqual(notesOf(JSON.parse(JSON.stringify(pageOf(round, "jar", null))), "jar", null), round);
});

test("annotations of other programs are read, or refused where their shape is not understood", () => {
  const item = (target, body = { type: "TextualBody", value: "x" }) => [{ id: "1", type: "Annotation", body, target }];
  const svg = (inside) => ({ source: "https://example.org/picture.jpg", selector: { type: "SvgSelector", value: `<svg>${inside}</svg>` } });
  const corners = [[-25, 25, 0], [0, 25, 0], [0, 0, 0], [-25, 0, 0]];
  for (const target of [
    "https://example.org/picture.jpg#xywh=100,50,100,100",
    { source: "p", selector: { type: "FragmentSelector", value: "xywh=pixel:100,50,100,100" } },
    svg('<polygon points="100,50 200,50 200,150 100,150"/>'),
    svg('<path class="a" d="M100,50 L200,50 L200,150 L100,150 Z"/>'),
  ]) assert.deepEqual(notesOf({ items: item(target) }, "s", PLANE)[0].points, corners);
  for (const target of ["https://example.org/picture.jpg", svg('<path d="M1 1C2 2 3 3 4 4Z"/>'), svg('<path d="m1 1l2 2Z"/>'), svg('<path d="M1 1L2"/>'), svg("<circle/>")]) {
    assert.throws(() => notesOf({ items: item(target) }, "s", PLANE), Error);
  }
  for (const wrong of [null, {}, 3, { items: "no" }]) assert.throws(() => notesOf(wrong, "s", PLANE), Error);
  assert.equal(notesOf(item("p#xywh=0,0,4,4", ["a", { value: "b" }]), "s", PLANE)[0].text, "a\nb");
});

test("the lens shows the place under the pointer in its middle, larger", () => {
  const made = scene(), at = [300, 200];
  const { state: shown, region } = lensOf(made, state, { at, size: 200, raised: false });
  assert.deepEqual(region, { x: 200, y: 100, width: 200, height: 200 });
  near(made.toScene(...at, shown), made.toScene(...at, state), 0.05); // the picture lies on whole pixels of the canvas
  const across = made.toScene(310, 200, shown)[0] - made.toScene(300, 200, shown)[0];
  near([across], [(made.toScene(310, 200, state)[0] - made.toScene(300, 200, state)[0]) / 3]);
  const raised = lensOf(made, state, { at, size: 200, raised: true });
  assert.deepEqual(raised.region, { x: 200, y: 0, width: 200, height: 150 });
  near(made.toScene(300, 50, raised.state), made.toScene(...at, state), 0.05);
  assert.equal(lensOf(made, state, { at: [900, 900], size: 100, raised: false }).region.width, 0);
});

test("the picture of a camera is larger about a place, which comes to lie where it is wanted", () => {
  const size = { width: 300, height: 200 }, view = { eye: [1, 2, 8], target: [0, 0, 0], up: [0, 1, 0], fov_deg: 30 };
  const camera = { ...lookAt(view, size.height, size.width), distortion: [-0.1, 0.02, 0.001, 0.002, 0] }, points = [[0.3, 0.2, 0.4], [0.5, -0.1, 0]];
  const pixel = (by, point) => projected(by, point).map((v) => v + 0.5), from = pixel(camera, points[0]), to = [100, 50];
  const part = ([x, y]) => [x / size.width, y / size.height], larger = nearer(camera, { times: 3, from: part(from), to: part(to) }, size);
  near(pixel(larger, points[0]), to, 1e-6);
  const apart = (by) => pixel(by, points[1]).map((v, k) => v - pixel(by, points[0])[k]);
  near(apart(larger), apart(camera).map((v) => 3 * v), 1e-6);
});

test("smoothed normals keep the form and lose the relief", () => {
  // a cylinder of radius 2 with ripples of its normals, on a grid of 60 x 60 corners a tenth apart
  const side = 60, angle = (column) => (column - side / 2) * 0.05, vertices = [], normals = [], form = [], triangles = [];
  for (let n = 0; n < side * side; n++) {
    const column = n % side, row = (n - column) / side, ripple = angle(column) + 0.3 * (-1) ** (row + column);
    vertices.push(2 * Math.sin(angle(column)), row * 0.1, 2 * Math.cos(angle(column)));
    normals.push(Math.sin(ripple), 0, Math.cos(ripple));
    form.push(Math.sin(angle(column)), 0, Math.cos(angle(column)));
    if (row < side - 1 && column < side - 1) triangles.push(n, n + 1, n + side, n + 1, n + side + 1, n + side);
  }
  const found = smoothed(normals, vertices, triangles, 0.3);
  for (const row of [25, 30]) for (const column of [20, 30, 41]) {
    const at = 3 * (row * side + column);
    near(found.subarray(at, at + 3), form.slice(at, at + 3), 0.01);
  }
  // the spread of a single corner's normal is the deviation that was asked for, along both axes
  const spike = vertices.map((_, k) => (k % 3 === 2 ? 1 : 0)), middle = 3 * (30 * side + 30);
  spike[middle] = 1e-3;
  const spread = smoothed(spike, vertices.map((v, k) => (k % 3 === 2 ? 0 : k % 3 ? v : ((k / 3) % side) * 0.1)), triangles, 0.3);
  let total = 0, across = 0, along = 0;
  for (let n = 0; n < side * side; n++) {
    const [x, y] = [(n % side) - 30, Math.floor(n / side) - 30].map((v) => v * 0.1), weight = spread[3 * n];
    total += weight;
    across += weight * x * x;
    along += weight * y * y;
  }
  near([Math.sqrt(across / total), Math.sqrt(along / total)], [0.3, 0.3], 0.06);
});

test("zoom keeps the place under the pointer, and a pan moves it", () => {
  const made = scene(), view = zoomed(made, state, 2, 500, 250);
  near(made.toScene(500, 250, { view }), made.toScene(500, 250, state), 0.05);
  const moved = panned(made, state, 40, -30);
  near(made.toScene(340, 270, { view: moved }), made.toScene(300, 300, state), 0.09);
});

test("a tilt has an end, and none of it comes back to the front", () => {
  const right = tilted({ view: { tilt_deg: 0, azimuth_deg: 0 } }, 30, 0), up = tilted({ view: right }, 0, 40);
  near([up.tilt_deg, up.azimuth_deg], [50, (Math.atan2(40, 30) * 180) / Math.PI]);
  assert.equal(tilted({ view: up }, 300, 0).tilt_deg, 75);
  near([tilted({ view: right }, -30, 0).tilt_deg], [0]);
});

test("a bookmark holds what differs and leaves out what the page does not know", () => {
  const first = firstState({ x: 0 }, "en"), changed = { ...first, ambient: 0.25, language: "ja", view: { x: 1 / 3 } };
  const text = bookmark(changed, first);
  assert.deepEqual(JSON.parse(decodeURIComponent(text)), { ambient: 0.25, view: { x: 0.333333 } });
  assert.deepEqual(fromBookmark(`#${text}`, first), { ...changed, language: "en", view: { x: 0.333333 } });
  assert.deepEqual(fromBookmark("#%7Bbroken", first), first);
  assert.ok(!("unknown" in fromBookmark(`#${encodeURIComponent('{"unknown":1}')}`, first)));
});
