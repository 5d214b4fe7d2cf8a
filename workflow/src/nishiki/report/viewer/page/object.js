// The viewer's scene of a turntable object: the coded object, decoded in the browser and drawn as
// nishiki.render.object draws it.

import { unpackArrays } from "viewer/arrays";
import { enlarged, projected } from "viewer/cameras";
import { CodedObject } from "viewer/coded_object";
import { decode } from "viewer/colour";
import { SCREEN_VERTEX, enhancementOf } from "viewer/common_shaders";
import { Shader, drop, framebuffer, image } from "viewer/gl";
import { add, apply, scale } from "viewer/matrices";
import { capturedUniforms, freeUniforms, hasFreeLamps } from "viewer/object_lamps";
import { ObjectProbe } from "viewer/object_probe";
import {
  COVERAGE_FRAGMENT, DISPLAY_FRAGMENT, LINES_FRAGMENT, LINES_VERTEX, MESH_VERTEX, meshFragment,
} from "viewer/object_shaders";
import { ObjectShadows } from "viewer/object_shadows";
import { ObjectSurface } from "viewer/object_surface";
import { ObjectTexels } from "viewer/object_texels";
import { ObjectViews } from "viewer/object_views";
import { RoundScene } from "viewer/round_scene";

const SAMPLES = 4; // of a pixel at the object's edge
const EDGE = 2; // pixels from which the object's edge is carried on
const MOST_LIGHT = 6e4; // that a half float holds
const MILLIMETRES = { mm: 1, cm: 10, m: 1000 };
const LAYER = { appearance: 0, colours: 1, greys: 2, normals: 3 };
const LAYERS = [
  { name: "appearance", label_key: "layer.appearance", unit: "", range: [0, 1], map: "grey" },
  { name: "diffuse", label_key: "layer.diffuse", unit: "", range: [0, 1], map: "grey" },
  { name: "specular", label_key: "layer.specular", unit: "", range: [0, 0.2], map: "grey" },
  { name: "roughness", label_key: "layer.roughness", unit: "rad", range: [0, 1], map: "grey" },
  { name: "normals", label_key: "layer.normals", unit: "", range: [-1, 1], map: "normal" },
  { name: "residual", label_key: "layer.residual_coded", unit: "", range: [-0.2, 0.2], map: "diverging" },
];

export class ObjectScene extends RoundScene {
  /** @type {CodedObject} */ coded;
  /** @type {CodedObject | null} */ pictures = null; // captured views, a tile of pixels each, in place of residuals of texels
  /** @type {ObjectSurface} */ mesh;
  /** @type {ObjectTexels} */ texels;
  /** @type {ObjectShadows} */ shadows;

  static async open(canvas, manifest, loader) {
    const scene = new ObjectScene(canvas, manifest, loader);
    const arrays = await unpackArrays(await loader.load("object"));
    scene.coded = new CodedObject(manifest.design, arrays);
    const ofPictures = Object.entries(arrays).filter(([name]) => name.startsWith("pictures/"));
    scene.pictures = manifest.pictures
      && new CodedObject(manifest.pictures, Object.fromEntries(ofPictures.map(([name, array]) => [name.slice(9), array])));
    scene.mesh = new ObjectSurface(scene.gl, manifest, arrays);
    scene.makePrograms();
    scene.texels = new ObjectTexels(scene, scene.coded, scene.mesh, arrays);
    scene.shadows = new ObjectShadows(scene);
    return scene;
  }

  constructor(canvas, manifest, loader) {
    super(canvas, manifest, loader, "an object");
    this.views = new ObjectViews(manifest);
    this.targets = new Map(); // `width x height` -> framebuffers
    this.shownAt = 0; // time of the last picture
  }

  get busy() {
    return this.texels.working > 0 || this.shadows.busy;
  }

  /** What of the panel this scene has use for. */
  get offers() {
    return ["captured lamps", "softness", ...(this.millimetres ? ["ruler"] : [])];
  }

  get enhancements() {
    return ["none", "specular", "relief"];
  }

  /** Axis of the turn and radius of the object, for the control of the camera. */
  get axis() {
    return this.manifest.turn.axis;
  }

