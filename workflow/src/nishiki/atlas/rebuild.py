"""The atlas from what has to be transmitted beside mesh and cameras: a chart for each triangle and a few numbers."""

from __future__ import annotations

import numpy as np

from nishiki.atlas.adjacency import smoothed_vertices
from nishiki.atlas.atlas import Atlas, build_atlas
from nishiki.atlas.charts import directions_of, flatten, frame_along, turning, unit_normals
from nishiki.geometry.camera import Camera
from nishiki.geometry.mesh import Mesh


def rebuild_atlas(
    mesh: Mesh,
    cameras: list[Camera],
    chart: np.ndarray,
    texels_per_unit: np.ndarray,
    *,
    smoothing_rounds: int,
    size: int,
) -> Atlas:
    """The atlas whose charts (f,) and texels_per_unit (charts, 2) are known.

    cameras: those that took part when it was made; smoothing_rounds: as the diagnostics of the stage tell. Equal to
    the original, as the charts' directions, axes and corners follow from the triangles in each chart.
    """
    up, front = turning(cameras)
    vertices = smoothed_vertices(mesh.vertices, mesh.triangles, rounds=smoothing_rounds)
    normals, areas = unit_normals(mesh, vertices)
    frames = frame_along(directions_of(chart, normals, areas), up=up, front=front)
    return build_atlas(flatten(vertices[mesh.triangles], chart, frames), chart, texels_per_unit, size=size)
