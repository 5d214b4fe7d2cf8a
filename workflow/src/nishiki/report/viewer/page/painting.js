// A painting under moving lamps: tiles of a pyramid, shaded as nishiki.render.plane shades the maps.
//
// Pixels of the map have their upper left corner at whole numbers; the scene's own unit is mm (or pixels where no scale
// is known), from the centre of the painting, x to the right and y up.
import * as colour from "viewer/colour";
import { bind, context, program, readback, target, texture } from "viewer/gl";
import { inflate, picture } from "viewer/loader";
import { LAYER_FRAGMENT, paintingFragment, TILE_VERTEX } from "viewer/painting_shaders";
import { PlaneView } from "viewer/plane_view";
import { Relief } from "viewer/relief";
import { openHeights, Shadows } from "viewer/shadows";
import { Tiles } from "viewer/tiles";

const EXPOSURE_PIXELS = 1 << 18; // at most, of the picture that the exposure is chosen from
const MOST_LAMPS = 8;
const ENHANCEMENTS = ["none", "specular", "curvature", "raking"];
const LAYER_COLOURS = ["grey", "diverging", "flags"];
const BACKGROUND = 0.106;
const FRONTAL = { x: 0, y: 0, zoom: 1, tilt_deg: 0, azimuth_deg: 0 };
const KEPT = 3; // states whose shadows and exposure are kept

/** Put an entry last in a map and keep the last few; the values that were dropped. */
function remember(map, key, value) {
  map.delete(key);
  map.set(key, value);
  const dropped = [...map.keys()].slice(0, -KEPT).map((name) => [name, map.get(name)]);
  dropped.forEach(([name]) => map.delete(name));
  return dropped.map(([, each]) => each);
}

export class Painting {
  /** Opens a painting; ready to draw once its coarsest tiles are there. */
  static async open(canvas, manifest, loader) {
    const scene = new Painting(canvas, manifest, loader);
    await scene.tiles.load(manifest.tiles.levels.length - 1, 0, 0);
    scene.#openShadows();
    return scene;
  }

  constructor(canvas, manifest, loader) {
    Object.assign(this, { canvas, manifest, loader });
    this.gl = context(canvas);
    this.onready = () => {};
    this.pending = 0;
    this.programs = new Map();
    this.layerTextures = new Map();
    this.exposures = new Map(); // of the states drawn last: two, where a divider compares
    const { colour: chroma, shading } = manifest.code;
    this.chroma = chroma.low.length;
    this.shades = shading ? shading.low.length : 0;
    this.terms = shading ? shading.mean.length : 0;
    this.planes = 3 + this.chroma + this.shades; // the region comes after them
    this.stack = Math.ceil((this.planes + 1) / 3);
    this.tiles = new Tiles(this.gl, manifest.tiles, this.stack, loader, (promise) => this.#wait(promise));
    this.hasRegions = manifest.tiles.regions;
    this.gloss = this.#glossTexture();
    this.spectra = new Map();
    this.shadows = []; // of reliefs, the coarse first
    this.relief = null; // the coarse one, for tilted views
    this.shadowsOf = new Map(); // shadows of the lamps drawn last: {key, level, texture, count}
    this.shadow = null; // those of the state that is drawn
  }

  /** What of the panel this scene has use for. */
  get offers() {
    return ["softness", "exposure auto"];
  }

  /** Whether something that the present view needs is on its way. */
  get busy() {
    return this.pending > 0 || this.shadows.some(({ busy }) => busy);
  }

  bounds() {
    const { rows, columns, pitch_mm } = this.manifest;
    const pitch = pitch_mm ?? 1;
    return { width_mm: columns * pitch, height_mm: rows * pitch, unit: pitch_mm ? "mm" : "px" };
  }

  /** Pixels of the canvas that a pixel of the map takes at zoom 1: the painting fits into the canvas. */
  fit() {
    return Math.min(this.canvas.width / this.manifest.columns, this.canvas.height / this.manifest.rows);
  }

  /** Point of the scene's plane, in its own unit, at a pixel of the canvas (from its upper left corner). */
  toScene(x, y, state) {
    return this.#pointOf(this.#place(state).toMap(x, y));
  }

  /** Point of the relief [x, y, height] at a pixel of the canvas. */
  pointAt(x, y, state) {
    const place = this.#toRelief(x, y, state);
    return [...this.#pointOf(place), this.relief?.heightAt(...place) || 0];
  }

  #toRelief(x, y, state) {
    return this.#place(state).toRelief(x, y, (...at) => this.relief.heightAt(...at));
  }

  #pointOf([column, row]) {
    const { rows, columns, pitch_mm } = this.manifest, pitch = pitch_mm ?? 1;
    return [(column - columns / 2) * pitch, (rows / 2 - row) * pitch];
  }

