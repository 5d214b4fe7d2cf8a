// The viewer's scene of a cloth: draped, flat or on cylinders, with any of its models and dyes, under any lamps.
//
// A picture at rest is the mean of SAMPLES pictures, each with its own point of every lamp's disc and its own shift by
// part of a pixel: soft shadows and smooth edges. While something moves, the first of them is shown; before it a coarse
// one, once frames have been slow.

import { unpackArrays } from "viewer/arrays";
import { freeView, lookAt } from "viewer/cameras";
import {
  CLOTH_FRAGMENT, CLOTH_VERTEX, DEVELOP_FRAGMENT, LAMPS, MEAN_FRAGMENT, SCREEN_VERTEX, SHADOW_FRAGMENT, SHADOW_VERTEX,
} from "viewer/cloth_shaders";
import { context, readback } from "viewer/gl";
import { add, apply, cross, dot, normalised, scale, subtract, transpose } from "viewer/matrices";
import { Shader, framebuffer, texture } from "viewer/shader";

const SAMPLES = 16;
const COARSE = 3; // pixels of the canvas to one of a coarse picture, along each side
const SLOW = [150, 2000]; // ms between two changes of the state that say that frames are slow
const MAP = 2048; // side of a shadow map
const MAP_BIAS = 2 / MAP; // in depths of a map, which are the cloth's diameter
const GOLDEN = 2.399963229728653; // radians between points of a spiral that covers a disc evenly
const NEAREST = 0.02, FARTHEST = 40; // of what is drawn, in radii of the cloth
const BELOW = 1 / 3; // of the light from above
const LAYERS = [
  { name: "appearance", label_key: "layer.appearance", unit: "", range: [0, 1], map: "grey" },
  { name: "normals", label_key: "layer.normals", unit: "", range: [-1, 1], map: "normal" },
  { name: "weft", label_key: "layer.weft", unit: "", range: [-1, 1], map: "normal" },
  { name: "openness", label_key: "layer.openness", unit: "", range: [0, 1], map: "grey" },
];
const PLACE = 4, REFLECTANCE = 5; // layers that are read, not shown

export class ClothScene {
  static async open(canvas, manifest, loader) {
    const scene = new ClothScene(canvas, manifest, loader);
    await Promise.all([scene.shapeOf(scene.firstShape), scene.materialOf(scene.keyOf({}))]);
    scene.draw({ lamps: [], ambient: 0, options: {}, view: scene.firstView() });
    return scene;
  }

  constructor(canvas, manifest, loader) {
    Object.assign(this, { canvas, manifest, loader });
    this.onready = () => {};
    this.gl = context(canvas);
    const { gl } = this, { sides, rings } = manifest.table;
    if (!gl.getExtension("EXT_color_buffer_float")) throw new Error("WebGL2 with EXT_color_buffer_float is needed to show a cloth");
    if (gl.getParameter(gl.MAX_3D_TEXTURE_SIZE) < sides * rings) {
      throw new Error(`A cloth needs volume textures of ${sides * rings} texels; this graphics processor has ${gl.getParameter(gl.MAX_3D_TEXTURE_SIZE)}.`);
    }
    this.programs = {
      shadow: new Shader(gl, SHADOW_VERTEX, SHADOW_FRAGMENT), cloth: new Shader(gl, CLOTH_VERTEX, CLOTH_FRAGMENT),
      mean: new Shader(gl, SCREEN_VERTEX, MEAN_FRAGMENT), develop: new Shader(gl, SCREEN_VERTEX, DEVELOP_FRAGMENT),
    };
    this.empty = gl.createVertexArray();
    this.firstShape = Object.keys(manifest.shapes)[0];
    this.shown = this.firstShape; // surface of the last picture
    this.shapes = new Map(); // what is loaded, or its promise
    this.materials = new Map();
    this.loading = 0;
    this.changed = -Infinity; // time of the last change of what is shown
    this.slow = false;
    this.maps = { layers: 0 };
    this.parts = {}; // of the canvas: `whole`, or `left` and `right`; what is on each
  }

