// The viewer's scene of a cloth: draped, flat or on cylinders, with any of its models and dyes, under any lamps.

import { unpackArrays } from "viewer/arrays";
import { enlarged, freeView, lookAt, screenMatrix } from "viewer/cameras";
import { sharesOf, uploadMaterial, uploadSurface } from "viewer/cloth_blocks";
import { CLOTH_FRAGMENT, CLOTH_VERTEX, DEVELOP_FRAGMENT, SHADOW_VERTEX } from "viewer/cloth_shaders";
import { decode } from "viewer/colour";
import { SCREEN_VERTEX, enhancementOf } from "viewer/common_shaders";
import { freeLamps } from "viewer/free_lamps";
import { Shader, drop, framebuffer, image } from "viewer/gl";
import { dot, normalised, scale, subtract } from "viewer/matrices";
import { MeanPictures } from "viewer/mean_picture";
import { RoundScene } from "viewer/round_scene";
import { MAP_BIAS, SHADOW_FRAGMENT, ShadowMaps } from "viewer/shadow_maps";
import { MOST_LAMPS } from "viewer/state";

const NEAREST = 0.02, FARTHEST = 40; // of what is drawn, in radii of the cloth
const BELOW = 1 / 3; // of the light from above
const LAYERS = [
  { name: "appearance", label_key: "layer.appearance", unit: "", range: [0, 1], map: "grey" },
  { name: "normals", label_key: "layer.normals", unit: "", range: [-1, 1], map: "normal" },
  { name: "weft", label_key: "layer.weft", unit: "", range: [-1, 1], map: "normal" },
  { name: "openness", label_key: "layer.openness", unit: "", range: [0, 1], map: "grey" },
];
const PLACE = 4, REFLECTANCE = 5; // layers that are read, not shown

export class ClothScene extends RoundScene {
  static async open(canvas, manifest, loader) {
    const scene = new ClothScene(canvas, manifest, loader);
    await Promise.all([scene.shapeOf(scene.firstShape), scene.materialOf(scene.keyOf({}))]);
    scene.draw({ lamps: [], ambient: 0, options: {}, view: scene.firstView() });
    return scene;
  }

  constructor(canvas, manifest, loader) {
    super(canvas, manifest, loader, "a cloth");
    const { gl } = this, { sides, rings } = manifest.table;
    if (gl.getParameter(gl.MAX_3D_TEXTURE_SIZE) < sides * rings) {
      throw new Error(`A cloth needs volume textures of ${sides * rings} texels; this graphics processor has ${gl.getParameter(gl.MAX_3D_TEXTURE_SIZE)}.`);
    }
    this.programs = {
      shadow: new Shader(gl, SHADOW_VERTEX, SHADOW_FRAGMENT), cloth: new Shader(gl, CLOTH_VERTEX, CLOTH_FRAGMENT),
      develop: new Shader(gl, SCREEN_VERTEX, DEVELOP_FRAGMENT),
    };
    this.firstShape = Object.keys(manifest.shapes)[0];
    this.shown = this.firstShape; // surface of the last picture
    this.shapes = new Map(); // what is loaded, or its promise
    this.materials = new Map();
    this.loading = 0;
    this.maps = new ShadowMaps(gl);
    this.means = new MeanPictures(gl, (...sample) => this.#drawSample(...sample), () => this.drawScreen());
  }

  get busy() {
    return this.loading > 0 || this.means.busy;
  }

  /** What of the panel this scene has use for. */
  get offers() {
    return ["softness", "exposure sheet"];
  }

  /** The surfaces are computed, not captured: they have no relief to exaggerate. */
  get enhancements() {
    return ["none", "specular"];
  }

  /** For the control of the camera. */
  get axis() {
    return [0, 1, 0];
  }

  get radius() {
    return this.manifest.shapes[this.shown].radius;
  }

  /** Millimetres to the unit of the surface that is shown; that of a file is not known, and its numbers are given as they are. */
  get unit() {
    return this.shown === "file" ? 1 : 1000;
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
    return this.#loaded(this.shapes, `shape-${name}`, (arrays) => uploadSurface(this.gl, arrays, this.manifest.shapes[name].step));
  }

  materialOf(key) {
    return this.#loaded(this.materials, key, (arrays) => uploadMaterial(this.gl, arrays, this.manifest.table));
  }

  /** The state's lamps in the scene's frame, for sample `k`. None shines through the paper. */
  lampsOf(state, k) {
    const { camera, centre, radius, floor } = this.manifest.shapes[this.shapeName(state)];
    const front = [camera.rotation[0], scale(camera.rotation[1], -1), scale(camera.rotation[2], -1)];
    const lamps = freeLamps((state.lamps ?? []).slice(0, MOST_LAMPS), front, centre, radius, k);
    return lamps.filter(({ near, shadow }) => floor === null || shadow[1] > (near ? floor : 0));
  }

  /** Depth of the cloth as every lamp sees it. */
  #drawShadows(lamps, surface, { centre, radius }) {
    const { gl } = this;
    return this.maps.draw(lamps, centre, radius, (toLamp) => {
      this.programs.shadow.use({ toLamp });
      gl.bindVertexArray(surface.made);
      gl.drawElements(gl.TRIANGLES, surface.cloth, gl.UNSIGNED_INT, 0);
    });
  }

