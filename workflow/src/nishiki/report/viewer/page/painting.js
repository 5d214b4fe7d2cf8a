// A painting under moving lamps: tiles of a pyramid, shaded as nishiki.render.plane shades the maps.
//
// Pixels of the map have their upper left corner at whole numbers; the scene's own unit is mm (or pixels where no scale
// is known), from the centre of the painting, x to the right and y up.
import { ENHANCEMENTS, enhancementOf } from "viewer/common_shaders";
import { afterPicture } from "viewer/dom";
import { bind, context, program, readback, texture } from "viewer/gl";
import { Exposures } from "viewer/exposures";
import { Colours } from "viewer/painting_colours";
import { LAYER_FRAGMENT, paintingFragment, SHOWN, TILE_VERTEX } from "viewer/painting_shaders";
import { Values } from "viewer/painting_values";
import { enlarged } from "viewer/flat";
import { PlaneView } from "viewer/plane_view";
import { Relief } from "viewer/relief";
import { Shadows } from "viewer/shadows";
import { MOST_LAMPS } from "viewer/state";
import { Tiles } from "viewer/tiles";

const LAYER_COLOURS = ["grey", "diverging", "flags"];
const BACKGROUND = 0.106;
const FRONTAL = { x: 0, y: 0, zoom: 1, tilt_deg: 0, azimuth_deg: 0 };
export class Painting {
  opening; // promise of the reliefs

  /** Opens a painting; ready to draw once its coarsest tile is there and the level from which the exposure is chosen, in
   * long paintings a finer one. */
  static async open(canvas, manifest, loader) {
    const scene = new Painting(canvas, manifest, loader);
    const tiles = [manifest.tiles.levels.length - 1, scene.exposures.level].map((level) => scene.tiles.loadAll(level));
    scene.#tileProgram(1, false); // compiled while the tiles are decoded
    await Promise.all(tiles);
    return scene;
  }

  constructor(canvas, manifest, loader) {
    this.canvas = canvas;
    this.manifest = manifest;
    this.loader = loader;
    this.gl = context(canvas);
    this.onready = () => {};
    this.pending = 0;
    this.programs = new Map();
    const { colour: chroma, shading } = manifest.code;
    this.chroma = chroma.low.length;
    this.shades = shading ? shading.low.length : 0;
    this.terms = shading ? shading.mean.length : 0;
    this.planes = 3 + this.chroma + this.shades; // the region comes after them
    const wait = (promise) => this.#wait(promise);
    this.tiles = new Tiles(this.gl, manifest.tiles, Math.ceil((this.planes + 1) / 3), loader, wait);
    this.values = new Values(this.gl, manifest, this.tiles, loader, wait);
    this.exposures = new Exposures(this.gl, this.tiles);
    this.colours = new Colours(manifest);
    this.gloss = this.#glossTexture();
    this.shadows = new Shadows(this.gl, manifest.shadows, loader, MOST_LAMPS);
    this.shadows.onready = () => this.onready();
    this.shadow = null; // those of the state that is drawn
    this.relief = null; // the coarse one, for tilted views
  }

  /** What of the panel this scene has use for. */
  get offers() {
    return ["softness", "exposure auto"];
  }

  get enhancements() {
    return ENHANCEMENTS;
  }

  /** Whether something that the present view needs is on its way. */
  get busy() {
    return this.pending > 0 || this.shadows.busy;
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

  /** A state whose picture is so many times larger, with the place at the pixel `from` of the canvas at `to`. */
  enlarged(state, times, from, to) {
    return enlarged(this, state, times, from, to);
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

  /** Point of the scene at a place of the map. @param {number[]} place */
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
      texture_reads: Math.ceil(this.planes / 3) + 4 * blurred + 1 + lobes + (this.manifest.shadows.length ? 1 : 0) + (this.manifest.tiles.regions ? 1 : 0),
      operations: 60 + 8 * this.chroma + 12 * this.shades + 60 * blurred + (lobes ? 90 : 20) + lobes * (blurred ? 22 : 4) + 40,
    };
  }