  get radius() {
    return this.manifest.radius;
  }

  /** Largest linear value of a state's picture: under other lamps what the capture could hold means nothing. */
  ceilingOf(state) {
    return hasFreeLamps(state) ? MOST_LIGHT : (this.manifest.ceiling ?? MOST_LIGHT);
  }

  /** Millimetres to the cameras' unit; undefined where that is no length. */
  get millimetres() {
    return MILLIMETRES[this.manifest.unit];
  }

  firstView() {
    return this.views.first();
  }

  /** View of a state; the first one where the state has none of an object. */
  viewOf(state) {
    return this.views.of(state);
  }

  freeViewOf(state) {
    return this.views.freed(state);
  }

  capturedView(state, steps) {
    return this.views.stepped(state, steps);
  }

  /** The camera of a view for a picture {width, height}, and its position along the turn. */
  cameraOf(view, size = { width: 1, height: 1 }) {
    const { camera, position } = this.views.camera(view, size);
    return { camera: view.lens ? enlarged(camera, view.lens, size) : camera, position };
  }

  lightOf(state) {
    return Math.max(this.manifest.lights.indexOf(state.options?.light), 0);
  }

  makePrograms() {
    const { gl } = this;
    this.programs = {
      coverage: new Shader(gl, MESH_VERTEX, COVERAGE_FRAGMENT),
      mesh: new Shader(gl, MESH_VERTEX, meshFragment(this.coded.design.encoding === "srgb")),
      lines: new Shader(gl, LINES_VERTEX, LINES_FRAGMENT),
      display: new Shader(gl, SCREEN_VERTEX, DISPLAY_FRAGMENT),
    };
  }

  /** Captured views, with weights, whose residual a state shows; a residual belongs to the light that it was captured under,
   * and to what an eye sees. */
  lending(state, view, position) {
    return hasFreeLamps(state) || enhancementOf(state) || state.options?.residual === false ? [] : this.views.lending(view, position);
  }

  /** Draw the texels as a state's camera sees them, for a part of the canvas; see ObjectShadows. The lens shows the texels of
   * `main` from the same eye. */
  drawTexels(state, camera, lenders, part) {
    const light = this.lightOf(state), free = hasFreeLamps(state);
    const shaded = free && state.lamps?.length > 0 && state.options.shadows !== false;
    if (!shaded) this.shadows.forget(part);
    const shadows = shaded ? this.shadows.next(part, state, camera) : null;
    const lamps = free ? freeUniforms(this.manifest, state, camera) : capturedUniforms(this.manifest, light, camera);
    this.texels.draw(camera, { ...lamps, enhance: enhancementOf(state), strength: state.strength ?? 0 }, lenders, light, { shadows });
    if (this.shadows.busy) setTimeout(() => this.onready());
  }

  /** Give up what was kept for parts of the canvas that are not drawn any more. */
  keepOnly(parts) {
    if (!parts.includes("left")) this.shadows.forget("left");
  }

  /** Draw one frame; region {x, y, width, height} of the canvas, from its upper left corner, or all of it; part: its name,
   * `main`, `left` of the divider, or `lens`. */
  draw(state, region, part = "main") {
    const { gl, canvas } = this, size = { width: canvas.width, height: canvas.height };
    const area = region ?? { x: 0, y: 0, ...size }, view = this.viewOf(state);
    const { camera, position } = this.cameraOf(view, size);
    const layer = LAYERS.find(({ name }) => name === state.layer) ?? LAYERS[0];
    const lenders = layer.name === "residual" ? this.views.lending(view, position) : this.lending(state, view, position);
    const lit = part === "left" ? "left" : "main";
    if (layer.name === "appearance") this.drawTexels(state, camera, lenders, lit);
    else this.shadows.forget(lit);
    const target = this.target(size.width, size.height);
    gl.enable(gl.SCISSOR_TEST);
    // more than the area, because the object's edge is carried on from the pixels around
    gl.scissor(area.x - EDGE, canvas.height - area.y - area.height - EDGE, area.width + 2 * EDGE, area.height + 2 * EDGE);
    this.begin(target.plain, size);
    this.drawPicture(camera, layer, lenders, state);
    this.begin(target.smooth, size);
    this.programs.coverage.use(this.mesh.seenBy(camera));
    this.mesh.draw();
    this.resolve(target.smooth, target.covered, size);
    const lined = Boolean(state.options?.cameras);
    if (lined) {
      this.begin(target.lined, size);
      this.drawCameras(camera, view, position);
    }
    const grey = decode(state.options?.background ?? 0);
    this.onCanvas(area, () => {
      this.programs.display.use({
        picture: target.picture, coverage: target.coverage, overlay: lined ? target.overlay : this.texels.zero, ceiling: this.ceilingOf(state), lined,
        exposure: typeof state.exposure === "number" ? state.exposure : 1,
        background: [grey, grey, grey], coded: layer.name !== "appearance",
      });
      this.drawScreen();
    });
    this.shownAt = performance.now();
  }

