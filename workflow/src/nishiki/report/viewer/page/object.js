// The viewer's scene of a turntable object: the coded object, decoded in the browser and drawn as
// nishiki.render.object draws it.

import { unpackArrays } from "viewer/arrays";
import {
  cameraAlong, centreOf, fitted, freeView, lookAt, neighbours, positionAlong, positionOfEye,
} from "viewer/cameras";
import { CodedObject, surfaceOf, trianglesOfTiles } from "viewer/coded_object";
import { context, readback } from "viewer/gl";
import { add, apply, dot, multiply, norm, normalised, scale, subtract, transpose } from "viewer/matrices";
import {
  COVERAGE_FRAGMENT, DEPTH_FRAGMENT, DISPLAY_FRAGMENT, LAMPS, LINES_FRAGMENT, LINES_VERTEX, MESH_VERTEX, SCREEN_VERTEX, SURFACE_FRAGMENT,
  SURFACE_VERTEX, VISIBILITY_FRAGMENT, meshFragment, texelFragment,
} from "viewer/object_shaders";
import { Shader, framebuffer, integers, texture } from "viewer/shader";

const TO_LAMP_FRAME = [[1, 0, 0], [0, -1, 0], [0, 0, -1]];
const KEPT_VIEWS = 6; // residual textures that stay on the GPU
const SLICE_MS = 14; // of decoding between two chances for events
const REDRAW_MS = 400; // between two pictures while decoding goes on
const SAMPLES = 4; // of a pixel at the object's edge
const MILLIMETRES = { mm: 1, cm: 10, m: 1000 };
const LAYER = { appearance: 0, colours: 1, greys: 2, normals: 3, place: 4 };
const LAYERS = [
  { name: "appearance", label_key: "layer.appearance", unit: "", range: [0, 1], map: "grey" },
  { name: "diffuse", label_key: "layer.diffuse", unit: "", range: [0, 1], map: "grey" },
  { name: "specular", label_key: "layer.specular", unit: "", range: [0, 0.2], map: "grey" },
  { name: "roughness", label_key: "layer.roughness", unit: "rad", range: [0, 1], map: "grey" },
  { name: "normals", label_key: "layer.normals", unit: "", range: [-1, 1], map: "normal" },
  { name: "residual", label_key: "layer.residual_coded", unit: "", range: [-0.2, 0.2], map: "diverging" },
];

export class ObjectScene {
  static async open(canvas, manifest, loader) {
    const scene = new ObjectScene(canvas, manifest, loader);
    await scene.prepare();
    return scene;
  }

  constructor(canvas, manifest, loader) {
    Object.assign(this, { canvas, manifest, loader });
    this.onready = () => {};
    this.gl = context(canvas);
    if (!this.gl.getExtension("EXT_color_buffer_float")) {
      throw new Error("WebGL2 with EXT_color_buffer_float is needed to show an object");
    }
    this.parts = manifest.parts.length;
    this.residuals = new Map(); // `view/light` -> textures
    this.targets = new Map(); // `width x height` -> framebuffers
    this.version = 0; // of what is decoded
    this.working = 0;
    this.shownAt = 0; // time of the last picture
  }

  get busy() {
    return this.working > 0;
  }

  /** What of the panel this scene has use for. */
  get offers() {
    return ["captured lamps"];
  }

  /** Axis of the turn and radius of the object, for the control of the camera. */
  get axis() {
    return this.manifest.turn.axis;
  }

  get radius() {
    return this.manifest.radius;
  }

  /** View that a scene opens with. */
  firstView() {
    return { ...freeView(this.manifest.views[0], this.manifest.centre), captured: 0 };
  }

  /** View of a state; the first one where the state has none of an object. */
  viewOf(state) {
    return state.view?.eye || Number.isFinite(state.view?.captured) ? state.view : this.firstView();
  }

  /** The same view by eye, target, up and field of view alone. */
  freeViewOf(state) {
    const view = this.viewOf(state), captured = view.captured ?? null;
    if (captured === null) return view;
    return freeView(cameraAlong(this.manifest.views, this.manifest.turn, captured), this.manifest.centre);
  }