  get busy() {
    return this.loading > 0 || Object.values(this.parts).some(({ count }) => count < SAMPLES);
  }

  /** What of the panel this scene has use for. */
  get offers() {
    return ["softness", "exposure sheet"];
  }

  /** For the control of the camera. */
  get axis() {
    return [0, 1, 0];
  }

  get radius() {
    return this.manifest.shapes[this.shown].radius;
  }

  /** What differs from the page's first state. */
  firstState() {
    return { ambient: 0.16, lamps: [{ azimuth_deg: 140, elevation_deg: 35, distance: null, radius_deg: 1.5, intensity: 1, illuminant: "D65" }] };
  }

  firstView(shape = this.firstShape) {
    const { camera, centre } = this.manifest.shapes[shape];
    return { ...freeView(camera, centre), shape };
  }

  /** View of a state: the first one of its surface, where the state's belongs to another. */
  viewOf(state) {
    const shape = this.shapeName(state);
    return state.view?.eye && state.view.shape === shape ? state.view : this.firstView(shape);
  }

  freeViewOf(state) {
    return this.viewOf(state);
  }

  shapeName(state) {
    return state.options?.shape in this.manifest.shapes ? state.options.shape : this.firstShape;
  }

  /** Name of the block of a state's material: a dye needs the gloss alone. */
  keyOf(state) {
    const { materials } = this.manifest, name = ({ region, model }) => `${region}-${model}`;
    const material = materials.find((each) => name(each) === state.options?.material) ?? materials[0];
    return `${this.dyeOf(state) ? "gloss" : "measured"}-${name(material)}`;
  }

  /** Linear sRGB of a state's dye; null for the cloth as measured. */
  dyeOf(state) {
    const { dye = "measured", colour = "#808080" } = state.options ?? {};
    const code = dye === "own" ? colour : this.manifest.dyes[dye];
    return code ? [1, 3, 5].map((k) => decode(parseInt(code.slice(k, k + 2), 16) / 255)) : null;
  }