  begin(target, area) {
    const { gl } = this;
    gl.bindFramebuffer(gl.FRAMEBUFFER, target);
    gl.viewport(0, 0, area.width, area.height);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.enable(gl.DEPTH_TEST);
  }

  resolve(from, to, area) {
    const { gl } = this, corners = [0, 0, area.width, area.height];
    gl.bindFramebuffer(gl.READ_FRAMEBUFFER, from);
    gl.bindFramebuffer(gl.DRAW_FRAMEBUFFER, to);
    gl.blitFramebuffer(...corners, ...corners, gl.COLOR_BUFFER_BIT, gl.NEAREST);
  }

  drawPicture(camera, layer, lenders, state) {
    const [texels, kind, channel] = this.shown(layer.name, lenders, this.lightOf(state)), { mesh } = this;
    this.programs.mesh.use({
      ...mesh.seenBy(camera), texels, grids: mesh.grids, cells: mesh.cells, size: this.coded.size,
      tilesAcross: this.texels.across, layer: kind, ceiling: this.ceilingOf(state), range: layer.range, channel,
    });
    mesh.draw();
  }

  /** Texture, kind and channel of what a layer shows. */
  shown(name, lenders, light) {
    const { texels } = this;
    if (name === "diffuse") return [texels.diffuse, LAYER.colours, [0, 0, 0, 0]];
    if (name === "specular") return [texels.specular, LAYER.colours, [0, 0, 0, 0]];
    if (name === "roughness") return [texels.diffuse, LAYER.greys, [0, 0, 0, 1]];
    if (name === "normals") return [texels.normals, LAYER.normals, [0, 0, 0, 0]];
    if (name === "residual") {
      const nearest = lenders.reduce((best, lender) => (lender.weight > (best?.weight ?? -1) ? lender : best), null);
      const source = nearest ? texels.residualOf(nearest.view, light).texture : texels.zero;
      return [source, LAYER.colours, [0, 0, 0, 0]];
    }
    return [texels.seen, LAYER.appearance, [0, 0, 0, 0]];
  }

  drawCameras(camera, view, position) {
    const uniforms = this.mesh.seenBy(camera);
    const farthest = 4 * Math.max(uniforms.depthRange[1], ...this.manifest.views.map((v) => v.translation[2]));
    const depthRange = [uniforms.depthRange[0], farthest];
    this.programs.lines.use({ ...uniforms, depthRange, chosen: view.captured ?? this.views.nearest(position) });
    this.gl.disable(this.gl.DEPTH_TEST);
    this.mesh.drawCameraLines();
  }

