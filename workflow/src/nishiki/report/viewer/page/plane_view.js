// Where a painting lies on the canvas: seen from the front or tilted, in parallel projection, its relief lifted.
//
// A tilt by t towards the direction d in the plane turns the line of sight from z to (d sin t, cos t), about the axis
// across d. A point p of the plane then moves to p + (cos t - 1) (p.d) d, and a height h lifts it by -h sin t d.

export const MOST_TILT = 75; // degrees
const RAY_STEPS = 256, HALVINGS = 20; // down a line of sight to the relief

export class PlaneView {
  /** size: {rows, columns, pitch} of the map; screen: {width, height} of the canvas; scale: its pixels to one of the map
   * across the tilt; view: of the state; heights: lowest and highest of the relief, in the unit of the pitch. */
  constructor({ rows, columns, pitch }, { width, height }, scale, view, heights = [0, 0]) {
    const tilt = (view.tilt_deg * Math.PI) / 180, azimuth = (view.azimuth_deg * Math.PI) / 180;
    const [dx, dy] = [Math.cos(azimuth), Math.sin(azimuth)], shrink = Math.cos(tilt) - 1;
    this.rows = rows;
    this.columns = columns;
    this.pitch = pitch;
    this.width = width;
    this.height = height;
    this.scale = scale;
    this.heights = heights;
    this.tilted = tilt > 0;
    this.toward = [Math.sin(tilt) * dx, Math.sin(tilt) * dy, Math.cos(tilt)];
    // rows of the map and of the canvas grow downwards
    this.matrix = [[1 + shrink * dx * dx, -shrink * dx * dy], [-shrink * dx * dy, 1 + shrink * dy * dy]].map((row) => row.map((v) => v * scale));
    this.lift = [(-this.toward[0] * scale) / pitch, (this.toward[1] * scale) / pitch];
    const [[a, b], [c, d]] = this.matrix, middle = [columns / 2 + view.x / pitch, rows / 2 - view.y / pitch];
    this.offset = [width / 2 - a * middle[0] - b * middle[1], height / 2 - c * middle[0] - d * middle[1]];
    if (!this.tilted) this.offset = this.offset.map(Math.round); // so that 1:1 resamples nothing
  }

  /** Pixel of the canvas of a place on the map at this height. */
  toCanvas(column, row, height = 0) {
    const [[a, b], [c, d]] = this.matrix, [x, y] = this.offset, [u, v] = this.lift;
    return [a * column + b * row + x + u * height, c * column + d * row + y + v * height];
  }

  /** Place on the map, [column, row], that a pixel of the canvas shows at this height. */
  toMap(x, y, height = 0) {
    const [[a, b], [c, d]] = this.matrix, [u, v] = this.lift, determinant = a * d - b * c;
    const [right, down] = [x - this.offset[0] - u * height, y - this.offset[1] - v * height];
    return [(d * right - b * down) / determinant, (a * down - c * right) / determinant];
  }

  /** Place on the map of the point of the relief that a pixel of the canvas shows; heightAt(column, row) or NaN. */
  toRelief(x, y, heightAt) {
    const [low, high] = this.heights;
    if (!this.tilted || low === high) return this.toMap(x, y);
    const below = (height) => heightAt(...this.toMap(x, y, height)) >= height, step = (high - low) / RAY_STEPS;
    let height = high;
    while (height > low && !below(height)) height -= step;
    let above = height + step;
    for (let k = 0; k < HALVINGS; k++) {
      const middle = (height + above) / 2;
      if (below(middle)) height = middle;
      else above = middle;
    }
    return this.toMap(x, y, height);
  }

  /** First and last pixel of the map, [left, top, right, bottom], that an area of the canvas can show. */
  bounds({ x, y, width, height }) {
    const places = [[x, y], [x + width - 1, y], [x, y + height - 1], [x + width - 1, y + height - 1]].flatMap((at) => this.heights.map((h) => this.toMap(...at, h)));
    const of = (choose, k) => choose(...places.map((place) => place[k]));
    return [of(Math.min, 0), of(Math.min, 1), of(Math.max, 0), of(Math.max, 1)];
  }

  /** Uniforms of the vertex shader, for maps averaged by `factor`. */
  uniforms(factor) {
    const [[a, b], [c, d]] = this.matrix, [x, y] = this.offset, [across, down] = [2 / this.width, -2 / this.height];
    const { rows, columns, pitch, toward } = this;
    const reach = (Math.hypot(rows, columns) * pitch) / 2 + Math.max(...this.heights.map(Math.abs));
    const deep = [-toward[0] * pitch * factor, toward[1] * pitch * factor, -toward[2], ((toward[0] * columns - toward[1] * rows) * pitch) / 2];
    return {
      toClip: [across * a * factor, down * c * factor, across * b * factor, down * d * factor, across * x - 1, down * y + 1],
      lift: [across * this.lift[0], down * this.lift[1]],
      depth: deep.map((value) => value / reach),
    };
  }
}
