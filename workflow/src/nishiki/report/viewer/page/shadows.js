// Cast shadows: which share of each lamp the relief leaves visible, as textures for the shader.
import { texture } from "viewer/gl";
import { work } from "viewer/shadow_worker";

const KEPT = 3; // states whose shadows are kept
// Near lamps are marched from every pixel: on the finer relief only around what the canvas shows, up to a number of pixels.
const MARGIN = 64, MOST_MARCHED = 3e6;

/** Put an entry last in a map and keep the last few; the values that were dropped. */
export function remember(map, key, value) {
  map.delete(key);
  map.set(key, value);
  const dropped = [...map.keys()].slice(0, -KEPT).map((name) => [name, map.get(name)]);
  dropped.forEach(([name]) => map.delete(name));
  return dropped.map(([, each]) => each);
}

/** The heights of a block in a worker: `request(job)` answers by `onready(job, visibility)`. */
class Heights {
  /** described: rows, columns, pitch and code of the heights, of the manifest. */
  constructor(described) {
    this.described = described;
    this.running = null;
    this.next = null;
    this.onready = (job, visibility) => {}; // eslint-disable-line no-unused-vars
    const url = URL.createObjectURL(new Blob([`(${work})()`], { type: "text/javascript" }));
    this.worker = new Worker(url);
    URL.revokeObjectURL(url);
  }

  /** Promise of the heights {surface (NaN: unknown), rows, columns, pitch} where they are wanted here, else of null. */
  open(block, wanted) {
    const { described, worker } = this, { rows, columns, pitch } = described;
    return new Promise((resolve, reject) => {
      worker.onerror = ({ message }) => reject(new Error(`${described.block}: ${message}`));
      worker.onmessage = ({ data }) => {
        worker.onmessage = ({ data: visibility }) => this.#answered(visibility);
        if (data.error) reject(new Error(`${described.block}: ${data.error}`));
        else resolve(data.surface && { surface: data.surface, rows, columns, pitch });
      };
      worker.postMessage({ block, described, wanted });
    });
  }

  /** Ask for {key, lamps: [{vector, w, radius}], window}; of several requests in a row only the last is answered. */
  request(job) {
    if (this.running && JSON.stringify(this.running) === JSON.stringify(job)) this.next = null;
    else if (this.running) this.next = job;
    else this.#start(job);
  }

  #start(job) {
    this.next = null;
    this.running = job;
    this.worker.postMessage(job);
  }

  #answered(visibility) {
    const job = this.running;
    this.running = null;
    if (this.next) this.#start(this.next);
    this.onready(job, visibility);
  }
}

/** Shadows of the lamps drawn last: those of the coarse relief follow a lamp that is dragged, those of the finer one come
 *  when it rests. */