  /** What a block became on the GPU, or the promise of it. */
  #loaded(kept, name, make) {
    if (!kept.has(name)) {
      this.loading++;
      kept.set(name, this.loader.load(name).then(unpackArrays).then((arrays) => {
        kept.set(name, make(arrays));
        this.loading--;
        this.onready();
      }));
    }
    return kept.get(name);
  }

  shapeOf(name) {
    return this.#loaded(this.shapes, `shape-${name}`, (arrays) => this.#surface(arrays, this.manifest.shapes[name]));
  }

  materialOf(key) {
    return this.#loaded(this.materials, key, (arrays) => this.#material(arrays));
  }

  #surface(arrays, { step }) {
    const { gl } = this, made = gl.createVertexArray();
    const [vertices, normals, weft, triangles] = ["vertices", "normals", "weft", "triangles"].map((name) => summed(arrays[name].values, 3));
    const count = vertices.length / 3, cloth = arrays.cloth.values;
    gl.bindVertexArray(made);
    attribute(gl, 0, Float32Array.from(vertices, (v) => v * step), 3);
    attribute(gl, 1, four(normals, (n) => (cloth[n] ? 0 : 32767)), 4);
    attribute(gl, 2, four(weft, () => 0), 4);
    attribute(gl, 3, arrays.around.values, 4);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
    // triangles of the cloth first: the paper throws no shadow on it
    const ofCloth = [], ofPaper = [];
    for (let n = 0; n < triangles.length; n += 3) (cloth[triangles[n]] ? ofCloth : ofPaper).push(triangles[n], triangles[n + 1], triangles[n + 2]);
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, Uint32Array.from([...ofCloth, ...ofPaper]), gl.STATIC_DRAW);
    gl.bindVertexArray(null);
    return { made, count, all: triangles.length, cloth: ofCloth.length };
  }

  #material({ codes, largest, shares, albedo, albedo_of_views, mean_albedo }) {
    const { gl } = this, { sides, rings, turns, steps } = this.manifest.table;
    const values = summed(codes.values, sides * sides * turns * 3);
    const table = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_3D, table);
    filter(gl, gl.TEXTURE_3D, gl.REPEAT);
    const data = new Float32Array(turns * rings * sides * sides * 4);
    let from = 0;
    for (let ring = 0; ring < rings; ring++) {
      for (let u = 0; u < sides; u++) {
        for (let v = 0; v < sides; v++) {
          let to = 4 * turns * (ring + rings * (v + sides * u));
          for (let turn = 0; turn < turns; turn++, to += 4) {
            for (let c = 0; c < 3; c++) data[to + c] = values[from++] / steps;
          }
        }
      }
    }
    gl.texImage3D(gl.TEXTURE_3D, 0, gl.RGBA16F, turns, rings * sides, sides, 0, gl.RGBA, gl.FLOAT, data);
    const wide = (array, channels, wrap) => {
      const [rows, columns] = array.shape, made = gl.createTexture(), padded = new Float32Array(4 * rows * columns);
      for (let n = 0; n < rows * columns; n++) for (let c = 0; c < 3; c++) padded[4 * n + c] = array.values[channels * n + (c % channels)];
      gl.bindTexture(gl.TEXTURE_2D, made);
      filter(gl, gl.TEXTURE_2D, wrap);
      gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA16F, columns, rows, 0, gl.RGBA, gl.FLOAT, padded);
      return made;
    };
    const gloss = albedo && { albedo: wide(albedo, 1, gl.REPEAT), mean: mean_albedo.values[0], views: albedo_of_views };
    return { table, largest: largest.values[0], wide, shares, gloss };
  }

  /** Texture of the share of even light that a material sends to each view, and its mean (nishiki.render.cloth.dyes). */
  #sharesOf(material, dye) {
    const { gl } = this, name = `${dye}`;
    if (material.shown !== name) {
      if (material.shareTexture) gl.deleteTexture(material.shareTexture);
      const { values, shape } = dye ? material.gloss.views : material.shares;
      const sent = dye ? Float32Array.from({ length: 3 * values.length }, (_, n) => {
        const a = values[Math.floor(n / 3)];
        return Math.min(Math.max(a + (1 - a) * dye[n % 3], 0), 1);
      }) : values;
      const back = [0, 1, 2].map((c) => sent.filter((_, n) => n % 3 === c).reduce((sum, v) => sum + v, 0) / (sent.length / 3));
      Object.assign(material, { shown: name, shareTexture: material.wide({ values: sent, shape }, 3, gl.CLAMP_TO_EDGE), back });
    }
    return { shares: material.shareTexture, back: material.back };
  }

  /** The state's lamps in the scene's frame, for sample `k`: each with a point of its disc. None shines through the paper. */
  lampsOf(state, k) {
    const { camera, centre, radius, floor } = this.manifest.shapes[this.shapeName(state)];
    const front = [camera.rotation[0], scale(camera.rotation[1], -1), scale(camera.rotation[2], -1)];
    const reach = Math.sqrt((k + 0.5) / SAMPLES), angle = GOLDEN * k;
    return (state.lamps ?? []).slice(0, LAMPS).map((lamp) => {
      const [azimuth, elevation] = [lamp.azimuth_deg, lamp.elevation_deg].map((v) => (v * Math.PI) / 180);
      const seen = [Math.cos(elevation) * Math.cos(azimuth), Math.cos(elevation) * Math.sin(azimuth), Math.sin(elevation)];
      const towards = apply(transpose(front), seen);
      const x = normalised(cross(Math.abs(towards[0]) < 0.6 ? [1, 0, 0] : [0, 1, 0], towards)), y = cross(towards, x);
      const near = lamp.distance !== null && lamp.distance !== undefined, distance = near ? 2 * radius * lamp.distance : 1;
      const wide = distance * Math.tan(((lamp.radius_deg ?? 0) * Math.PI) / 180) * reach;
      const off = add(scale(x, wide * Math.cos(angle)), scale(y, wide * Math.sin(angle)));
      const vector = near ? add(centre, scale(towards, distance)) : towards;
      return { near, vector, shadow: near ? add(vector, off) : normalised(add(towards, off)), strength: lamp.intensity ?? 1, distance };
    }).filter(({ near, shadow }) => floor === null || shadow[1] > (near ? floor : 0));
  }

  /** Depth of the cloth as every lamp sees it. */
  #drawShadows(lamps, surface, { centre, radius }) {
    const { gl } = this;
    if (this.maps.layers < lamps.length) {
      for (const old of this.maps.targets ?? []) gl.deleteFramebuffer(old);
      if (this.maps.texture) gl.deleteTexture(this.maps.texture);
      const made = gl.createTexture();
      gl.bindTexture(gl.TEXTURE_2D_ARRAY, made);
      filter(gl, gl.TEXTURE_2D_ARRAY, gl.CLAMP_TO_EDGE, gl.NEAREST);
      gl.texStorage3D(gl.TEXTURE_2D_ARRAY, 1, gl.DEPTH_COMPONENT24, MAP, MAP, lamps.length);
      const targets = lamps.map((_, layer) => {
        const target = gl.createFramebuffer();
        gl.bindFramebuffer(gl.FRAMEBUFFER, target);
        gl.framebufferTextureLayer(gl.FRAMEBUFFER, gl.DEPTH_ATTACHMENT, made, 0, layer);
        return target;
      });
      this.maps = { layers: lamps.length, texture: made, targets };
    }
    gl.enable(gl.DEPTH_TEST);
    gl.viewport(0, 0, MAP, MAP);
    gl.bindVertexArray(surface.made);
    return lamps.map((lamp, layer) => {
      const toLamp = lampMatrix(lamp, centre, radius);
      gl.bindFramebuffer(gl.FRAMEBUFFER, this.maps.targets[layer]);
      gl.clear(gl.DEPTH_BUFFER_BIT);
      this.programs.shadow.use({ toLamp });
      gl.drawElements(gl.TRIANGLES, surface.cloth, gl.UNSIGNED_INT, 0);
      return toLamp;
    });
  }

  #uniforms(state, surface, k) {
    const shape = this.manifest.shapes[this.shapeName(state)], dye = this.dyeOf(state);
    const material = this.materials.get(this.keyOf(state)), lamps = this.lampsOf(state, k);
    const matrices = this.#drawShadows(lamps, surface, shape), { sides, rings, turns, edge, least_cosine } = this.manifest.table;
    const padded = (values, empty) => Array.from({ length: LAMPS }, (_, n) => values[n] ?? empty);
    const zero = new Array(16).fill(0);
    return {
      lamps: lamps.length, near: padded(lamps.map(({ near }) => near), false), lampVector: padded(lamps.map(({ vector }) => vector), [0, 0, 1]),
      strength: padded(lamps.map(({ strength }) => strength), 0), reference: padded(lamps.map(({ distance }) => distance), 1),
      toLamp: padded(matrices, zero), centre: shape.centre, radius: shape.radius, shadows: this.maps.texture ?? null, lift: shape.lift, shadowBias: MAP_BIAS,
      above: state.ambient ?? 0, below: BELOW * (state.ambient ?? 0), reflectance: shape.reflectance, leastCosine: least_cosine,
      table: material.table, sides, rings, turns, edge, largest: material.largest, ...this.#sharesOf(material, dye),
      dyed: Boolean(dye), dye: dye ?? [0, 0, 0], glossAlbedo: material.gloss?.albedo ?? material.shareTexture, meanAlbedo: material.gloss?.mean ?? 0,
    };
  }

  /** Whether all that a state shows is loaded; asks for what lacks. */
  #has(state) {
    const shape = this.shapeName(state), key = this.keyOf(state);
    this.shapeOf(shape);
    this.materialOf(key);
    return Boolean(this.shapes.get(`shape-${shape}`)?.made && this.materials.get(key)?.table);
  }

  /** Draw one frame; region {x, y, width, height} of the canvas, from its upper left corner, or all of it. */
  draw(state, region) {
    const { gl, canvas } = this, { width, height } = canvas;
    const area = region ?? { x: 0, y: 0, width, height };
    if (!this.#has(state)) return;
    const name = area.width === width ? "whole" : area.x > 0 ? "right" : "left";
    if (name === "whole") for (const other of ["left", "right"]) this.#forget(other);
    else this.#forget("whole");
    this.shown = this.shapeName(state);
    const part = this.#part(name, state, width, height);
    if (part.count < SAMPLES) {
      this.#addSample(part, state, width, height);
      if (part.count < SAMPLES) setTimeout(() => this.onready());
    }
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.viewport(0, 0, width, height);
    gl.disable(gl.DEPTH_TEST);
    gl.enable(gl.SCISSOR_TEST);
    gl.scissor(area.x, height - area.y - area.height, area.width, area.height);
    this.programs.develop.use({ picture: part.mean[0].texture, exposure: exposureOf(state), coded: part.layer > 0 });
    this.drawScreen();
    gl.disable(gl.SCISSOR_TEST);
  }

  /** The textures of a part of the canvas; begun anew where its state is another than before. */
  #part(name, state, width, height) {
    const { lamps, ambient, view, layer, options } = state, key = JSON.stringify([lamps, ambient, view, layer, options]);
    let part = this.parts[name];
    if (!part || part.width !== width || part.height !== height) {
      this.#forget(name);
      const make = (format, depth) => {
        const made = texture(this.gl, format, width, height);
        return { texture: made, target: framebuffer(this.gl, [made], depth) };
      };
      part = { width, height, sample: make("RGBA16F", [width, height]), mean: [make("RGBA32F"), make("RGBA32F")] };
      this.parts[name] = part;
    }
    if (part.key !== key) {
      const now = performance.now(), apart = now - this.changed;
      this.changed = now;
      this.slow ||= apart > SLOW[0] && apart < SLOW[1];
      Object.assign(part, { key, count: this.slow ? -1 : 0, layer: Math.max(LAYERS.findIndex((each) => each.name === layer), 0) });
    }
    return part;
  }

  #forget(name) {
    const { gl } = this, part = this.parts[name];
    if (!part) return;
    for (const { texture: old, target } of [part.sample, ...part.mean]) {
      gl.deleteTexture(old);
      gl.deleteFramebuffer(target);
    }
    delete this.parts[name];
  }

  #addSample(part, state, width, height) {
    const { gl } = this, coarse = part.count < 0 ? COARSE : 1, k = Math.max(part.count, 0), [mean, next] = part.mean;
    // the additive sequence of the plastic number covers the pixel evenly, its middle first
    const shift = k ? [(0.5 + k * 0.7548776662) % 1 - 0.5, (0.5 + k * 0.5698402910) % 1 - 0.5] : [0, 0];
    const size = { width: Math.ceil(width / coarse), height: Math.ceil(height / coarse) };
    this.#drawSurface(part.sample.target, state, size, shift, k, part.layer);
    gl.bindFramebuffer(gl.FRAMEBUFFER, next.target);
    gl.viewport(0, 0, width, height);
    gl.disable(gl.DEPTH_TEST);
    this.programs.mean.use({ mean: mean.texture, next: part.sample.texture, count: k, coarse });
    this.drawScreen();
    part.mean.reverse();
    part.count++;
  }

  #drawSurface(target, state, size, shift, k, layer, picture = size) {
    const { gl } = this, name = this.shapeName(state), surface = this.shapes.get(`shape-${name}`);
    const view = this.viewOf(state), camera = this.cameraOf(view, name, picture);
    const uniforms = this.#uniforms(state, surface, k);
    gl.bindFramebuffer(gl.FRAMEBUFFER, target);
    gl.viewport(0, 0, size.width, size.height);
    gl.enable(gl.DEPTH_TEST);
    gl.clearBufferfv(gl.COLOR, 0, [0, 0, 0, 0]);
    gl.clear(gl.DEPTH_BUFFER_BIT);
    gl.bindVertexArray(surface.made);
    const toScreen = screenMatrix(camera, size, shift, this.manifest.shapes[name].radius);
    this.programs.cloth.use({ ...uniforms, toScreen, eye: view.eye, layer });
    gl.drawElements(gl.TRIANGLES, surface.all, gl.UNSIGNED_INT, 0);
    gl.bindVertexArray(null);
  }

  /** The camera of a view; a canvas that is narrower than the first view's picture shows the same from side to side. */
  cameraOf(view, shape, { width, height }) {
    const { rows, columns } = this.manifest.shapes[shape].camera;
    const camera = lookAt(view, Math.min(height, (width * rows) / columns), width);
    camera.intrinsics[1][2] = (height - 1) / 2;
    return camera;
  }

  drawScreen() {
    this.gl.bindVertexArray(this.empty);
    this.gl.drawArrays(this.gl.TRIANGLES, 0, 3);
  }

  /** What the canvas shows at (x, y): place, normal, openness, and the cloth's reflectance there under the first lamp. */
  async probe(x, y, state) {
    if (!this.#has(state)) return null;
    const [place, normal, openness, values] = [PLACE, 1, 3, REFLECTANCE].map((layer) => this.#pixel(x, y, state, layer));
    if (place[3] === 0) return null;
    const unit = 1000, { vector, near } = this.lampsOf(state, 0)[0] ?? { vector: [0, 0, 1], near: false };
    const n = normalised(normal.slice(0, 3).map((v) => 2 * v - 1)), at = place.slice(0, 3);
    const angle = (towards) => (Math.acos(Math.min(Math.max(dot(n, normalised(towards)), -1), 1)) * 180) / Math.PI;
    return {
      position_mm: at.map((v) => v * unit), normal: n, layers: { openness: openness[0] }, spectrum: null, photographs: null,
      gloss: {
        reflectance: values.slice(0, 3), lamp_deg: angle(near ? subtract(vector, at) : vector),
        eye_deg: angle(subtract(this.viewOf(state).eye, at)),
      },
    };
  }

  /** Four numbers of a layer at one pixel of the canvas. */
  #pixel(x, y, state, layer) {
    const { gl, canvas } = this, values = texture(gl, "RGBA32F", 1, 1), target = framebuffer(gl, [values], [1, 1]);
    const size = { width: canvas.width, height: canvas.height };
    this.#drawSurface(target, state, { width: 1, height: 1, x: Math.floor(x), y: Math.floor(y) }, [0, 0], 0, layer, size);
    const out = new Float32Array(4);
    gl.bindFramebuffer(gl.FRAMEBUFFER, target);
    gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.FLOAT, out);
    gl.deleteFramebuffer(target);
    gl.deleteTexture(values);
    return Array.from(out);
  }

  toScene(x, y) {
    return [x, y];
  }

  /** RGBA bytes of the canvas, first row at the bottom. */
  readPixels() {
    this.gl.bindFramebuffer(this.gl.FRAMEBUFFER, null);
    return readback(this.gl, 0, 0, this.canvas.width, this.canvas.height);
  }

  layers() {
    return LAYERS;
  }

  /** What else of a state can be chosen; see layers.js. */
  options() {
    const { shapes, materials, dyes } = this.manifest, regions = new Set(materials.map(({ region }) => region));
    const named = materials.map(({ region, model }) => [`${region}-${model}`, regions.size > 1 ? `${region}: ${model}` : model]);
    return [
      { name: "shape", label_key: "option.shape", values: Object.keys(shapes).map((name) => [name, `option.shape.${name}`]), value: this.firstShape },
      { name: "material", label_key: "option.material", values: named, value: named[0][0] },
      { name: "dye", label_key: "option.dye", values: [["measured", "option.dye.measured"], ...Object.keys(dyes).map((name) => [name, name]), ["own", "option.dye.own"]], value: "measured" },
      { name: "colour", label_key: "option.colour", colour: true, value: "#808080", when: ["dye", "own"] },
    ];
  }

  bounds() {
    const across = 2000 * this.radius;
    return { width_mm: across, height_mm: across, unit: "mm" };
  }

  cost() {
    return { texture_reads: 5, operations: 150 }; // a lamp: two of the table, one of its map, two of a dye's albedo
  }
}