  #uniforms(state, surface, k) {
    const shape = this.manifest.shapes[this.shapeName(state)], dye = this.dyeOf(state);
    const material = this.materials.get(this.keyOf(state)), lamps = this.lampsOf(state, k);
    const matrices = this.#drawShadows(lamps, surface, shape), { sides, rings, turns, edge, least_cosine } = this.manifest.table;
    const padded = (values, empty) => Array.from({ length: MOST_LAMPS }, (_, n) => values[n] ?? empty);
    const zero = new Array(16).fill(0);
    return {
      lamps: lamps.length, near: padded(lamps.map(({ near }) => near), false), lampVector: padded(lamps.map(({ vector }) => vector), [0, 0, 1]),
      lampStrength: padded(lamps.map(({ strength }) => strength), 0), reference: padded(lamps.map(({ distance }) => distance), 1),
      toLamp: padded(matrices, zero), centre: shape.centre, radius: shape.radius, shadows: this.maps.texture, lift: shape.lift, shadowBias: MAP_BIAS,
      above: state.ambient ?? 0, below: BELOW * (state.ambient ?? 0), reflectance: shape.reflectance, leastCosine: least_cosine,
      table: material.table, sides, rings, turns, edge, largest: material.largest, ...sharesOf(this.gl, material, dye),
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

  /** Give up what was kept for parts of the canvas that are not drawn any more. */
  keepOnly(parts) {
    this.means.keepOnly(parts);
  }

  /** Draw one frame; region {x, y, width, height} of the canvas, from its upper left corner, or all of it; part: its name,
   * `main`, `left` of the divider, or `lens`. */
  draw(state, region, part = "main") {
    const { width, height } = this.canvas, area = region ?? { x: 0, y: 0, width, height };
    if (!this.#has(state)) return;
    this.shown = this.shapeName(state);
    const { texture, more } = this.means.next(part, area, state, { width, height });
    if (more) setTimeout(() => this.onready());
    this.onCanvas(area, () => {
      this.programs.develop.use({ picture: texture, exposure: exposureOf(state), coded: layerOf(state) > 0 });
      this.drawScreen();
    });
  }

  /** Draw one sample of a picture, within an area {x, y, width, height} of the framebuffer where it is given. */
  #drawSample(target, size, shift, k, state, area) {
    this.#drawSurface(target, state, size, shift, k, layerOf(state), { area });
  }

  #drawSurface(target, state, size, shift, k, layer, { picture = size, area = null } = {}) {
    const { gl } = this, name = this.shapeName(state), surface = this.shapes.get(`shape-${name}`);
    const view = this.viewOf(state), camera = this.cameraOf(view, name, picture);
    const uniforms = this.#uniforms(state, surface, k);
    gl.bindFramebuffer(gl.FRAMEBUFFER, target);
    gl.viewport(0, 0, size.width, size.height);
    gl.enable(gl.DEPTH_TEST);
    if (area) {
      gl.enable(gl.SCISSOR_TEST);
      gl.scissor(area.x, area.y, area.width, area.height);
    }
    gl.clearBufferfv(gl.COLOR, 0, [0, 0, 0, 0]);
    gl.clear(gl.DEPTH_BUFFER_BIT);
    gl.bindVertexArray(surface.made);
    const { radius } = this.manifest.shapes[name], toScreen = screenMatrix(camera, size, shift, NEAREST * radius, FARTHEST * radius);
    this.programs.cloth.use({ ...uniforms, toScreen, eye: view.eye, layer, enhance: enhancementOf(state), strength: state.strength ?? 0 });
    gl.drawElements(gl.TRIANGLES, surface.all, gl.UNSIGNED_INT, 0);
    gl.bindVertexArray(null);
    gl.disable(gl.SCISSOR_TEST);
  }

