// Synthesis of planes of coefficients: nishiki.codec.transform, by the sparse matrices that the page's data hold.

/** Synthesis of one family: `lengths[n] = {index, weight, width}` is one level of n samples (rows of `width` terms),
 * `norms[n] = [{low, high}, ...]` the lengths of an axis' basis vectors, level by level, finest first. */
export class PlaneSynthesis {
  constructor(lengths, norms, levels) {
    this.lengths = lengths;
    this.norms = norms;
    this.levels = levels;
    this.gains = new Map();
  }

  levelsOf(rows, columns) {
    let levels = 0;
    while (levels < this.levels && (rows >> levels) % 2 === 0 && (columns >> levels) % 2 === 0 &&
      rows >> levels > 1 && columns >> levels > 1) levels++;
    return levels;
  }

  /** One over the length of every basis plane, row by row. */
  inverseGains(rows, columns) {
    const key = `${rows}x${columns}`;
    if (!this.gains.has(key)) {
      const levels = this.levelsOf(rows, columns);
      const [down, across] = [this.axisNorms(rows, levels), this.axisNorms(columns, levels)];
      const gains = new Float32Array(rows * columns).fill(1);
      for (let level = levels - 1; level >= 0; level--) {
        const h = rows >> (level + 1), w = columns >> (level + 1);
        for (let i = 0; i < 2 * h; i++) {
          for (let j = 0; j < 2 * w; j++) {
            if (i < h && j < w && level < levels - 1) continue;
            const vertical = i < h ? down[level].low[i] : down[level].high[i - h];
            const horizontal = j < w ? across[level].low[j] : across[level].high[j - w];
            gains[i * columns + j] = 1 / (vertical * horizontal);
          }
        }
      }
      this.gains.set(key, gains);
    }
    return this.gains.get(key);
  }

  axisNorms(length, levels) {
    return this.norms[length].slice(0, levels);
  }

  /** Samples of a plane of coefficients (already divided by their gains), in place. */
  inverse(plane, rows, columns) {
    const scratch = new Float32Array(rows * columns);
    for (let level = this.levelsOf(rows, columns) - 1; level >= 0; level--) {
      const h = rows >> level, w = columns >> level;
      const down = this.lengths[h], across = this.lengths[w];
      for (let i = 0; i < h; i++) {
        const out = i * w;
        scratch.fill(0, out, out + w);
        for (let k = 0; k < down.width; k++) {
          const factor = down.weight[i * down.width + k];
          if (factor === 0) continue;
          const from = down.index[i * down.width + k] * columns;
          for (let j = 0; j < w; j++) scratch[out + j] += factor * plane[from + j];
        }
      }
      for (let j = 0; j < w; j++) {
        for (let i = 0; i < h; i++) {
          let total = 0;
          for (let k = j * across.width; k < (j + 1) * across.width; k++) {
            total += across.weight[k] * scratch[i * w + across.index[k]];
          }
          plane[i * columns + j] = total;
        }
      }
    }
  }
}
