// Tiles of a pyramid as textures: read when first asked for, those used longest ago dropped.
import { texture } from "viewer/gl";
import { picture } from "viewer/loader";

const TEXTURE_BYTES = 256e6; // of tiles that are kept
const MOST_ANISOTROPY = 4; // pixels that a tilt squeezes into one
const WHOLE = [0, 0, Infinity, Infinity]; // of a level
const MIPMAPS = 3; // of a tile: levels of the pyramid are a factor of 4 apart

/** Pictures of a tile: before each its length in bytes, four of them, the lowest first. */
function stackOf(data) {
  const view = new DataView(data.buffer, data.byteOffset, data.byteLength), parts = [];
  for (let at = 0; at < data.length; at += 4 + view.getUint32(at, true)) {
    parts.push(picture(data.subarray(at + 4, at + 4 + view.getUint32(at, true)), "image/webp"));
  }
  return Promise.all(parts);
}

export class Tiles {
  /** layout: {size, border, levels} of the manifest; stack: pictures of a tile; wait(promise): told of what is on its way. */
  constructor(gl, layout, stack, loader, wait) {
    this.gl = gl;
    this.layout = layout;
    this.stack = stack;
    this.loader = loader;
    this.wait = wait;
    this.side = layout.size + 2 * layout.border;
    this.sharp = gl.getExtension("EXT_texture_filter_anisotropic"); // for tilted views
    this.tiles = new Map();
  }

  /** Coarsest level whose pixels are no larger than those of the canvas, which has `scale` of them to one of the map. */
  levelOf(scale) {
    return Math.max(this.layout.levels.findLastIndex(({ factor }) => factor * scale < 1.25), 0);
  }

  /** Tiles of a level, [row, column], within [left, top, right, bottom] of the map.
   * @param {number} level @param {number[]} bounds */
  within(level, [left, top, right, bottom]) {
    const { levels, size } = this.layout, { rows, columns, factor } = levels[level];
    const range = (from, to, count) => {
      const first = Math.max(Math.floor(from / (size * factor)), 0), last = Math.min(Math.floor(to / (size * factor)), count - 1);
      return Array.from({ length: Math.max(last - first + 1, 0) }, (_, k) => first + k);
    };
    const across = range(left, right, Math.ceil(columns / size));
    return range(top, bottom, Math.ceil(rows / size)).flatMap((row) => across.map((column) => [row, column]));
  }

  /** Promise of a whole level. */
  loadAll(level) {
    return Promise.all(this.within(level, WHOLE).map(([row, column]) => this.load(level, row, column)));
  }

  /** Whether a whole level is here; what lacks is asked for. */
  haveAll(level) {
    return this.within(level, WHOLE).map(([row, column]) => this.ready(level, row, column)).every(Boolean);
  }

  /** Texture of a tile, or null while it is on its way. */
  ready(level, row, column) {
    const known = this.tiles.get(`${level}-${row}-${column}`);
    if (!known) {
      this.load(level, row, column);
      return null;
    }
    if (known.texture) {
      this.tiles.delete(known.name); // the last used come last
      this.tiles.set(known.name, known);
    }
    return known.texture;
  }

  /** Promise of the texture of a tile. */
  load(level, row, column) {
    const name = `${level}-${row}-${column}`;
    if (!this.tiles.has(name)) {
      const tile = { name, texture: null };
      this.tiles.set(name, tile);
      tile.making = this.wait(this.#make(tile));
    }
    return this.tiles.get(name).making;
  }

  async #make(tile) {
    const pictures = await stackOf(await this.loader.load(`tile-${tile.name}`));
    const { gl, side } = this;
    tile.texture = texture(gl, gl.TEXTURE_2D_ARRAY, gl.LINEAR);
    gl.texParameteri(gl.TEXTURE_2D_ARRAY, gl.TEXTURE_MIN_FILTER, gl.LINEAR_MIPMAP_NEAREST);
    if (this.sharp) gl.texParameterf(gl.TEXTURE_2D_ARRAY, this.sharp.TEXTURE_MAX_ANISOTROPY_EXT, MOST_ANISOTROPY);
    gl.texStorage3D(gl.TEXTURE_2D_ARRAY, MIPMAPS, gl.RGBA8, side, side, pictures.length);
    pictures.forEach((image, layer) => {
      gl.texSubImage3D(gl.TEXTURE_2D_ARRAY, 0, 0, 0, layer, side, side, 1, gl.RGBA, gl.UNSIGNED_BYTE, image);
      image.close();
    });
    gl.generateMipmap(gl.TEXTURE_2D_ARRAY);
    this.#forget();
    return tile.texture;
  }

  /** Drop the tiles used longest ago; the coarsest stays. */
  #forget() {
    const most = Math.max(Math.floor(TEXTURE_BYTES / (this.side ** 2 * 5.3 * this.stack)), 8);
    for (const [name, tile] of this.tiles) {
      if (this.tiles.size <= most) break;
      if (!tile.texture || name.startsWith(`${this.layout.levels.length - 1}-`)) continue;
      this.gl.deleteTexture(tile.texture);
      this.tiles.delete(name);
    }
  }
}
