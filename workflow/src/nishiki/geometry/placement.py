"""Draw the outline of a mesh in a view, and check that a mesh lies where the silhouettes show the object."""

from dataclasses import dataclass
from itertools import permutations, product

import numpy as np

from nishiki.geometry.camera import Camera
from nishiki.geometry.mesh import Mesh, face_vectors
from nishiki.geometry.visibility import rasterise

UNSURE_PX = 2.0
MIDDLE, LEAST_PX = 0.7, 1.5
"""Share of the depth of a part narrower than twice UNSURE_PX and a cell, and pixels, from which its middle begins."""


def outline_of(mesh: Mesh, camera: Camera) -> np.ndarray:
    """Find the pixel centres that the mesh covers: (rows, columns) bool."""
    return rasterise(mesh, camera).triangle >= 0


def agreement(first: np.ndarray, second: np.ndarray) -> float:
    """Compute the intersection over union of two masks; 1 where both are empty."""
    union = int((first | second).sum())
    return int((first & second).sum()) / union if union else 1.0


def shade_from_camera(mesh: Mesh, camera: Camera) -> np.ndarray:
    """Shade the mesh lit from the camera, triangles flat: (rows, columns) uint8, dark grey where there is none."""
    seen = rasterise(mesh, camera).triangle
    faces = face_vectors(mesh.vertices, mesh.triangles)
    faces /= np.maximum(np.linalg.norm(faces, axis=1, keepdims=True), 1e-300)
    middle = mesh.vertices[mesh.triangles].mean(axis=1)
    ray = camera.centre - middle
    ray /= np.maximum(np.linalg.norm(ray, axis=1, keepdims=True), 1e-300)
    light = np.clip(np.einsum("ij,ij->i", faces, ray), 0, 1)
    return np.where(seen >= 0, 30 + 225 * np.sqrt(light[seen]), 20).astype(np.uint8)


def find_overruled(loose: Mesh, camera: Camera, mask: np.ndarray, unsure: np.ndarray, cell: float) -> np.ndarray:
    """Find the background of a view's mask that is the object by the other views, (rows, columns) bool.

    loose: hull that forgives some views, with grid cells of side `cell` (world's unit), which holds the object whatever
    single masks (rows, columns) bool say; unsure (rows, columns) bool: pixels that may be object, dark ones and small
    parts. Where background lies deeper within the hull's outline than the grid and the outline are unsure, or is unsure
    in the middle of a part too thin for that, all of it up to the outline counts: a shadow that the object casts on
    itself is as black as a dark background. So does an unsure gap across a thin part of the mask.
    """
    import cv2

    # bridges gaps between dark pixels and small parts
    unsure = cv2.dilate(unsure.astype(np.uint8), _disc(int(UNSURE_PX))) > 0
    covered = outline_of(loose, camera)
    depth = float(np.median(camera.project(loose.vertices)[1]))
    cell_px = cell * float(np.sqrt(abs(np.linalg.det(camera.intrinsics)))) / max(depth, 1e-300)
    reach = int(np.ceil(UNSURE_PX + cell_px))
    solid, lost, rim = mask.astype(np.uint8), (covered & ~mask).astype(np.uint8), 2 * reach + 1
    depths = cv2.distanceTransform(covered.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    middle = np.maximum(MIDDLE * cv2.dilate(depths, _disc(reach)), LEAST_PX)
    deep = ((depths > reach) | ((depths > middle) & unsure)).astype(np.uint8) & lost
    closed = cv2.morphologyEx(np.pad(solid, rim), cv2.MORPH_CLOSE, _disc(2 * reach))[rim:-rim, rim:-rim]
    return ((cv2.dilate(deep, _disc(reach + 1)) | (closed & unsure)) & lost) > 0


def remove_specks(mask: np.ndarray) -> np.ndarray:
    """Remove the pixels of a mask (rows, columns) bool that no square of 2 x 2 pixels within it covers."""
    import cv2

    square = np.ones((2, 2), np.uint8)
    # OpenCV's opening takes the same anchor twice, which moves all by a pixel where the square's side is even.
    return cv2.dilate(cv2.erode(mask.astype(np.uint8), square), square, anchor=(0, 0)) > 0


def _disc(radius: int) -> np.ndarray:
    import cv2

    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))


SCALES = (1.0, 1000.0, 100.0, 10.0, 0.1, 0.01, 0.001, 25.4, 1 / 25.4, 12.0, 1 / 12, 304.8, 1 / 304.8)
"""Scales between millimetres, centimetres, metres, inches and feet."""
Triple = tuple[int, int, int]
USUAL_AXES: tuple[tuple[Triple, Triple], ...] = (
    ((0, 1, 2), (1, 1, 1)),
    ((0, 2, 1), (1, -1, 1)),
    ((0, 2, 1), (1, 1, -1)),
)
"""Axes as they lie, y up to z up, and z up to y up: x, -z, y and x, z, -y."""
AXES = USUAL_AXES + tuple(
    axes
    for axes in product(permutations((0, 1, 2), 3), product((1, -1), (1, -1), (1, -1)))
    if axes not in USUAL_AXES and np.linalg.det(np.eye(3)[list(axes[0])] * np.array(axes[1])[:, None]) > 0
)
"""The 24 turns of a cube: new axis k is `signs[k]` times the mesh's axis `order[k]`."""
SIDE, POINTS = 96, 4000  # pixels and points of the surface with which readings are compared
MOST_VIEWS = 6  # compared with each trial
SAME_EXTENT = 0.6  # of the larger of two extents that both have in common, else their overlap is 0
EQUAL = 0.01  # overlaps that differ by less are equal


