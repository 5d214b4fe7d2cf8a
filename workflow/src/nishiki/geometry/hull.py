"""The visual hull: the largest body that has the given silhouettes in the given views.

A. Laurentini, The visual hull concept for silhouette-based image understanding, IEEE Trans. PAMI 16(2), 1994. Here as
the zero level of the smallest, over the views, of the signed distances to the silhouettes' outlines, so that the
surface lies between the grid points where the outlines put it.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np

from nishiki.errors import UserError
from nishiki.geometry.camera import Camera
from nishiki.geometry.hull_kernels import MOST_MISSES, cut_slab, fill_slab
from nishiki.geometry.mesh import Mesh
from nishiki.geometry.silhouettes import HALF, inside_of
from nishiki.installation import optional
from nishiki.threads import in_threads

BLOCK = 8  # grid points along a cube that is decided at once where it can be
VIEWS_A_MISS = 30  # views for one that may wrongly see background
BAND = 3.0
"""Cells around the surface within which distances are kept as they are; beyond, only the sign counts."""
SMOOTHING_PX = 0.7
FINER = 3  # steps of a pixel in which the outline of a cover is found
VOTES = 2  # views that must see beside a part to cut it
MARGIN_PX = 3


@dataclass(frozen=True)
class SilhouetteField:
    """Silhouettes of several views as signed distances, laid out as in `nishiki.geometry.hull_kernels`."""

    poses: np.ndarray
    lenses: np.ndarray
    frames: np.ndarray
    buffer: np.ndarray

    @staticmethod
    def geometry_of(cameras: list[Camera]) -> tuple[np.ndarray, np.ndarray]:
        """Return `poses` and `lenses` of cameras."""
        poses = [np.column_stack([camera.rotation, camera.translation]).ravel() for camera in cameras]
        lenses = []
        for camera in cameras:
            k, distortion = camera.intrinsics, [*camera.distortion, *([0.0] * 5)][:5]
            focal_length = float(np.sqrt(abs(k[0, 0] * k[1, 1])))
            lenses.append([k[0, 0], k[0, 1], k[0, 2], k[1, 1], k[1, 2], *distortion, focal_length])
        return np.array(poses), np.array(lenses)


@dataclass(frozen=True)
class FrontParts:
    """Edges of the parts that stand before the rest of the object, in the views that show the rest beside them."""

    cameras: list[Camera]
    distances: np.ndarray  # (views, rows, columns) float32, pixels to the edge, positive on the part
    depths: np.ndarray  # (views, rows, columns) float32, behind the part and before the rest; 0 where there is no part

    def pixels_beside(self) -> dict[str, int]:
        """Count by view the pixels of the hull's front parts that show what is behind them."""
        beside = (self.distances < 0).sum(axis=(1, 2)) if self.cameras else []
        return {camera.name: int(count) for camera, count in zip(self.cameras, beside, strict=True)}


@dataclass(frozen=True)
class Hull:
    """A visual hull."""

    volume: np.ndarray  # (x, y, z) float32, signed distance at the points of a grid, positive inside
    origin: np.ndarray  # (3,) of the grid
    cell: float  # side of a grid cell, world's unit
    box: np.ndarray  # (2, 3) lowest and highest corner

    @cached_property
    def mesh(self) -> Mesh:
        """The surface of the hull."""
        return surface_of(self.volume, self.origin, self.cell)

    def cut(self, parts: FrontParts) -> "Hull":
        """Cut front parts along their edges, as far as `VOTES` views agree."""
        from scipy.ndimage import gaussian_filter

        if len(parts.cameras) < VOTES:
            return self
        (count, rows, columns), volume = parts.distances.shape, self.volume.copy()
        frames = np.array([[view * rows * columns, 0, 0, rows, columns, 1, 0] for view in range(count)])
        field = *SilhouetteField.geometry_of(parts.cameras), frames, parts.distances.ravel()
        cut = partial(cut_slab, field, parts.depths, (tuple(self.origin), self.cell), VOTES, BAND * self.cell)
        list(in_threads(lambda s: cut(s, min(s + BLOCK, len(volume)), volume), range(0, len(volume), BLOCK)))
        changed = np.argwhere(volume < self.volume)
        if not len(changed):
            return self
        box = tuple(slice(max(0, low - 4), high + 5) for low, high in zip(changed.min(0), changed.max(0), strict=True))
        # The cut is rough where the number of agreeing views changes. Smoothing removes threads and thin sheets.
        before, after = self.volume[box], volume[box]
        near = gaussian_filter((after < before).astype(np.float32), 1.0) > 0.01
        volume[box] = np.where(near, np.minimum(before, gaussian_filter(after, 1.0)), before)
        return replace(self, volume=volume)


