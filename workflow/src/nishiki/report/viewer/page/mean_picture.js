// A picture at rest: the mean of SAMPLES pictures, each with its own point of every lamp's disc and its own shift by part of
// a pixel: soft shadows and smooth edges. While something moves, the first of them is shown; before it a coarse one, once
// frames have been slow.
import { SCREEN_VERTEX } from "viewer/common_shaders";
import { SAMPLES } from "viewer/free_lamps";
import { Shader, drop, framebuffer, image } from "viewer/gl";

const COARSE = 3; // pixels of the canvas to one of a coarse picture, along each side
const SLOW = [150, 2000]; // ms between two changes of the state that say that frames are slow

/** The mean of the pictures so far and one more. */
const MEAN_FRAGMENT = `
uniform sampler2D mean, next;
uniform float count;            // of pictures in the mean
uniform int coarse;             // pixels to one of the next picture
out vec4 result;
void main() {
  ivec2 at = ivec2(gl_FragCoord.xy);
  vec4 value = texelFetch(next, at / coarse, 0);
  result = count > 0.0 ? mix(texelFetch(mean, at, 0), value, 1.0 / (count + 1.0)) : value;
}`;

/** Means for the parts of a canvas, by their names, each of its own state. */
export class MeanPictures {
  /** drawSample(target, {width, height}, shift, k, state, area): one picture, or an area of it; drawScreen(): a program over all of a framebuffer. */
  constructor(gl, drawSample, drawScreen) {
    this.gl = gl;
    this.drawSample = drawSample;
    this.drawScreen = drawScreen;
    this.parts = {};
    this.slow = false;
    this.changed = -Infinity; // time of the last change of what is shown
    this.program = new Shader(gl, SCREEN_VERTEX, MEAN_FRAGMENT);
  }

  get busy() {
    return Object.values(this.parts).some(({ count }) => count < SAMPLES);
  }

  /** Give up the means of all other parts. */
  keepOnly(names) {
    for (const name of Object.keys(this.parts)) if (!names.includes(name)) this.#forget(name);
  }

  /** The texture of a state's mean after one more picture of a part of the canvas, and whether more are to come. */
  next(name, area, state, { width, height }) {
    const part = this.#part(name, state, width, height);
    // the lens moves with its state; the divider uncovers what was drawn before
    if (part.count < SAMPLES) this.#add(part, state, name === "lens" ? area : null);
    return { texture: part.mean[0].texture, more: part.count < SAMPLES };
  }

  /** The textures of a part of the canvas; begun anew where its state is another than before. */
  #part(name, state, width, height) {
    const { lamps, ambient, view, layer, options, enhance, strength } = state, key = JSON.stringify([lamps, ambient, view, layer, options, enhance, strength]);
    let part = this.parts[name];
    if (!part || part.width !== width || part.height !== height) {
      this.#forget(name);
      const make = (format, depth) => {
        const made = image(this.gl, format, width, height);
        return { texture: made, target: framebuffer(this.gl, [made], depth) };
      };
      part = { width, height, sample: make("RGBA16F", [width, height]), mean: [make("RGBA32F"), make("RGBA32F")] };
      this.parts[name] = part;
    }
    if (part.key !== key) {
      const now = performance.now(), apart = now - this.changed;
      this.changed = now;
      this.slow ||= apart > SLOW[0] && apart < SLOW[1];
      Object.assign(part, { key, count: this.slow ? -1 : 0 });
    }
    return part;
  }

  #forget(name) {
    const { gl } = this, part = this.parts[name];
    if (!part) return;
    for (const { texture, target } of [part.sample, ...part.mean]) {
      gl.deleteTexture(texture);
      drop(gl, target);
    }
    delete this.parts[name];
  }

  #add(part, state, area) {
    const { gl } = this, { width, height } = part, coarse = part.count < 0 ? COARSE : 1, k = Math.max(part.count, 0), [mean, next] = part.mean;
    // the additive sequence of the plastic number covers the pixel evenly, its middle first
    const shift = k ? [(0.5 + k * 0.7548776662) % 1 - 0.5, (0.5 + k * 0.5698402910) % 1 - 0.5] : [0, 0];
    const [columns, rows] = [width, height].map((size) => Math.ceil(size / coarse)), low = (v) => Math.floor(v / coarse);
    const within = area && { x: low(area.x), y: low(height - area.y - area.height), width: low(area.width) + 2, height: low(area.height) + 2 };
    this.drawSample(part.sample.target, { width: columns, height: rows }, shift, k, state, within);
    gl.bindFramebuffer(gl.FRAMEBUFFER, next.target);
    gl.viewport(0, 0, width, height);
    gl.disable(gl.DEPTH_TEST);
    this.program.use({ mean: mean.texture, next: part.sample.texture, count: k, coarse });
    this.drawScreen();
    part.mean.reverse();
    part.count++;
  }
}
