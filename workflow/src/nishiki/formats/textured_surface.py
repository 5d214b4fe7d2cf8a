"""A textured mesh and a dielectric as formats of scenes know them, binary glTF 2.0 (Khronos) and PLY with textures.

Light is reflected diffusely by a base under a lobe of Trowbridge and Reitz with alpha = roughness^2. Its reflectance is
F0 along the normal and 1 at grazing light, so that an index of refraction n = (1 + sqrt F0) / (1 - sqrt F0) says it.
Places in a texture: u from the left, v from the top.
"""

import json
import struct
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np


@dataclass(frozen=True)
class TexturedMesh:
    """Triangles with places in a texture."""

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
        """Index of refraction of the reflectance with the mean of its weights, those of metals left out."""
        if self.weight is None:
            return self.index
        weights = self.weight[self.metallic == 0] if isinstance(self.metallic, np.ndarray) else self.weight
        return index_of(self.reflectance * float(weights.mean()) / 255)

    def pictures(self) -> dict[str, np.ndarray]:
        """Return the textures that there are, (rows, columns, 3), by the name of their file without suffix.

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
    """Index of refraction of a dielectric with this reflectance along the normal, at most 199."""
    root = min(float(np.sqrt(reflectance)), 0.99)
    return (1 + root) / (1 - root)


FLOAT, UNSIGNED_INT = 5126, 5125
ARRAY, ELEMENTS = 34962, 34963  # what a buffer view is for
_TYPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4"}


@dataclass
class Glb:
    """A glTF file that grows: each part is named by its number."""

    content: dict[str, list[Any]] = field(default_factory=dict)
    binary: bytearray = field(default_factory=bytearray)
    extensions: set[str] = field(default_factory=set)

    def add(self, kind: str, **values: Any) -> int:
        """Add an object to one of the file's lists (`materials`, `nodes`, ..); its number."""
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
        return self._texture(bufferView=self.view(picture), mimeType=mime)

    def texture_beside(self, uri: str) -> int:
        """Add a texture of a picture that is a file beside this one."""
        return self._texture(uri=uri)

    def _texture(self, **image: Any) -> int:
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
FACE = np.dtype([("count", "u1"), ("corner", "<i4", 3)])


def heading(count: int, triangles: int) -> bytes:
    """Encode the text before the values; count: vertices."""
    lines = [
        *("ply", "format binary_little_endian 1.0", f"element vertex {count}"),
        *(f"property float {name}" for name in ("x", "y", "z", "nx", "ny", "nz", "u", "v")),
        *(f"element face {triangles}", "property list uchar int vertex_indices", "end_header"),
    ]
    return ("\n".join(lines) + "\n").encode("ascii")


def vertices(places: np.ndarray, normals: np.ndarray, texture: np.ndarray) -> bytes:
    """Vertices: places and unit normals (v, 3), places in the texture (v, 2), 0 to 1."""
    points = np.empty(len(places), VERTEX)
    points["place"], points["normal"], points["texture"] = places, normals, texture
    return points.tobytes()


def faces(triangles: np.ndarray) -> bytes:
    """Triangles (t, 3), numbers of vertices."""
    corners = np.empty(len(triangles), FACE)
    corners["count"], corners["corner"] = 3, triangles
    return corners.tobytes()