  /** Draw one frame; region {x, y, width, height} of the canvas, from its upper left corner, or all of it; part: its name,
   * `main`, `left` of the divider, or `lens`. */
  draw(state, region, part = "main") {
    const { gl, canvas } = this;
    const area = region ?? { x: 0, y: 0, width: canvas.width, height: canvas.height };
    const layer = this.manifest.layers.find(({ name }) => name === state.layer);
    const plain = !layer || layer.name === "appearance";
    const lamps = this.#lamps(state);
    const place = this.#place(state);
    this.shadow = plain ? this.shadows.of(lamps, this.#share(place), part) : null;
    const exposure = plain ? this.#exposureOf(state, lamps) : 1;
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.viewport(0, 0, canvas.width, canvas.height);
    gl.enable(gl.SCISSOR_TEST);
    gl.scissor(area.x, canvas.height - area.y - area.height, area.width, area.height);
    gl.clearColor(BACKGROUND, BACKGROUND, BACKGROUND, 1);
    gl.clear(gl.COLOR_BUFFER_BIT);
    if (place.tilted) gl.enable(gl.DEPTH_TEST);
    if (layer?.block) this.#drawLayer(layer, place);
    else this.#drawTiles(state, lamps, place, area, { exposure, shown: plain ? SHOWN.display : SHOWN.normals });
    gl.disable(gl.DEPTH_TEST);
    gl.disable(gl.SCISSOR_TEST);
    this.opening ??= this.#openShadows();
  }

  /** What is known at a pixel of the canvas: null beside the painting. */
  async probe(x, y, state) {
    const { manifest } = this;
    const [column, row] = this.#toRelief(x, y, state).map(Math.floor);
    if (column < 0 || row < 0 || column >= manifest.columns || row >= manifest.rows) return null;
    return this.values.at(column, row, this.#pointOf([column + 0.5, row + 0.5]));
  }

  /** RGBA bytes of the canvas as drawn, first row at the bottom. */
  readPixels() {
    this.gl.bindFramebuffer(this.gl.FRAMEBUFFER, null);
    return readback(this.gl, 0, 0, this.canvas.width, this.canvas.height);
  }

  #place({ view }) {
    return this.#placed(this.canvas, this.fit() * view.zoom, view);
  }

  #placed(screen, scale, view) {
    const { rows, columns, pitch_mm } = this.manifest;
    return new PlaneView({ rows, columns, pitch: pitch_mm ?? 1 }, screen, scale, view, this.relief?.heights);
  }

  /** Part of the map [left, top, right, bottom] that the canvas shows, 0 to 1. */
  #share(place) {
    const { rows, columns } = this.manifest, [left, top, right, bottom] = place.bounds({ x: 0, y: 0, width: this.canvas.width, height: this.canvas.height });
    return [left / columns, top / rows, (right + 1) / columns, (bottom + 1) / rows];
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

  /** Exposure that was chosen last. */
  get exposureShown() {
    return this.exposures.last;
  }

