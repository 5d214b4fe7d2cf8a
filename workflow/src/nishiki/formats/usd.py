"""MaterialX 1.39 (a document with the node open_pbr_surface) and OpenUSD (a package .usdz) of a surface with textures.

OpenPBR (Academy Software Foundation, 2024): specular_ior is the index whose reflectance along the normal is F0, and
specular_weight the share of that reflectance. Places in a texture count from the left and from the bottom. The material
of USD is UsdPreviewSurface, its gloss said by roughness and index of refraction, which all programs understand alike:
the workflow of specular colours would hold a texture of its strength, but Blender multiplies such a colour with the
reflectance of the index.
"""

import os
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from nishiki.formats.picture_tiles import png_bytes
from nishiki.formats.textured_surface import SurfaceLook, TexturedMesh
from nishiki.installation import optional

INPUTS = {
    "colour": ("base_color", "color3"),
    "roughness": ("specular_roughness", "float"),
    "specular": ("specular_weight", "float"),
    "normals": ("geometry_normal", "vector3"),
    "metallic": ("base_metalness", "float"),
}
"""Of each texture the input of the surface that it feeds, and the type of its values."""


def write_materialx(path: Path, look: SurfaceLook, *, facts: Mapping[str, Any]) -> list[str]:
    """Write the document and its textures; the names of the files, relative to the document's folder.

    facts: what the document says of its making.

    Raises
    ------
    UserError
        Where the package materialx is not installed.
    RuntimeError
        Where MaterialX finds the document invalid.
    """
    optional("materialx")
    import MaterialX

    document = MaterialX.createDocument()
    libraries = MaterialX.createDocument()
    MaterialX.loadLibraries(MaterialX.getDefaultDataLibraryFolders(), MaterialX.getDefaultDataSearchPath(), libraries)
    document.setDataLibrary(libraries)
    document.setColorSpace("lin_rec709")
    told = ", ".join(f"{name} {value}" for name, value in facts.items())
    document.setDocString(f"Made by Nishiki ({told}). Places in the textures as in its USD and glTF files.")
    surface = document.addNode("open_pbr_surface", "open_pbr_surface", "surfaceshader")
    _set(surface, "base_weight", 1.0)
    _set(surface, "specular_ior", look.index)
    for name, value in (("specular_roughness", look.roughness), ("base_metalness", look.metallic)):
        if not isinstance(value, np.ndarray):
            _set(surface, name, value)
    files = []
    graph = document.addNodeGraph("textures")
    for texture, picture in look.pictures().items():
        files.append(f"{texture}.png")
        (path.parent / files[-1]).write_bytes(png_bytes(picture))
        _connect(graph, surface, texture)
    document.addMaterialNode("material", surface)
    valid, report = document.validate()
    if not valid:
        raise RuntimeError(f"MaterialX finds its own document invalid: {report}")
    MaterialX.writeToXmlFile(document, str(path))
    return [path.name, *files]


def _connect(graph: Any, surface: Any, texture: str) -> None:
    """Connect an image to an input of the surface."""
    name, kind = INPUTS[texture]
    image = graph.addNode("image", texture, kind)
    file = image.addInput("file", "filename")
    file.setValueString(f"{texture}.png")
    if texture == "colour":
        file.setColorSpace("srgb_texture")
    for side in ("uaddressmode", "vaddressmode"):
        image.addInput(side, "string").setValueString("clamp")
    if texture == "normals":
        turned = graph.addNode("normalmap", "turned", kind)
        turned.addInput("in", kind).setConnectedNode(image)
        image = turned
    output = graph.addOutput(f"{texture}_out", kind)
    output.setConnectedNode(image)
    surface.addInput(name, kind).setConnectedOutput(output)


def _set(surface: Any, name: str, value: float) -> None:
    surface.addInput(name, "float").setValueString(f"{value:.9g}")


ROOT = "/surface"
READER = f"{ROOT}/material/places"
DATE = time.mktime((1980, 1, 2, 0, 0, 0, 0, 0, -1))
"""Of all files in a package, so that the same results give the same bytes."""
CHANNELS = {"colour": "rgb", "roughness": "r", "normals": "rgb", "metallic": "r"}
"""Textures that the material has, and what it takes of each."""


def write_usdz(path: Path, mesh: TexturedMesh, look: SurfaceLook, *, name: str, facts: Mapping[str, Any]) -> None:
    """Write a package: y is up, the unit is the metre. Of the look's weights it takes the mean.

    facts: stand in the layer's `customLayerData`.

    Raises
    ------
    UserError
        Where the package usd-core is not installed.
    """
    optional("usd-core")
    from pxr import Sdf

    with tempfile.TemporaryDirectory(dir=path.parent, prefix=".usd-") as scratch:
        folder = Path(scratch)
        textures = {}
        for texture, picture in look.pictures().items():
            if texture not in CHANNELS:
                continue
            textures[texture] = f"textures/{texture}.png"
            (folder / "textures").mkdir(exist_ok=True)
            (folder / textures[texture]).write_bytes(png_bytes(picture))
        _write_layer(folder / "surface.usdc", mesh, look, name, facts)
        for file in ("surface.usdc", *textures.values()):  # the package says when they were written
            os.utime(folder / file, (DATE, DATE))
        with Sdf.ZipFileWriter.CreateNew(str(path)) as package:
            for file in ("surface.usdc", *textures.values()):  # the layer first, as the specification wants it
                package.AddFile(str(folder / file), file)