  /** Pixel of the canvas of a point of the scene [x, y, height]. */
  fromScene([x, y, height], state) {
    const { rows, columns, pitch_mm } = this.manifest, pitch = pitch_mm ?? 1;
    return this.#place(state).toCanvas(x / pitch + columns / 2, rows / 2 - y / pitch, this.relief ? height : 0);
  }

  layers() {
    return this.manifest.layers.map(({ name, label_key, unit, range, map }) => ({ name, label_key, unit, range, map }));
  }

  /** Texture reads and arithmetic operations of the shader, about, for one pixel of the canvas and one lamp. */
  cost() {
    const lobes = this.manifest.gloss.beta[0].length, blurred = this.manifest.gloss.blurred && lobes ? 1 : 0;
    return {
      texture_reads: Math.ceil(this.planes / 3) + 4 * blurred + 1 + lobes + (this.manifest.shadows.length ? 1 : 0) + (this.hasRegions ? 1 : 0),
      operations: 60 + 8 * this.chroma + 12 * this.shades + 60 * blurred + (lobes ? 90 : 20) + lobes * (blurred ? 22 : 4) + 40,
    };
  }

  /** Draw one frame; region {x, y, width, height} of the canvas, from its upper left corner, or all of it. */
  draw(state, region) {
    const { gl, canvas } = this;
    const area = region ?? { x: 0, y: 0, width: canvas.width, height: canvas.height };
    const layer = this.manifest.layers.find(({ name }) => name === state.layer);
    const plain = !layer || layer.name === "appearance";
    const lamps = this.#lamps(state);
    if (plain) this.#askShadows(lamps);
    const exposure = plain ? this.#exposureOf(state, lamps) : 1;
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.viewport(0, 0, canvas.width, canvas.height);
    gl.enable(gl.SCISSOR_TEST);
    gl.scissor(area.x, canvas.height - area.y - area.height, area.width, area.height);
    gl.clearColor(BACKGROUND, BACKGROUND, BACKGROUND, 1);
    gl.clear(gl.COLOR_BUFFER_BIT);
    const place = this.#place(state);
    if (place.tilted) gl.enable(gl.DEPTH_TEST);
    if (layer?.block) this.#drawLayer(layer, place);
    else this.#drawTiles(state, lamps, place, area, { exposure, output: plain ? 0 : 2 });
    gl.disable(gl.DEPTH_TEST);
    gl.disable(gl.SCISSOR_TEST);
  }

