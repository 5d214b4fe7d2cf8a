// Coefficients of a coded tile: the range coder and contexts of nishiki.codec.range_coder and nishiki.codec.entropy,
// decoding only, integer for integer.

const INPUTS = 8, LIMIT = 250, UNARY = 18;
const TABLE_SIZES = [36 * 8, 720, 36, 128, 240, 144, 108, 720, 128, 24 * 8, 720 * 3, 25 * 6 * 3];
const OFFSETS = TABLE_SIZES.map((_, n) => TABLE_SIZES.slice(0, n).reduce((a, b) => a + b, 0));

export const STRETCH = Int32Array.from({ length: 4096 }, (_, n) => {
  const p = (n + 0.5) / 4096;
  return Math.round(Math.log(p / (1 - p)) * 256);
});
export const SQUASH = Int32Array.from({ length: 6143 }, (_, n) => {
  return Math.min(Math.max(Math.round(65536 / (1 + Math.exp(-(n - 3071) / 256))), 4), 65532);
});
export const RATE = Int32Array.from({ length: LIMIT + 1 }, (_, n) => Math.round(65536 / (n + 1.6)));

/** Bands of a plane, coarse to fine: first row and column, rows, columns, level (1 finest), orientation, parent. */
export function bandsOf(rows, columns, levels) {
  const bands = [[0, 0, rows >> levels, columns >> levels, levels + 1, 0, -1]];
  for (let level = levels; level > 0; level--) {
    const h = rows >> level, w = columns >> level;
    [[0, w], [h, 0], [h, w]].forEach(([row, column], n) => {
      bands.push([row, column, h, w, level, n + 1, level < levels ? bands.length - 3 : -1]);
    });
  }
  return bands;
}

/** Coefficients that are not zero, plane by plane (channel, then frequency): `starts[n]` to `starts[n + 1]` of
 * `places` (in the plane, row by row) and `values`.
 * @param {any} data @param {number[]} shape channels, frequencies, rows, columns @param {any} levels @param {any} model */
export function decodeBlock(data, [channels, frequencies, rows, columns], levels, model) {
  return new BlockDecoder(data, channels, frequencies, rows, columns, levels, model).decode();
}

const grade = (value) => (value < 3 ? value : value < 5 ? 3 : value < 9 ? 4 : 5);

function fineGrade(value) {
  if (value < 4) return value;
  let octave = 0;
  while (value >> octave >= 8) octave++;
  return Math.min(4 * octave + (value >> octave), 23);
}

function placeClass(k, c, level, orientation) {
  const f = k < 4 ? k : k < 6 ? 4 : k < 9 ? 5 : k < 13 ? 6 : k < 20 ? 7 : k < 36 ? 8 : 9;
  const turn = orientation === 0 ? 0 : orientation < 3 ? 1 : 2;
  return ((f * 3 + Math.min(c, 2)) * 8 + Math.min(level, 7)) * 3 + turn;
}

class BlockDecoder {
  constructor(data, channels, frequencies, rows, columns, levels, model) {
    this.data = data;
    this.channels = channels;
    this.frequencies = frequencies;
    this.rows = rows;
    this.columns = columns;
    this.bands = bandsOf(rows, columns, levels);
    this.chance = Int32Array.from(model.chance);
    this.seen = Uint8Array.from(model.seen);
    this.weights = Int32Array.from(model.weights);
    this.size = rows * columns;
    this.magnitude = new Int32Array(channels * frequencies * this.size);
    this.negative = new Uint8Array(this.magnitude.length);
    this.filled = new Uint8Array(this.bands.length * frequencies * channels);
    this.contexts = new Int32Array(INPUTS);
    this.low = 0;
    this.high = 0xffffffff;
    this.word = 0;
    this.place = 0;
    while (this.place < 4) this.readByte();
  }

  readByte() {
    const byte = this.place < this.data.length ? this.data[this.place] : 0;
    this.word = ((this.word << 8) | byte) >>> 0;
    this.place++;
  }

