// The relief that lifts a tilted painting: heights between their pixels, unknown ones taken from beside them.
import { texture } from "viewer/gl";

const CELL = 3; // pixels of the canvas that a square of the mesh takes, at least
const MOST_CELLS = 160; // along a side of a tile

export class Relief {
  /** heights: {surface (NaN: unknown), rows, columns, pitch}; pitch: of a pixel of the map, in the same unit. */
  constructor(gl, { surface, rows, columns, pitch: own }, pitch) {
    this.rows = rows;
    this.columns = columns;
    this.scale = pitch / own;
    this.surface = filled(surface, columns);
    this.heights = [0, 0]; // lowest and highest
    for (const value of this.surface) {
      if (value < this.heights[0]) this.heights[0] = value;
      else if (value > this.heights[1]) this.heights[1] = value;
    }
    this.texture = texture(gl, gl.TEXTURE_2D, gl.NEAREST);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.R32F, columns, rows, 0, gl.RED, gl.FLOAT, this.surface);
  }

  /** Height at a place on the map; NaN beside it. */
  heightAt(column, row) {
    const { rows, columns, scale, surface } = this;
    const [x, y] = [column * scale - 0.5, row * scale - 0.5];
    if (!(x >= -0.5 && y >= -0.5 && x < columns && y < rows)) return NaN;
    const within = (value, most) => Math.min(Math.max(value, 0), most);
    const [left, top] = [within(Math.floor(x), columns - 1), within(Math.floor(y), rows - 1)];
    const [right, below] = [within(left + 1, columns - 1), within(top + 1, rows - 1)], [s, t] = [within(x - left, 1), within(y - top, 1)];
    const along = (r) => (1 - s) * surface[r * columns + left] + s * surface[r * columns + right];
    return (1 - t) * along(top) + t * along(below);
  }

  /** Squares along a side of this many pixels of the map, of which `scale` of the canvas show one. */
  cells(length, scale) {
    return Math.max(1, Math.min(MOST_CELLS, Math.ceil(length * this.scale), Math.ceil((length * scale) / CELL)));
  }
}

/** Unknown heights as the last known one of their row, or that of the row above. */
function filled(surface, columns) {
  const out = Float32Array.from(surface);
  for (let i = 0, before = 0; i < out.length; i++) {
    if (i % columns === 0 && i) before = out[i - columns];
    if (Number.isNaN(out[i])) out[i] = before;
    before = out[i];
  }
  return out;
}
