// WebGL2 helpers: programs, textures, framebuffers, reading back.

/** A WebGL2 context of a canvas, or an Error that says what lacks. */
export function context(canvas) {
  const gl = canvas.getContext("webgl2", { alpha: false, antialias: false, depth: true, preserveDrawingBuffer: true });
  if (!gl) throw new Error("This browser offers no WebGL2; enable it, or use a browser of 2022 or later.");
  gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
  gl.pixelStorei(gl.UNPACK_COLORSPACE_CONVERSION_WEBGL, gl.NONE);
  gl.pixelStorei(gl.UNPACK_PREMULTIPLY_ALPHA_WEBGL, false);
  return gl;
}

/** A linked program with its uniforms: {program, uniforms: {name: location}, use()}; texts begin after "#version". */
export function program(gl, vertexText, fragmentText, defines = {}) {
  const head = "#version 300 es\nprecision highp float;\nprecision highp int;\nprecision highp sampler2D;\n" +
    "precision highp sampler2DArray;\n" +
    Object.entries(defines).map(([name, value]) => `#define ${name} ${value}\n`).join("");
  const made = gl.createProgram();
  for (const [kind, text] of [[gl.VERTEX_SHADER, vertexText], [gl.FRAGMENT_SHADER, fragmentText]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, head + text);
    gl.compileShader(shader);
    gl.attachShader(made, shader);
    gl.deleteShader(shader);
  }
  gl.linkProgram(made);
  if (!gl.getProgramParameter(made, gl.LINK_STATUS)) {
    const logs = gl.getAttachedShaders(made).map((shader) => gl.getShaderInfoLog(shader));
    throw new Error(`shader: ${gl.getProgramInfoLog(made)} ${logs.join(" ")}`);
  }
  const uniforms = {};
  for (let i = 0; i < gl.getProgramParameter(made, gl.ACTIVE_UNIFORMS); i++) {
    const name = gl.getActiveUniform(made, i).name.replace("[0]", "");
    uniforms[name] = gl.getUniformLocation(made, name);
  }
  return { program: made, uniforms, use: () => gl.useProgram(made) };
}

/** A texture with clamped edges. target: TEXTURE_2D or TEXTURE_2D_ARRAY; filter: LINEAR or NEAREST. */
export function texture(gl, target, filter) {
  const made = gl.createTexture();
  gl.bindTexture(target, made);
  gl.texParameteri(target, gl.TEXTURE_MIN_FILTER, filter);
  gl.texParameteri(target, gl.TEXTURE_MAG_FILTER, filter);
  gl.texParameteri(target, gl.TEXTURE_WRAP_S, gl.CLAMP_TO_EDGE);
  gl.texParameteri(target, gl.TEXTURE_WRAP_T, gl.CLAMP_TO_EDGE);
  return made;
}

/** Bind a texture to a unit and give the unit to a sampler of the program in use. */
export function bind(gl, unit, target, what, location) {
  gl.activeTexture(gl.TEXTURE0 + unit);
  gl.bindTexture(target, what);
  if (location !== undefined) gl.uniform1i(location, unit);
}

/** A framebuffer with an RGBA8 texture of this size: {framebuffer, texture, width, height}. */
export function target(gl, width, height) {
  const colour = texture(gl, gl.TEXTURE_2D, gl.NEAREST);
  gl.texStorage2D(gl.TEXTURE_2D, 1, gl.RGBA8, width, height);
  const framebuffer = gl.createFramebuffer();
  gl.bindFramebuffer(gl.FRAMEBUFFER, framebuffer);
  gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, colour, 0);
  gl.bindFramebuffer(gl.FRAMEBUFFER, null);
  return { framebuffer, texture: colour, width, height };
}

/** RGBA bytes of a rectangle of the framebuffer that is bound, first row at the bottom. */
export function readback(gl, x, y, width, height) {
  const bytes = new Uint8Array(width * height * 4);
  gl.readPixels(x, y, width, height, gl.RGBA, gl.UNSIGNED_BYTE, bytes);
  return bytes;
}