  /** Exposure of a state: its own number, or that of an eye adapted to the picture. */
  #exposureOf(state, lamps) {
    if (state.exposure !== "auto") return state.exposure;
    const key = JSON.stringify([state.lamps, state.ambient, this.shadow?.key, this.shadows.finest(this.shadow, null).level]);
    return this.exposures.of(key, state, (width, height, scale) => {
      const area = { x: 0, y: 0, width, height };
      const place = this.#placed(area, scale, FRONTAL);
      this.#drawTiles({ ...state, enhance: "none" }, lamps, place, area, { exposure: null, shown: SHOWN.luminance });
    });
  }

  /** Open the reliefs one after the other, the coarse one first, once there is a picture. */
  async #openShadows() {
    await this.#wait(new Promise(afterPicture));
    for (const level of this.manifest.shadows.keys()) {
      const heights = await this.#wait(this.shadows.open(level));
      if (heights) this.relief = new Relief(this.gl, heights, this.manifest.pitch_mm ?? 1);
      this.onready();
    }
  }

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
  #drawTiles(state, lamps, place, area, { exposure, shown }) {
    const { gl, tiles, manifest } = this, { size, border, levels } = manifest.tiles;
    const level = tiles.levelOf(place.scale), bounds = place.bounds(area), wanted = tiles.within(level, bounds);
    const complete = wanted.map(([row, column]) => tiles.ready(level, row, column)).every(Boolean);
    const uniforms = this.#shader(state, lamps, place, { exposure, shown });
    const set = (call, name, value) => uniforms[name] && gl[call](uniforms[name], value);
    for (const each of complete ? [level] : [...new Set([levels.length - 1, level])]) {
      const { factor } = levels[each], columns = manifest.columns / factor, rows = manifest.rows / factor;
      // the meter looks at some of the pixels, each as it is
      const metered = shown === SHOWN.luminance, step = metered ? 1 : factor * place.scale;
      gl.clear(gl.DEPTH_BUFFER_BIT);
      gl.uniform2f(uniforms.size, columns, rows);
      set("uniform1f", "pitch", (manifest.pitch_mm ?? 1) * factor);
      set("uniform1f", "blur", Math.min(1, 1 / step ** 2));
      set("uniform1f", "stride", Math.max(1, 1 / step));
      for (const [row, column] of each === level ? wanted : tiles.within(each, bounds)) {
        const made = tiles.ready(each, row, column);
        if (!made) continue;
        bind(gl, 0, gl.TEXTURE_2D_ARRAY, made, uniforms.planes);
        gl.texParameterf(gl.TEXTURE_2D_ARRAY, gl.TEXTURE_MAX_LOD, metered ? 0 : 1000);
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

  /** The program for a number of lamps. */
  #tileProgram(lamps, lifted) {
    const { manifest, planes, chroma, terms, shades } = this, { gloss } = manifest;
    const defines = {
      PLANES: planes, CHROMA: chroma, TERMS: terms, SHADES: shades, LAMPS: lamps, LOBES: gloss.beta[0].length,
      REGIONS: manifest.tiles.regions ? 1 : 0, BLURRED: gloss.blurred ? 1 : 0, SHADOWS: manifest.shadows.length ? 1 : 0, RELIEF: lifted ? 1 : 0,
    };
    return this.#program(JSON.stringify(defines), TILE_VERTEX, paintingFragment(defines), defines);
  }

  /** The program of a state in use, with everything but the tile set; its uniforms. */
  #shader(state, lamps, place, { exposure, shown }) {
    const { gl, manifest } = this, { code } = manifest;
    const shader = this.#tileProgram(lamps.length, Boolean(this.#reliefOf(place))), { uniforms } = shader;
    shader.use();
    const illuminants = lamps.map(({ lamp }) => lamp.illuminant);
    const { colours, whites } = this.colours.uniforms([...illuminants, illuminants[0] ?? "E"], exposure);
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
    set("uniform1i", "enhance", enhancementOf(state));
    set("uniform1f", "strength", state.strength ?? 0.5);
    bind(gl, 1, gl.TEXTURE_2D, this.gloss, uniforms.gloss);
    set("uniform1i", "shown", shown);
    if (uniforms.visibility) {
      const shadow = this.shadow?.count === lamps.length ? this.shadow : null;
      const { texture: made, place: part } = this.shadows.finest(shadow, shown === SHOWN.luminance ? null : this.#share(place));
      gl.uniform4f(uniforms.shadowPlace, ...part);
      bind(gl, 2, gl.TEXTURE_2D_ARRAY, made, uniforms.visibility);
    }
    return uniforms;
  }

  #program(key, vertex, fragment, defines) {
    if (!this.programs.has(key)) this.programs.set(key, program(this.gl, vertex, fragment, defines));
    return this.programs.get(key);
  }

  /** A row a region: index, entering light and transmission, then beta and 1 / gamma^2 of each lobe. */
  #glossTexture() {
    const { gl, manifest } = this, { beta, gamma, refractive_index, transmission, entering } = manifest.gloss;
    const rows = beta.map((lobes, region) => [refractive_index[region], entering[region], transmission[region], 0, ...lobes.flatMap((strength, k) => [strength, gamma[region][k] ** -2, 0, 0])]);
    const made = texture(gl, gl.TEXTURE_2D, gl.NEAREST);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA32F, 1 + beta[0].length, rows.length, 0, gl.RGBA, gl.FLOAT, new Float32Array(rows.flat()));
    return made;
  }

  #drawLayer(layer, place) {
    const { gl, manifest } = this;
    const made = this.values.layer(layer);
    if (!made) return;
    const defines = { RELIEF: this.#reliefOf(place) ? 1 : 0 };
    const shader = this.#program(`layer${defines.RELIEF}`, TILE_VERTEX, LAYER_FRAGMENT, defines);
    const { uniforms } = shader;
    shader.use();
    bind(gl, 0, gl.TEXTURE_2D, made, uniforms.codes);
    gl.clear(gl.DEPTH_BUFFER_BIT);
    gl.uniform2f(uniforms.size, manifest.columns, manifest.rows);
    gl.uniform1i(uniforms.colouring, Math.max(LAYER_COLOURS.indexOf(layer.map), 0));
    gl.uniform1f(uniforms.nothing, layer.code.nothing);
    // codes to 0 ... 1 over the range that is shown
    gl.uniform1f(uniforms.scale, (layer.code.high - layer.code.low) / layer.code.top / (layer.range[1] - layer.range[0]));
    this.#drawMesh(uniforms, place, 1, [0, 0, manifest.columns, manifest.rows]);
  }
}
