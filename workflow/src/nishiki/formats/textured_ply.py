"""Binary PLY of a mesh with normals and places in a texture, as renderers read it; u from the left, v from the top."""

import numpy as np

VERTEX = np.dtype([("place", "<f4", 3), ("normal", "<f4", 3), ("texture", "<f4", 2)])
FACE = np.dtype([("count", "u1"), ("corner", "<i4", 3)])


def heading(count: int, triangles: int) -> bytes:
    """The text before the values; count: vertices."""
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