  /** View of the captured camera `steps` further than the nearest one. */
  capturedView(state, steps) {
    const { views, turn } = this.manifest, nearest = this.nearestView(this.cameraOf(this.viewOf(state)).position);
    const last = views.length - 1, captured = nearest + steps;
    const index = turn.closed ? (captured + views.length) % views.length : Math.min(Math.max(captured, 0), last);
    return { ...freeView(views[index], this.manifest.centre), captured: index };
  }

  nearestView(position) {
    const { turn } = this.manifest;
    const apart = (at) => {
      const off = Math.abs(at - position);
      return turn.closed ? Math.min(off, turn.length - off) : off;
    };
    return turn.position.reduce((best, at, n) => (apart(at) < apart(turn.position[best]) ? n : best), 0);
  }

  async prepare() {
    const arrays = await unpackArrays(await this.loader.load("object"));
    this.coded = new CodedObject(this.manifest, arrays);
    this.surface = surfaceOf(this.manifest, arrays);
    this.across = Math.ceil(Math.sqrt(this.coded.tiles));
    this.atlas = this.across * this.coded.size;
    this.makePrograms();
    this.uploadMesh(arrays);
    this.makeTexels(arrays);
    this.decodeAll();
  }

  makePrograms() {
    const { gl, parts } = this, srgb = this.coded.design.encoding === "srgb";
    this.programs = {
      surface: new Shader(gl, SURFACE_VERTEX, SURFACE_FRAGMENT),
      depth: new Shader(gl, MESH_VERTEX, DEPTH_FRAGMENT),
      coverage: new Shader(gl, MESH_VERTEX, COVERAGE_FRAGMENT),
      visibility: new Shader(gl, SCREEN_VERTEX, VISIBILITY_FRAGMENT),
      texels: new Shader(gl, SCREEN_VERTEX, texelFragment(parts, srgb)),
      mesh: new Shader(gl, MESH_VERTEX, meshFragment(parts, srgb)),
      lines: new Shader(gl, LINES_VERTEX, LINES_FRAGMENT),
      display: new Shader(gl, SCREEN_VERTEX, DISPLAY_FRAGMENT),
    };
    this.empty = gl.createVertexArray();
  }

  uploadMesh(arrays) {
    const { gl, surface } = this, { vertices, normals, corners, vertexOf, place, chartOf } = surface;
    const width = 6 * 256, rows = Math.ceil(corners.length / 3 / 256);
    const data = new Float32Array(4 * width * rows);
    for (let n = 0; n < corners.length; n++) {
      const point = corners[n], vertex = 3 * vertexOf[point];
      data.set([...vertices.subarray(vertex, vertex + 3), place[2 * point]], 8 * n);
      data.set([...normals.subarray(vertex, vertex + 3), place[2 * point + 1]], 8 * n + 4);
    }
    this.corners = texture(gl, "RGBA32F", width, rows, data);
    this.charts = integers(gl, "R32I", Int32Array.from(corners.filter((_, n) => n % 3 === 0), (point) => chartOf[point]), 1);
    const lines = cameraLines(this.manifest);
    this.cameraLines = gl.createVertexArray();
    this.cameraLineEnds = lines.length / 4;
    gl.bindVertexArray(this.cameraLines);
    attribute(gl, 0, lines, 4);
    gl.bindVertexArray(null);
    const grid = arrays.chart_grid.values, padded = new Int32Array((grid.length / 3) * 4);
    for (let n = 0; n < grid.length / 3; n++) padded.set(grid.subarray(3 * n, 3 * n + 3), 4 * n);
    this.grids = integers(gl, "RGBA32I", padded, 4);
    this.cells = integers(gl, "R32I", arrays.cells.values, 1);
  }

