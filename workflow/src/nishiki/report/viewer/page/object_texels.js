// The texels of an object on the graphics processor, tile beside tile in one atlas: places, normals, parameters, residuals of
// captured views, and what a camera sees of them. Streams are decoded one after another while frames go on.
import { centreOf } from "viewer/cameras";
import { trianglesOfTiles } from "viewer/coded_object";
import { ENHANCEMENTS, SCREEN_VERTEX } from "viewer/common_shaders";
import { Shader, attribute, drop, framebuffer, image } from "viewer/gl";
import { capturedUniforms } from "viewer/object_lamps";
import { DEPTH_FRAGMENT, MESH_VERTEX } from "viewer/object_shaders";
import { LENT_FRAGMENT, SURFACE_FRAGMENT, SURFACE_VERTEX, VISIBILITY_FRAGMENT, texelFragment } from "viewer/object_texel_shaders";

const KEPT_VIEWS = 6; // residual textures that stay on the GPU
const SLICE_MS = 14; // of decoding between two chances for events
const REDRAW_MS = 400; // between two pictures while decoding goes on

export class ObjectTexels {
  /** Textures, as `#places` and `#form` make them. */
  positions;
  normals;
  form;

  /** scene: its gl, manifest, loader, drawScreen(), onready() and shownAt, the time of its last picture. */
  constructor(scene, coded, mesh, arrays) {
    const { gl, manifest } = scene;
    this.scene = scene;
    this.gl = gl;
    this.manifest = manifest;
    this.coded = coded;
    this.mesh = mesh;
    this.parts = scene.pictures ? scene.pictures.tiles / this.manifest.views.length : 0; // tiles of a picture
    this.residuals = new Map(); // `view/light` -> textures
    this.version = 0; // of what is decoded
    this.working = 0;
    this.across = Math.ceil(Math.sqrt(coded.tiles));
    this.atlas = this.across * coded.size;
    this.programs = {
      surface: new Shader(gl, SURFACE_VERTEX, SURFACE_FRAGMENT),
      depth: new Shader(gl, MESH_VERTEX, DEPTH_FRAGMENT),
      visibility: new Shader(gl, SCREEN_VERTEX, VISIBILITY_FRAGMENT),
      lent: new Shader(gl, SCREEN_VERTEX, LENT_FRAGMENT),
      texels: new Shader(gl, SCREEN_VERTEX, texelFragment(coded.design.encoding === "srgb")),
    };
    const pairs = trianglesOfTiles(mesh.surface, arrays, coded.size);
    this.instances = gl.createVertexArray();
    gl.bindVertexArray(this.instances);
    attribute(gl, 0, pairs, 4);
    gl.vertexAttribDivisor(0, 1);
    this.instanceCount = pairs.length / 4;
    [this.positions, this.normals] = this.#places(mesh.corners);
    const { atlas } = this;
    this.diffuse = image(gl, "RGBA16F", atlas, atlas);
    this.specular = image(gl, "RGBA16F", atlas, atlas);
    this.zero = image(gl, "RGBA16F", 1, 1);
    this.seen = image(gl, "RGBA16F", atlas, atlas);
    this.seenTarget = framebuffer(gl, [this.seen]);
    this.#upload(this.diffuse, null, new Float32Array(4 * atlas * atlas).fill(0.3));
    this.#decodeAll();
  }

