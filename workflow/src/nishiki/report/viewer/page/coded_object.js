// The coded object: its mesh and charts, and the maps of parameters and residual that its streams decode to
// (nishiki.codec.store, read tile by tile).

import { decodeBlock } from "viewer/codec";
import { PlaneSynthesis } from "viewer/wavelet";

const WIDTH_FLOOR = 1e-3, WIDTH_CEILING = 1e3;
const MOST_STEPS = 100; // of a smoothing
const IDENTITY = (count) => Array.from({ length: count }, (_, i) => Array.from({ length: count }, (_, j) => +(i === j)));

export class CodedObject {
  /** design: of the coding; arrays: its index, start states and transforms. */
  constructor(design, arrays) {
    const values = (name) => arrays[name]?.values;
    this.design = design;
    this.size = this.design.tile_size;
    this.channels = this.design.channels;
    this.tiles = arrays.lengths.shape[0];
    this.streams = arrays.lengths.shape[1];
    this.lengths = values("lengths");
    this.extents = Array.from({ length: this.tiles }, (_, tile) => {
      const [start, length, row, column, rows, columns] = values("extents").subarray(6 * tile, 6 * tile + 6);
      return { start, length, row, column, rows, columns };
    });
    this.models = ["parameters", "residual"].map((name) => ({
      chance: values(`${name}/chance`), seen: values(`${name}/seen`), weights: values(`${name}/weights`),
    }));
    this.plane = synthesisOf("plane", arrays, this.design.levels);
    this.parameterPlane = synthesisOf("parameter_plane", arrays, this.design.parameter_levels);
    this.alongLights = values("along/lights");
    this.alongViews = (length) => values(`along/views/${length}`);
    this.coefficients = new Array(this.tiles); // of the residual
  }

  /** The streams `first` .. `stop - 1` of one tile among the bytes of a part that begins with tile `start`. */
  streamsOf(tile, start, data, kind) {
    const [low, high] = kind === "parameters" ? [0, 1] : [1, this.streams];
    let at = 0;
    for (let t = start; t < tile; t++) for (let n = low; n < high; n++) at += this.lengths[t * this.streams + n];
    return Array.from({ length: high - low }, (_, n) => {
      const length = this.lengths[tile * this.streams + low + n];
      at += length;
      return data.subarray(at - length, at);
    });
  }

  /** Parameters of a tile: diffuse (kd, sigma) and specular (ks, 0), four numbers a texel, where they are coded. */
  parameters(tile, stream) {
    const { design, size, channels } = this, extent = this.extents[tile];
    const diffuse = new Float32Array(4 * size * size), specular = new Float32Array(4 * size * size);
    for (let n = 3; n < diffuse.length; n += 4) diffuse[n] = 1;
    if (!design.model || !extent.length) return { diffuse, specular };
    const { rows, columns } = extent, area = rows * columns;
    const shape = [channels, 3, rows, columns];
    const levels = this.parameterPlane.levelsOf(rows, columns);
    const coded = stream.length ? decodeBlock(stream, shape, levels, this.models[0]) : null;
    for (let group = 0; group < 3; group++) {
      const count = group === 2 ? 1 : channels;
      const planes = [];
      for (let c = 0; c < count; c++) {
        const plane = new Float32Array(area);
        if (coded) {
          addPlane(plane, coded, c * 3 + group, design.parameter_steps[group]);
          this.synthesise(this.parameterPlane, plane, rows, columns);
        }
        planes.push(plane);
      }
      const mix = group === 2 || !design.parameter_colour.length ? IDENTITY(count) : design.parameter_colour[group];
      const means = design.parameter_means.length ? design.parameter_means[group] : new Array(count).fill(0);
      for (let c = 0; c < (group === 2 ? 1 : 3); c++) {
        const own = this.channelOf(mix, count, c);
        const mean = count === 1 ? means[0] : channels === 3 ? means[c] : means.reduce((a, b) => a + b, 0) / count;
        for (let i = 0; i < area; i++) {
          let value = mean;
          for (let d = 0; d < count; d++) value += own[d] * planes[d][i];
          const at = 4 * ((extent.row + Math.floor(i / columns)) * size + extent.column + (i % columns));
          if (group === 0) diffuse[at + c] = Math.max(value, 0);
          if (group === 1) specular[at + c] = Math.max(value, 0);
          if (group === 2) {
            diffuse[at + 3] = Math.exp(Math.min(Math.max(value, Math.log(WIDTH_FLOOR)), Math.log(WIDTH_CEILING)));
          }
        }
      }
    }
    return { diffuse, specular };
  }

  /** What each decorrelated channel gives to the shown channel c: three channels as they are, others their mean. */
  channelOf(mix, count, c) {
    if (count === 3) return mix.map((row) => row[c]);
    return mix.map((row) => row.reduce((a, b) => a + b, 0) / count);
  }

  /** Decode the residual's coefficients of a tile and keep them. */
  decodeResidual(tile, streams) {
    const extent = this.extents[tile];
    const { rows, columns } = extent, levels = this.plane.levelsOf(rows, columns);
    const shape = [this.channels, this.design.lights * extent.length, rows, columns];
    const [data] = streams;
    this.coefficients[tile] = data.length && extent.length ? decodeBlock(data, shape, levels, this.models[1]) : null;
  }

  /** Place of a view in a tile's arc; -1 where the tile is coded for other views only. */
  placeOf(tile, view) {
    const { start, length } = this.extents[tile];
    const place = (view - start + this.design.views) % this.design.views;
    return place < length ? place : -1;
  }

