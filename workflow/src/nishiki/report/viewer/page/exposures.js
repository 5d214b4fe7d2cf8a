// The exposure of an eye that is adapted to the picture, as in nishiki.render.display.
import * as colour from "viewer/colour";
import { readback, target } from "viewer/gl";
import { remember } from "viewer/shadows";

const LEVEL_PIXELS = 1 << 18; // at most, of the level of the pyramid that is looked at
const FIRST_PIXELS = 1 << 16; // at most, about, of the pixels of it that are looked at for the first picture

export class Exposures {
  constructor(gl, tiles) {
    this.gl = gl;
    this.tiles = tiles;
    this.chosen = new Map(); // of the states drawn last: two, where a divider compares
    const { levels } = tiles.layout;
    this.level = Math.max(levels.findIndex(({ rows, columns }) => rows * columns <= LEVEL_PIXELS), 0);
    const { rows, columns } = levels[this.level];
    // an odd number, so that pixels of the meter lie on pixels of the level
    this.apart = 2 * Math.ceil((Math.sqrt((rows * columns) / FIRST_PIXELS) - 1) / 2) + 1;
    this.first = null; // exposure of the first picture
  }

  /** Exposure that was chosen last. */
  get last() {
    return [...this.chosen.values()].at(-1) ?? this.first ?? 1;
  }

  /** Exposure of a state that `key` names; draw(width, height, scale): codes of the luminance of every pixel of the frontal view. */
  of(key, state, draw) {
    const known = this.chosen.get(key);
    if (known !== undefined) {
      remember(this.chosen, key, known);
      return known;
    }
    if (!this.tiles.haveAll(this.level)) return this.last;
    if (this.first === null) return (this.first = colour.adaptedExposure(this.#luminance(draw, this.apart), sheetOf(state)));
    const exposure = colour.adaptedExposure(this.#luminance(draw, 1), sheetOf(state));
    remember(this.chosen, key, exposure);
    return exposure;
  }

  /** Percentile of the luminance to which the eye adapts. */
  #luminance(draw, apart) {
    const { gl } = this, { rows, columns, factor } = this.tiles.layout.levels[this.level];
    const [width, height] = [columns, rows].map((count) => Math.ceil(count / apart));
    if (this.meter?.width !== width) this.meter = target(gl, width, height);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.meter.framebuffer);
    gl.viewport(0, 0, width, height);
    gl.disable(gl.SCISSOR_TEST);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT);
    draw(width, height, 1 / (factor * apart));
    const bytes = readback(gl, 0, 0, width, height);
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
    return seen ? 2 ** (((bin + 0.5) / 65535) * 32 - 20) : 0;
  }
}

/** Luminance of a white sheet under the lamps. */
const sheetOf = ({ ambient, lamps }) => ambient + lamps.reduce((sum, lamp) => sum + lamp.intensity * Math.sin((lamp.elevation_deg * Math.PI) / 180), 0);