  bit(chanceOfOne) {
    const span = this.high - this.low;
    const middle = this.low + (span >>> 16) * chanceOfOne + (((span & 0xffff) * chanceOfOne) >>> 16);
    const bit = this.word <= middle ? 1 : 0;
    if (bit) this.high = middle;
    else this.low = middle + 1;
    while (((this.low ^ this.high) & 0xff000000) === 0) {
      this.readByte();
      this.low = (this.low << 8) >>> 0;
      this.high = ((this.high << 8) | 255) >>> 0;
    }
    return bit;
  }

  mixedBit(count, group) {
    const { chance, seen, weights, contexts } = this;
    const first = group * INPUTS;
    let total = weights[first + INPUTS - 1] * 256;
    for (let k = 0; k < count; k++) total += weights[first + k] * STRETCH[chance[contexts[k]] >> 10];
    total = Math.min(Math.max(Math.floor((total + 32768) / 65536), -3071), 3071);
    const chanceOfOne = SQUASH[total + 3071];
    const bit = this.bit(chanceOfOne);
    const error = ((bit << 16) - chanceOfOne) * 6;
    for (let k = 0; k < count; k++) {
      const place = contexts[k];
      weights[first + k] += (STRETCH[chance[place] >> 10] * error + (1 << 19)) >> 20;
      chance[place] += Math.floor((((bit << 22) - bit - chance[place]) * RATE[seen[place]]) / 65536);
      if (seen[place] < LIMIT) seen[place]++;
    }
    weights[first + INPUTS - 1] += (256 * error + (1 << 19)) >> 20;
    return bit;
  }

  decode() {
    for (let b = 0; b < this.bands.length; b++) {
      for (let k = 0; k < this.frequencies; k++) {
        for (let c = 0; c < this.channels; c++) {
          const some = this.flag(b, k, c);
          this.filled[this.at(b, k, c)] = some;
          if (some) this.plane(b, k, c);
        }
      }
    }
    return this.sparse();
  }

  at(b, k, c) {
    return (b * this.frequencies + k) * this.channels + c;
  }

  flag(b, k, c) {
    const { filled, contexts } = this;
    const [, , , , level, orientation, parent] = this.bands[b];
    const before = k > 0 ? filled[this.at(b, k - 1, c)] : 2;
    const earlier = k > 1 ? filled[this.at(b, k - 2, c)] : 1;
    const above = parent >= 0 ? filled[this.at(parent, k, c)] : 2;
    const beside = c > 0 ? filled[this.at(b, k, c - 1)] : 2;
    const turned = orientation > 1 ? filled[this.at(b - 1, k, c)] : 2;
    contexts[0] = OFFSETS[0] + ((before * 3 + above) * 4 + beside) * 8 + Math.min(level, 7);
    contexts[1] = OFFSETS[1] + placeClass(k, c, level, orientation);
    contexts[2] = OFFSETS[2] + ((turned * 3 + before) * 2 + earlier) * 2 + Math.min(c, 1);
    return this.mixedBit(3, 0);
  }

  /** Twice the magnitude at (i, j) of a band of the plane that begins at `start`, plus its four neighbours in the band. */
  around(start, band, i, j) {
    const { magnitude, columns } = this;
    const at = start + (band[0] + i) * columns + band[1] + j;
    let total = 2 * magnitude[at];
    if (i > 0) total += magnitude[at - columns];
    if (i + 1 < band[2]) total += magnitude[at + columns];
    if (j > 0) total += magnitude[at - 1];
    if (j + 1 < band[3]) total += magnitude[at + 1];
    return total;
  }