  /** Textures of the atlas: position and normal of every texel, parameters, and what the camera sees. */
  makeTexels(arrays) {
    const { gl, atlas, surface, coded } = this;
    this.positions = texture(gl, "RGBA32F", atlas, atlas);
    this.normals = texture(gl, "RGBA16F", atlas, atlas);
    const pairs = trianglesOfTiles(surface, arrays, coded.size);
    const instances = gl.createVertexArray();
    gl.bindVertexArray(instances);
    attribute(gl, 0, pairs, 4);
    gl.vertexAttribDivisor(0, 1);
    const target = framebuffer(gl, [this.positions, this.normals], [atlas, atlas]);
    gl.viewport(0, 0, atlas, atlas);
    gl.enable(gl.DEPTH_TEST);
    gl.depthFunc(gl.LESS);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    this.programs.surface.use({
      corners: this.corners, size: coded.size, tilesAcross: this.across, atlasSize: atlas,
    });
    gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, pairs.length / 4);
    gl.bindVertexArray(null);
    gl.deleteFramebuffer(target);
    this.diffuse = texture(gl, "RGBA16F", atlas, atlas);
    this.specular = texture(gl, "RGBA16F", atlas, atlas);
    this.zero = texture(gl, "RGBA16F", 1, 1);
    this.seen = Array.from({ length: this.parts }, () => texture(gl, "RGBA16F", atlas, atlas));
    this.seenTarget = framebuffer(gl, this.seen);
    this.upload(this.diffuse, null, new Float32Array(4 * atlas * atlas).fill(0.3));
  }

  upload(target, tile, data) {
    const { gl, across } = this, size = tile === null ? this.atlas : this.coded.size;
    gl.bindTexture(gl.TEXTURE_2D, target);
    const [x, y] = tile === null ? [0, 0] : [(tile % across) * size, Math.floor(tile / across) * size];
    gl.texSubImage2D(gl.TEXTURE_2D, 0, x, y, size, size, gl.RGBA, gl.FLOAT, data);
  }

  /** Decode all streams, parameters first, in slices that leave time for frames. */
  async decodeAll() {
    await this.work(async (pause) => {
      for (const { name, first, stop } of this.manifest.streams) {
        const data = await this.loader.load(name);
        const kind = name.split("-")[0];
        for (let tile = first; tile < stop; tile++) {
          const streams = this.coded.streamsOf(tile, first, data, kind);
          if (kind === "parameters") {
            const { diffuse, specular } = this.coded.parameters(tile, streams[0]);
            this.upload(this.diffuse, tile, diffuse);
            this.upload(this.specular, tile, specular);
          } else {
            this.coded.decodeResidual(tile, streams);
            for (const kept of this.residuals.values()) this.uploadResidual(kept, tile);
          }
          this.version++;
          await pause();
        }
      }
    });
  }

  /** Run a task whose `pause` gives way to frames; `busy` until it is done. */
  async work(task) {
    this.working++;
    let since = performance.now();
    await task(async () => {
      if (performance.now() - since < SLICE_MS) return;
      if (performance.now() - this.shownAt > REDRAW_MS) this.onready();
      await new Promise((resolve) => setTimeout(resolve));
      since = performance.now();
    });
    this.working--;
    this.onready();
  }

  uploadResidual(kept, tile) {
    kept.parts.forEach((target, part) => {
      const values = this.coded.residual(tile, kept.view, kept.light, part, this.parts);
      if (values) this.upload(target, tile, values);
    });
  }

  /** Textures of a captured view's residual and of how well it sees each texel; filled while frames go on. */
  residualOf(view, light) {
    const key = `${view}/${light}`;
    if (!this.residuals.has(key)) {
      const { gl, atlas } = this;
      const parts = Array.from({ length: this.parts }, () => texture(gl, "RGBA16F", atlas, atlas));
      const kept = { view, light, parts, visible: this.visibility(view) };
      this.residuals.set(key, kept);
      this.work(async (pause) => {
        for (let tile = 0; tile < this.coded.tiles; tile++) {
          if (this.coded.coefficients[tile] && this.residuals.get(key) === kept) {
            this.uploadResidual(kept, tile);
            this.version++;
            await pause();
          }
        }
      });
    }
    const kept = this.residuals.get(key);
    this.residuals.delete(key); // the most recent one last
    this.residuals.set(key, kept);
    if (this.residuals.size > KEPT_VIEWS) {
      const [oldest, dropped] = this.residuals.entries().next().value;
      this.residuals.delete(oldest);
      [...dropped.parts, dropped.visible].forEach((old) => this.gl.deleteTexture(old));
    }
    return kept;
  }

  visibility(view) {
    const { gl, atlas } = this, camera = this.manifest.views[view];
    const depths = texture(gl, "R32F", camera.columns, camera.rows);
    const target = framebuffer(gl, [depths], [camera.columns, camera.rows]);
    gl.viewport(0, 0, camera.columns, camera.rows);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.enable(gl.DEPTH_TEST);
    this.programs.depth.use(this.cameraUniforms(camera));
    this.drawMesh();
    const visible = texture(gl, "R8", atlas, atlas);
    const result = framebuffer(gl, [visible]);
    gl.viewport(0, 0, atlas, atlas);
    gl.disable(gl.DEPTH_TEST);
    this.programs.visibility.use({
      ...this.cameraUniforms(camera), positions: this.positions, normals: this.normals, depths, eye: centreOf(camera),
    });
    this.drawScreen();
    gl.deleteFramebuffer(target);
    gl.deleteFramebuffer(result);
    gl.deleteTexture(depths);
    return visible;
  }

  drawMesh() {
    const { gl } = this;
    gl.bindVertexArray(this.empty);
    gl.drawArrays(gl.TRIANGLES, 0, this.surface.corners.length);
  }

  drawScreen() {
    this.gl.bindVertexArray(this.empty);
    this.gl.drawArrays(this.gl.TRIANGLES, 0, 3);
  }

  cameraUniforms(camera) {
    const k = camera.intrinsics;
    const middle = add(apply(camera.rotation, this.manifest.centre), camera.translation)[2];
    const near = Math.max(middle - this.manifest.radius * 1.01, this.manifest.radius * 0.01);
    return {
      corners: this.corners, charts: this.charts, rotation: camera.rotation, translation: camera.translation, focal: [k[0][0], k[0][1], k[1][1]],
      principal: [k[0][2], k[1][2]], pictureSize: [camera.columns, camera.rows], distortion: camera.distortion,
      depthRange: [near, Math.max(middle + this.manifest.radius * 1.01, 2 * near)],
    };
  }

  /** The camera of a state's view for a picture of some size, and its position along the turn. */
  cameraOf(view, size = { width: 1, height: 1 }) {
    const { views, turn } = this.manifest;
    const captured = view.captured ?? null;
    const camera = captured === null
      ? lookAt(view, size.height, size.width)
      : fitted(cameraAlong(views, turn, captured), size.height, size.width);
    const position = captured === null ? positionOfEye(turn, views, view.eye) : positionAlong(turn, captured);
    return { camera, position };
  }

  /** Captured views, with weights, whose residual a state shows. */
  lending(state, view, position) {
    const { turn, without } = this.manifest;
    if (this.freeLamps(state) || state.options?.residual === false) return [];
    const captured = view.captured ?? null;
    if (captured !== null && Number.isInteger(captured) && !without.includes(captured)) {
      return [{ view: captured, weight: 1 }];
    }
    return neighbours(turn, position, without);
  }

  freeLamps(state) {
    return state.options?.lighting === "free" && (state.lamps ?? []).length > 0;
  }

  /** Uniforms of the lamps as a camera has them: the captured light, or the state's own lamps. */
  lampUniforms(state, camera) {
    const frame = multiply(TO_LAMP_FRAME, camera.rotation), { lighting, centre, radius } = this.manifest;
    const lamps = [];
    let harmonics = new Array(9).fill([0, 0, 0]);
    if (this.freeLamps(state)) {
      for (const lamp of state.lamps.slice(0, LAMPS - 1)) {
        const [azimuth, elevation] = [lamp.azimuth_deg, lamp.elevation_deg].map((v) => (v * Math.PI) / 180);
        const seen = [Math.cos(elevation) * Math.cos(azimuth), Math.cos(elevation) * Math.sin(azimuth), Math.sin(elevation)];
        const towards = apply(transpose(frame), seen), near = lamp.distance !== null && lamp.distance !== undefined;
        const length = near ? lamp.distance * radius : 0;
        lamps.push({
          form: near ? 0 : 1, vector: near ? add(centre, scale(towards, length)) : towards,
          colour: new Array(3).fill(lamp.intensity ?? 1), reference: length,
        });
      }
      if (state.ambient) {
        harmonics = harmonics.map((row, n) => (n === 0 ? new Array(3).fill(state.ambient) : row));
        lamps.push({ form: 2, vector: [0, 0, 0], colour: [1, 1, 1], reference: 0 });
      }
    } else {
      const light = this.lightOf(state), vector = apply(transpose(frame), lighting.vectors[light]);
      const form = { environment: 2, direction: 1, position: 0, camera: 0 }[lighting.kind];
      const place = form === 0 ? add(centreOf(camera), vector) : vector;
      lamps.push({ form, vector: place, colour: [1, 1, 1], reference: form === 0 ? lighting.reference : 0 });
      if (form === 2) {
        harmonics = lighting.harmonics[light].map((row) => {
          return row.length === 3 ? row : new Array(3).fill(row.reduce((a, b) => a + b, 0) / row.length);
        });
      }
    }
    const padded = Array.from({ length: LAMPS }, (_, n) => lamps[n] ?? lamps[0]);
    return {
      lamps: lamps.length, form: padded.map((l) => l.form), lampVector: padded.map((l) => l.vector),
      lampColour: padded.map((l) => l.colour), reference: padded.map((l) => l.reference), lampFrame: frame, harmonics,
    };
  }

  lightOf(state) {
    return Math.max(this.manifest.lights.indexOf(state.options?.light), 0);
  }

  /** Draw the texels as a state's camera sees them. */
  drawTexels(state, camera, lenders) {
    const { gl, atlas } = this, light = this.lightOf(state);
    const lent = lenders.map(({ view }) => this.residualOf(view, light));
    const lamps = this.lampUniforms(state, camera), eye = centreOf(camera);
    const key = JSON.stringify([eye, lamps, lenders, light, this.version]);
    if (key === this.drawnTexels) return;
    this.drawnTexels = key;
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.seenTarget);
    gl.viewport(0, 0, atlas, atlas);
    gl.disable(gl.DEPTH_TEST);
    const none = { parts: new Array(this.parts).fill(this.zero), visible: this.zero };
    const [first, second] = [lent[0] ?? none, lent[1] ?? none];
    this.programs.texels.use({
      positions: this.positions, normals: this.normals, diffuse: this.diffuse, specular: this.specular,
      residual0: first.parts, residual1: second.parts, visible0: first.visible, visible1: second.visible,
      views: lent.length, weights: [lenders[0]?.weight ?? 0, lenders[1]?.weight ?? 0], eye, ...lamps,
    });
    this.drawScreen();
  }

  /** Draw one frame; region {x, y, width, height} of the canvas, from its upper left corner, or all of it. */
  draw(state, region) {
    const { gl, canvas } = this, size = { width: canvas.width, height: canvas.height };
    const area = region ?? { x: 0, y: 0, ...size }, view = this.viewOf(state);
    const { camera, position } = this.cameraOf(view, size);
    const lenders = this.lending(state, view, position);
    const layer = LAYERS.find(({ name }) => name === state.layer) ?? LAYERS[0];
    if (layer.name === "appearance") this.drawTexels(state, camera, lenders);
    const target = this.target(size.width, size.height);
    gl.enable(gl.SCISSOR_TEST);
    gl.scissor(area.x, canvas.height - area.y - area.height, area.width, area.height);
    this.begin(target.plain, size);
    this.drawPicture(camera, layer, lenders, this.lightOf(state));
    this.begin(target.smooth, size);
    this.programs.coverage.use(this.cameraUniforms(camera));
    this.drawMesh();
    this.resolve(target.smooth, target.covered, size);
    const lined = Boolean(state.options?.cameras);
    if (lined) {
      this.begin(target.lined, size);
      this.drawCameras(camera, view, position);
    }
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.viewport(0, 0, size.width, size.height);
    gl.disable(gl.DEPTH_TEST);
    const grey = decode(state.options?.background ?? 0);
    this.programs.display.use({
      picture: target.picture, coverage: target.coverage, overlay: lined ? target.overlay : this.zero, ceiling: this.ceiling, lined,
      exposure: typeof state.exposure === "number" ? state.exposure : 1,
      background: [grey, grey, grey], coded: layer.name !== "appearance",
    });
    this.drawScreen();
    gl.disable(gl.SCISSOR_TEST);
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

  get ceiling() {
    return this.manifest.ceiling ?? 1e30;
  }

  drawPicture(camera, layer, lenders, light) {
    const [texels, kind, channel] = this.shown(layer.name, lenders, light);
    this.programs.mesh.use({
      ...this.cameraUniforms(camera), texels, grids: this.grids, cells: this.cells, size: this.coded.size,
      tilesAcross: this.across, layer: kind, ceiling: this.ceiling, range: layer.range, channel,
    });
    this.drawMesh();
  }

  /** Textures, kind and channel of what a layer shows. */
  shown(name, lenders, light) {
    const one = (source) => new Array(this.parts).fill(source);
    if (name === "diffuse") return [one(this.diffuse), LAYER.colours, [0, 0, 0, 0]];
    if (name === "specular") return [one(this.specular), LAYER.colours, [0, 0, 0, 0]];
    if (name === "roughness") return [one(this.diffuse), LAYER.greys, [0, 0, 0, 1]];
    if (name === "normals") return [one(this.normals), LAYER.normals, [0, 0, 0, 0]];
    if (name === "residual") {
      const nearest = lenders.reduce((best, lender) => (lender.weight > (best?.weight ?? -1) ? lender : best), null);
      const source = nearest ? this.residualOf(nearest.view, light).parts[0] : this.zero;
      return [one(source), LAYER.colours, [0, 0, 0, 0]];
    }
    return [this.seen, LAYER.appearance, [0, 0, 0, 0]];
  }

  drawCameras(camera, view, position) {
    const { gl } = this;
    const uniforms = this.cameraUniforms(camera);
    const farthest = 4 * Math.max(uniforms.depthRange[1], ...this.manifest.views.map((v) => v.translation[2]));
    const depthRange = [uniforms.depthRange[0], farthest];
    this.programs.lines.use({ ...uniforms, depthRange, chosen: view.captured ?? this.nearestView(position) });
    gl.disable(gl.DEPTH_TEST);
    gl.bindVertexArray(this.cameraLines);
    gl.drawArrays(gl.LINES, 0, this.cameraLineEnds);
    gl.bindVertexArray(null);
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
    const [picture, coverage, overlay] = ["RGBA16F", "RGBA8", "RGBA8"].map((name) => texture(gl, name, width, height));
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
      [smooth, plain, covered, lined].forEach((old) => gl.deleteFramebuffer(old));
      storage.forEach((old) => gl.deleteRenderbuffer(old));
      Object.values(textures).forEach((old) => gl.deleteTexture(old));
    }
    this.targets.clear();
  }

  /** What the canvas shows at (x, y): place, normal, parameters, and the captured views' values there. */
  async probe(x, y, state) {
    const { camera } = this.cameraOf(this.viewOf(state), this.canvas);
    const place = this.placeAt(camera, x, y);
    if (!place) return null;
    const [kd, ks, normal, position] = [this.diffuse, this.specular, this.normals, this.positions].map(
      (source) => bilinear(this.readTexels(source, place), place));
    const unit = MILLIMETRES[this.manifest.unit] ?? 1;
    return {
      position_mm: position.slice(0, 3).map((v) => v * unit),
      normal: normalised(normal.slice(0, 3)),
      layers: { diffuse: kd.slice(0, 3), specular: ks.slice(0, 3), roughness: kd[3] },
      spectrum: null,
      gloss: { specular: ks.slice(0, 3), sigma_rad: kd[3] },
      photographs: this.captures(place, position.slice(0, 3), normalised(normal.slice(0, 3)), this.lightOf(state)),
    };
  }

  /** Texel {x, y, row, column} (row, column: parts of the way to the next) behind a pixel; null beside the object. */
  placeAt(camera, x, y) {
    const target = this.onePixel("RGBA32F", camera, x, y, () => {
      this.programs.mesh.use({
        texels: this.seen, grids: this.grids, cells: this.cells, size: this.coded.size, tilesAcross: this.across,
        layer: LAYER.place,
      });
    }, [-1, 0, 0, 0]);
    const [column, row, down, across] = target;
    return column < 0 ? null : { x: column, y: row, row: down, column: across };
  }

  /** What a program of the mesh draws at the one pixel (x, y) of a camera's picture. */
  onePixel(format, camera, x, y, use, clear) {
    const { gl } = this, [first, second, third] = camera.intrinsics;
    const shifted = [[first[0], first[1], first[2] - Math.floor(x)], [0, second[1], second[2] - Math.floor(y)], third];
    const values = texture(gl, format, 1, 1), target = framebuffer(gl, [values], [1, 1]);
    gl.viewport(0, 0, 1, 1);
    gl.enable(gl.DEPTH_TEST);
    gl.clearBufferfv(gl.COLOR, 0, clear);
    gl.clear(gl.DEPTH_BUFFER_BIT);
    use();
    const program = format === "RGBA32F" ? this.programs.mesh : this.programs.depth;
    program.use(this.cameraUniforms({ ...camera, intrinsics: shifted, rows: 1, columns: 1 }));
    this.drawMesh();
    const out = new Float32Array(4);
    gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.FLOAT, out);
    gl.deleteFramebuffer(target);
    gl.deleteTexture(values);
    return out;
  }

  /** The four texels of a place in a texture of the atlas. */
  readTexels(source, { x, y }) {
    const { gl } = this, target = framebuffer(gl, [source]), out = new Float32Array(16);
    gl.readPixels(x, y, 2, 2, gl.RGBA, gl.FLOAT, out);
    gl.deleteFramebuffer(target);
    return out;
  }

  /** Linear values of a place in every captured view that sees it: as coded, and as the model alone predicts them. */
  captures(place, position, normal, light) {
    const { gl, coded } = this, { views, lighting } = this.manifest;
    const tile = Math.floor(place.y / coded.size) * this.across + Math.floor(place.x / coded.size);
    const [left, top] = [place.x % coded.size, place.y % coded.size];
    const linear = coded.design.encoding === "srgb" ? decode : (v) => v;
    const out = [];
    views.forEach((camera, view) => {
      const eye = centreOf(camera), away = subtract(eye, position);
      if (coded.placeOf(tile, view) < 0 || dot(away, normal) <= 0.1 * norm(away)) return;
      const seen = add(apply(camera.rotation, position), camera.translation), k = camera.intrinsics;
      const column = Math.round((k[0][0] * seen[0] + k[0][1] * seen[1]) / seen[2] + k[0][2]);
      const row = Math.round((k[1][1] * seen[1]) / seen[2] + k[1][2]);
      const [depth] = this.onePixel("R32F", camera, column, row, () => {}, [0, 0, 0, 0]);
      if (seen[2] > depth + 0.02 * this.radius) return;
      const state = { options: { light: this.manifest.lights[light] } };
      gl.bindFramebuffer(gl.FRAMEBUFFER, this.seenTarget);
      gl.enable(gl.SCISSOR_TEST);
      gl.scissor(place.x, place.y, 2, 2);
      this.drawnTexels = null;
      this.drawTexels(state, camera, []);
      gl.disable(gl.SCISSOR_TEST);
      this.drawnTexels = null;
      const values = [0, 0, 0], predicted = [0, 0, 0];
      for (let part = 0; part < this.parts; part++) {
        const model = this.readTexels(this.seen[part], place);
        const residual = coded.residual(tile, view, light, part, this.parts);
        const left4 = 4 * (top * coded.size + left), down4 = left4 + 4 * coded.size;
        const added = new Float32Array(16);
        if (residual) {
          added.set(residual.subarray(left4, left4 + 8));
          added.set(residual.subarray(down4, down4 + 8), 8);
        }
        const [plain, coding] = [bilinear(model, place), bilinear(model.map((v, n) => v + added[n]), place)];
        for (let c = 0; c < 3; c++) {
          predicted[c] += linear(plain[c]);
          values[c] += linear(coding[c]);
        }
      }
      const frame = multiply(TO_LAMP_FRAME, camera.rotation);
      const vector = apply(transpose(frame), lighting.vectors[light]);
      const towards = lighting.kind === "camera" || lighting.kind === "position" ? add(away, vector) : vector;
      out.push({ view: camera.name, light: normalised(towards), values: values.map((v) => Math.max(v, 0)), predicted });
    });
    return out;
  }

  toScene(x, y, state) {
    const { camera } = this.cameraOf(this.viewOf(state), this.canvas);
    const depth = add(apply(camera.rotation, this.manifest.centre), camera.translation)[2];
    const unit = (MILLIMETRES[this.manifest.unit] ?? 1) * depth, k = camera.intrinsics;
    return [((x - k[0][2]) / k[0][0]) * unit, ((k[1][2] - y) / k[1][1]) * unit];
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
    const { lights } = this.manifest;
    const lighting = ["captured", "free"].map((name) => [name, `option.lighting.${name}`]);
    return [
      { name: "lighting", label_key: "option.lighting", values: lighting, value: "captured" },
      ...(lights.length > 1 ? [{ name: "light", label_key: "option.light", values: lights.map((name) => [name, name]), value: lights[0] }] : []),
      { name: "residual", label_key: "option.residual", values: null, value: true },
      { name: "cameras", label_key: "option.cameras", values: null, value: false },
    ];
  }

  bounds() {
    const millimetres = MILLIMETRES[this.manifest.unit];
    const across = 2 * this.manifest.radius * (millimetres ?? 1);
    return { width_mm: across, height_mm: across, unit: millimetres ? "mm" : "px" };
  }

  cost() {
    // a texel: position, normal, parameters, residual and visibility of two views; a pixel: four texels, grid, cell
    return { texture_reads: 4 * this.parts + 2, operations: 60 * this.parts, texels: this.atlas ** 2,
      texel_reads: 6 + 2 * this.parts, texel_operations: 150 };
  }
}