export class Shadows {
  /** most: lamps that the shader can take. */
  constructor(gl, reliefs, loader, most) {
    this.gl = gl;
    this.reliefs = reliefs;
    this.loader = loader;
    this.levels = []; // heights that are open, the coarse first
    this.known = new Map(); // by lamps: {key, count, parts}, parts by level: {texture, rows, columns, window}
    this.shown = {}; // keys of those that each part of the canvas shows
    this.onready = () => {};
    this.none = { texture: this.#texture(1, 1, most, new Uint8Array(most).fill(255)), window: null };
  }

  get busy() {
    return this.levels.some(({ running }) => running !== null);
  }

  /** Open a relief in a worker; promise of its heights, if it is the coarse one, which lifts tilted views. */
  async open(level) {
    const heights = new Heights(this.reliefs[level]);
    const opened = await heights.open(await this.loader.load(this.reliefs[level].block), level === 0);
    heights.onready = (job, visibility) => {
      this.#keep(job, level, visibility);
      this.onready();
    };
    this.levels.push(heights);
    return opened;
  }

  /** Shadows of lamps, {key, count, parts}: until they come, those of the lamps just before, or null. view: [left, top,
   *  right, bottom] of the map that the canvas shows, 0 to 1; part: of the canvas, whose lamps they are. */
  of(lamps, view, part) {
    const wanted = lamps.map(({ vector, w, radius }) => ({ vector, w, radius }));
    const key = JSON.stringify(wanted), ready = this.known.get(key);
    if (lamps.length) this.#ask(key, wanted, ready, view);
    const before = this.known.get(this.shown[part]), shown = ready ?? (before?.count === lamps.length ? before : null);
    if (shown) remember(this.known, shown.key, shown);
    this.shown[part] = shown?.key;
    return shown;
  }

  #ask(key, lamps, ready, view) {
    if (!ready) {
      this.levels[0]?.request({ key, lamps, window: null });
      return;
    }
    const [, fine] = this.levels, [, part] = ready.parts;
    if (!fine || (part && holds(part.window, this.#pixels(view, 0)))) return;
    const near = lamps.some(({ w }) => w), window = near ? this.#pixels(view, MARGIN) : null;
    if (near) {
      const marched = (window[2] - window[0]) * (window[3] - window[1]);
      if (!marched || marched > MOST_MARCHED) return;
    }
    fine.request({ key, lamps, window });
  }

  /** A part [left, top, right, bottom] of the map, 0 to 1, in pixels of the finer relief.
   * @param {number[]} part @param {number} margin */
  #pixels([left, top, right, bottom], margin) {
    const { rows, columns } = this.reliefs[1];
    const within = (value, most) => Math.min(Math.max(value, 0), most);
    return [
      within(Math.floor(left * columns) - margin, columns), within(Math.floor(top * rows) - margin, rows),
      within(Math.ceil(right * columns) + margin, columns), within(Math.ceil(bottom * rows) + margin, rows),
    ];
  }

  /** The finest shadows that there are of all of a view, or of all of the map where it is null: {texture, place}, place
   *  being that of the texture on the map: scale and offset, across and down. */
  finest(shadow, view) {
    const parts = (shadow?.parts ?? []).filter(({ window }) => !window || (view && holds(window, this.#pixels(view, 0))));
    const { texture: made, window, rows, columns } = parts.at(-1) ?? this.none;
    if (!window) return { texture: made, level: parts.length - 1, place: [1, 1, 0, 0] };
    const [left, top, right, bottom] = window, wide = right - left, high = bottom - top;
    return { texture: made, level: parts.length - 1, place: [columns / wide, rows / high, -left / wide, -top / high] };
  }

  #keep({ key, lamps, window }, level, visibility) {
    const { rows, columns } = this.reliefs[level], [left, top, right, bottom] = window ?? [0, 0, columns, rows];
    const made = { texture: this.#texture(bottom - top, right - left, lamps.length, visibility), rows, columns, window };
    const entry = this.known.get(key) ?? { key, count: lamps.length, parts: [] };
    if (entry.parts[level]) this.gl.deleteTexture(entry.parts[level].texture);
    if (level > entry.parts.length) return this.gl.deleteTexture(made.texture); // its coarse part was dropped meanwhile
    entry.parts[level] = made;
    for (const { parts } of remember(this.known, key, entry)) parts.forEach((part) => this.gl.deleteTexture(part.texture));
  }

  #texture(rows, columns, count, visibility) {
    const { gl } = this, made = texture(gl, gl.TEXTURE_2D_ARRAY, gl.LINEAR);
    gl.texParameteri(gl.TEXTURE_2D_ARRAY, gl.TEXTURE_MIN_FILTER, gl.LINEAR_MIPMAP_LINEAR);
    gl.texStorage3D(gl.TEXTURE_2D_ARRAY, Math.floor(Math.log2(Math.max(rows, columns))) + 1, gl.R8, columns, rows, count);
    gl.texSubImage3D(gl.TEXTURE_2D_ARRAY, 0, 0, 0, 0, columns, rows, count, gl.RED, gl.UNSIGNED_BYTE, visibility);
    gl.generateMipmap(gl.TEXTURE_2D_ARRAY);
    return made;
  }
}

/** Whether a window, or the whole map where it is null, holds a part of it. @param {any} window @param {number[]} part */
const holds = (window, [left, top, right, bottom]) => !window || (window[0] <= left && window[1] <= top && window[2] >= right && window[3] >= bottom);
