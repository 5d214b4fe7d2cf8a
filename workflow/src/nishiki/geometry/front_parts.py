"""Find the edges of parts that occlude the rest of the object, such as a handle in front of its jug.

Views that show such a part against the background bound it. From the front the visual hull is too wide, since no
silhouette ends where the rest of the object is behind the part. But there the photographs show the rest: a line of
sight that enters the hull, leaves it and enters it again meets the part first. The other views predict the values of
both points in this view (I = b . l, see `nishiki.geometry.hollows`). The line passes beside the part where the
photograph agrees with the prediction of the far point, or with that in shadow, and not with that of the near one.
"""

import numpy as np

from nishiki.geometry.hollows import ShadingPhotographs
from nishiki.geometry.hull import SMOOTHING_PX, FrontParts, sight_rays
from nishiki.geometry.mesh import Mesh
from nishiki.geometry.placement import remove_specks
from nishiki.geometry.visibility import RayTree, cast, interpolate, make_tree, rasterise

GAP_PX, FARTHEST_PX = 3.0, 10.0
"""Free space behind a part; cap of distances to its edge."""
ERROR = 0.08
"""Difference from a prediction, as a share of bright values and averaged over 3 x 3 pixels, above which the prediction
is rejected. A single pixel contributes at most twice this value."""


def find_front_parts(mesh: Mesh, photographed: ShadingPhotographs) -> FrontParts:
    """Find the front parts of a hull's surface, and where the photographs show that they end."""
    import cv2

    tree, square, found = make_tree(mesh.vertices, mesh.triangles), np.ones((3, 3), np.uint8), []
    drawn = [rasterise(mesh, camera).depth for camera in photographed.cameras]
    seen = np.stack([cv2.erode(depth, square) for depth in drawn])  # a point next to an occluding edge may be hidden
    for view, camera in enumerate(photographed.cameras):
        rows, columns = np.nonzero(np.isfinite(drawn[view]))
        if not len(rows):
            continue
        rays = sight_rays(np.column_stack([columns, rows]).astype(np.float64), camera)
        pixel = photographed.pixel_at(float(drawn[view][rows, columns].mean()))
        distances, normals = find_crossings(mesh, tree, camera.centre, rays, 0.01 * pixel)
        before = distances[2] - distances[1] > GAP_PX * pixel
        if not before.any():
            continue
        rows, columns = rows[before], columns[before]
        points = camera.centre + distances[:, before, None] * rays[before]
        shown = photographed.pictures[view, rows, columns]
        near, far = (photographed.fit(seen, points[k], normals[k, before], view)[1] for k in (0, 2))
        lit = np.clip((shown * far).sum(axis=1) / np.maximum((far * far).sum(axis=1), 1e-12), 0, 1)
        values = np.zeros((*drawn[view].shape, 4), np.float32)
        # what too few views see is no evidence: the near point is kept, the far one rejected
        for k, (expected, unknown) in enumerate(((near, 0.0), (lit[:, None] * far, 2 * ERROR))):
            error = np.abs(shown - expected).max(axis=1)
            values[rows, columns, k] = np.where(np.isfinite(error), np.minimum(error, 2 * ERROR), unknown)
        values[rows, columns, 2] = points[1:].mean(axis=0) @ camera.rotation[2] + camera.translation[2]
        values[rows, columns, 3] = 1
        near, far, _, share = np.moveaxis(cv2.blur(values, (3, 3)), 2, 0)
        part, behind = values[..., 3] > 0, values[..., 2]
        beside = select_border_regions(part & (near > ERROR * share) & (far < ERROR * share), part)
        if beside.any():
            behind = np.where(part, behind, cv2.dilate(behind, np.ones((5, 5), np.uint8)))
            found.append((camera, edge_distance(beside, part), behind))
    cameras, distances, depths = zip(*found, strict=True) if found else ((), (), ())
    return FrontParts(list(cameras), np.array(distances, np.float32), np.array(depths, np.float32))


def find_crossings(
    mesh: Mesh, tree: RayTree, origin: np.ndarray, rays: np.ndarray, step: float
) -> tuple[np.ndarray, np.ndarray]:
    """Find the first three crossings of rays with a surface: distances (3, n), NaN where none is, normals (3, n, 3)."""
    distances, normals = np.full((3, len(rays)), np.nan), np.zeros((3, len(rays), 3), np.float32)
    going, start = np.arange(len(rays)), np.zeros(len(rays))
    for k in range(3):
        hits = cast(tree, origin + start[going, None] * rays[going], rays[going])
        met = hits.triangle >= 0
        weights = np.column_stack([1 - hits.weights.sum(axis=1), hits.weights[:, 0]]).astype(np.float32)
        facing = interpolate(mesh.normals, mesh.triangles, hits.triangle, weights)
        normals[k, going] = facing / np.maximum(np.linalg.norm(facing, axis=1, keepdims=True), 1e-9)
        going = going[met]
        start[going] += hits.distance[met]
        distances[k, going] = start[going]
        start[going] += step
    return distances, normals


def select_border_regions(beside: np.ndarray, part: np.ndarray) -> np.ndarray:
    """Select the regions beside a part that reach its border, without specks."""
    import cv2

    inner = cv2.erode(part.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    opened = remove_specks(beside)
    _, labels = cv2.connectedComponents(opened.astype(np.uint8))
    return opened & np.isin(labels, labels[opened & ~inner])


def edge_distance(beside: np.ndarray, part: np.ndarray) -> np.ndarray:
    """Compute the distance in pixels to the edge of a part, negative beside it: (rows, columns) float32."""
    import cv2

    def to(mask: np.ndarray) -> np.ndarray:
        return cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE).clip(0, FARTHEST_PX)

    return cv2.GaussianBlur(np.where(beside, 0.5 - to(part & ~beside), to(beside) - 0.5), (0, 0), SMOOTHING_PX)
