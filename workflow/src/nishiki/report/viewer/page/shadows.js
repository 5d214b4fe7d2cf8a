// Cast shadows: which share of each lamp the relief leaves visible. The sweep and the march of
// nishiki.render.plane.shadow and horizon, in a worker so that the page stays quick.
import { inflate } from "viewer/loader";

/** Heights of a block: {surface (NaN: unknown), rows, columns, pitch, pieces, count}. */
export async function openHeights(shadows, loader) {
  const data = await inflate(await loader.load(shadows.block));
  const { rows, columns } = shadows, size = rows * columns;
  const codes = new Int16Array(size), surface = new Float32Array(size);
  for (let row = 0, i = 0; row < rows; row++) {
    for (let column = 0; column < columns; column++, i++) {
      const above = row ? codes[i - columns] : 0, left = column ? codes[i - 1] : 0;
      const corner = row && column ? codes[i - columns - 1] : 0;
      codes[i] = (data[i] | (data[i + size] << 8)) + above + left - corner;
      surface[i] = codes[i] === shadows.nothing ? NaN : shadows.low + codes[i] * shadows.step;
    }
  }
  return { surface, rows, columns, pitch: shadows.pitch, ...separatePieces(surface, rows, columns) };
}

/** Connected pieces of known heights: {pieces (Int32Array or null where all is one), count}. */
function separatePieces(surface, rows, columns) {
  if (!surface.some(Number.isNaN)) return { pieces: null, count: 1 };
  const pieces = new Int32Array(surface.length), queue = new Int32Array(surface.length);
  let count = 0;
  for (let start = 0; start < surface.length; start++) {
    if (pieces[start] || Number.isNaN(surface[start])) continue;
    pieces[start] = ++count;
    queue[0] = start;
    for (let read = 0, end = 1; read < end; read++) {
      const at = queue[read], column = at % columns;
      const around = [column ? at - 1 : -1, column < columns - 1 ? at + 1 : -1, at - columns, at + columns];
      for (const next of around) {
        if (next < 0 || next >= surface.length || pieces[next] || Number.isNaN(surface[next])) continue;
        pieces[next] = count;
        queue[end++] = next;
      }
    }
  }
  return count > 1 ? { pieces, count: count + 1 } : { pieces: null, count: 1 };
}

/** Visibilities of lamps, computed in a worker: `request(lamps)` answers by `onready`. */
export class Shadows {
  constructor(heights) {
    this.rows = heights.rows;
    this.columns = heights.columns;
    this.onready = () => {};
    this.running = null;
    this.next = null;
    const url = URL.createObjectURL(new Blob([`(${work})()`], { type: "text/javascript" }));
    this.worker = new Worker(url);
    this.worker.postMessage({ heights });
    this.worker.onmessage = ({ data }) => {
      const key = this.running;
      this.running = null;
      if (this.next) this.#start(this.next);
      this.onready(key, data);
    };
  }

  get busy() {
    return this.running !== null;
  }

  /** Ask for the visibilities of lamps [{vector, w, radius}]; of several requests in a row only the last is answered. */
  request(key, lamps) {
    if (this.running === key) this.next = null;
    else if (this.running !== null) this.next = { key, lamps };
    else this.#start({ key, lamps });
  }

  #start({ key, lamps }) {
    this.next = null;
    this.running = key;
    this.worker.postMessage({ lamps });
  }
}