def _write_layer(path: Path, mesh: TexturedMesh, look: SurfaceLook, name: str, facts: Mapping[str, Any]) -> None:
    from pxr import Kind, Usd, UsdGeom, UsdShade

    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    root = UsdGeom.Xform.Define(stage, ROOT).GetPrim()
    root.SetDisplayName(name)
    Usd.ModelAPI(root).SetKind(Kind.Tokens.component)
    stage.SetDefaultPrim(root)
    stage.GetRootLayer().customLayerData = {key: str(value) for key, value in facts.items()}
    shape = _define_mesh(stage, mesh)
    material = _define_material(stage, look)
    UsdShade.MaterialBindingAPI.Apply(shape).Bind(material)
    stage.Save()


def _define_mesh(stage: Any, mesh: TexturedMesh) -> Any:
    from pxr import Sdf, UsdGeom, Vt

    shape = UsdGeom.Mesh.Define(stage, f"{ROOT}/mesh")
    positions = np.ascontiguousarray(mesh.positions, np.float32)
    shape.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(positions))
    shape.CreateExtentAttr(Vt.Vec3fArray.FromNumpy(np.stack([positions.min(axis=0), positions.max(axis=0)])))
    shape.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(mesh.triangles), 3, np.int32)))
    shape.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(np.ascontiguousarray(mesh.triangles, np.int32).ravel()))
    shape.CreateNormalsAttr(Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(mesh.normals, np.float32)))
    shape.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
    shape.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    upwards = np.column_stack([mesh.texture[:, 0], 1 - mesh.texture[:, 1]]).astype(np.float32)  # v from the bottom
    places = UsdGeom.PrimvarsAPI(shape).CreatePrimvar("st", Sdf.ValueTypeNames.TexCoord2fArray, UsdGeom.Tokens.vertex)
    places.Set(Vt.Vec2fArray.FromNumpy(upwards))
    return shape.GetPrim()


def _define_material(stage: Any, look: SurfaceLook) -> Any:
    from pxr import Sdf, UsdShade

    types = Sdf.ValueTypeNames
    material = UsdShade.Material.Define(stage, f"{ROOT}/material")
    surface = _shader(stage, "surface", "UsdPreviewSurface")
    material.CreateSurfaceOutput().ConnectToSource(surface.CreateOutput("surface", types.Token))
    reader = _shader(stage, "places", "UsdPrimvarReader_float2")
    reader.CreateInput("varname", types.String).Set("st")
    reader.CreateOutput("result", types.Float2)
    surface.CreateInput("ior", types.Float).Set(look.mean_index)
    surface.CreateInput("diffuseColor", types.Color3f).ConnectToSource(_texture(stage, "colour", (1.0, 0.0)))
    for name, value in (("roughness", look.roughness), ("metallic", look.metallic)):
        given = surface.CreateInput(name, types.Float)
        if isinstance(value, np.ndarray):
            given.ConnectToSource(_texture(stage, name, (1.0, 0.0)))
        else:
            given.Set(value)
    if look.normals is not None:
        surface.CreateInput("normal", types.Normal3f).ConnectToSource(_texture(stage, "normals", (2.0, -1.0)))
    return material


def _texture(stage: Any, name: str, scale: tuple[float, float]) -> Any:
    """Define a texture's node and return its output; scale: factor and summand of its values."""
    from pxr import Gf, Sdf, UsdShade

    types = Sdf.ValueTypeNames
    shader = _shader(stage, name, "UsdUVTexture")
    shader.CreateInput("file", types.Asset).Set(Sdf.AssetPath(f"textures/{name}.png"))
    shader.CreateInput("sourceColorSpace", types.Token).Set("sRGB" if name == "colour" else "raw")
    for side in ("wrapS", "wrapT"):
        shader.CreateInput(side, types.Token).Set("clamp")
    if scale != (1.0, 0.0):
        factor, summand = scale
        shader.CreateInput("scale", types.Float4).Set(Gf.Vec4f(factor, factor, factor, 1))
        shader.CreateInput("bias", types.Float4).Set(Gf.Vec4f(summand, summand, summand, 0))
    reader = UsdShade.Shader.Get(stage, READER)
    shader.CreateInput("st", types.Float2).ConnectToSource(reader.ConnectableAPI(), "result")
    channels = CHANNELS[name]
    return shader.CreateOutput(channels, types.Float if channels == "r" else types.Float3)


def _shader(stage: Any, name: str, kind: str) -> Any:
    from pxr import UsdShade

    shader = UsdShade.Shader.Define(stage, f"{ROOT}/material/{name}")
    shader.CreateIdAttr(kind)
    return shader
