// WebGL2 helpers: context, programs, textures, framebuffers, reading back.

/** Beginning of every shader. */
export const HEAD = `#version 300 es
precision highp float;
precision highp int;
precision highp sampler2D;
precision highp sampler3D;
precision highp sampler2DArray;
precision highp isampler2D;
`;

/** A WebGL2 context of a canvas, or an Error that says what lacks. */
export function context(canvas) {
  const gl = canvas.getContext("webgl2", { alpha: false, antialias: false, depth: true, preserveDrawingBuffer: true });
  if (!gl) throw new Error("This browser offers no WebGL2; enable it, or use a browser of 2022 or later.");
  gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
  gl.pixelStorei(gl.UNPACK_COLORSPACE_CONVERSION_WEBGL, gl.NONE);
  gl.pixelStorei(gl.UNPACK_PREMULTIPLY_ALPHA_WEBGL, false);
  return gl;
}

/** A program of two texts, linked. */
function linked(gl, vertexText, fragmentText) {
  const made = gl.createProgram();
  for (const [kind, text] of [[gl.VERTEX_SHADER, vertexText], [gl.FRAGMENT_SHADER, fragmentText]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, text);
    gl.compileShader(shader);
    gl.attachShader(made, shader);
    gl.deleteShader(shader);
  }
  gl.linkProgram(made);
  if (!gl.getProgramParameter(made, gl.LINK_STATUS)) {
    const logs = gl.getAttachedShaders(made).map((shader) => gl.getShaderInfoLog(shader));
    throw new Error(`shader: ${gl.getProgramInfoLog(made)} ${logs.join(" ")}`);
  }
  return made;
}

/** What a program's uniforms are: {name, type, size, at}. */
function uniformsOf(gl, program) {
  const count = gl.getProgramParameter(program, gl.ACTIVE_UNIFORMS);
  return Array.from({ length: count }, (_, n) => {
    const { name, type, size } = gl.getActiveUniform(program, n);
    return { name: name.replace("[0]", ""), type, size, at: gl.getUniformLocation(program, name) };
  });
}

/** A linked program with its uniforms: {program, uniforms: {name: location}, use()}; texts begin after HEAD. */
export function program(gl, vertexText, fragmentText, defines = {}) {
  const head = HEAD + Object.entries(defines).map(([name, value]) => `#define ${name} ${value}\n`).join("");
  const made = linked(gl, head + vertexText, head + fragmentText);
  const uniforms = Object.fromEntries(uniformsOf(gl, made).map(({ name, at }) => [name, at]));
  return { program: made, uniforms, use: () => gl.useProgram(made) };
}

/** A program whose uniforms are set by name: `use({name: number | array | texture})`; texts begin after HEAD. */
export class Shader {
  constructor(gl, vertexText, fragmentText) {
    this.gl = gl;
    this.program = linked(gl, HEAD + vertexText, HEAD + fragmentText);
    this.uniforms = new Map();
    let unit = 0;
    for (const { name, type, size, at } of uniformsOf(gl, this.program)) {
      const sampled = {
        [gl.SAMPLER_2D]: gl.TEXTURE_2D, [gl.INT_SAMPLER_2D]: gl.TEXTURE_2D, [gl.SAMPLER_3D]: gl.TEXTURE_3D,
        [gl.SAMPLER_2D_ARRAY]: gl.TEXTURE_2D_ARRAY,
      }[type];
      this.uniforms.set(name, { type, size, unit, sampled, at });
      if (sampled) unit += size;
    }
  }

  use(values) {
    this.gl.useProgram(this.program);
    for (const [name, value] of Object.entries(values)) this.set(name, value);
  }

