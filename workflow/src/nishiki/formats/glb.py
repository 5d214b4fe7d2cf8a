"""Binary glTF 2.0 (Khronos): a mesh with one material and its textures in one file."""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

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
        """A buffer view of these bytes, aligned to four."""
        self.binary += bytes(-len(self.binary) % 4)
        number = self.add("bufferViews", buffer=0, byteOffset=len(self.binary), byteLength=len(data), target=target)
        self.binary += data
        return number

    def vertices(self, values: np.ndarray, *, bounds: bool = False) -> int:
        """An accessor of float32 values (n, k) at vertices; bounds: with least and largest, as positions need."""
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
        """An accessor of the triangles' corners (t, 3)."""
        flat = np.ascontiguousarray(triangles, "<u4").ravel()
        view = self.view(flat.tobytes(), ELEMENTS)
        return self.add("accessors", bufferView=view, componentType=UNSIGNED_INT, count=len(flat), type="SCALAR")

    def add_mesh(self, attributes: Mapping[str, int], triangles: np.ndarray, material: int, *, name: str) -> None:
        """Add a node with a mesh of vertex accessors by their names, triangles (t, 3) and the number of a material."""
        primitive = {"attributes": attributes, "indices": self.corners(triangles), "material": material}
        self.add("nodes", mesh=self.add("meshes", primitives=[primitive]), name=name)

    def texture(self, picture: bytes, *, mime: str) -> int:
        """A texture of an encoded picture, not repeated at its edges."""
        return self._texture(bufferView=self.view(picture), mimeType=mime)

    def texture_beside(self, uri: str) -> int:
        """A texture of a picture that is a file beside this one."""
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