function attribute(gl, place, data, size) {
  gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
  gl.bufferData(gl.ARRAY_BUFFER, data, gl.STATIC_DRAW);
  gl.enableVertexAttribArray(place);
  if (data instanceof Int32Array) gl.vertexAttribIPointer(place, size, gl.INT, 0, 0);
  else gl.vertexAttribPointer(place, size, gl.FLOAT, false, 0, 0);
}

/** Four numbers between the four texels of a place. */
function bilinear(texels, { row, column }) {
  return [0, 1, 2, 3].map((n) => {
    const upper = texels[n] + column * (texels[n + 4] - texels[n]);
    return upper + row * (texels[n + 8] + column * (texels[n + 12] - texels[n + 8]) - upper);
  });
}

const decode = (code) => (code <= 0.04045 ? code / 12.92 : ((code + 0.055) / 1.055) ** 2.4);

/** Ends of the lines that show where the captured cameras stand: x, y, z and number of the camera. */
function cameraLines(manifest) {
  const out = [];
  manifest.views.forEach((camera, number) => {
    const eye = centreOf(camera), depth = 0.25 * manifest.radius, k = camera.intrinsics;
    const corner = (column, row) => {
      const seen = [(column - k[0][2]) / k[0][0], (row - k[1][2]) / k[1][1], 1].map((v) => v * depth);
      return add(eye, apply(transpose(camera.rotation), seen));
    };
    const ends = [corner(0, 0), corner(camera.columns, 0), corner(camera.columns, camera.rows), corner(0, camera.rows)];
    ends.forEach((end, n) => out.push(...eye, number, ...end, number, ...end, number, ...ends[(n + 1) % 4], number));
  });
  return Float32Array.from(out);
}