  plane(b, k, c) {
    const { magnitude, negative, filled, contexts, bands, columns, size, frequencies } = this;
    const band = bands[b];
    const [r, q, height, width, level, orientation, parent] = band;
    const start = (c * frequencies + k) * size;
    const place = placeClass(k, c, level, orientation);
    const hasParent = parent >= 0 && filled[this.at(parent, k, c)] === 1;
    const hasBefore = k > 0 && filled[this.at(b, k - 1, c)] === 1;
    const hasEarlier = k > 1 && filled[this.at(b, k - 2, c)] === 1;
    const hasFirst = c > 0 && filled[this.at(b, k, 0)] === 1;
    const hasSecond = c > 1 && filled[this.at(b, k, c - 1)] === 1;
    const hasTurned = orientation > 1 &&
      (filled[this.at(b - 1, k, c)] === 1 || (orientation === 3 && filled[this.at(b - 2, k, c)] === 1));
    const grain = Math.min(level, 7);
    const turn = orientation === 0 ? 0 : orientation < 3 ? 1 : 2;
    for (let i = 0; i < height; i++) {
      for (let j = 0; j < width; j++) {
        const at = start + (r + i) * columns + q + j;
        const w = j > 0 ? magnitude[at - 1] : 0;
        const n = i > 0 ? magnitude[at - columns] : 0;
        const nw = i > 0 && j > 0 ? magnitude[at - columns - 1] : 0;
        const ne = i > 0 && j + 1 < width ? magnitude[at - columns + 1] : 0;
        const far = (j > 1 ? magnitude[at - 2] : 0) + (i > 1 ? magnitude[at - 2 * columns] : 0);
        const above = hasParent ? this.around(start, bands[parent], i >> 1, j >> 1) : 0;
        const before = hasBefore ? this.around(start - size, band, i, j) : 0;
        const earlier = hasEarlier ? this.around(start - 2 * size, band, i, j) : 0;
        let beside = hasFirst ? this.around(k * size, band, i, j) : 0;
        if (hasSecond) beside += this.around(start - frequencies * size, band, i, j);
        let turned = 0;
        if (hasTurned) {
          turned = this.around(start, bands[b - 1], i, j);
          if (orientation === 3) turned += this.around(start, bands[b - 2], i, j);
        }
        const near = w + n, diagonal = nw + ne;
        const total = 6 * near + 3 * diagonal + 2 * far + 2 * above + 3 * before + earlier + 2 * beside + 2 * turned;
        const amount = fineGrade(total), close = Math.min(near, 2), fine = grain < 2 ? 1 : 0;
        contexts[0] = OFFSETS[3] +
          ((Math.min(w, 3) * 4 + Math.min(n, 3)) * 4 + Math.min(diagonal, 3)) * 2 + Math.min(far, 1);
        contexts[1] = OFFSETS[4] + ((grade(above) * 6 + grade(turned)) * 3 + close) * 2 + fine;
        contexts[2] = OFFSETS[5] + ((grade(before) * 4 + Math.min(earlier, 3)) * 3 + close) * 2 + (k < 4 ? 1 : 0);
        contexts[3] = OFFSETS[6] + ((grade(beside) * 3 + close) * 3 + Math.min(c, 2)) * 2 + fine;
        contexts[4] = OFFSETS[7] + place;
        contexts[5] = OFFSETS[8] + amount * 5 + Math.min(grain - 1, 4);
        if (this.mixedBit(6, (1 + (total > 0 ? 1 : 0)) * 24 + grain * 3 + turn) === 0) continue;
        negative[at] = this.bit(32768);
        let value = 1;
        while (value < UNARY) {
          const step = Math.min(value - 1, 7), few = Math.min(step, 2);
          contexts[0] = OFFSETS[9] + amount * 8 + step;
          contexts[1] = OFFSETS[10] + place * 3 + few;
          contexts[2] = OFFSETS[11] + ((Math.min(w, 4) * 5 + Math.min(n, 4)) * 6 + grade(before)) * 3 + few;
          if (this.mixedBit(3, 1 + few * 3 + turn) === 0) break;
          value++;
        }
        magnitude[at] = value === UNARY ? this.rest() : value;
      }
    }
  }

  /** Magnitudes from UNARY on: Elias' gamma code of what is above. */
  rest() {
    let length = 0;
    while (length < 31 && this.bit(32768)) length++;
    let value = 1;
    for (let k = 0; k < length; k++) value = 2 * value + this.bit(32768);
    return value + UNARY - 1;
  }

  sparse() {
    const { magnitude, negative, size } = this;
    const planes = this.channels * this.frequencies;
    const starts = new Uint32Array(planes + 1);
    let count = 0;
    for (let n = 0; n < planes; n++) {
      for (let i = n * size; i < (n + 1) * size; i++) if (magnitude[i]) count++;
      starts[n + 1] = count;
    }
    const places = new Uint16Array(count), values = new Int32Array(count);
    for (let i = 0, at = 0; at < count; i++) {
      if (!magnitude[i]) continue;
      places[at] = i % size;
      values[at++] = negative[i] ? -magnitude[i] : magnitude[i];
    }
    return { starts, places, values };
  }
}