  set(name, value) {
    const { gl } = this, uniform = this.uniforms.get(name);
    if (!uniform) return;
    const { at, type, unit, size, sampled } = uniform;
    if (sampled) {
      const textures = [value].flat();
      for (let n = 0; n < size; n++) {
        gl.activeTexture(gl.TEXTURE0 + unit + n);
        gl.bindTexture(sampled, textures[n]);
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

/** A texture with clamped edges, empty. target: TEXTURE_2D, TEXTURE_2D_ARRAY or TEXTURE_3D; filter: LINEAR or NEAREST;
 * wrap: along its first axis. */
export function texture(gl, target, filter, wrap = gl.CLAMP_TO_EDGE) {
  const made = gl.createTexture();
  gl.bindTexture(target, made);
  gl.texParameteri(target, gl.TEXTURE_MIN_FILTER, filter);
  gl.texParameteri(target, gl.TEXTURE_MAG_FILTER, filter);
  gl.texParameteri(target, gl.TEXTURE_WRAP_S, wrap);
  gl.texParameteri(target, gl.TEXTURE_WRAP_T, gl.CLAMP_TO_EDGE);
  if (target === gl.TEXTURE_3D) gl.texParameteri(target, gl.TEXTURE_WRAP_R, gl.CLAMP_TO_EDGE);
  return made;
}

/** A texture of two axes without filtering: `format` is the name of a sized internal format of WebGL2. */
export function image(gl, format, width, height, data = null) {
  const made = texture(gl, gl.TEXTURE_2D, gl.NEAREST);
  const [layout, type] = {
    RGBA32F: [gl.RGBA, gl.FLOAT], RGBA16F: [gl.RGBA, gl.FLOAT], R32F: [gl.RED, gl.FLOAT], R8: [gl.RED, gl.UNSIGNED_BYTE],
    RGBA32I: [gl.RGBA_INTEGER, gl.INT], R32I: [gl.RED_INTEGER, gl.INT], RGBA8: [gl.RGBA, gl.UNSIGNED_BYTE],
  }[format];
  gl.texImage2D(gl.TEXTURE_2D, 0, gl[format], width, height, 0, layout, type, data);
  return made;
}

/** Integers in rows of 1024, as the shaders read them. */
export function integers(gl, format, values, each) {
  const rows = Math.max(1, Math.ceil(values.length / each / 1024));
  const padded = new Int32Array(rows * 1024 * each);
  padded.set(values);
  return image(gl, format, 1024, rows, padded);
}

/** Bind a texture to a unit and give the unit to a sampler of the program in use. */
export function bind(gl, unit, target, what, location) {
  gl.activeTexture(gl.TEXTURE0 + unit);
  gl.bindTexture(target, what);
  if (location !== undefined) gl.uniform1i(location, unit);
}

/** Numbers of the vertex array that is bound: `data` at a place, `size` of them a vertex; bytes and int16 as parts of 1. */
export function attribute(gl, place, data, size) {
  gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
  gl.bufferData(gl.ARRAY_BUFFER, data, gl.STATIC_DRAW);
  gl.enableVertexAttribArray(place);
  if (data instanceof Int32Array) return gl.vertexAttribIPointer(place, size, gl.INT, 0, 0);
  const type = data instanceof Float32Array ? gl.FLOAT : data instanceof Int16Array ? gl.SHORT : gl.UNSIGNED_BYTE;
  return gl.vertexAttribPointer(place, size, type, type !== gl.FLOAT, 0, 0);
}

/** A framebuffer that draws into textures, with a depth buffer of its size where asked for; to be deleted by `drop`. */
export function framebuffer(gl, textures, depth = null) {
  const made = gl.createFramebuffer();
  gl.bindFramebuffer(gl.FRAMEBUFFER, made);
  textures.forEach((each, n) => {
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0 + n, gl.TEXTURE_2D, each, 0);
  });
  if (depth) {
    made.depth = gl.createRenderbuffer();
    gl.bindRenderbuffer(gl.RENDERBUFFER, made.depth);
    gl.renderbufferStorage(gl.RENDERBUFFER, gl.DEPTH_COMPONENT24, ...depth);
    gl.framebufferRenderbuffer(gl.FRAMEBUFFER, gl.DEPTH_ATTACHMENT, gl.RENDERBUFFER, made.depth);
  }
  gl.drawBuffers(textures.map((_, n) => gl.COLOR_ATTACHMENT0 + n));
  return made;
}

/** Delete a framebuffer and its depth buffer; its textures stay. */
export function drop(gl, framebuffer) {
  gl.deleteRenderbuffer(framebuffer.depth ?? null);
  gl.deleteFramebuffer(framebuffer);
}

/** A framebuffer with an RGBA8 texture of this size: {framebuffer, texture, width, height}. */
export function target(gl, width, height) {
  const colour = image(gl, "RGBA8", width, height), made = framebuffer(gl, [colour]);
  gl.bindFramebuffer(gl.FRAMEBUFFER, null);
  return { framebuffer: made, texture: colour, width, height };
}

/** RGBA bytes of a rectangle of the framebuffer that is bound, first row at the bottom. */
export function readback(gl, x, y, width, height) {
  const bytes = new Uint8Array(width * height * 4);
  gl.readPixels(x, y, width, height, gl.RGBA, gl.UNSIGNED_BYTE, bytes);
  return bytes;
}
