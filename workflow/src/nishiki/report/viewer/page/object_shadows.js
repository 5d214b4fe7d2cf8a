// Shadows that an object casts on itself under the state's own lamps: at every texel the share of each lamp's disc that it sees,
// as a sum over SAMPLES points of the discs. A picture that moves shows the first; it gets smoother while it rests.
import { SCREEN_VERTEX } from "viewer/common_shaders";
import { SAMPLES } from "viewer/free_lamps";
import { Shader, drop, framebuffer, image } from "viewer/gl";
import { lampFrame, ownLamps } from "viewer/object_lamps";
import { LIT_FRAGMENT, SHADOW_VERTEX } from "viewer/object_texel_shaders";
import { MAP_BIAS, SHADOW_FRAGMENT, ShadowMaps } from "viewer/shadow_maps";
import { MOST_LAMPS } from "viewer/state";

export class ObjectShadows {
  /** scene: gl, manifest, mesh, texels, drawScreen(). */
  constructor(scene) {
    this.scene = scene;
    this.gl = scene.gl;
    this.maps = new ShadowMaps(scene.gl);
    this.sums = {};
    this.programs = {
      map: new Shader(this.gl, SHADOW_VERTEX, SHADOW_FRAGMENT), lit: new Shader(this.gl, SCREEN_VERTEX, LIT_FRAGMENT),
    };
  }

  get busy() {
    return Object.values(this.sums).some(({ count, needed }) => count < needed);
  }

  /** Uniforms of a state's shadows after some more samples, for a part of the canvas: `left` of the divider, or `main`. */
  next(part, state, camera) {
    const sum = this.sums[part] ??= this.#make(), key = JSON.stringify([state.lamps, lampFrame(camera)]);
    if (sum.key !== key) Object.assign(sum, { key, count: 0, needed: state.lamps.some(({ radius_deg }) => radius_deg > 0) ? SAMPLES : 1 });
    const until = Math.min(Math.max(2 * sum.count, 1), sum.needed); // ever twice as many, so that few pictures are drawn
    while (sum.count < until) this.#add(sum, ownLamps(this.scene.manifest, state, camera, sum.count));
    return { part, key: sum.key, lit0: sum.textures[0], lit1: sum.textures[1], samples: sum.count };
  }

  /** Give up the sums of a part of the canvas. */
  forget(part) {
    const { gl } = this, sum = this.sums[part];
    if (!sum) return;
    drop(gl, sum.target);
    sum.textures.forEach((old) => gl.deleteTexture(old));
    delete this.sums[part];
  }

  #make() {
    const { gl } = this, { atlas } = this.scene.texels;
    const textures = [0, 1].map(() => image(gl, "RGBA8", atlas, atlas));
    return { textures, target: framebuffer(gl, textures), count: 0 };
  }

  #add(sum, lamps) {
    const { gl } = this, { manifest, mesh, texels } = this.scene;
    const matrices = this.maps.draw(lamps, manifest.centre, manifest.radius, (toLamp) => {
      this.programs.map.use({ corners: mesh.corners, toLamp });
      mesh.draw();
    });
    gl.bindFramebuffer(gl.FRAMEBUFFER, sum.target);
    gl.viewport(0, 0, texels.atlas, texels.atlas);
    gl.disable(gl.DEPTH_TEST);
    if (sum.count === 0) {
      gl.clearColor(0, 0, 0, 0);
      gl.clear(gl.COLOR_BUFFER_BIT);
    }
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE);
    this.programs.lit.use({
      positions: texels.positions, normals: texels.normals, lamps: lamps.length, lift: manifest.lift, shadows: this.maps.texture,
      shadowBias: MAP_BIAS, toLamp: [...matrices, ...new Array(MOST_LAMPS - matrices.length).fill(new Array(16).fill(0))],
    });
    this.scene.drawScreen();
    gl.disable(gl.BLEND);
    sum.count++;
  }
}
