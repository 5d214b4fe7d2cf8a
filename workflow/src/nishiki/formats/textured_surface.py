"""Write a textured mesh and a dielectric in formats of scenes, binary glTF 2.0 (Khronos) and PLY with textures.

Light is reflected diffusely by a base under a lobe of Trowbridge and Reitz with alpha = roughness^2. Its reflectance is
F0 along the normal and 1 at grazing light, so that an index of refraction n = (1 + sqrt F0) / (1 - sqrt F0) says it.
Places in a texture: u from the left, v from the top.
"""

import json
import os
import struct
import tempfile
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from nishiki.formats.banded_pictures import png_bytes
from nishiki.formats.mesh_heading import ply_heading
from nishiki.installation import optional

INDEX = 1.5  # of refraction, what a viewer of glTF takes where the file says nothing
NORMAL_REFLECTANCE = ((INDEX - 1) / (INDEX + 1)) ** 2


@dataclass(frozen=True)
class TexturedMesh:
    """Triangles with texture coordinates."""

    positions: np.ndarray  # positions, normals: (n, 3) ndarray: of the vertices, metres and unit vectors
    normals: np.ndarray
    texture: np.ndarray  # (n, 2) ndarray: places in the texture, 0 to 1, from its left and its top
    triangles: np.ndarray  # (t, 3) ndarray: numbers of vertices, counter-clockwise seen from outside


@dataclass(frozen=True)
class SurfaceLook:
    """Textures and constants of one material; rows of textures from the top."""

    colour: np.ndarray  # (rows, columns, 3) uint8 ndarray: colour of the base, sRGB
    roughness: float | np.ndarray  # float or (rows, columns) uint8 ndarray: 0 to 1; of a texture 255 is 1
    reflectance: float  # F0, 0 to below 1; where there are weights, of weight 1
    weight: np.ndarray | None = None  # (rows, columns) uint8 ndarray or None: share of the reflectance, 255 is all
    normals: np.ndarray | None = None  # (rows, columns, 3) uint8 ndarray or None: tangent space, y up, (n + 1) / 2
    # float or (rows, columns) uint8 ndarray: 1 of a metal, of a texture 255: the colour is that of its mirror, and the
    # weight 1
    metallic: float | np.ndarray = 0.0

    @property
    def index(self) -> float:
        """Index of refraction of the reflectance."""
        return index_of(self.reflectance)

    @property
    def mean_index(self) -> float:
        """Index of refraction of the reflectance with the mean of its weights, without metals."""
        if self.weight is None:
            return self.index
        weights = self.weight[self.metallic == 0] if isinstance(self.metallic, np.ndarray) else self.weight
        return index_of(self.reflectance * float(weights.mean()) / 255)

    def pictures(self) -> dict[str, np.ndarray]:
        """Return the existing textures, (rows, columns, 3), by the name of their file without suffix.

        Single values are repeated in three channels: programs read pictures of one channel differently.
        """
        named = {"colour": self.colour, "roughness": self.roughness, "specular": self.weight, "normals": self.normals}
        named["metallic"] = self.metallic
        given = {name: values for name, values in named.items() if isinstance(values, np.ndarray)}
        return {
            name: values if values.ndim == 3 else np.repeat(values[..., None], 3, axis=-1)
            for name, values in given.items()
        }


def index_of(reflectance: float) -> float:
    """Compute the index of refraction of a dielectric with this reflectance along the normal, at most 199."""
    root = min(float(np.sqrt(reflectance)), 0.99)
    return (1 + root) / (1 - root)


FLOAT, UNSIGNED_INT = 5126, 5125
ARRAY, ELEMENTS = 34962, 34963  # what a buffer view is for
_TYPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4"}