  /** Residual of a tile in a view under a light, four numbers a texel; null where all of it is zero. */
  residual(tile, view, light) {
    const place = this.placeOf(tile, view), coded = this.coefficients[tile];
    if (place < 0 || !coded) return null;
    const { design, size, channels } = this, extent = this.extents[tile];
    const { rows, columns, length } = extent, area = rows * columns;
    const out = new Float32Array(4 * size * size);
    const planes = [];
    for (let c = 0; c < channels; c++) {
      const plane = new Float32Array(area);
      for (let k = 0; k < design.lights * length; k++) {
        const weight = this.alongLights[Math.floor(k / length) * design.lights + light] *
          this.alongViews(length)[(k % length) * length + place];
        if (weight !== 0) addPlane(plane, coded, c * design.lights * length + k, design.step * weight);
      }
      this.synthesise(this.plane, plane, rows, columns);
      planes.push(plane);
    }
    const mix = design.colour.length ? design.colour : IDENTITY(channels);
    for (let c = 0; c < 3; c++) {
      const own = this.channelOf(mix, channels, c);
      for (let i = 0; i < area; i++) {
        let value = 0;
        for (let d = 0; d < channels; d++) value += own[d] * planes[d][i];
        out[4 * ((extent.row + Math.floor(i / columns)) * size + extent.column + (i % columns)) + c] = value;
      }
    }
    return out;
  }

  synthesise(synthesis, plane, rows, columns) {
    const gains = synthesis.inverseGains(rows, columns);
    for (let i = 0; i < plane.length; i++) plane[i] *= gains[i];
    synthesis.inverse(plane, rows, columns);
  }
}

function addPlane(plane, { starts, places, values }, number, factor) {
  for (let n = starts[number]; n < starts[number + 1]; n++) plane[places[n]] += values[n] * factor;
}

function synthesisOf(name, arrays, levels) {
  const lengths = {}, norms = {};
  for (const [key, { values, shape }] of Object.entries(arrays)) {
    const [family, length, kind, level] = key.split("/");
    if (family !== name) continue;
    if (kind === "low" || kind === "high") {
      norms[length] ??= [];
      norms[length][level] = { ...norms[length][level], [kind]: values };
    } else {
      lengths[length] = { ...lengths[length], width: shape[1], [kind]: values };
    }
  }
  return new PlaneSynthesis(lengths, norms, levels);
}

/** Vertices, their normals, and the corners of the triangles on the charts, in the order in which they were coded. */
export function surfaceOf(manifest, arrays) {
  const grid = arrays.vertices.values, lowest = arrays.lowest.values;
  const vertices = new Float32Array(grid.length);
  for (let n = 0; n < grid.length; n++) vertices[n] = (grid[n] + lowest[n % 3]) * manifest.mesh_step;
  const vertexOf = arrays.point_vertex.values, corners = arrays.corners.values;
  const place = Float32Array.from(arrays.point_place.values, (v) => v / manifest.chart_steps);
  const normals = Float32Array.from(arrays.normals.values, (v) => v / manifest.normal_steps);
  return { vertices, normals, vertexOf, corners, place, chartOf: arrays.point_chart.values };
}

/** Normals of a mesh, the mean of those around: a step takes the mean over the corners of the triangles at each vertex, whose
 * variance along each axis is about a third of the squared length of an edge. */
export function smoothed(normals, vertices, triangles, deviation) {
  let squares = 0;
  triangles.forEach((a, n) => {
    const b = triangles[n % 3 === 2 ? n - 2 : n + 1];
    for (let k = 0; k < 3; k++) squares += (vertices[3 * a + k] - vertices[3 * b + k]) ** 2;
  });
  const steps = Math.min(Math.ceil((3 * deviation ** 2 * triangles.length) / squares), MOST_STEPS);
  let now = Float64Array.from(normals);
  for (let step = 0; step < steps; step++) {
    const next = new Float64Array(now.length);
    for (let n = 0; n < triangles.length; n += 3) {
      const corners = [3 * triangles[n], 3 * triangles[n + 1], 3 * triangles[n + 2]];
      for (let k = 0; k < 3; k++) {
        const sum = now[corners[0] + k] + now[corners[1] + k] + now[corners[2] + k];
        for (const corner of corners) next[corner + k] += sum;
      }
    }
    for (let at = 0; at < next.length; at += 3) {
      const length = Math.hypot(next[at], next[at + 1], next[at + 2]);
      for (let k = 0; k < 3; k++) next[at + k] = length > 0 ? next[at + k] / length : now[at + k];
    }
    now = next;
  }
  return Float32Array.from(now);
}

/** (triangle, tile, row and column of the tile's cell) of every triangle near every tile, four numbers each. */
export function trianglesOfTiles(surface, arrays, size) {
  const { corners, place, chartOf } = surface;
  const grid = arrays.chart_grid.values, cells = arrays.cells.values, stride = size - 1;
  const range = (a, b, c, count) => {
    const first = Math.min(Math.max(Math.floor((Math.min(a, b, c) - 1) / stride), 0), count - 1);
    return [first, Math.min(Math.max(Math.floor((Math.max(a, b, c) + 1) / stride), first), count - 1)];
  };
  const out = [];
  for (let f = 0; f < corners.length / 3; f++) {
    const points = [0, 1, 2].map((k) => corners[3 * f + k]), chart = chartOf[points[0]];
    if (chart < 0) continue;
    const [first, rows, columns] = grid.subarray(3 * chart, 3 * chart + 3);
    const [top, bottom] = range(...points.map((p) => place[2 * p]), rows);
    const [left, right] = range(...points.map((p) => place[2 * p + 1]), columns);
    for (let down = top; down <= bottom; down++) {
      for (let across = left; across <= right; across++) {
        const tile = cells[first + down * columns + across];
        if (tile >= 0) out.push(f, tile, down, across);
      }
    }
  }
  return Int32Array.from(out);
}
