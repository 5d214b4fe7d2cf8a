"""Whether the given mesh of a turntable can be read and lies where its views show the object."""

from __future__ import annotations

import numpy as np

from nishiki.capture.turntable import TurntableCapture
from nishiki.capture.turntable_rules import Turntable
from nishiki.errors import UserError
from nishiki.formats.problems import Problem, error, warning
from nishiki.geometry.camera import Camera
from nishiki.geometry.mesh import Mesh, face_vectors, read_triangles
from nishiki.geometry.placement import Placement, measure_placement, move_mesh
from nishiki.packages import installed

SOUND, LEAST = 0.9, 0.5  # overlap of sound meshes: .985 and more; the stage mesh keeps none below .5
EXPLAINED = 0.8  # overlap from which another unit or other axes explain why the mesh does not fit
AXES = "xyz"


def mesh_problems(
    capture: TurntableCapture,
    silhouettes: list[np.ndarray],
    cameras: list[Camera],
    mirror: tuple[int, ...] | None,
    *,
    sure: bool,
) -> list[Problem]:
    """Read the mesh and compare it with silhouettes (rows, columns) bool, one a camera (of pictures of that size).

    mirror: factors on the world's axes that the cameras' matrices need, see `geometry.matrices`; sure: whether the
    silhouettes are given, not found in the photographs.
    """
    block = capture.settings.turntable
    if capture.mesh is None or not installed("trimesh"):
        return []
    try:
        vertices, triangles = move_mesh(*read_triangles(capture.mesh), *block.mesh_placement)
        if not face_vectors(vertices, triangles).any():
            raise UserError("its triangles have no area. Remedy: export the mesh again")
    except UserError as e:
        return [error("mesh-unreadable", block.mesh, str(e).removeprefix(f"{capture.mesh}: "))]
    world = np.array(mirror or (1, 1, 1), np.float64)
    mesh = Mesh.of(vertices * world, triangles[:, ::-1] if mirror else triangles)
    found = measure_placement(mesh, silhouettes, cameras, enough=SOUND)
    if found.overlap >= SOUND:
        return []
    what = "the mesh does not lie where the photographs show the object"
    expected = f"an overlap with the silhouettes of {SOUND:g} and more"
    facts = f"{found.overlap:.2f}"
    if found.best >= EXPLAINED and found.best > found.overlap + 0.1:
        facts += f"; {found.best:.2f} in another unit or with other axes"
        return [
            error(
                "mesh-placement", block.mesh, what, expected=expected, found=facts, remedy=_remedy(block, found, world)
            )
        ]
    remedy = "Check that mesh and cameras are of one world, unit and origin, and that the silhouettes show the object"
    kind = error if sure and found.overlap < LEAST else warning
    return [kind("mesh-placement", block.mesh, what, expected=expected, found=facts, remedy=remedy)]


def _remedy(block: Turntable, found: Placement, world: np.ndarray) -> str:
    """The keys that bring the mesh there, on top of those that are given already; world: factors on its axes."""
    scale, order, signs = block.mesh_placement
    old = list(found.order)
    signs = np.array(signs)[old] * found.signs * world * world[old]
    turns = zip(signs, (order[i] for i in old), strict=True)
    axes = ",".join(f"{'-' if sign < 0 else ''}{AXES[axis]}" for sign, axis in turns)
    keys = [f"mesh_scale: {scale * found.scale:.6g}"] if found.scale != 1 else []
    keys += [f"mesh_axes: '{axes}'"] if axes != block.mesh_axes else []
    return f"Set {' and '.join(keys)} under turntable in capture.yaml and seal a copy"