def signed_distance(silhouette: np.ndarray) -> np.ndarray:
    """Compute the distance in pixels to the outline of a mask, positive inside: (rows, columns) float32.

    The outline of a mask runs between the centres of its pixels and those outside, that of a cover (uint8) where it is
    one half; steps of a pixel are smoothed away (Gaussian, 0.7 pixels) so that slanted outlines come out straight.
    """
    import cv2

    finer = FINER if silhouette.dtype == np.uint8 else 1
    if finer > 1:
        silhouette = cv2.resize(silhouette, None, fx=finer, fy=finer, interpolation=cv2.INTER_LINEAR) > HALF
    inside = np.pad(silhouette.astype(np.uint8), 1, mode="edge")
    within, outside = (cv2.distanceTransform(s, cv2.DIST_L2, cv2.DIST_MASK_PRECISE) for s in (inside, 1 - inside))
    distance = np.where(inside > 0, within - 0.5, 0.5 - outside)[1:-1, 1:-1]
    # A mask without an outline has no nearest pixel: OpenCV answers with a huge number.
    distance = np.clip(distance[finer // 2 :: finer, finer // 2 :: finer] / finer, -1e6, 1e6).astype(np.float32)
    return cv2.GaussianBlur(distance, (0, 0), SMOOTHING_PX)


def field_of(
    silhouettes: Sequence[np.ndarray | None], cameras: list[Camera], *, finest_px: float = 0.0
) -> SilhouetteField:
    """Make distance maps of the views that have a silhouette (None: none known there).

    finest_px: detail that nobody will ask for, pixels; larger pictures are kept at a coarser stride. Raises UserError
    where fewer than two views have one, where one is empty, or where its size is not the camera's.
    """
    placed, frames, maps, start = [], [], [], 0
    for silhouette, camera in zip(silhouettes, cameras, strict=True):
        if silhouette is None:
            continue
        if silhouette.shape != (camera.rows, camera.columns):
            size = f"{camera.rows} x {camera.columns}"
            raise UserError(f"view {camera.name!r}: expected a silhouette of {size} pixels, found {silhouette.shape}")
        mask = inside_of(silhouette)
        area = _area_of(mask, camera)
        stride = max(1, int(finest_px))
        distance = signed_distance((silhouette if finest_px < 1 else mask)[area])[::stride, ::stride]
        touches = mask[0].any() or mask[-1].any() or mask[:, 0].any() or mask[:, -1].any()
        frames.append([start, area[0].start, area[1].start, *distance.shape, stride, int(touches)])
        maps.append(distance.ravel())
        start += distance.size
        placed.append(camera)
    _expect_two(len(placed))
    return SilhouetteField(*SilhouetteField.geometry_of(placed), np.array(frames, np.int64), np.concatenate(maps))


def _expect_two(count: int) -> None:
    if count < 2:
        raise UserError(f"expected silhouettes in two views at least, found {count}; give masks or a background")


def _area_of(silhouette: np.ndarray, camera: Camera) -> tuple[slice, slice]:
    rows, columns = np.flatnonzero(silhouette.any(axis=1)), np.flatnonzero(silhouette.any(axis=0))
    if rows.size == 0:
        raise UserError(
            f"view {camera.name!r}: its silhouette is empty. Remedy: give a mask or a background, or omit the view"
        )
    first, last = (slice(max(0, each[0] - MARGIN_PX), each[-1] + 1 + MARGIN_PX) for each in (rows, columns))
    return first, last


def bounding_box(silhouettes: Sequence[np.ndarray | None], cameras: list[Camera], *, misses: int = 0) -> np.ndarray:
    """Find lowest and highest corner (2, 3) float64 of all points that project into the silhouettes' convex outlines.

    Each edge of a convex outline spans a plane with the camera's centre; the smallest and largest x, y and z within all
    these planes are six linear programs, exact for any cameras, without a first guess. An outline's edge along the
    picture's border bounds nothing. misses: the box also holds what lies outside one view's outline; for more than one,
    the views that bind it most are set aside in turn. Raises UserError where the cameras have no such point in common,
    or no bounded set.
    """
    planes = [_planes(mask, camera) for mask, camera in zip(silhouettes, cameras, strict=True) if mask is not None]
    _expect_two(len(planes))
    middle = np.mean([camera.centre for camera in cameras], axis=0)
    size = max(float(np.linalg.norm(camera.centre - middle)) for camera in cameras) or 1.0
    boxes = [] if misses else [_extent(planes, middle, size)[0]]
    for _ in range(min(misses, len(planes) - 2)):
        freed, failure = [], None
        try:
            binding = _extent(planes, middle, size)[1]
        except UserError:
            binding = range(len(planes))
        for place in binding:
            try:
                freed.append((_extent(planes[:place] + planes[place + 1 :], middle, size)[0], place))
            except UserError as error:
                failure = error
        if failure and not freed:
            raise failure
        boxes += [extent for extent, _ in freed]
        del planes[max(freed, key=lambda item: float(np.prod(item[0][1] - item[0][0])))[1]]
    spans = np.stack(boxes or [_extent(planes, middle, size)[0]])
    return np.array([spans[:, 0].min(axis=0), spans[:, 1].max(axis=0)])


def _extent(planes: list[np.ndarray], middle: np.ndarray, size: float) -> tuple[np.ndarray, list[int]]:
    """Find the extent (2, 3) of the space within all planes, and the places of the views that bind it.

    It stays the same without any one other view. Start: the cameras' middle and the size of their ring.

    The solver's tolerance is absolute: solved again in units of the box that was found, which can be small beside the
    cameras' distance.
    """
    box, binding = _solve_extent(planes, middle, size)
    for _ in range(2):
        half = float((box[1] - box[0]).max()) / 2
        if half > 0.1 * size:
            break
        middle, size = box.mean(axis=0), max(half, 1e-9 * size)
        box, binding = _solve_extent(planes, middle, size)
    return box, binding


def _solve_extent(planes: list[np.ndarray], middle: np.ndarray, size: float) -> tuple[np.ndarray, list[int]]:
    """Solve for extent and binding views, see `_extent`; positions in steps of size from the middle."""
    from scipy.optimize import linprog

    joined, owner = np.concatenate(planes), np.repeat(np.arange(len(planes)), [len(each) for each in planes])
    box, prices = np.empty((2, 3)), np.zeros(len(planes))
    for axis in range(3):
        for end, sign in enumerate((1.0, -1.0)):
            solution = linprog(
                sign * np.eye(3)[axis],
                A_ub=-joined[:, :3],
                b_ub=(joined[:, :3] @ middle + joined[:, 3]) / size,
                bounds=[(None, None)] * 3,
                method="highs",
            )
            if solution.status == 2:
                raise UserError(
                    "the silhouettes have no point of space in common. Remedy: check silhouettes and order of the "
                    "cameras"
                )
            if solution.status != 0:
                raise UserError("the silhouettes do not bound the object: more views from other sides are needed")
            box[end, axis] = middle[axis] + size * solution.x[axis]
            prices += np.bincount(owner, np.abs(solution.ineqlin.marginals))
    return box, np.flatnonzero(prices).tolist()


def _planes(silhouette: np.ndarray, camera: Camera) -> np.ndarray:
    """Compute planes p (n, 4) with p . (x, y, z, 1) >= 0 within the cone of the silhouette's convex outline."""
    import cv2

    _area_of(silhouette, camera)
    rows = np.flatnonzero(silhouette.any(axis=1))
    last = camera.columns - 1 - silhouette[rows, ::-1].argmax(axis=1)
    points = np.concatenate([np.column_stack([each, rows]) for each in (silhouette[rows].argmax(axis=1), last)])
    # Pixels are squares: half a pixel more on every side.
    corners = np.concatenate([points + np.array([a, b]) for a in (-0.5, 0.5) for b in (-0.5, 0.5)])
    outline = cv2.convexHull(corners.astype(np.float32))[:, 0].astype(np.float64)
    edge = np.array([camera.columns - 0.5, camera.rows - 0.5])
    following = np.roll(outline, -1, axis=0)
    on_border = ((outline == following) & ((outline <= -0.5) | (outline >= edge))).any(axis=1)
    rays = _undistort(outline, camera)
    normals = np.cross(rays, np.roll(rays, -1, axis=0))
    inwards = np.sign(normals @ rays.mean(axis=0))[:, None]
    normals = (normals * inwards)[~on_border]
    normals = np.concatenate([normals, [[0.0, 0.0, 1.0]]])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return np.column_stack([normals @ camera.rotation, normals @ camera.translation])


def sight_rays(pixels: np.ndarray, camera: Camera) -> np.ndarray:
    """Compute unit directions (n, 3) in the world of the lines of sight of pixels (n, 2)."""
    directions = _undistort(pixels, camera) @ camera.rotation
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


def _undistort(pixels: np.ndarray, camera: Camera) -> np.ndarray:
    """Compute directions (n, 3) in the camera's frame, third component 1, of pixels (n, 2)."""
    k = camera.intrinsics
    y = (pixels[:, 1] - k[1, 2]) / k[1, 1]
    x = (pixels[:, 0] - k[0, 2] - k[0, 1] * y) / k[0, 0]
    if any(camera.distortion):
        import cv2

        plane = np.column_stack([x, y])[:, None]
        return np.column_stack(
            [cv2.undistortPoints(plane, np.eye(3), np.array(camera.distortion))[:, 0], np.ones(len(x))]
        )
    return np.column_stack([x, y, np.ones(len(x))])


def usual_misses(views: int) -> int:
    """Return how many of so many views may wrongly see background in outlines that photographs show.

    Beside an edge that shades it a place is in shadow for a turn as wide as the angle between lamp and camera: with 6
    degrees in 0.6 of 36 views.
    """
    return min(round(views / VIEWS_A_MISS), MOST_MISSES)


def carve(silhouettes: list[np.ndarray | None], cameras: list[Camera], *, cells: int = 256, misses: int = 0) -> Hull:
    """Carve the visual hull of silhouettes, (rows, columns) bool (inside) or uint8 (cover), or None, one per camera.

    cells: grid cells along the longest side of the `bounding_box`; misses: views (up to 4) that may see background
    where the body is: with 1, no single wrong mask can carve anything away.
    Memory: 4 bytes a grid point, 8 while the surface is extracted. Raises UserError where nothing is left.
    """
    if not 0 <= misses <= MOST_MISSES:
        raise ValueError(f"misses: expected 0 to {MOST_MISSES}, found {misses}")
    masks = [None if each is None else inside_of(each) for each in silhouettes]
    box = bounding_box(masks, cameras, misses=misses)
    cell = float((box[1] - box[0]).max()) / cells
    origin = box[0] - 2.5 * cell
    shape = tuple(int(n) for n in np.ceil((box[1] - box[0]) / cell) + 6)
    middle = box.mean(axis=0)
    depths = [max((camera.rotation @ middle + camera.translation)[2], 1e-12) for camera in cameras]
    focal = [np.sqrt(abs(np.linalg.det(camera.intrinsics))) for camera in cameras]
    cell_px = min(cell * f / depth for f, depth in zip(focal, depths, strict=True))  # in the middle, of all views
    field = field_of(silhouettes, cameras, finest_px=cell_px / 4)
    volume = np.empty(shape, np.float32)
    views = field.poses, field.lenses, field.frames, field.buffer
    fill = partial(fill_slab, views, (tuple(origin), cell, BLOCK), misses, BAND * cell)
    list(in_threads(lambda s: fill(s, min(s + BLOCK, shape[0]), volume), range(0, shape[0], BLOCK)))
    if not (volume > 0).any():
        raise UserError(
            f"nothing is left of the hull on a grid of {cells} cells, since silhouettes contradict each other. Remedy: "
            "check silhouettes and camera matrices, or omit the wrong view"
        )
    return Hull(volume, origin, cell, box)


def surface_of(volume: np.ndarray, origin: np.ndarray, cell: float) -> Mesh:
    """Extract the zero level of volume (x, y, z), positive inside, by marching cubes.

    Lewiner et al., Efficient implementation of marching cubes' cases with topological guarantees, J. Graphics Tools
    8(2), 2003.
    """
    optional("scikit-image")
    from skimage.measure import marching_cubes

    vertices, triangles, _, _ = marching_cubes(volume, 0.0, spacing=(cell,) * 3, gradient_direction="descent")
    a, b, c = (vertices[triangles[:, k]].astype(np.float64) for k in range(3))
    if np.einsum("ij,ij->", a, np.cross(b, c)) < 0:
        triangles = triangles[:, ::-1]
    return Mesh.of(vertices.astype(np.float64) + origin, triangles)