/** Factor at which a white sheet that faces the brightest lamp is white, or the state's own. */
function exposureOf({ exposure, lamps = [], ambient = 0 }) {
  if (typeof exposure === "number") return exposure;
  const sheet = Math.max(0, ...lamps.map(({ intensity = 1 }) => intensity)) + ambient;
  return sheet > 0 ? 1 / sheet : 1;
}

/** From the scene to the picture of a lamp: a box around the cloth, or a pyramid from a near lamp. */
function lampMatrix({ near, shadow }, centre, radius) {
  const away = near ? subtract(shadow, centre) : shadow, back = normalised(away);
  const x = normalised(cross(Math.abs(back[1]) < 0.9 ? [0, 1, 0] : [1, 0, 0], back)), y = cross(back, x);
  const row = (axis, factor, from) => [...scale(axis, factor), -factor * dot(axis, from)];
  if (!near) return [row(x, 1 / radius, centre), row(y, 1 / radius, centre), row(back, -1 / radius, centre), [0, 0, 0, 1]];
  const distance = Math.hypot(...away), [first, last] = [distance - radius, distance + radius];
  const half = radius / Math.sqrt(distance ** 2 - radius ** 2), depth = row(back, -1, shadow);
  return [
    row(x, 1 / half, shadow), row(y, 1 / half, shadow),
    depth.map((v, n) => ((last + first) * v - (n === 3 ? 2 * last * first : 0)) / (last - first)), depth,
  ];
}

