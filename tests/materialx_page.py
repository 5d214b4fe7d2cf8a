"""A MaterialX document drawn by the shader that MaterialX generates of it, in headless Chromium (WebGL 2)."""

from __future__ import annotations

import base64
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import viewer_pages

LIGHTS = "uniform int u_numActiveLightSources;"
DRAW = """async ([vertex, pixel, uniforms, textures, rows, columns, far]) => {
  const canvas = document.createElement("canvas");
  const gl = canvas.getContext("webgl2");
  gl.getExtension("EXT_color_buffer_float");
  const program = gl.createProgram();
  for (const [kind, source] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, pixel]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
    gl.attachShader(program, shader);
  }
  gl.linkProgram(program);
  if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(program));
  gl.useProgram(program);
  const at = (name) => gl.getUniformLocation(program, name);
  const right = columns / 2, top = rows / 2;
  const corners = [-right, -top, right, -top, -right, top, right, top];
  const attributes = { i_position: [], i_normal: [], i_tangent: [], i_texcoord_0: [] };
  for (let k = 0; k < 4; k += 1) {
    attributes.i_position.push(corners[2 * k], corners[2 * k + 1], 0);
    attributes.i_normal.push(0, 0, 1);
    attributes.i_tangent.push(1, 0, 0);
    attributes.i_texcoord_0.push(k % 2, k >> 1);
  }
  for (const [name, values] of Object.entries(attributes)) {
    const place = gl.getAttribLocation(program, name);
    if (place < 0) continue;
    gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ARRAY_BUFFER, new Float32Array(values), gl.STATIC_DRAW);
    gl.enableVertexAttribArray(place);
    gl.vertexAttribPointer(place, values.length / 4, gl.FLOAT, false, 0, 0);
  }
  const unit = new Float32Array([1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]);
  gl.uniformMatrix4fv(at("u_worldMatrix"), false, unit);
  gl.uniformMatrix4fv(at("u_worldInverseTransposeMatrix"), false, unit);
  const flat = new Float32Array([1 / right, 0, 0, 0, 0, 1 / top, 0, 0, 0, 0, 0.5, 0, 0, 0, 0, 1]);
  gl.uniformMatrix4fv(at("u_viewProjectionMatrix"), false, flat);
  gl.uniform3f(at("u_viewPosition"), 0, 0, far);
  gl.uniform1i(at("u_numActiveLightSources"), 1);
  for (const [name, type, value] of uniforms) {
    const place = at(name);
    if (place === null) continue;
    if (["integer", "boolean"].includes(type)) gl.uniform1i(place, value[0]);
    else gl[`uniform${value.length}f`](place, ...value);
  }
  for (const [number, [name, address]] of textures.entries()) {
    const blob = await (await fetch(address)).blob();
    const options = { imageOrientation: "flipY", premultiplyAlpha: "none", colorSpaceConversion: "none" };
    gl.activeTexture(gl.TEXTURE0 + number);
    gl.bindTexture(gl.TEXTURE_2D, gl.createTexture());
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, gl.RGBA, gl.UNSIGNED_BYTE, await createImageBitmap(blob, options));
    const { NEAREST, CLAMP_TO_EDGE } = gl;
    const chosen = { MIN_FILTER: NEAREST, MAG_FILTER: NEAREST, WRAP_S: CLAMP_TO_EDGE, WRAP_T: CLAMP_TO_EDGE };
    for (const [what, value] of Object.entries(chosen)) gl.texParameteri(gl.TEXTURE_2D, gl[`TEXTURE_${what}`], value);
    gl.uniform1i(at(name), number);
  }
  gl.activeTexture(gl.TEXTURE0 + textures.length);
  const target = gl.createTexture();
  gl.bindTexture(gl.TEXTURE_2D, target);
  gl.texStorage2D(gl.TEXTURE_2D, 1, gl.RGBA32F, columns, rows);
  gl.bindFramebuffer(gl.FRAMEBUFFER, gl.createFramebuffer());
  gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, target, 0);
  gl.viewport(0, 0, columns, rows);
  return (globalThis.draw = (direction) => {
    gl.uniform1i(at("u_lightData[0].type"), 1);
    gl.uniform3f(at("u_lightData[0].direction"), ...direction.map((value) => -value));
    gl.uniform3f(at("u_lightData[0].color"), 1, 1, 1);
    gl.uniform1f(at("u_lightData[0].intensity"), Math.PI);
    gl.drawArrays(gl.TRIANGLE_STRIP, 0, 4);
    const values = new Float32Array(rows * columns * 4);
    gl.readPixels(0, 0, columns, rows, gl.RGBA, gl.FLOAT, values);
    const bytes = new Uint8Array(values.buffer);
    let text = "";
    for (let i = 0; i < bytes.length; i += 32768) text += String.fromCharCode(...bytes.subarray(i, i + 32768));
    return btoa(text);
  }) && gl.getError();
}"""
"""Uploads shaders, uniforms and textures, and leaves the function `draw` of a direction of light in the page."""


