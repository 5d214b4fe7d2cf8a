// Small helpers over WebGL2: programs whose uniforms are set by name, textures, framebuffers.

/** A program with its uniforms by name: `use({name: number | array | {texture, unit}})`. */
export class Shader {
  constructor(gl, vertex, fragment) {
    this.gl = gl;
    this.program = gl.createProgram();
    for (const [kind, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, text);
      gl.compileShader(shader);
      if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
      gl.attachShader(this.program, shader);
    }
    gl.linkProgram(this.program);
    if (!gl.getProgramParameter(this.program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(this.program));
    this.uniforms = new Map();
    const count = gl.getProgramParameter(this.program, gl.ACTIVE_UNIFORMS);
    let unit = 0;
    for (let n = 0; n < count; n++) {
      const { name, type, size } = gl.getActiveUniform(this.program, n);
      const plain = name.replace("[0]", "");
      const target = {
        [gl.SAMPLER_2D]: gl.TEXTURE_2D, [gl.INT_SAMPLER_2D]: gl.TEXTURE_2D, [gl.UNSIGNED_INT_SAMPLER_2D]: gl.TEXTURE_2D,
        [gl.SAMPLER_3D]: gl.TEXTURE_3D, [gl.SAMPLER_2D_ARRAY]: gl.TEXTURE_2D_ARRAY,
      }[type];
      this.uniforms.set(plain, { type, size, unit, target, at: gl.getUniformLocation(this.program, name) });
      if (target) unit += size;
    }
  }

  use(values) {
    const { gl } = this;
    gl.useProgram(this.program);
    for (const [name, value] of Object.entries(values)) this.set(name, value);
  }

  set(name, value) {
    const { gl } = this, uniform = this.uniforms.get(name);
    if (!uniform) return;
    const { at, type, unit, size, target } = uniform;
    if (target) {
      const textures = [value].flat();
      for (let n = 0; n < size; n++) {
        gl.activeTexture(gl.TEXTURE0 + unit + n);
        gl.bindTexture(target, textures[n]);
      }
      gl.uniform1iv(at, textures.slice(0, size).map((_, n) => unit + n));
      return;
    }
    const numbers = [value].flat(Infinity).map(Number);
    const setters = {
      [gl.FLOAT]: "uniform1fv", [gl.FLOAT_VEC2]: "uniform2fv", [gl.FLOAT_VEC3]: "uniform3fv",
      [gl.FLOAT_VEC4]: "uniform4fv", [gl.INT]: "uniform1iv", [gl.INT_VEC2]: "uniform2iv", [gl.BOOL]: "uniform1iv",
    };
    if (type === gl.FLOAT_MAT3) gl.uniformMatrix3fv(at, true, numbers);
    else if (type === gl.FLOAT_MAT4) gl.uniformMatrix4fv(at, true, numbers);
    else gl[setters[type]](at, numbers);
  }
}

/** A texture without filtering: `format` is the name of a sized internal format of WebGL2. */
export function texture(gl, format, width, height, data = null) {
  const made = gl.createTexture();
  gl.bindTexture(gl.TEXTURE_2D, made);
  for (const [key, value] of [
    [gl.TEXTURE_MIN_FILTER, gl.NEAREST], [gl.TEXTURE_MAG_FILTER, gl.NEAREST],
    [gl.TEXTURE_WRAP_S, gl.CLAMP_TO_EDGE], [gl.TEXTURE_WRAP_T, gl.CLAMP_TO_EDGE],
  ]) gl.texParameteri(gl.TEXTURE_2D, key, value);
  const [layout, type] = layoutOf(gl, format);
  gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
  gl.texImage2D(gl.TEXTURE_2D, 0, gl[format], width, height, 0, layout, type, data);
  return made;
}

export function layoutOf(gl, format) {
  return {
    RGBA32F: [gl.RGBA, gl.FLOAT], RGBA16F: [gl.RGBA, gl.FLOAT], R32F: [gl.RED, gl.FLOAT], R8: [gl.RED, gl.UNSIGNED_BYTE],
    RGBA32I: [gl.RGBA_INTEGER, gl.INT], R32I: [gl.RED_INTEGER, gl.INT], RGBA8: [gl.RGBA, gl.UNSIGNED_BYTE],
  }[format];
}

/** Integers in rows of 1024, as the shaders read them. */
export function integers(gl, format, values, each) {
  const rows = Math.max(1, Math.ceil(values.length / each / 1024));
  const padded = new Int32Array(rows * 1024 * each);
  padded.set(values);
  return texture(gl, format, 1024, rows, padded);
}

/** A framebuffer that draws into textures, with a depth buffer of its size where asked for. */
export function framebuffer(gl, textures, depth = null) {
  const made = gl.createFramebuffer();
  gl.bindFramebuffer(gl.FRAMEBUFFER, made);
  textures.forEach((target, n) => {
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0 + n, gl.TEXTURE_2D, target, 0);
  });
  if (depth) {
    gl.bindRenderbuffer(gl.RENDERBUFFER, gl.createRenderbuffer());
    gl.renderbufferStorage(gl.RENDERBUFFER, gl.DEPTH_COMPONENT24, ...depth);
    gl.framebufferRenderbuffer(
      gl.FRAMEBUFFER, gl.DEPTH_ATTACHMENT, gl.RENDERBUFFER, gl.getParameter(gl.RENDERBUFFER_BINDING));
  }
  gl.drawBuffers(textures.map((_, n) => gl.COLOR_ATTACHMENT0 + n));
  return made;
}
