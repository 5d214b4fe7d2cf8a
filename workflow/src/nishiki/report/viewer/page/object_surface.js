// The mesh of an object on the graphics processor, its charts, and the lines that show where the cameras stand.
import { centreOf } from "viewer/cameras";
import { smoothed, surfaceOf } from "viewer/coded_object";
import { attribute, image, integers } from "viewer/gl";
import { add, apply, transpose } from "viewer/matrices";

const FORM = 0.06; // standard deviation, in radii of the object, of the smoothing that leaves the form without its relief

export class ObjectSurface {
  constructor(gl, manifest, arrays) {
    this.gl = gl;
    this.manifest = manifest;
    this.surface = surfaceOf(manifest, arrays);
    this.empty = gl.createVertexArray();
    const { normals, corners, chartOf } = this.surface;
    this.corners = this.#cornersWith(normals);
    this.charts = integers(gl, "R32I", Int32Array.from(corners.filter((_, n) => n % 3 === 0), (point) => chartOf[point]), 1);
    const grid = arrays.chart_grid.values, padded = new Int32Array((grid.length / 3) * 4);
    for (let n = 0; n < grid.length / 3; n++) padded.set(grid.subarray(3 * n, 3 * n + 3), 4 * n);
    this.grids = integers(gl, "RGBA32I", padded, 4);
    this.cells = integers(gl, "R32I", arrays.cells.values, 1);
    const lines = cameraLines(manifest);
    this.cameraLines = gl.createVertexArray();
    this.cameraLineEnds = lines.length / 4;
    gl.bindVertexArray(this.cameraLines);
    attribute(gl, 0, lines, 4);
    gl.bindVertexArray(null);
  }

  /** Texture of the triangles' corners: position and row, normal and column of each. */
  #cornersWith(normals) {
    const { vertices, corners, vertexOf, place } = this.surface, width = 6 * 256, rows = Math.ceil(corners.length / 3 / 256);
    const data = new Float32Array(4 * width * rows);
    for (let n = 0; n < corners.length; n++) {
      const point = corners[n], vertex = 3 * vertexOf[point];
      data.set([...vertices.subarray(vertex, vertex + 3), place[2 * point]], 8 * n);
      data.set([...normals.subarray(vertex, vertex + 3), place[2 * point + 1]], 8 * n + 4);
    }
    return image(this.gl, "RGBA32F", width, rows, data);
  }

  /** The same texture with the normals of the form without its relief. */
  formCorners() {
    const { vertices, normals, corners, vertexOf } = this.surface;
    return this.#cornersWith(smoothed(normals, vertices, Array.from(corners, (point) => vertexOf[point]), FORM * this.manifest.radius));
  }

  /** All triangles, by the program in use. */
  draw() {
    const { gl } = this;
    gl.bindVertexArray(this.empty);
    gl.drawArrays(gl.TRIANGLES, 0, this.surface.corners.length);
  }

  drawCameraLines() {
    const { gl } = this;
    gl.bindVertexArray(this.cameraLines);
    gl.drawArrays(gl.LINES, 0, this.cameraLineEnds);
    gl.bindVertexArray(null);
  }

  /** Uniforms of the mesh as a camera sees it. */
  seenBy(camera) {
    const k = camera.intrinsics, { centre, radius } = this.manifest;
    const middle = add(apply(camera.rotation, centre), camera.translation)[2];
    const near = Math.max(middle - radius * 1.01, radius * 0.01);
    return {
      corners: this.corners, charts: this.charts, rotation: camera.rotation, translation: camera.translation, focal: [k[0][0], k[0][1], k[1][1]],
      principal: [k[0][2], k[1][2]], pictureSize: [camera.columns, camera.rows], distortion: camera.distortion,
      depthRange: [near, Math.max(middle + radius * 1.01, 2 * near)],
    };
  }
}

/** Ends of the lines that show where the captured cameras stand: x, y, z and number of the camera. */
function cameraLines(manifest) {
  const out = [];
  manifest.views.forEach((camera, number) => {
    const eye = centreOf(camera), depth = 0.25 * manifest.radius, k = camera.intrinsics;
    const corner = (column, row) => {
      const seen = [(column - k[0][2]) / k[0][0], (row - k[1][2]) / k[1][1], 1].map((v) => v * depth);
      return add(eye, apply(transpose(camera.rotation), seen));
    };
    const ends = [corner(0, 0), corner(camera.columns, 0), corner(camera.columns, camera.rows), corner(0, camera.rows)];
    ends.forEach((end, n) => out.push(...eye, number, ...end, number, ...end, number, ...ends[(n + 1) % 4], number));
  });
  return Float32Array.from(out);
}