def shader_of(document: Path) -> tuple[str, str, list[tuple[str, str, list[float]]], list[tuple[str, str]]]:
    """Vertex and pixel shader (GLSL ES 3) of the only material of a document under one distant lamp without
    surroundings; uniforms (name, type, numbers); textures (name of the uniform, file)."""
    import MaterialX
    from MaterialX import PyMaterialXGenGlsl, PyMaterialXGenShader

    places = MaterialX.getDefaultDataSearchPath()
    library, read = MaterialX.createDocument(), MaterialX.createDocument()
    MaterialX.loadLibraries(MaterialX.getDefaultDataLibraryFolders(), places, library)
    MaterialX.readFromXmlFile(read, str(document))
    read.setDataLibrary(library)
    generator = PyMaterialXGenGlsl.EsslShaderGenerator.create()
    colours = PyMaterialXGenShader.DefaultColorManagementSystem.create(generator.getTarget())
    colours.loadLibrary(library)
    generator.setColorManagementSystem(colours)
    context = PyMaterialXGenShader.GenContext(generator)
    context.registerSourceCodeSearchPath(places)
    options = context.getOptions()
    options.targetColorSpaceOverride = "lin_rec709"
    options.hwSpecularEnvironmentMethod = PyMaterialXGenShader.HwSpecularEnvironmentMethod.SPECULAR_ENVIRONMENT_NONE
    options.hwMaxActiveLightSources = 1
    lamp = library.getNodeDef("ND_directional_light")
    PyMaterialXGenShader.HwShaderGenerator.bindLightShader(lamp, 1, context)
    (material,) = read.getMaterialNodes()
    shader = generator.generate("surface", material, context)
    block = shader.getStage("pixel").getUniformBlocks()["PublicUniforms"]
    uniforms: list[tuple[str, str, list[float]]] = []
    textures = []
    for number in range(block.size()):
        port = block[number]
        kind, value = port.getType().getName(), port.getValue()
        if kind == "filename":
            textures.append((port.getVariable(), value.getValueString()))
        elif value is not None and kind != "string":
            uniforms.append((port.getVariable(), kind, _numbers(value.getValueString())))
    # MaterialX 1.39.5 names this uniform of transmitted surroundings without declaring it where there are none.
    pixel = shader.getSourceCode("pixel").replace(LIGHTS, f"{LIGHTS}\nuniform bool u_refractionTwoSided;", 1)
    return shader.getSourceCode("vertex"), pixel, uniforms, textures


def _numbers(text: str) -> list[float]:
    return [float({"true": 1, "false": 0}.get(part.strip(), part)) for part in text.split(",")]


@contextmanager
def opened(document: Path, rows: int, columns: int) -> Iterator[Any]:
    """A function (direction of light) that gives (rows, columns, 3) float32: the material on a plane, a pixel of side 1
    for each texel, seen from far along its normal; linear, 1: a white that faces the lamp."""
    from playwright.sync_api import sync_playwright

    vertex, pixel, uniforms, textures = shader_of(document)
    pictures = [(name, (document.parent / file).read_bytes()) for name, file in textures]
    coded = [(name, "data:image/png;base64," + base64.b64encode(data).decode()) for name, data in pictures]
    with sync_playwright() as tool:
        browser = tool.chromium.launch(executable_path=viewer_pages.CHROMIUM, args=viewer_pages.FLAGS)
        page = browser.new_page()
        far = 1e4 * max(rows, columns)
        assert page.evaluate(DRAW, [vertex, pixel, uniforms, coded, rows, columns, far]) == 0

        def draw(direction: np.ndarray) -> np.ndarray:
            text = page.evaluate("(direction) => draw(direction)", [float(value) for value in direction])
            return np.frombuffer(base64.b64decode(text), "<f4").reshape(rows, columns, 4)[::-1, :, :3]

        yield draw
        browser.close()
