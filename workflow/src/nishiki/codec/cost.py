"""Bytes of everything that a renderer needs, each of a form that can be read back."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from nishiki.codec.compact_mesh import CompactMesh, encode_mesh, mesh_step, shift
from nishiki.codec.compact_parts import chart_bytes, lamp_bytes, pack_cameras
from nishiki.geometry.mesh import Mesh


@dataclass(frozen=True)
class Cost:
    """parts: bytes by what they hold; mesh: as it was coded, vertex_shift_px: how far that moves a vertex, at most."""

    parts: dict[str, int]
    mesh: CompactMesh
    vertex_shift_px: float

    @property
    def total(self) -> int:
        """All bytes."""
        return sum(self.parts.values())


def cost_of(mesh: Mesh, chart: np.ndarray, cameras: list, lighting: dict, residual: dict[str, int]) -> Cost:
    """chart (f,): of the atlas; lighting: as plain data; residual: its bytes by part, parameters included (a "total"
    among them is left out)."""
    coded = encode_mesh(mesh, step=mesh_step(mesh, cameras))
    used = np.unique(mesh.triangles)
    moved = shift(mesh.vertices[used], coded.restored(mesh).vertices[used], cameras)
    parts = {f"residual_{name}": int(size) for name, size in residual.items() if name != "total"}
    parts |= {
        "mesh": len(coded.data),
        "charts": chart_bytes(chart, coded.order),
        "cameras": len(pack_cameras(cameras)),
        "lamps": lamp_bytes(lighting),
    }
    return Cost(parts, coded, moved)