  /** What is known at a pixel of the canvas: null beside the painting. */
  async probe(x, y, state) {
    const { manifest } = this;
    const [column, row] = this.#toRelief(x, y, state).map(Math.floor);
    if (column < 0 || row < 0 || column >= manifest.columns || row >= manifest.rows) return null;
    const layers = Object.fromEntries(await Promise.all(manifest.layers.filter(({ block }) => block).map(async (layer) => {
      const { texture: made } = await this.#layerTexture(layer);
      const at = [Math.floor((column / manifest.columns) * layer.columns), Math.floor((row / manifest.rows) * layer.rows)];
      const code = this.#readPixel(made, null, ...at)[0];
      const { low, high, top, nothing } = layer.code;
      return [layer.name, code === nothing && layer.map !== "flags" ? null : low + (code / top) * (high - low)];
    })));
    const record = await this.#record(column, row);
    if (!record) return { position_mm: null, normal: null, layers, spectrum: null, gloss: null, photographs: null };
    const { beta, gamma, refractive_index } = manifest.gloss;
    const place = [...this.#pointOf([column + 0.5, row + 0.5]), layers.height ?? 0];
    const sigma = layers.sigma_spectrum;
    return {
      position_mm: place,
      normal: record.normal,
      layers,
      spectrum: manifest.basis && {
        nm: manifest.wavelengths_nm,
        reflectance: manifest.wavelengths_nm.map((_, k) => manifest.basis.reduce((sum, base, i) => sum + base[k] * record.coefficients[i], 0)),
        sigma: sigma == null ? null : manifest.wavelengths_nm.map(() => sigma),
      },
      gloss: beta[0].length ? { beta: beta[record.region], gamma_rad: gamma[record.region], refractive_index: refractive_index[record.region] } : null,
      ...(await this.#photographsAt(column, row)),
    };
  }

  /** What every photograph shows, and what the model predicts, at the sample nearest to a pixel of the map. */
  async #photographsAt(column, row) {
    const { block, rows, columns, first, step, lights, white, top, nothing } = this.manifest.photographs;
    this.photographs ??= inflate(await this.loader.load(block));
    const codes = await this.photographs;
    const nearest = (place, start, count) => Math.min(Math.max(Math.round((place - start) / step), 0), count - 1);
    const [y, x] = [nearest(row, first[0], rows), nearest(column, first[1], columns)];
    const value = (kind, light) => codes[((kind * lights.length + light) * rows + y) * columns + x];
    const linear = (code) => (code === nothing ? null : [white * (code / top) ** 2]);
    return {
      photographs: lights.map((view, k) => ({ view, values: linear(value(0, k)), predicted: linear(value(1, k)) })),
      sample_pixels: Math.hypot(first[0] + y * step - row, first[1] + x * step - column),
    };
  }

  /** RGBA bytes of the canvas as drawn, first row at the bottom. */
  readPixels() {
    this.gl.bindFramebuffer(this.gl.FRAMEBUFFER, null);
    return readback(this.gl, 0, 0, this.canvas.width, this.canvas.height);
  }

  // view

  #place({ view }) {
    return this.#placed(this.canvas, this.fit() * view.zoom, view);
  }

