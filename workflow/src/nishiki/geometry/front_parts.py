"""Find the edges of parts that occlude the rest of the object, such as a handle in front of its jug.

Views that show such a part against the background bound it. From the front the visual hull is too wide, since no
silhouette ends where the rest of the object is behind the part. But there the photographs show the rest: a line of
sight that enters the hull, leaves it and enters it again meets the part first. The other views predict the values of
both points in this view (I = b . l, see `nishiki.geometry.hollows`). The line passes beside the part where the
photograph agrees with the prediction of the far point, or with that in shadow, and not with that of the near one.
"""

import numpy as np

from nishiki.geometry.camera import Camera
from nishiki.geometry.hollows import ShadingPhotographs
from nishiki.geometry.hull import SMOOTHING_PX, FrontParts
from nishiki.geometry.mesh import Mesh
from nishiki.geometry.placement import remove_specks
from nishiki.geometry.visibility import interpolate, rasterise

GAP_PX, FARTHEST_PX = 3.0, 10.0
"""Free space behind a part; cap of distances to its edge."""
ERROR = 0.08
"""Difference from a prediction, as a share of bright values and averaged over 3 x 3 pixels, above which the prediction
is rejected. A single pixel contributes at most twice this value."""


def find_front_parts(mesh: Mesh, photographed: ShadingPhotographs) -> FrontParts:
    """Find the front parts of a hull's surface, and where the photographs show that they end."""
    import cv2

    square, found = np.ones((3, 3), np.uint8), []
    crossings = [find_crossings(mesh, camera, photographed) for camera in photographed.cameras]
    seen = np.stack([cv2.erode(depth, square) for depth, *_ in crossings])  # next to an edge a point may be hidden
    for view, (camera, (_, part, free, points, normals)) in enumerate(
        zip(photographed.cameras, crossings, strict=True)
    ):
        if not part.any():
            continue
        shown = photographed.pictures[view][part]
        near, far = (photographed.fit(seen, points[k], normals[k], view)[1] for k in (0, 1))
        lit = np.clip((shown * far).sum(axis=1) / np.maximum((far * far).sum(axis=1), 1e-12), 0, 1)
        values = np.zeros((*part.shape, 4), np.float32)
        # what too few views see is no evidence: the near point is kept, the far one rejected
        for k, (expected, unknown) in enumerate(((near, 0.0), (lit[:, None] * far, 2 * ERROR))):
            error = np.abs(shown - expected).max(axis=1)
            values[part, k] = np.where(np.isfinite(error), np.minimum(error, 2 * ERROR), unknown)
        values[part, 2] = free
        values[part, 3] = 1
        near, far, _, share = np.moveaxis(cv2.blur(values, (3, 3)), 2, 0)
        beside = select_border_regions(part & (near > ERROR * share) & (far < ERROR * share), part)
        if beside.any():
            behind = np.where(part, values[..., 2], cv2.dilate(values[..., 2], np.ones((5, 5), np.uint8)))
            found.append((camera, edge_distance(beside, part), behind))
    cameras, distances, depths = zip(*found, strict=True) if found else ((), (), ())
    return FrontParts(list(cameras), np.array(distances, np.float32), np.array(depths, np.float32))


def find_crossings(mesh: Mesh, camera: Camera, photographed: ShadingPhotographs) -> tuple[np.ndarray, ...]:
    """Find the lines of sight that enter a surface, leave it, and enter it again more than GAP_PX behind.

    Return the depth of the surface and the pixels of such lines, bool (rows, columns); of each line the depth (n,) in
    the middle of the free space, and the two points (2, n, 3) where it enters, with their normals (2, n, 3).
    """
    layers = [rasterise(mesh, camera)]
    depths = layers[0].depth[layers[0].triangle >= 0]
    pixel = photographed.pixel_at(float(depths.sum()) / max(1, len(depths)))
    for _ in range(2):
        layers.append(rasterise(mesh, camera, behind=layers[-1].depth + np.float32(0.01 * pixel)))
    part = layers[2].triangle >= 0

    def at_layers(values: np.ndarray) -> np.ndarray:
        return np.stack(
            [interpolate(values, mesh.triangles, each.triangle[part], each.barycentric[part]) for each in layers]
        )

    part[part] = np.linalg.norm(np.diff(at_layers(mesh.vertices)[1:], axis=0)[0], axis=1) > GAP_PX * pixel
    points, normals = at_layers(mesh.vertices)[::2], at_layers(mesh.normals)[::2]
    normals /= np.maximum(np.linalg.norm(normals, axis=2, keepdims=True), 1e-9)
    return layers[0].depth, part, (layers[1].depth[part] + layers[2].depth[part]) / 2, points, normals


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
