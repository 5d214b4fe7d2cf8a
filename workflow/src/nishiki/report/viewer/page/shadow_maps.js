// Cast shadows: the depth of a scene as each lamp sees it, from one point of the lamp's disc at a time.
import { texture } from "viewer/gl";
import { cross, dot, normalised, scale, subtract } from "viewer/matrices";

const MAP = 2048; // side of a shadow map
export const MAP_BIAS = 2 / MAP; // in depths of a map, which are the diameter of what is lit
export const SHADOW_FRAGMENT = "void main() {}";

export class ShadowMaps {
  constructor(gl) {
    this.gl = gl;
    this.layers = 0;
    this.texture = null;
    this.targets = [];
  }

  /** Draw what throws shadows, as every lamp of freeLamps sees it; draw(toLamp) draws it once. The lamps' matrices. */
  draw(lamps, centre, radius, draw) {
    const { gl } = this;
    if (this.layers < lamps.length) this.#make(lamps.length);
    gl.enable(gl.DEPTH_TEST);
    gl.viewport(0, 0, MAP, MAP);
    return lamps.map((lamp, layer) => {
      const toLamp = lampMatrix(lamp, centre, radius);
      gl.bindFramebuffer(gl.FRAMEBUFFER, this.targets[layer]);
      gl.clear(gl.DEPTH_BUFFER_BIT);
      draw(toLamp);
      return toLamp;
    });
  }

  #make(layers) {
    const { gl } = this;
    for (const old of this.targets) gl.deleteFramebuffer(old);
    if (this.texture) gl.deleteTexture(this.texture);
    this.texture = texture(gl, gl.TEXTURE_2D_ARRAY, gl.NEAREST);
    gl.texStorage3D(gl.TEXTURE_2D_ARRAY, 1, gl.DEPTH_COMPONENT24, MAP, MAP, layers);
    this.layers = layers;
    this.targets = Array.from({ length: layers }, (_, layer) => {
      const target = gl.createFramebuffer();
      gl.bindFramebuffer(gl.FRAMEBUFFER, target);
      gl.framebufferTextureLayer(gl.FRAMEBUFFER, gl.DEPTH_ATTACHMENT, this.texture, 0, layer);
      return target;
    });
  }
}

/** From the scene to the picture of a lamp: a box around a ball, or a pyramid from a near lamp. */
function lampMatrix({ near, shadow }, centre, radius) {
  const away = near ? subtract(shadow, centre) : shadow, back = normalised(away);
  const x = normalised(cross(Math.abs(back[1]) < 0.9 ? [0, 1, 0] : [1, 0, 0], back)), y = cross(back, x);
  const row = (axis, factor, from) => [...scale(axis, factor), -factor * dot(axis, from)];
  if (!near) return [row(x, 1 / radius, centre), row(y, 1 / radius, centre), row(back, -1 / radius, centre), [0, 0, 0, 1]];
  const distance = Math.hypot(...away), [first, last] = [distance - radius, distance + radius];
  const half = radius / Math.sqrt(distance ** 2 - radius ** 2), depth = row(back, -1, shadow);
  return [
    row(x, 1 / half, shadow), row(y, 1 / half, shadow),
    depth.map((v, n) => ((last + first) * v - (n === 3 ? 2 * last * first : 0)) / (last - first)), depth,
  ];
}