  /** Framebuffers of the canvas' size: with several samples a pixel, and the picture that they are resolved to. */
  target(width, height) {
    const { gl } = this, key = `${width}x${height}`;
    if (this.targets.has(key)) return this.targets.get(key);
    if (this.targets.size > 3) this.dropTargets();
    const smooth = gl.createFramebuffer();
    gl.bindFramebuffer(gl.FRAMEBUFFER, smooth);
    const buffers = [[gl.RGBA8, gl.COLOR_ATTACHMENT0], [gl.DEPTH_COMPONENT24, gl.DEPTH_ATTACHMENT]];
    const storage = buffers.map(([format, place]) => {
      const buffer = gl.createRenderbuffer();
      gl.bindRenderbuffer(gl.RENDERBUFFER, buffer);
      gl.renderbufferStorageMultisample(gl.RENDERBUFFER, SAMPLES, format, width, height);
      gl.framebufferRenderbuffer(gl.FRAMEBUFFER, place, gl.RENDERBUFFER, buffer);
      return buffer;
    });
    const [picture, coverage, overlay] = ["RGBA16F", "RGBA8", "RGBA8"].map((name) => image(gl, name, width, height));
    const made = {
      smooth, storage, picture, coverage, overlay, plain: framebuffer(gl, [picture], [width, height]),
      covered: framebuffer(gl, [coverage]), lined: framebuffer(gl, [overlay]),
    };
    this.targets.set(key, made);
    return made;
  }

  dropTargets() {
    const { gl } = this;
    for (const { smooth, storage, plain, covered, lined, ...textures } of this.targets.values()) {
      [smooth, plain, covered, lined].forEach((old) => drop(gl, old));
      storage.forEach((old) => gl.deleteRenderbuffer(old));
      Object.values(textures).forEach((old) => gl.deleteTexture(old));
    }
    this.targets.clear();
  }

  /** What the canvas shows at (x, y): place, normal, parameters, and the captured views' values there. */
  async probe(x, y, state) {
    const { camera } = this.cameraOf(this.viewOf(state), this.canvas);
    const found = new ObjectProbe(this).at(camera, x, y, this.lightOf(state));
    if (!found) return null;
    const { kd, ks, normal, place, photographs } = found;
    return {
      position_mm: scale(place, this.millimetres ?? 1), normal, layers: { diffuse: kd.slice(0, 3), specular: ks.slice(0, 3), roughness: kd[3] },
      spectrum: null, photographs,
    };
  }

  /** Point of the surface at (x, y) of the canvas, in mm or the cameras' unit; null beside the object. */
  pointAt(x, y, state) {
    const { camera } = this.cameraOf(this.viewOf(state), this.canvas);
    const place = new ObjectProbe(this).placeAt(camera, x, y);
    return place && scale(place, this.millimetres ?? 1);
  }

  /** Place on the canvas of a point, mm; as events have it, with whole numbers at the corners of pixels. */
  fromScene(point, state) {
    const { camera } = this.cameraOf(this.viewOf(state), this.canvas);
    return projected(camera, scale(point, 1 / (this.millimetres ?? 1))).map((v) => v + 0.5);
  }

  /** Pixels of the canvas to a millimetre at the depth of the object's middle. */
  scaleOf(state) {
    const { camera } = this.cameraOf(this.viewOf(state), this.canvas);
    const depth = add(apply(camera.rotation, this.manifest.centre), camera.translation)[2];
    return camera.intrinsics[0][0] / depth / this.millimetres;
  }

  layers() {
    return LAYERS;
  }

  /** What else of a state can be chosen; see layers.js. */
  options() {
    const { lights } = this.manifest;
    const lighting = ["captured", "free"].map((name) => [name, `option.lighting.${name}`]);
    return [
      { name: "lighting", label_key: "option.lighting", values: lighting, value: "captured" },
      ...(lights.length > 1 ? [{ name: "light", label_key: "option.light", values: lights.map((name) => [name, name]), value: lights[0], when: ["lighting", "captured"] }] : []),
      { name: "residual", label_key: "option.residual", values: null, value: true, when: ["lighting", "captured"] },
      { name: "shadows", label_key: "option.shadows", values: null, value: true, when: ["lighting", "free"] },
      { name: "cameras", label_key: "option.cameras", values: null, value: false },
    ];
  }

  bounds() {
    const across = 2 * this.manifest.radius * (this.millimetres ?? 1);
    return { width_mm: across, height_mm: across, unit: this.millimetres ? "mm" : "" };
  }

  cost() {
    // a texel: position, normal, parameters, residual and visibility of two views; a pixel: four texels, grid, cell
    const { atlas } = this.texels;
    return { texture_reads: 6, operations: 60, texels: atlas ** 2, texel_reads: 8, texel_operations: 150 };
  }
}
