// The worker that casts shadows: heights of a relief are decoded, and the sweep and the march of
// nishiki.render.plane.shade and horizon computed, beside the page.

/** The worker's whole program: nothing from outside is in reach. */
export function work() {
  const NOWHERE = -1e30;
  const MOST = 255; // byte of a code that needs two
  const SQUARES = [7, 4]; // powers of two: sides of the squares that a march passes over where they are too low
  let heights;

  /** Promise of {surface (NaN: unknown), rows, columns, pitch, pieces, count, highest, squares} of a block. */
  async function open(data, described) {
    const { rows, columns, pitch, low, step, nothing } = described;
    const codes = await decoded(data, described), surface = new Float32Array(codes.length);
    for (let i = 0; i < codes.length; i++) surface[i] = codes[i] === nothing ? NaN : low + codes[i] * step;
    return { surface, rows, columns, pitch, ...separatePieces(surface, rows, columns), ...highestOf(surface, rows, columns) };
  }

  /** Promise of the streams of a block: before each its length in bytes, four of them, the lowest first. */
  function streamsOf(data) {
    const view = new DataView(data.buffer, data.byteOffset, data.byteLength), parts = [];
    for (let at = 0; at < data.length; at += 4 + view.getUint32(at, true)) {
      const stream = new Blob([data.subarray(at + 4, at + 4 + view.getUint32(at, true))]).stream();
      parts.push(new Response(stream.pipeThrough(new DecompressionStream("deflate"))).arrayBuffer());
    }
    return Promise.all(parts).then((all) => all.map((part) => new Uint8Array(part)));
  }

  /** Promise of the codes (Int16Array) of a block: nishiki.report.viewer.pyramid says how they are written. */
  async function decoded(data, { rows, columns, weights: [w0, w1, w2, w3, w4], thresholds }) {
    const streams = await streamsOf(data), escaped = streams.pop(), places = new Int32Array(streams.length);
    const streamAt = Uint8Array.from({ length: 6 * MOST + 1 }, (_, activity) => thresholds.filter((each) => each < activity).length);
    const codes = new Int16Array(rows * columns);
    let above = new Uint8Array(columns + 2), here = new Uint8Array(columns + 2), escapes = 0;
    for (let row = 0, i = 0; row < rows; row++) {
      for (let column = 0; column < columns; column++, i++) {
        const stream = streamAt[2 * (here[column] + above[column + 1]) + above[column] + above[column + 2]];
        let z = streams[stream][places[stream]++];
        here[column + 1] = z;
        if (z === MOST) z = escaped[escapes] | (escaped[escaped.length / 2 + escapes++] << 8);
        let predicted = column ? codes[i - 1] : row ? codes[i - columns] : 0;
        if (row > 1 && column > 1 && column < columns - 1) {
          const west = predicted, north = i - columns;
          predicted += (w0 * (codes[north] - west) + w1 * (codes[north - 1] - west) + w2 * (codes[north + 1] - west) +
            w3 * (codes[i - 2] - west) + w4 * (codes[north - columns] - west) + 128) >> 8;
        }
        codes[i] = predicted + (z & 1 ? -(z + 1) / 2 : z / 2);
      }
      [above, here] = [here, above];
    }
    return codes;
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

  /** Highest known height of all, and of the squares of every size with the pixels around them. */
  function highestOf(surface, rows, columns) {
    const squares = SQUARES.map((bits) => {
      const across = ((columns - 1) >> bits) + 1, tops = new Float32Array(across * (((rows - 1) >> bits) + 1)).fill(NOWHERE);
      for (let row = 0; row < rows; row++) {
        const firstRow = Math.max(row - 1, 0) >> bits, lastRow = Math.min(row + 1, rows - 1) >> bits;
        for (let column = 0; column < columns; column++) {
          const height = surface[row * columns + column];
          const first = Math.max(column - 1, 0) >> bits, last = Math.min(column + 1, columns - 1) >> bits;
          for (let r = firstRow; r <= lastRow; r++) {
            for (let c = first; c <= last; c++) if (height > tops[r * across + c]) tops[r * across + c] = height;
          }
        }
      }
      return { bits, across, tops };
    });
    return { squares, highest: squares[0].tops.reduce((most, top) => Math.max(most, top), NOWHERE) };
  }

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

  /** Visibilities of a near lamp in a window [left, top, right, bottom], row by row. */
  function march([x, y, z], radius, [left, top, right, bottom], out) {
    const { surface, pieces, rows, columns, pitch, squares } = heights, highest = heights.highest / pitch;
    const lampColumn = x / pitch + (columns - 1) / 2, lampRow = -y / pitch + (rows - 1) / 2, lampZ = z / pitch;
    for (let row = top, place = 0; row < bottom; row++) {
      for (let column = left, i = row * columns + left; column < right; column++, i++, place++) {
        const start = surface[i] / pitch, dc = lampColumn - column, dr = lampRow - row;
        const horizontal = Math.hypot(dc, dr), rise = lampZ - start;
        if (Number.isNaN(start) || horizontal <= 1e-12 * Math.abs(rise)) continue;
        const elevation = Math.atan2(rise, horizontal);
        const lowest = Math.tan(Math.max(elevation - radius, -1.5));
        const enough = elevation + radius < 1.5 ? Math.tan(elevation + radius) : Infinity; // hides all of the lamp
        const byColumn = Math.abs(dc) >= Math.abs(dr), length = horizontal / Math.max(Math.abs(dc), Math.abs(dr));
        const stepColumn = (dc / horizontal) * length, stepRow = (dr / horizontal) * length;
        let tangent = NOWHERE, beyond = 0;
        for (let k = 1; tangent <= enough; k++) {
          const distance = k * length, needed = distance * Math.max(tangent, lowest);
          const c = column + k * stepColumn, r = row + k * stepRow;
          if (distance > horizontal || highest - start <= needed) break;
          if (c < -1e-9 || c > columns - 1 + 1e-9 || r < -1e-9 || r > rows - 1 + 1e-9) break;
          let r0 = Math.floor(r + 1e-9), c0 = Math.floor(c + 1e-9), share, other;
          if (byColumn) c0 = Math.round(c);
          else r0 = Math.round(r);
          if (k >= beyond) {
            // a square that is too low is passed over; none later in it can be higher above the line of sight
            let steps;
            for (const { bits, across, tops } of squares) {
              steps = Math.min(stepsWithin(c0, c, stepColumn, bits), stepsWithin(r0, r, stepRow, bits));
              if (Math.max(tops[(r0 >> bits) * across + (c0 >> bits)] / pitch - start, 0) <= needed) {
                beyond = k + steps;
                break;
              }
              if (bits === SQUARES.at(-1)) beyond = -(k + steps);
            }
            if (beyond > 0) {
              k = beyond - 1;
              continue;
            }
            beyond = -beyond;
          }
          if (byColumn) {
            share = Math.max(0, r - r0);
            other = surface[Math.min(r0 + 1, rows - 1) * columns + c0];
          } else {
            share = Math.max(0, c - c0);
            other = surface[r0 * columns + Math.min(c0 + 1, columns - 1)];
          }
          const at = surface[r0 * columns + c0];
          const value = ((share < 1e-8 ? at : (1 - share) * at + share * other) / pitch - start) / distance;
          if (value > tangent && (!pieces || pieces[r0 * columns + c0] === pieces[i])) tangent = value;
        }
        out[place] = Math.round(255 * discShare(elevation, Math.atan(tangent), radius));
      }
    }
  }

  /** Steps until a coordinate leaves the square of the pixel `whole`. */
  function stepsWithin(whole, place, step, bits) {
    const first = (whole >> bits) << bits;
    if (step > 0) return Math.max(Math.ceil((first + (1 << bits) - place) / step), 1);
    return step < 0 ? Math.max(Math.ceil((place - first) / -step), 1) : Infinity;
  }

  /** Visibilities of lamps in a window, or everywhere where it is null: one after the other, row by row. */
  function visibilities(lamps, window) {
    const { surface, rows, columns } = heights;
    const [left, top, right, bottom] = window ?? [0, 0, columns, rows], wide = right - left, size = wide * (bottom - top);
    const visibility = new Uint8Array(size * lamps.length).fill(255);
    lamps.forEach(({ vector, w, radius }, k) => {
      const out = visibility.subarray(k * size, (k + 1) * size);
      if (w) march(vector, radius, [left, top, right, bottom], out);
      else if (!window) sweep(vector, radius, out);
      else {
        const all = new Uint8Array(rows * columns).fill(255);
        sweep(vector, radius, all);
        for (let row = top; row < bottom; row++) out.set(all.subarray(row * columns + left, row * columns + right), (row - top) * wide);
      }
      for (let i = 0; i < size; i++) if (Number.isNaN(surface[(top + Math.floor(i / wide)) * columns + left + (i % wide)])) out[i] = 255;
    });
    return visibility;
  }

  onmessage = async ({ data }) => {
    if (data.block) {
      try {
        heights = await open(data.block, data.described);
        postMessage({ surface: data.wanted ? heights.surface : null });
      } catch (error) { // of an async function none reaches onerror
        postMessage({ error: error.message });
      }
    } else {
      const visibility = visibilities(data.lamps, data.window);
      postMessage(visibility, { transfer: [visibility.buffer] });
    }
  };
}