@dataclass(frozen=True)
class MeshPlacement:
    """The fit of a mesh to silhouettes."""

    overlap: float  # mean intersection over union of the mesh's outline and the silhouettes, as it lies
    scale: float  # scale, order, signs: of the reading that overlaps most, see `move_mesh`
    order: Triple
    signs: Triple
    best: float  # its overlap


def move_mesh(
    vertices: np.ndarray, triangles: np.ndarray, scale: float, order: Triple, signs: Triple
) -> tuple[np.ndarray, np.ndarray]:
    """Multiply a mesh by `scale`, and take its axis k from `order[k]` with the sign `signs[k]`.

    Vertices (v, 3), triangles (f, 3); where the axes mirror it, triangles are turned so that they face outwards again.
    """
    mirrored = np.linalg.det(np.eye(3)[list(order)] * np.array(signs)[:, None]) < 0
    moved = scale * vertices[:, list(order)] * np.array(signs, np.float64)
    return moved, triangles[:, ::-1] if mirrored else triangles


def measure_placement(
    mesh: Mesh, silhouettes: list[np.ndarray], cameras: list[Camera], *, enough: float = 0.9
) -> MeshPlacement:
    """Compare a mesh with silhouettes (rows, columns) bool in the cameras' pictures.

    Where they overlap by less than `enough`, other units and axes are tried too.
    """
    chosen = np.unique(np.linspace(0, len(cameras) - 1, min(MOST_VIEWS, len(cameras))).round().astype(int))
    views = [shrink(silhouettes[i], cameras[i], SIDE) for i in chosen]

    def overlap(reading: tuple) -> float:
        moved = Mesh.of(*move_mesh(mesh.vertices, mesh.triangles, *reading))
        return float(np.mean([agreement(outline_of(moved, camera), mask) for mask, camera in views]))

    stated = 1.0, AXES[0][0], AXES[0][1]
    found = overlap(stated)
    if found >= enough:
        return MeshPlacement(found, *stated, found)
    # points spread evenly over the surface, always the same
    rng, scores = np.random.default_rng(0), {}
    areas = np.linalg.norm(face_vectors(mesh.vertices, mesh.triangles), axis=1)
    corners = mesh.vertices[mesh.triangles[rng.choice(len(areas), POINTS, p=areas / areas.sum())]]
    u, v = np.sqrt(rng.random(POINTS)), rng.random(POINTS)
    points = np.einsum("nk,nkc->nc", np.stack([1 - u, u * (1 - v), u * v], axis=1), corners)
    for scale, axes in product(SCALES, AXES):
        moved, _ = move_mesh(points, mesh.triangles, scale, *axes)
        scores[scale, *axes] = total = 0.0
        for number, (mask, camera) in enumerate(views):
            total += _splat_overlap(moved, mask, camera)
            if total == 0:  # the first view excludes nearly all readings
                break
            scores[scale, *axes] = total / (number + 1)
    # of a round object several turns fit: the most usual one
    best = next(key for key, score in scores.items() if score >= max(scores.values()) - EQUAL)
    return MeshPlacement(found, *best, overlap(best))


def shrink(mask: np.ndarray, camera: Camera, side: int) -> tuple[np.ndarray, Camera]:
    """Reduce a silhouette and its camera to a picture of at most `side` pixels on its longer side."""
    import cv2

    factor = side / max(mask.shape)
    if factor >= 1:
        return mask, camera
    rows, columns = (max(2, round(size * factor)) for size in mask.shape)
    small = cv2.resize(mask.astype(np.uint8) * np.uint8(255), (columns, rows), interpolation=cv2.INTER_AREA) > 127
    return small, camera.resize(rows, columns)


def _splat_overlap(points: np.ndarray, mask: np.ndarray, camera: Camera) -> float:
    """Compute the intersection over union of a silhouette and the closed picture of points.

    It is 0 where the two differ much in place or size.
    """
    import cv2

    pixels, depth = camera.project(points)
    shown = np.argwhere(mask)[:, ::-1]
    if (depth <= 0).any() or not len(shown):
        return 0.0
    ours, theirs = ((np.min(each, axis=0), np.max(each, axis=0) + 1) for each in (pixels, shown))
    common = np.maximum(np.minimum(ours[1], theirs[1]) - np.maximum(ours[0], theirs[0]), 0)
    if (common < SAME_EXTENT * np.maximum(ours[1] - ours[0], theirs[1] - theirs[0])).any():
        return 0.0
    at = np.round(pixels).astype(int)
    at = at[((at >= 0) & (at < mask.shape[::-1])).all(axis=1)]
    drawn = np.zeros(mask.shape, np.uint8)
    drawn[at[:, 1], at[:, 0]] = 1
    return agreement(cv2.morphologyEx(drawn, cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8)) > 0, mask)