  #placed(screen, scale, view) {
    const { rows, columns, pitch_mm } = this.manifest;
    return new PlaneView({ rows, columns, pitch: pitch_mm ?? 1 }, screen, scale, view, this.relief?.heights);
  }

  // lamps and colours

  #lamps(state) {
    const { rows, columns, pitch_mm } = this.manifest;
    const side = Math.max(rows, columns) * (pitch_mm ?? 1);
    return state.lamps.slice(0, MOST_LAMPS).map((lamp) => {
      const elevation = (lamp.elevation_deg * Math.PI) / 180, azimuth = (lamp.azimuth_deg * Math.PI) / 180;
      const length = lamp.distance ? lamp.distance * side : 1;
      const vector = [Math.cos(elevation) * Math.cos(azimuth), Math.cos(elevation) * Math.sin(azimuth), Math.sin(elevation)].map((v) => v * length);
      return { vector, w: lamp.distance ? 1 : 0, radius: (lamp.radius_deg * Math.PI) / 180, lamp, length };
    });
  }

  /** XYZ of a lamp's spectrum: {matrix (3, K), white}. */
  #spectrum(choice) {
    const key = JSON.stringify(choice);
    if (!this.spectra.has(key)) {
      const { manifest } = this, power = colour.powerOf(choice, manifest);
      const white = colour.whiteOf(power, manifest.cmf);
      const d65 = () => colour.whiteOf(colour.powerOf("D65", manifest), manifest.cmf);
      const matrix = manifest.basis
        ? colour.xyzMatrix(power, manifest.basis, manifest.cmf)
        : colour.product(colour.adaptation(d65(), white), colour.inverse(colour.srgbMatrix()));
      this.spectra.set(key, { matrix, white });
    }
    return this.spectra.get(key);
  }

  /** Uniforms of the colours: XYZ, or linear sRGB of the display at this exposure. */
  #colours(state, exposure) {
    const { direction, mean, components } = this.manifest.code.colour;
    const choices = state.lamps.slice(0, MOST_LAMPS).map((lamp) => lamp.illuminant);
    choices.push(choices[0] ?? "E"); // the ambient light
    const first = this.#spectrum(choices[0]).white;
    const toDisplay = exposure === null
      ? [[1, 0, 0], [0, 1, 0], [0, 0, 1]]
      : colour.product(colour.srgbMatrix(), colour.adaptation(first)).map((row) => row.map((value) => value * exposure));
    const colours = [], whites = [];
    for (const choice of choices) {
      const { matrix, white } = this.#spectrum(choice);
      const shown = colour.product(toDisplay, matrix);
      for (const vector of [direction, mean, ...components]) colours.push(...colour.apply(shown, vector));
      whites.push(...colour.apply(toDisplay, white));
    }
    return { colours: new Float32Array(colours), whites: new Float32Array(whites) };
  }

  /** Exposure that was chosen last. */
  get exposureShown() {
    return [...this.exposures.values()].at(-1) ?? 1;
  }

  /** Exposure of a state: its own number, or that of an eye adapted to the picture. */
  #exposureOf(state, lamps) {
    if (state.exposure !== "auto") return state.exposure;
    const key = JSON.stringify([state.lamps, state.ambient, this.shadow?.key, this.shadow?.level]);
    if (this.exposures.has(key)) {
      remember(this.exposures, key, this.exposures.get(key));
      return this.exposureShown;
    }
    const { levels } = this.manifest.tiles;
    const level = Math.max(levels.findIndex(({ rows, columns }) => rows * columns <= EXPOSURE_PIXELS), 0);
    if (!this.tiles.haveAll(level)) return this.exposureShown;
    const { gl } = this, { rows, columns } = levels[level];
    this.meter ??= target(gl, columns, rows);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.meter.framebuffer);
    gl.viewport(0, 0, columns, rows);
    gl.disable(gl.SCISSOR_TEST);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT);
    const area = { x: 0, y: 0, width: columns, height: rows };
    const place = this.#placed(area, 1 / levels[level].factor, FRONTAL);
    this.#drawTiles({ ...state, enhance: "none" }, lamps, place, area, { exposure: null, output: 1 });
    const bytes = readback(gl, 0, 0, columns, rows);
    const bins = new Uint32Array(65536);
    let seen = 0;
    for (let i = 0; i < bytes.length; i += 4) {
      if (bytes[i + 3]) {
        bins[bytes[i] * 256 + bytes[i + 1]]++;
        seen++;
      }
    }
    let bin = 0;
    for (let below = bins[0]; bin < 65535 && below < colour.ADAPTED.percentile * (seen - 1) + 1; below += bins[++bin]);
    const sheet = state.ambient + state.lamps.reduce((sum, lamp) => sum + lamp.intensity * Math.sin((lamp.elevation_deg * Math.PI) / 180), 0);
    const exposure = colour.adaptedExposure(seen ? 2 ** (((bin + 0.5) / 65535) * 32 - 20) : 0, sheet);
    remember(this.exposures, key, exposure);
    return exposure;
  }

  // cast shadows

  /** Open the reliefs one after the other: the coarse one follows a lamp that is dragged, the finer one a lamp at rest. */
  async #openShadows() {
    for (const [level, relief] of this.manifest.shadows.entries()) {
      const heights = await this.#wait(openHeights(relief, this.loader)), shadows = new Shadows(heights);
      this.relief ??= new Relief(this.gl, heights, this.manifest.pitch_mm ?? 1);
      shadows.onready = (key, visibility) => {
        this.#keepShadows(key, level, visibility);
        this.onready();
      };
      this.shadows.push(shadows);
      this.onready();
    }
  }

  #askShadows(lamps) {
    const wanted = lamps.map(({ vector, w, radius }) => ({ vector, w, radius }));
    const key = JSON.stringify(wanted), ready = this.shadowsOf.get(key);
    if (ready) remember(this.shadowsOf, key, ready);
    // near lamps are marched from every pixel: too slow on the finer relief
    const level = ready ? ready.level + 1 : 0;
    if (lamps.length && (level === 0 || !lamps.some(({ w }) => w))) this.shadows[level]?.request(key, wanted);
    // until they come, those of the lamps just before
    this.shadow = ready ?? [...this.shadowsOf.values()].filter(({ count }) => count === lamps.length).at(-1) ?? null;
  }

  #keepShadows(key, level, visibility) {
    const { gl } = this, { rows, columns } = this.shadows[level];
    const count = visibility.length / (rows * columns);
    const made = texture(gl, gl.TEXTURE_2D_ARRAY, gl.LINEAR);
    gl.texParameteri(gl.TEXTURE_2D_ARRAY, gl.TEXTURE_MIN_FILTER, gl.LINEAR_MIPMAP_LINEAR);
    gl.texStorage3D(gl.TEXTURE_2D_ARRAY, Math.floor(Math.log2(Math.max(rows, columns))) + 1, gl.R8, columns, rows, count);
    gl.texSubImage3D(gl.TEXTURE_2D_ARRAY, 0, 0, 0, 0, columns, rows, count, gl.RED, gl.UNSIGNED_BYTE, visibility);
    gl.generateMipmap(gl.TEXTURE_2D_ARRAY);
    gl.deleteTexture(this.shadowsOf.get(key)?.texture ?? null);
    for (const dropped of remember(this.shadowsOf, key, { key, level, texture: made, count })) gl.deleteTexture(dropped.texture);
  }

  // tiles

  /** A promise on which `busy` depends. */
  #wait(promise) {
    this.pending++;
    promise.finally(() => {
      this.pending--;
      this.onready();
    });
    return promise;
  }

  /** Draw the tiles in sight, coarser ones below those that are still on their way. */
  #drawTiles(state, lamps, place, area, { exposure, output }) {
    const { gl, tiles, manifest } = this, { size, border, levels } = manifest.tiles;
    const level = tiles.levelOf(place.scale), bounds = place.bounds(area), wanted = tiles.within(level, bounds);
    const complete = wanted.map(([row, column]) => tiles.ready(level, row, column)).every(Boolean);
    const uniforms = this.#shader(state, lamps, place, { exposure, output });
    const set = (call, name, value) => uniforms[name] && gl[call](uniforms[name], value);
    for (const each of complete ? [level] : [...new Set([levels.length - 1, level])]) {
      const { factor } = levels[each], columns = manifest.columns / factor, rows = manifest.rows / factor, step = factor * place.scale;
      gl.clear(gl.DEPTH_BUFFER_BIT);
      gl.uniform2f(uniforms.size, columns, rows);
      set("uniform1f", "pitch", (manifest.pitch_mm ?? 1) * factor);
      set("uniform1f", "blur", Math.min(1, 1 / step ** 2));
      set("uniform1f", "stride", Math.max(1, 1 / step));
      for (const [row, column] of each === level ? wanted : tiles.within(each, bounds)) {
        const made = tiles.ready(each, row, column);
        if (!made) continue;
        bind(gl, 0, gl.TEXTURE_2D_ARRAY, made, uniforms.planes);
        gl.uniform2f(uniforms.origin, column * size - border, row * size - border);
        this.#drawMesh(uniforms, place, factor, [column * size, row * size, Math.min((column + 1) * size, columns), Math.min((row + 1) * size, rows)]);
      }
    }
  }

  /** The relief that lifts the picture; null from the front. */
  #reliefOf(place) {
    return place.tilted ? this.relief : null;
  }

  /** Draw a rectangle of the map, its corners in pixels averaged by `factor`: two triangles, or a mesh that is lifted. */
  #drawMesh(uniforms, place, factor, corners) {
    const { gl } = this, { toClip, lift, depth } = place.uniforms(factor);
    const relief = this.#reliefOf(place);
    const cells = relief ? relief.cells((corners[2] - corners[0]) * factor, place.scale) : 1;
    gl.uniform4f(uniforms.corners, ...corners);
    gl.uniformMatrix3x2fv(uniforms.toClip, false, toClip);
    gl.uniform4f(uniforms.depth, ...depth);
    gl.uniform1i(uniforms.cells, cells);
    if (relief) {
      gl.uniform2f(uniforms.lift, ...lift);
      gl.uniform1f(uniforms.reliefScale, relief.scale * factor);
      bind(gl, 3, gl.TEXTURE_2D, relief.texture, uniforms.relief);
    }
    gl.drawArrays(gl.TRIANGLES, 0, 6 * cells ** 2);
  }

  /** The program of a state in use, with everything but the tile set; its uniforms. */
  #shader(state, lamps, place, { exposure, output }) {
    const { gl, manifest } = this, { code, gloss } = manifest;
    const shadowed = Boolean(this.shadow && this.shadow.count === lamps.length && lamps.length);
    const defines = {
      PLANES: this.planes, CHROMA: this.chroma, TERMS: this.terms, SHADES: this.shades, LAMPS: lamps.length,
      LOBES: gloss.beta[0].length, REGIONS: this.hasRegions ? 1 : 0, BLURRED: gloss.blurred ? 1 : 0, SHADOWS: shadowed ? 1 : 0, OUTPUT: output, RELIEF: this.#reliefOf(place) ? 1 : 0,
    };
    const shader = this.#program(JSON.stringify(defines), TILE_VERTEX, paintingFragment(defines), defines);
    const { uniforms } = shader;
    shader.use();
    const { colours, whites } = this.#colours(state, exposure);
    const set = (call, name, ...values) => uniforms[name] && gl[call](uniforms[name], ...values);
    const ranges = ({ low, high }) => new Float32Array(low.flatMap((value, k) => [value, high[k]]));
    set("uniform1f", "side", this.tiles.side);
    set("uniform3f", "toward", ...place.toward);
    set("uniform2f", "normalCode", code.normal.width, code.normal.fineness);
    set("uniform1f", "top", code.colour.top);
    set("uniform2fv", "chromaRange", this.chroma ? ranges(code.colour) : new Float32Array(2));
    if (this.terms) {
      const five = (vector) => [...vector, 0, 0].slice(0, 5);
      if (this.shades) set("uniform2fv", "shadeRange", ranges(code.shading));
      set("uniform1fv", "shadeMean", new Float32Array(five(code.shading.mean)));
      if (this.shades) set("uniform1fv", "shadeAxes", new Float32Array(code.shading.components.flatMap(five)));
    }
    set("uniform3fv", "colours", colours);
    set("uniform3fv", "whites", whites);
    if (lamps.length) {
      set("uniform4fv", "lamps", new Float32Array(lamps.flatMap(({ vector, w }) => [...vector, w])));
      set("uniform4fv", "powers", new Float32Array(lamps.flatMap(({ lamp, w, length }) => [lamp.intensity, w ? length ** 2 : 0, 0, 0])));
    }
    set("uniform1f", "ambient", state.ambient);
    set("uniform1f", "transmission", gloss.transmission);
    set("uniform1i", "enhance", Math.max(ENHANCEMENTS.indexOf(state.enhance), 0));
    set("uniform1f", "strength", state.strength ?? 0.5);
    bind(gl, 1, gl.TEXTURE_2D, this.gloss, uniforms.gloss);
    if (shadowed) bind(gl, 2, gl.TEXTURE_2D_ARRAY, this.shadow.texture, uniforms.visibility);
    return uniforms;
  }

  #program(key, vertex, fragment, defines) {
    if (!this.programs.has(key)) this.programs.set(key, program(this.gl, vertex, fragment, defines));
    return this.programs.get(key);
  }

  /** A row a region: index and entering light, then beta and 1 / gamma^2 of each lobe. */
  #glossTexture() {
    const { gl, manifest } = this, { beta, gamma, refractive_index, entering } = manifest.gloss;
    const rows = beta.map((lobes, region) => [refractive_index[region], entering[region], 0, 0, ...lobes.flatMap((strength, k) => [strength, gamma[region][k] ** -2, 0, 0])]);
    const made = texture(gl, gl.TEXTURE_2D, gl.NEAREST);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA32F, 1 + beta[0].length, rows.length, 0, gl.RGBA, gl.FLOAT, new Float32Array(rows.flat()));
    return made;
  }

  // layers and probe

  async #layerTexture(layer) {
    if (!this.layerTextures.has(layer.name)) {
      const making = this.loader.load(layer.block).then((data) => picture(data, "image/png")).then((image) => {
        const { gl } = this, made = texture(gl, gl.TEXTURE_2D, gl.NEAREST);
        gl.texImage2D(gl.TEXTURE_2D, 0, gl.R8, gl.RED, gl.UNSIGNED_BYTE, image);
        return { texture: made };
      });
      const entry = { making, made: null };
      this.layerTextures.set(layer.name, entry);
      this.#wait(making.then((made) => (entry.made = made)));
    }
    return this.layerTextures.get(layer.name).making;
  }

  #drawLayer(layer, place) {
    const { gl, manifest } = this;
    this.#layerTexture(layer);
    const { made } = this.layerTextures.get(layer.name);
    if (!made) return;
    const defines = { RELIEF: this.#reliefOf(place) ? 1 : 0 };
    const shader = this.#program(`layer${defines.RELIEF}`, TILE_VERTEX, LAYER_FRAGMENT, defines);
    const { uniforms } = shader;
    shader.use();
    bind(gl, 0, gl.TEXTURE_2D, made.texture, uniforms.codes);
    gl.clear(gl.DEPTH_BUFFER_BIT);
    gl.uniform2f(uniforms.size, manifest.columns, manifest.rows);
    gl.uniform1i(uniforms.colouring, Math.max(LAYER_COLOURS.indexOf(layer.map), 0));
    gl.uniform1f(uniforms.nothing, layer.code.nothing);
    // codes to 0 ... 1 over the range that is shown
    gl.uniform1f(uniforms.scale, (layer.code.high - layer.code.low) / layer.code.top / (layer.range[1] - layer.range[0]));
    this.#drawMesh(uniforms, place, 1, [0, 0, manifest.columns, manifest.rows]);
  }

  /** RGBA bytes of one pixel of a texture, or of a layer of an array texture. */
  #readPixel(made, layer, column, row) {
    const { gl } = this;
    this.packing ??= gl.createFramebuffer();
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.packing);
    if (layer === null) gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, made, 0);
    else gl.framebufferTextureLayer(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, made, 0, layer);
    const bytes = readback(gl, column, row, 1, 1);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    return bytes;
  }

  /** Normal, coefficients and region of a pixel of the map; null where nothing is known. */
  async #record(column, row) {
    const { size, border, unknown } = this.manifest.tiles;
    const [tileRow, tileColumn] = [row, column].map((k) => Math.floor(k / size));
    const made = await this.tiles.load(0, tileRow, tileColumn);
    const place = [column - tileColumn * size + border, row - tileRow * size + border];
    const values = Array.from({ length: this.stack }, (_, layer) => [...this.#readPixel(made, layer, ...place)].slice(0, 3)).flat();
    const region = values[this.planes];
    if (region === unknown) return null;
    const { normal, colour: code } = this.manifest.code;
    const [sx, sy] = values.slice(0, 2).map((value) => value / 127 - 1).map((t) => normal.width * t * (normal.fineness + (1 - normal.fineness) * t * t));
    const square = sx * sx + sy * sy;
    const u = (values[2] / 255) * code.top;
    const chroma = code.low.map((low, k) => low + (values[3 + k] / 255) * (code.high[k] - low));
    return {
      region,
      normal: [2 * sx, 2 * sy, 1 - square].map((value) => value / (1 + square)),
      coefficients: code.direction.map((d, i) => u ** 3 * d + u * u * chroma.reduce((sum, value, k) => sum + value * code.components[k][i], code.mean[i])),
    };
  }
}
