// Values of an object under the pointer: place, normal, parameters, and what the captured views show there.
import { centreOf } from "viewer/cameras";
import { decode } from "viewer/colour";
import { drop, framebuffer, image } from "viewer/gl";
import { add, apply, dot, norm, normalised, subtract } from "viewer/matrices";
import { capturedUniforms, towardsCaptured } from "viewer/object_lamps";
import { PLACE_LAYER } from "viewer/object_shaders";

const HIDDEN = 0.02; // depth behind the surface that a view sees, in radii of the object, from which on a point is hidden

export class ObjectProbe {
  /** scene: gl, manifest, mesh, texels, and `programs.mesh`. */
  constructor(scene) {
    this.scene = scene;
    this.gl = scene.gl;
  }

  /** What a camera sees at the pixel (x, y), without positions' unit; null beside the object. */
  at(camera, x, y, light) {
    const texel = this.#texelAt(camera, x, y);
    if (!texel) return null;
    const { texels } = this.scene;
    const [kd, ks, facing, position] = [texels.diffuse, texels.specular, texels.normals, texels.positions].map(
      (source) => bilinear(texels.read(source, texel), texel));
    const normal = normalised(facing.slice(0, 3)), place = position.slice(0, 3);
    return { kd, ks, normal, place, photographs: this.#captures(texel, place, normal, light) };
  }

  /** Place of the surface behind a pixel, in the cameras' unit; null beside the object. */
  placeAt(camera, x, y) {
    const texel = this.#texelAt(camera, x, y), { texels } = this.scene;
    return texel && bilinear(texels.read(texels.positions, texel), texel).slice(0, 3);
  }

  /** Texel {x, y, row, column} (row, column: parts of the way to the next) behind a pixel; null beside the object. */
  #texelAt(camera, x, y) {
    const { mesh, texels, coded, programs } = this.scene;
    const [column, row, down, across] = this.#pixel("RGBA32F", programs.mesh, camera, x, y, {
      texels: texels.seen, grids: mesh.grids, cells: mesh.cells, size: coded.size, tilesAcross: texels.across, layer: PLACE_LAYER,
    }, [-1, 0, 0, 0]);
    return column < 0 ? null : { x: column, y: row, row: down, column: across };
  }

  /** What a program of the mesh draws at the one pixel (x, y) of a camera's picture. */
  #pixel(format, program, camera, x, y, uniforms, clear) {
    const { gl } = this, [first, second, third] = camera.intrinsics;
    const shifted = [[first[0], first[1], first[2] - Math.floor(x)], [0, second[1], second[2] - Math.floor(y)], third];
    const values = image(gl, format, 1, 1), target = framebuffer(gl, [values], [1, 1]);
    gl.viewport(0, 0, 1, 1);
    gl.enable(gl.DEPTH_TEST);
    gl.clearBufferfv(gl.COLOR, 0, clear);
    gl.clear(gl.DEPTH_BUFFER_BIT);
    program.use({ ...uniforms, ...this.scene.mesh.seenBy({ ...camera, intrinsics: shifted, rows: 1, columns: 1 }) });
    this.scene.mesh.draw();
    const out = new Float32Array(4);
    gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.FLOAT, out);
    drop(gl, target);
    gl.deleteTexture(values);
    return out;
  }

  /** Linear values of a texel in every captured view that sees it: as coded, and as the model alone predicts them. */
  #captures(texel, position, normal, light) {
    const { coded, texels, manifest } = this.scene, { views, lighting } = manifest;
    const tile = Math.floor(texel.y / coded.size) * texels.across + Math.floor(texel.x / coded.size);
    const out = [];
    views.forEach((camera, view) => {
      const away = subtract(centreOf(camera), position);
      if (coded.placeOf(tile, view) < 0 || dot(away, normal) <= 0.1 * norm(away) || this.#hides(camera, position)) return;
      const lent = this.scene.pictures ? texels.read(texels.residualOf(view, light).texture, texel) : null;
      texels.draw(camera, { ...capturedUniforms(manifest, light, camera), enhance: 0, strength: 0 }, [], light, { within: { x: texel.x, y: texel.y, width: 2, height: 2 } });
      const { values, predicted } = this.#values(texel, lent ?? this.#residual(texel, tile, view, light));
      const towards = towardsCaptured(lighting, light, camera, away);
      out.push({ view: camera.name, light: normalised(towards), values: values.map((v) => Math.max(v, 0)), predicted });
    });
    return out;
  }

  /** Whether something stands before a point, as a captured camera sees it. */
  #hides(camera, position) {
    const seen = add(apply(camera.rotation, position), camera.translation), k = camera.intrinsics;
    const column = Math.round((k[0][0] * seen[0] + k[0][1] * seen[1]) / seen[2] + k[0][2]);
    const row = Math.round((k[1][1] * seen[1]) / seen[2] + k[1][2]);
    const [depth] = this.#pixel("R32F", this.scene.texels.programs.depth, camera, column, row, {}, [0, 0, 0, 0]);
    return seen[2] > depth + HIDDEN * this.scene.radius;
  }

  /** Residual of a view at four texels. */
  #residual(texel, tile, view, light) {
    const { coded } = this.scene, residual = coded.residual(tile, view, light), out = new Float32Array(16);
    const upper = 4 * ((texel.y % coded.size) * coded.size + (texel.x % coded.size)), lower = upper + 4 * coded.size;
    if (residual) {
      out.set(residual.subarray(upper, upper + 8));
      out.set(residual.subarray(lower, lower + 8), 8);
    }
    return out;
  }

  /** Linear values between the four texels of `texels.seen`: with a residual (16 numbers), and without it. */
  #values(texel, residual) {
    const { coded, texels } = this.scene;
    const linear = coded.design.encoding === "srgb" ? decode : (v) => v;
    const model = texels.read(texels.seen, texel);
    const linearOf = (values) => bilinear(values, texel).slice(0, 3).map(linear);
    return { values: linearOf(model.map((v, n) => v + residual[n])), predicted: linearOf(model) };
  }
}

/** Four numbers between the four texels of a place. */
function bilinear(texels, { row, column }) {
  return [0, 1, 2, 3].map((n) => {
    const upper = texels[n] + column * (texels[n + 4] - texels[n]);
    return upper + row * (texels[n + 8] + column * (texels[n + 12] - texels[n + 8]) - upper);
  });
}