// The worker's whole program: nothing from outside is in reach.
function work() {
  const NOWHERE = -1e30;
  let heights, highest;

  /** Share of a disc of this angular radius above a straight horizon. */
  function discShare(elevation, horizon, radius) {
    if (radius <= 0) return elevation > horizon ? 1 : 0;
    const d = (elevation - horizon) / radius;
    if (d >= 1) return 1;
    if (d <= -1) return 0;
    return 0.5 + (d * Math.sqrt(1 - d * d) + Math.asin(d)) / Math.PI;
  }

  function sweep([x, y, z], radius, out) {
    const { surface, pieces, count, pitch } = heights;
    const elevation = Math.atan2(z, Math.hypot(x, y)), azimuth = Math.atan2(y, x);
    const towardColumn = Math.cos(azimuth), towardRow = -Math.sin(azimuth);
    // the lamp on the side of growing columns, within 45 degrees: strides turn the map
    const swap = Math.abs(towardRow) > Math.abs(towardColumn);
    const along = swap ? towardRow : towardColumn, across = swap ? towardColumn : towardRow;
    const rows = swap ? heights.columns : heights.rows, columns = swap ? heights.rows : heights.columns;
    const rowStride = swap ? 1 : heights.columns;
    let columnStride = swap ? heights.columns : 1, base = 0;
    const flip = along < 0;
    if (flip) {
      base = (columns - 1) * columnStride;
      columnStride = -columnStride;
    }
    const slope = Math.round((across / Math.abs(along)) * 2 ** 20) / 2 ** 20;
    const drift = slope * (columns - 1);
    const first = Math.floor(Math.min(0, -drift)) - 1, last = Math.ceil(rows - 1 + Math.max(0, -drift)) + 1;
    const phase = flip ? ((((-slope * (columns - 1)) % 1) + 1) % 1) : 0;
    const step = pitch * Math.hypot(1, slope);
    const floor = elevation > radius ? 0.5 * Math.tan(elevation - radius) : NOWHERE;
    const low = Math.tan(Math.max(elevation - radius, -1.5)), high = Math.tan(Math.min(elevation + radius, 1.5));
    const tops = new Int32Array(count), lineOf = new Int32Array(count).fill(first - 2);
    const below = new Int32Array(columns), line = new Float64Array(columns);
    let before = new Float64Array(columns), here = new Float64Array(columns);

    function sweepLine(number, start, tangents) {
      for (let column = columns - 1; column >= 0; column--) {
        tangents[column] = NaN;
        const at = start + slope * column, row = Math.floor(at), share = at - row;
        if (row < 0 || row >= rows || (share > 0 && row + 1 >= rows)) continue;
        const place = base + row * rowStride + column * columnStride;
        let height = surface[place];
        if (share > 0) height = (1 - share) * height + share * surface[place + rowStride];
        if (Number.isNaN(height)) continue;
        const piece = pieces ? pieces[place] : 0;
        let top = lineOf[piece] === number ? tops[piece] : -1, tangent = NOWHERE;
        if (top >= 0) {
          tangent = (line[top] - height) / (top - column);
          while (below[top] >= 0) {
            const under = below[top], deeper = (line[under] - height) / (under - column);
            if (deeper < tangent) break;
            tangent = deeper;
            top = under;
          }
          tangent /= step;
        }
        tangents[column] = tangent;
        below[column] = top;
        line[column] = height;
        tops[piece] = column;
        lineOf[piece] = number;
      }
    }

    sweepLine(first - 1, first - 1 + phase, before);
    for (let k = first; k < last + 1; k++) {
      sweepLine(k, k + phase, here);
      for (let column = 0; column < columns; column++) {
        const lower = k - 1 + phase + slope * column, row = Math.floor(lower) + 1;
        if (row < 0 || row >= rows) continue;
        const weight = row - lower;
        let a = before[column], b = here[column];
        if (weight === 1 || Number.isNaN(a)) a = b;
        else if (Number.isNaN(b)) b = a;
        const tangent = (1 - weight) * Math.max(a, floor) + weight * Math.max(b, floor);
        let share = 1;
        if (tangent >= low) {
          share = tangent > high && elevation + radius < 1.5 ? 0 : discShare(elevation, Math.atan(tangent), radius);
        }
        out[base + row * rowStride + column * columnStride] = Math.round(share * 255);
      }
      [before, here] = [here, before];
    }
  }

  function march([x, y, z], radius, out) {
    const { surface, pieces, rows, columns, pitch } = heights;
    const lampColumn = x / pitch + (columns - 1) / 2, lampRow = -y / pitch + (rows - 1) / 2, lampZ = z / pitch;
    for (let row = 0, i = 0; row < rows; row++) {
      for (let column = 0; column < columns; column++, i++) {
        const start = surface[i] / pitch, dc = lampColumn - column, dr = lampRow - row;
        const horizontal = Math.hypot(dc, dr), rise = lampZ - start;
        if (Number.isNaN(start) || horizontal <= 1e-12 * Math.abs(rise)) continue;
        const elevation = Math.atan2(rise, horizontal);
        const lowest = Math.tan(Math.max(elevation - radius, -1.5));
        const byColumn = Math.abs(dc) >= Math.abs(dr), length = horizontal / Math.max(Math.abs(dc), Math.abs(dr));
        const stepColumn = (dc / horizontal) * length, stepRow = (dr / horizontal) * length;
        let tangent = NOWHERE;
        for (let k = 1; ; k++) {
          const distance = k * length, c = column + k * stepColumn, r = row + k * stepRow;
          if (distance > horizontal || highest - start <= distance * Math.max(tangent, lowest)) break;
          if (c < -1e-9 || c > columns - 1 + 1e-9 || r < -1e-9 || r > rows - 1 + 1e-9) break;
          let r0 = Math.floor(r + 1e-9), c0 = Math.floor(c + 1e-9), share, other;
          if (byColumn) {
            c0 = Math.round(c);
            share = Math.max(0, r - r0);
            other = surface[Math.min(r0 + 1, rows - 1) * columns + c0];
          } else {
            r0 = Math.round(r);
            share = Math.max(0, c - c0);
            other = surface[r0 * columns + Math.min(c0 + 1, columns - 1)];
          }
          const at = surface[r0 * columns + c0];
          const value = ((share < 1e-8 ? at : (1 - share) * at + share * other) / pitch - start) / distance;
          if (value > tangent && (!pieces || pieces[r0 * columns + c0] === pieces[i])) tangent = value;
        }
        out[i] = Math.round(255 * discShare(elevation, Math.atan(tangent), radius));
      }
    }
  }

  onmessage = ({ data }) => {
    if (data.heights) {
      heights = data.heights;
      highest = heights.surface.reduce((most, value) => (value > most ? value : most), 0) / heights.pitch;
      return;
    }
    const size = heights.rows * heights.columns;
    const visibility = new Uint8Array(size * data.lamps.length).fill(255);
    data.lamps.forEach(({ vector, w, radius }, k) => {
      const out = visibility.subarray(k * size, (k + 1) * size);
      if (w) march(vector, radius, out);
      else sweep(vector, radius, out);
      for (let i = 0; i < size; i++) if (Number.isNaN(heights.surface[i])) out[i] = 255;
    });
    postMessage(visibility, [visibility.buffer]);
  };
}
