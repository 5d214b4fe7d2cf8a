"""A MaterialX document drawn by the shader that MaterialX generates of it, in headless Chromium (WebGL 2)."""

from __future__ import annotations

import base64
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import viewer_pages

from nishiki.formats.textured_surface import TexturedMesh
from nishiki.geometry.camera import Camera

LIGHTS = "uniform int u_numActiveLightSources;"
DIRECTIONAL, POINT = 1, 2
"""Numbers that this page gives to the kinds of lamps."""
DRAW = """async ([vertex, pixel, uniforms, textures, mesh, rows, columns, filter]) => {
  const canvas = document.createElement("canvas");
  const gl = canvas.getContext("webgl2");
  gl.getExtension("EXT_color_buffer_float");
  gl.getExtension("OES_texture_float_linear");
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
  for (const [name, [size, values]] of Object.entries(mesh.attributes)) {
    const place = gl.getAttribLocation(program, name);
    if (place < 0) continue;
    gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ARRAY_BUFFER, new Float32Array(values), gl.STATIC_DRAW);
    gl.enableVertexAttribArray(place);
    gl.vertexAttribPointer(place, size, gl.FLOAT, false, 0, 0);
  }
  gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
  gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, new Uint32Array(mesh.corners), gl.STATIC_DRAW);
  const unit = new Float32Array([1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]);
  gl.uniformMatrix4fv(at("u_worldMatrix"), false, unit);
  gl.uniformMatrix4fv(at("u_worldInverseTransposeMatrix"), false, unit);
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
    const { CLAMP_TO_EDGE } = gl;
    const chosen = { MIN_FILTER: gl[filter], MAG_FILTER: gl[filter], WRAP_S: CLAMP_TO_EDGE, WRAP_T: CLAMP_TO_EDGE };
    for (const [what, value] of Object.entries(chosen)) gl.texParameteri(gl.TEXTURE_2D, gl[`TEXTURE_${what}`], value);
    gl.uniform1i(at(name), number);
  }
  gl.activeTexture(gl.TEXTURE0 + textures.length);
  const target = gl.createTexture(), depth = gl.createRenderbuffer();
  gl.bindTexture(gl.TEXTURE_2D, target);
  gl.texStorage2D(gl.TEXTURE_2D, 1, gl.RGBA32F, columns, rows);
  gl.bindRenderbuffer(gl.RENDERBUFFER, depth);
  gl.renderbufferStorage(gl.RENDERBUFFER, gl.DEPTH_COMPONENT24, columns, rows);
  gl.bindFramebuffer(gl.FRAMEBUFFER, gl.createFramebuffer());
  gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, target, 0);
  gl.framebufferRenderbuffer(gl.FRAMEBUFFER, gl.DEPTH_ATTACHMENT, gl.RENDERBUFFER, depth);
  gl.enable(gl.DEPTH_TEST);
  gl.viewport(0, 0, columns, rows);
  return (globalThis.draw = ([eye, matrix, kind, lamp]) => {
    gl.uniformMatrix4fv(at("u_viewProjectionMatrix"), true, new Float32Array(matrix));
    gl.uniform3f(at("u_viewPosition"), ...eye);
    gl.uniform1i(at("u_lightData[0].type"), kind);
    gl.uniform3f(at("u_lightData[0].direction"), ...lamp.map((value) => -value));
    gl.uniform3f(at("u_lightData[0].position"), ...lamp);
    gl.uniform1f(at("u_lightData[0].decay_rate"), 0);
    gl.uniform3f(at("u_lightData[0].color"), 1, 1, 1);
    gl.uniform1f(at("u_lightData[0].intensity"), Math.PI);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.drawElements(gl.TRIANGLES, mesh.corners.length, gl.UNSIGNED_INT, 0);
    const values = new Float32Array(rows * columns * 4);
    gl.readPixels(0, 0, columns, rows, gl.RGBA, gl.FLOAT, values);
    const bytes = new Uint8Array(values.buffer);
    let text = "";
    for (let i = 0; i < bytes.length; i += 32768) text += String.fromCharCode(...bytes.subarray(i, i + 32768));
    return btoa(text);
  }) && gl.getError();
}"""
"""Uploads shaders, uniforms, textures and a mesh, and leaves the function `draw` of an eye and a lamp in the page."""