/** From the scene to the canvas; shift: of the samples in pixels; size: {width, height} and, of a part, its corner. */
function screenMatrix({ intrinsics, rotation, translation }, { width, height, x = 0, y = 0 }, shift, radius) {
  const [near, far] = [NEAREST * radius, FARTHEST * radius];
  const [columns, rows] = [intrinsics[0][2] + 0.5 - x + shift[0], intrinsics[1][2] + 0.5 - y + shift[1]];
  const lens = [
    [(2 * intrinsics[0][0]) / width, 0, (2 * columns) / width - 1],
    [0, (-2 * intrinsics[1][1]) / height, 1 - (2 * rows) / height],
    [0, 0, (far + near) / (far - near)], [0, 0, 1],
  ];
  const world = rotation.map((row, n) => [...row, translation[n]]);
  return lens.map((row, n) => [0, 1, 2, 3].map((c) => row.reduce((sum, v, m) => sum + v * world[m][c], n === 2 && c === 3 ? (-2 * far * near) / (far - near) : 0)));
}

/** Rows of `width` integers, each the sum of the differences up to it, in the type of the differences. */
function summed(values, width) {
  for (let n = width; n < values.length; n++) values[n] += values[n - width];
  return values;
}

/** Rows of three and a fourth number. */
function four(values, fourth) {
  const out = new Int16Array((values.length / 3) * 4);
  for (let n = 0; n < values.length / 3; n++) out.set([values[3 * n], values[3 * n + 1], values[3 * n + 2], fourth(n)], 4 * n);
  return out;
}

function attribute(gl, place, data, size) {
  gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
  gl.bufferData(gl.ARRAY_BUFFER, data, gl.STATIC_DRAW);
  gl.enableVertexAttribArray(place);
  const type = data instanceof Float32Array ? gl.FLOAT : data instanceof Int16Array ? gl.SHORT : gl.UNSIGNED_BYTE;
  gl.vertexAttribPointer(place, size, type, type !== gl.FLOAT, 0, 0);
}

function filter(gl, target, wrap, kind = gl.LINEAR) {
  for (const name of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(target, name, kind);
  gl.texParameteri(target, gl.TEXTURE_WRAP_S, wrap);
  gl.texParameteri(target, gl.TEXTURE_WRAP_T, gl.CLAMP_TO_EDGE);
  if (target === gl.TEXTURE_3D) gl.texParameteri(target, gl.TEXTURE_WRAP_R, gl.CLAMP_TO_EDGE);
}

const decode = (code) => (code <= 0.04045 ? code / 12.92 : ((code + 0.055) / 1.055) ** 2.4);