@dataclass
class Glb:
    """glTF file under construction: each part is referenced by its number."""

    content: dict[str, list[Any]] = field(default_factory=dict)
    binary: bytearray = field(default_factory=bytearray)
    extensions: set[str] = field(default_factory=set)

    def add(self, kind: str, **values: Any) -> int:
        """Add an object to one of the file's lists (`materials`, `nodes`, ..); return its number."""
        entries = self.content.setdefault(kind, [])
        entries.append({name: value for name, value in values.items() if value is not None})
        return len(entries) - 1

    def view(self, data: bytes, target: int | None = None) -> int:
        """Add a buffer view of these bytes, aligned to four."""
        self.binary += bytes(-len(self.binary) % 4)
        number = self.add("bufferViews", buffer=0, byteOffset=len(self.binary), byteLength=len(data), target=target)
        self.binary += data
        return number

    def vertices(self, values: np.ndarray, *, bounds: bool = False) -> int:
        """Add an accessor of float32 values (n, k) at vertices; bounds: with least and largest, as positions need."""
        values = np.ascontiguousarray(values, "<f4")
        limits = {"min": values.min(axis=0).tolist(), "max": values.max(axis=0).tolist()} if bounds else {}
        return self.add(
            "accessors",
            bufferView=self.view(values.tobytes(), ARRAY),
            componentType=FLOAT,
            count=len(values),
            type=_TYPES[values.shape[1]],
            **limits,
        )

    def corners(self, triangles: np.ndarray) -> int:
        """Add an accessor of the triangles' corners (t, 3)."""
        flat = np.ascontiguousarray(triangles, "<u4").ravel()
        view = self.view(flat.tobytes(), ELEMENTS)
        return self.add("accessors", bufferView=view, componentType=UNSIGNED_INT, count=len(flat), type="SCALAR")

    def add_mesh(self, attributes: Mapping[str, int], triangles: np.ndarray, material: int, *, name: str) -> None:
        """Add a node with a mesh of vertex accessors by their names, triangles (t, 3) and the number of a material."""
        primitive = {"attributes": attributes, "indices": self.corners(triangles), "material": material}
        self.add("nodes", mesh=self.add("meshes", primitives=[primitive]), name=name)

    def texture(self, picture: bytes, *, mime: str) -> int:
        """Add a texture of an encoded picture, not repeated at its edges."""
        return self.texture_of(bufferView=self.view(picture), mimeType=mime)

    def texture_of(self, **image: Any) -> int:
        """Add a texture of an image: a view of this file, or `uri`, a file beside it."""
        if not self.content.get("samplers"):
            self.add("samplers", magFilter=9729, minFilter=9987, wrapS=33071, wrapT=33071)
        return self.add("textures", sampler=0, source=self.add("images", **image))

    def write(self, path: Path, *, generator: str, extras: Mapping[str, Any]) -> None:
        """Write the file; node 0 is the scene."""
        document = {
            "asset": {"version": "2.0", "generator": generator, "extras": dict(extras)},
            "scene": 0,
            "scenes": [{"nodes": [0]}],
            **self.content,
            "buffers": [{"byteLength": len(self.binary)}],
        }
        if self.extensions:
            document["extensionsUsed"] = sorted(self.extensions)
        text = json.dumps(document, separators=(",", ":"), allow_nan=False).encode("utf-8")
        text += b" " * (-len(text) % 4)
        binary = bytes(self.binary) + bytes(-len(self.binary) % 4)
        size = 12 + 8 + len(text) + 8 + len(binary)
        with open(path, "wb") as file:
            file.write(struct.pack("<4sII", b"glTF", 2, size))
            file.write(struct.pack("<I4s", len(text), b"JSON") + text)
            file.write(struct.pack("<I4s", len(binary), b"BIN\0") + binary)


VERTEX = np.dtype([("place", "<f4", 3), ("normal", "<f4", 3), ("texture", "<f4", 2)])


def heading(count: int, triangles: int) -> bytes:
    """Encode the text before the values; count: vertices."""
    names = ("x", "y", "z", "nx", "ny", "nz", "u", "v")
    return ply_heading(count, triangles, [f"float {name}" for name in names]).encode("ascii")


def vertices(places: np.ndarray, normals: np.ndarray, texture: np.ndarray) -> bytes:
    """Encode vertices: places and unit normals (v, 3), texture coordinates (v, 2), 0 to 1."""
    points = np.empty(len(places), VERTEX)
    points["place"], points["normal"], points["texture"] = places, normals, texture
    return points.tobytes()


INPUTS = {
    "colour": ("base_color", "color3"),
    "roughness": ("specular_roughness", "float"),
    "specular": ("specular_weight", "float"),
    "normals": ("geometry_normal", "vector3"),
    "metallic": ("base_metalness", "float"),
}
"""Surface input of each texture, and the type of its values."""


def write_materialx(path: Path, look: SurfaceLook, *, facts: Mapping[str, Any]) -> list[str]:
    """Write the document and its textures; return the files' names relative to the document's folder.

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
"""Date of all files in a package, so that equal results give equal bytes."""
CHANNELS = {"colour": "rgb", "roughness": "r", "normals": "rgb", "metallic": "r"}
"""Textures of the material, with the channels used of each."""


def write_usdz(path: Path, mesh: TexturedMesh, look: SurfaceLook, *, name: str, facts: Mapping[str, Any]) -> None:
    """Write a package: y is up, the unit is the metre. The look's weights are averaged.

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


def sample(texture: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Sample (n, channels) bilinearly at places (n, 2), row and column in texels."""
    from scipy.ndimage import map_coordinates

    look_up = partial(map_coordinates, coordinates=places.T, output=np.float64, order=1, mode="nearest")
    return np.stack([look_up(channel) for channel in np.moveaxis(texture, -1, 0)], axis=1)


def quantise(values: np.ndarray) -> np.ndarray:
    """Quantise values in 0 to 1 to eight bits."""
    return np.rint(255 * np.clip(values, 0, 1)).astype(np.uint8)