def shader_of(document: Path) -> tuple[str, str, list[tuple[str, str, list[float]]], list[tuple[str, str]]]:
    """Vertex and pixel shader (GLSL ES 3) of the only material of a document under one lamp without surroundings;
    uniforms (name, type, numbers); textures (name of the uniform, file)."""
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
    for name, kind in (("ND_directional_light", DIRECTIONAL), ("ND_point_light", POINT)):
        PyMaterialXGenShader.HwShaderGenerator.bindLightShader(library.getNodeDef(name), kind, context)
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
    right, top, far = columns / 2, rows / 2, 1e4 * max(rows, columns)
    corners = np.array([[0, 0], [1, 0], [0, 1], [1, 1]], float)
    positions = np.column_stack([(2 * corners - 1) * [right, -top], np.zeros(4)])
    square = TexturedMesh(positions, np.tile([0.0, 0, 1], (4, 1)), corners, np.array([[0, 2, 1], [1, 2, 3]]))
    flat = np.diag([1 / right, 1 / top, 0.5, 1])
    with _page(document, square, rows, columns, filtering="NEAREST") as draw:
        yield lambda direction: draw([0, 0, far], flat, DIRECTIONAL, direction)[..., :3]


@contextmanager
def opened_object(document: Path, mesh: TexturedMesh, rows: int, columns: int) -> Iterator[Any]:
    """A function (camera, place of a lamp) that gives (rows, columns, 4) float32: the material on a mesh as a camera
    sees it, textures interpolated; linear, 1: a white that faces the lamp, whatever its distance; and 1 on the mesh.

    Cameras and lamps are in the mesh's unit.
    """
    with _page(document, mesh, rows, columns, filtering="LINEAR") as draw:

        def drawn(camera: Camera, lamp: np.ndarray) -> np.ndarray:
            _, depths = camera.project(mesh.positions)
            return draw(camera.centre, _projection(camera, 0.9 * depths.min(), 1.1 * depths.max()), POINT, lamp)

        yield drawn


def _projection(camera: Camera, near: float, far: float) -> np.ndarray:
    """(4, 4) from the world to clip space, as OpenGL has it; the middle of the first pixel is (0, 0)."""
    x, y, depth = camera.matrix
    across, down = 2 * (x + 0.5 * depth) / camera.columns - depth, depth - 2 * (y + 0.5 * depth) / camera.rows
    between = (far + near) * depth - [0, 0, 0, 2 * far * near]
    return np.stack([across, down, between / (far - near), depth])


@contextmanager
def _page(document: Path, mesh: TexturedMesh, rows: int, columns: int, *, filtering: str) -> Iterator[Any]:
    """A function (eye, matrix to clip space, kind of lamp, its direction or place) that gives (rows, columns, 4)."""
    from playwright.sync_api import sync_playwright

    vertex, pixel, uniforms, textures = shader_of(document)
    pictures = [(name, (document.parent / file).read_bytes()) for name, file in textures]
    coded = [(name, "data:image/png;base64," + base64.b64encode(data).decode()) for name, data in pictures]
    # The gloss is the same in all directions around the normal: any tangent does.
    beside = np.where(np.abs(mesh.normals[:, :1]) < 0.9, [[1.0, 0, 0]], [[0, 1.0, 0]])
    tangents = beside - np.sum(beside * mesh.normals, axis=1, keepdims=True) * mesh.normals
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    attributes = {
        "i_position": mesh.positions,
        "i_normal": mesh.normals,
        "i_tangent": tangents,
        "i_texcoord_0": np.column_stack([mesh.texture[:, 0], 1 - mesh.texture[:, 1]]),
    }
    told = {name: (values.shape[1], values.ravel().tolist()) for name, values in attributes.items()}
    shape = {"attributes": told, "corners": mesh.triangles.ravel().tolist()}
    with sync_playwright() as tool:
        browser = tool.chromium.launch(executable_path=viewer_pages.CHROMIUM, args=viewer_pages.FLAGS)
        page = browser.new_page()
        assert page.evaluate(DRAW, [vertex, pixel, uniforms, coded, shape, rows, columns, filtering]) == 0

        def draw(eye: np.ndarray, matrix: np.ndarray, kind: int, lamp: np.ndarray) -> np.ndarray:
            flat = [np.asarray(values, float).ravel().tolist() for values in (eye, matrix)]
            text = page.evaluate("(asked) => draw(asked)", [*flat, kind, [float(value) for value in lamp]])
            return np.frombuffer(base64.b64decode(text), "<f4").reshape(rows, columns, 4)[::-1]

        yield draw
        browser.close()
