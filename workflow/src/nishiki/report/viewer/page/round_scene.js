// What the scenes of objects and of cloths share: a canvas that is drawn with float textures, seen by a camera that goes round.
import { context, readback } from "viewer/gl";

export class RoundScene {
  /** kind: what is shown, for the error where the browser lacks something. */
  constructor(canvas, manifest, loader, kind) {
    this.canvas = canvas;
    this.manifest = manifest;
    this.loader = loader;
    this.onready = () => {};
    this.gl = context(canvas);
    if (!this.gl.getExtension("EXT_color_buffer_float")) {
      throw new Error(`WebGL2 with EXT_color_buffer_float is needed to show ${kind}`);
    }
    this.empty = this.gl.createVertexArray();
  }

  /** View of a state; of the kind of scene. @abstract @returns {any} */
  viewOf(state) {
    throw new Error(`no view of ${state}`);
  }

  /** A state whose picture is so many times larger, with the place at the pixel `from` of the canvas at `to`. */
  enlarged(state, times, from, to) {
    const part = ([x, y]) => [x / this.canvas.width, y / this.canvas.height];
    return { ...state, view: { ...this.viewOf(state), lens: { times, from: part(from), to: part(to) } } };
  }

  /** Run the program in use over the whole of a framebuffer. */
  drawScreen() {
    this.gl.bindVertexArray(this.empty);
    this.gl.drawArrays(this.gl.TRIANGLES, 0, 3);
  }

  /** Let the canvas be drawn into, within an area from its upper left corner; draw() does it. */
  onCanvas({ x, y, width, height }, draw) {
    const { gl, canvas } = this;
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.viewport(0, 0, canvas.width, canvas.height);
    gl.disable(gl.DEPTH_TEST);
    gl.enable(gl.SCISSOR_TEST);
    gl.scissor(x, canvas.height - y - height, width, height);
    draw();
    gl.disable(gl.SCISSOR_TEST);
  }

  /** RGBA bytes of the canvas, first row at the bottom. */
  readPixels() {
    this.gl.bindFramebuffer(this.gl.FRAMEBUFFER, null);
    return readback(this.gl, 0, 0, this.canvas.width, this.canvas.height);
  }
}