  /** The camera of a view; a canvas that is narrower than the first view's picture shows the same from side to side. */
  cameraOf(view, shape, { width, height }) {
    const { rows, columns } = this.manifest.shapes[shape].camera;
    const camera = lookAt(view, Math.min(height, (width * rows) / columns), width);
    camera.intrinsics[1][2] = (height - 1) / 2;
    return view.lens ? enlarged(camera, view.lens, { width, height }) : camera;
  }

  /** What the canvas shows at (x, y): place, normal, openness, and the cloth's reflectance there under the first lamp. */
  async probe(x, y, state) {
    if (!this.#has(state)) return null;
    const [place, normal, openness, values] = [PLACE, 1, 3, REFLECTANCE].map((layer) => this.#pixel(x, y, state, layer));
    if (place[3] === 0) return null;
    const { vector, near } = this.lampsOf(state, 0)[0] ?? { vector: [0, 0, 1], near: false };
    const n = normalised(normal.slice(0, 3).map((v) => 2 * v - 1)), at = place.slice(0, 3);
    const angle = (towards) => (Math.acos(Math.min(Math.max(dot(n, normalised(towards)), -1), 1)) * 180) / Math.PI;
    return {
      position_mm: at.map((v) => v * this.unit), normal: n, layers: { openness: openness[0] }, spectrum: null, photographs: null,
      gloss: {
        reflectance: values.slice(0, 3), lamp_deg: angle(near ? subtract(vector, at) : vector),
        eye_deg: angle(subtract(this.viewOf(state).eye, at)),
      },
    };
  }

  /** Four numbers of a layer at one pixel of the canvas. */
  #pixel(x, y, state, layer) {
    const { gl, canvas } = this, values = image(gl, "RGBA32F", 1, 1), target = framebuffer(gl, [values], [1, 1]);
    const size = { width: canvas.width, height: canvas.height };
    this.#drawSurface(target, state, { width: 1, height: 1, x: Math.floor(x), y: Math.floor(y) }, [0, 0], 0, layer, { picture: size });
    const out = new Float32Array(4);
    gl.bindFramebuffer(gl.FRAMEBUFFER, target);
    gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.FLOAT, out);
    drop(gl, target);
    gl.deleteTexture(values);
    return Array.from(out);
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
    const across = 2 * this.radius * this.unit;
    return { width_mm: across, height_mm: across, unit: this.shown === "file" ? "" : "mm" };
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

/** Number of a state's layer. */
const layerOf = ({ layer }) => Math.max(LAYERS.findIndex(({ name }) => name === layer), 0);