  /** Textures of the position and the normal of every texel. */
  #places(corners) {
    const { gl, atlas, coded } = this, made = [image(gl, "RGBA32F", atlas, atlas), image(gl, "RGBA16F", atlas, atlas)];
    gl.bindVertexArray(this.instances);
    const target = framebuffer(gl, made, [atlas, atlas]);
    gl.viewport(0, 0, atlas, atlas);
    gl.enable(gl.DEPTH_TEST);
    gl.depthFunc(gl.LESS);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    this.programs.surface.use({
      corners, size: coded.size, tilesAcross: this.across, atlasSize: atlas,
    });
    gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, this.instanceCount);
    gl.bindVertexArray(null);
    drop(gl, target);
    return made;
  }

  /** Normals of the form without its relief, made when a picture needs them first. */
  #form() {
    if (!this.form) {
      const { gl } = this, corners = this.mesh.formCorners(), [positions, normals] = this.#places(corners);
      [corners, positions].forEach((old) => gl.deleteTexture(old));
      this.form = normals;
    }
    return this.form;
  }

  #upload(target, tile, data) {
    const { gl, across } = this, size = tile === null ? this.atlas : this.coded.size;
    gl.bindTexture(gl.TEXTURE_2D, target);
    const [x, y] = tile === null ? [0, 0] : [(tile % across) * size, Math.floor(tile / across) * size];
    gl.texSubImage2D(gl.TEXTURE_2D, 0, x, y, size, size, gl.RGBA, gl.FLOAT, data);
  }

  /** Decode all streams, parameters first, in slices that leave time for frames. */
  async #decodeAll() {
    await this.#work(async (pause) => {
      for (const { name, first, stop } of this.manifest.streams) {
        const data = await this.scene.loader.load(name);
        const kind = name.split("-")[0], { pictures } = this.scene, coded = kind === "pictures" ? pictures : this.coded;
        for (let tile = first; tile < stop; tile++) {
          const streams = coded.streamsOf(tile, first, data, kind);
          if (kind === "parameters") {
            const { diffuse, specular } = this.coded.parameters(tile, streams[0]);
            this.#upload(this.diffuse, tile, diffuse);
            this.#upload(this.specular, tile, specular);
          } else if (kind === "pictures") {
            pictures.decodeResidual(tile, streams);
            for (const kept of this.residuals.values()) if (Math.floor(tile / this.parts) === kept.view) this.#lend(kept);
          } else {
            this.coded.decodeResidual(tile, streams);
            for (const kept of this.residuals.values()) this.#uploadResidual(kept, tile);
          }
          this.version++;
          await pause();
        }
      }
    });
  }

  /** Run a task whose `pause` gives way to frames; `working` until it is done. */
  async #work(task) {
    this.working++;
    let since = performance.now();
    await task(async () => {
      if (performance.now() - since < SLICE_MS) return;
      if (performance.now() - this.scene.shownAt > REDRAW_MS) this.scene.onready();
      await new Promise((resolve) => setTimeout(resolve));
      since = performance.now();
    });
    this.working--;
    this.scene.onready();
  }

  #uploadResidual(kept, tile) {
    const values = this.coded.residual(tile, kept.view, kept.light);
    if (values) this.#upload(kept.texture, tile, values);
  }

  /** Fill the residual of a view with what its picture, once it is decoded, differs from the model. */
  #lend({ view, light, texture, visible }) {
    const { gl, atlas, manifest, parts } = this, { pictures } = this.scene, camera = manifest.views[view], first = view * parts;
    for (let n = first; n < first + parts; n++) if (pictures.coefficients[n] === undefined) return;
    const { size } = pictures, across = Math.ceil(camera.columns / size);
    const picture = image(gl, "RGBA16F", across * size, (parts / across) * size);
    for (let n = 0; n < parts; n++) {
      const values = pictures.residual(first + n, view, light) ?? new Float32Array(4 * size * size);
      gl.texSubImage2D(gl.TEXTURE_2D, 0, (n % across) * size, Math.floor(n / across) * size, size, size, gl.RGBA, gl.FLOAT, values);
    }
    const model = image(gl, "RGBA16F", atlas, atlas), drawn = framebuffer(gl, [model]);
    gl.viewport(0, 0, atlas, atlas);
    gl.disable(gl.DEPTH_TEST);
    const lamps = { ...capturedUniforms(manifest, light, camera), enhance: 0, strength: 0 };
    this.#drawModel(centreOf(camera), lamps, [], []);
    const result = framebuffer(gl, [texture]);
    this.programs.lent.use({ ...this.mesh.seenBy(camera), positions: this.positions, visible, picture, model });
    this.scene.drawScreen();
    [drawn, result].forEach((old) => drop(gl, old));
    [picture, model].forEach((old) => gl.deleteTexture(old));
    this.version++;
  }

  /** Texture of a captured view's residual, and one of how well it sees each texel; filled while frames go on. */
  residualOf(view, light) {
    const key = `${view}/${light}`;
    if (!this.residuals.has(key)) {
      const { gl, atlas } = this;
      const kept = { view, light, texture: image(gl, "RGBA16F", atlas, atlas), visible: this.#visibility(view) };
      this.residuals.set(key, kept);
      if (this.scene.pictures) this.#lend(kept);
      else this.#work(async (pause) => {
        for (let tile = 0; tile < this.coded.tiles; tile++) {
          if (this.coded.coefficients[tile] && this.residuals.get(key) === kept) {
            this.#uploadResidual(kept, tile);
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
      [dropped.texture, dropped.visible].forEach((old) => this.gl.deleteTexture(old));
    }
    return kept;
  }

  /** How well a captured view sees each texel. */
  #visibility(view) {
    const { gl, atlas } = this, camera = this.manifest.views[view];
    const depths = image(gl, "R32F", camera.columns, camera.rows);
    const target = framebuffer(gl, [depths], [camera.columns, camera.rows]);
    gl.viewport(0, 0, camera.columns, camera.rows);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.enable(gl.DEPTH_TEST);
    this.programs.depth.use(this.mesh.seenBy(camera));
    this.mesh.draw();
    const visible = image(gl, "R8", atlas, atlas);
    const result = framebuffer(gl, [visible]);
    gl.viewport(0, 0, atlas, atlas);
    gl.disable(gl.DEPTH_TEST);
    this.programs.visibility.use({
      ...this.mesh.seenBy(camera), positions: this.positions, normals: this.normals, depths, eye: centreOf(camera),
    });
    this.scene.drawScreen();
    drop(gl, target);
    drop(gl, result);
    gl.deleteTexture(depths);
    return visible;
  }

  /** Draw into `seen` the texels as a camera sees them: lamps: uniforms, and those of the enhancement; lenders: captured views that lend their residual of
   * a light, with weights; within: {x, y, width, height} of the atlas alone; shadows: of ObjectShadows. */
  draw(camera, lamps, lenders, light, { within = null, shadows = null } = {}) {
    const { gl, atlas } = this;
    const lent = lenders.map(({ view }) => this.residualOf(view, light)), eye = centreOf(camera);
    const key = JSON.stringify([eye, lamps, lenders, light, this.version, within, shadows?.part, shadows?.key, shadows?.samples]);
    if (key === this.drawn) return;
    this.drawn = key;
    const plainNormals = ENHANCEMENTS[lamps.enhance] === "relief" ? this.#form() : this.normals;
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.seenTarget);
    gl.viewport(0, 0, atlas, atlas);
    gl.disable(gl.DEPTH_TEST);
    if (within) {
      gl.enable(gl.SCISSOR_TEST);
      gl.scissor(within.x, within.y, within.width, within.height);
    }
    this.#drawModel(eye, { ...lamps, plainNormals, ...shadows }, lent, lenders);
    if (within) gl.disable(gl.SCISSOR_TEST);
  }

  /** Draw the model as an eye sees it under lamps, with the residuals that views lend, by their weights. */
  #drawModel(eye, uniforms, lent, lenders) {
    const none = { texture: this.zero, visible: this.zero };
    const [first, second] = [lent[0] ?? none, lent[1] ?? none];
    this.programs.texels.use({
      positions: this.positions, normals: this.normals, plainNormals: this.normals, diffuse: this.diffuse, specular: this.specular,
      residual0: first.texture, residual1: second.texture, visible0: first.visible, visible1: second.visible,
      lit0: this.zero, lit1: this.zero, samples: 0, views: lent.length, weights: [lenders[0]?.weight ?? 0, lenders[1]?.weight ?? 0], eye, ...uniforms,
    });
    this.scene.drawScreen();
  }

  /** The four texels (16 numbers) from (x, y) on in a texture of the atlas. */
  read(source, { x, y }) {
    const { gl } = this, target = framebuffer(gl, [source]), out = new Float32Array(16);
    gl.readPixels(x, y, 2, 2, gl.RGBA, gl.FLOAT, out);
    drop(gl, target);
    return out;
  }
}
