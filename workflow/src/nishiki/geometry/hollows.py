"""Sink hollows that no outline shows: regions of a visual hull that the photographs contradict.

Object, camera and lamp: on a turntable the lamp keeps its place beside the camera, so every view of a surface point is
a photograph under another lamp. A matt point shows (Woodham, Photometric method for determining surface orientation
from multiple images, Optical Engineering 19, 1980)

    I_v = b . l_v        b: albedo times normal, l_v: towards the lamp of view v, times (distance / mean distance)^-2

with one b for each channel, whatever its paint. A point of a hull in front of a hollow shows other points of the object
in every view, and no b fits: there most views contradict the fit.

A view's contradiction is its squared error in units of ERROR, at most 1. A region that contradicts by more than half
sinks by depth * profile along the mean of its inward normals, the profile being 0 at the region's border. Regions are
cut at several levels of contradiction; those are taken that lower its sum over all pixels most, each at its best depth.
Topology and outlines stay.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numba import njit

from nishiki.geometry.camera import Camera
from nishiki.geometry.hull import SilhouetteField
from nishiki.geometry.hull_kernels import project_point
from nishiki.geometry.mesh import Mesh
from nishiki.geometry.surface import vertex_adjacency
from nishiki.geometry.turn import scale_camera
from nishiki.geometry.visibility import Raster, interpolate, rasterise
from nishiki.small_matrices import solve_by_cofactors
from nishiki.threads import over_rows

ERROR, DARK = 0.045, 0.25
"""A view contradicts a matt point from this part of the point's values plus DARK of the object's bright values: dark
places are lit by the rest of the object."""
LEVELS = 0.66 * 0.82 ** np.arange(4)
"""Shares of contradiction at which a region may end; steps of a fifth move its border by less than ROUNDS."""
FEWEST_VIEWS = 5  # b has three unknowns
LEAST_COSINE = 0.25  # of a view with the normal
ROUNDS = 8
"""Averages over neighbouring vertices: of contradiction, of a region's outline, and of a finer mesh's shift, since
steps between the coarse mesh's vertices would take five times the triangles. A region is at least what they reach."""
FLATNESS = 0.75  # power of the solution of Poisson's equation that is a hollow's profile


@njit(cache=True, nogil=True, error_model="numpy")
def fit_matt_points(start, stop, views, limits, points, normals, out, predicted):
    """Average over the views that see a point how much they contradict I = b . l (n,), 0 to 1; three rounds of weights.

    views: pictures (v, rows, columns, channels), depth of the farthest surface about each pixel (v, rows, columns),
    poses, lenses, centres (v, 3); limits: mean distance of the cameras, tolerance of the depth, view that is left out
    or -1; points and normals (n, 3). -1 where too few views see a point. predicted (n, channels): of the view left out.
    """
    (pictures, deepest, poses, lenses, centres), (distance, tolerance, left_out) = views, limits
    count, rows, columns, channels = pictures.shape
    shown, towards, light = np.empty((count, channels)), np.empty((count, 3)), np.empty(3)
    weight, error = np.empty(count), np.empty(count)
    sides, b = np.empty((channels, 3)), np.empty((channels, 3))
    for n in range(start, stop):
        seen, scale = 0, 0.0
        for v in range(count):
            if v == left_out:
                continue
            square, facing = 0.0, 0.0
            for k in range(3):
                light[k] = centres[v, k] - points[n, k]
                square += light[k] ** 2
                facing += light[k] * normals[n, k]
            if facing < LEAST_COSINE * np.sqrt(square):
                continue
            column, row, depth = project_point(poses, lenses, v, points[n, 0], points[n, 1], points[n, 2])
            if not (depth > 0 and 1 <= column < columns - 2 and 1 <= row < rows - 2):
                continue
            if depth > deepest[v, int(row + 0.5), int(column + 0.5)] + tolerance:
                continue
            i, j = int(row), int(column)
            s, t = row - i, column - j
            for k in range(channels):
                above = (1 - t) * pictures[v, i, j, k] + t * pictures[v, i, j + 1, k]
                below = (1 - t) * pictures[v, i + 1, j, k] + t * pictures[v, i + 1, j + 1, k]
                shown[seen, k] = (1 - s) * above + s * below
                scale += shown[seen, k] ** 2
            for k in range(3):
                towards[seen, k] = light[k] * distance**2 / square**1.5
            weight[seen] = 1.0
            seen += 1
        out[n] = -1.0
        if seen < FEWEST_VIEWS:
            continue
        scale = (ERROR * (np.sqrt(scale / (seen * channels)) + DARK)) ** 2 * channels
        for _ in range(3):
            xx = xy = xz = yy = yz = zz = 0.0
            sides[:] = 0
            for v in range(seen):
                x, y, z = towards[v, 0], towards[v, 1], towards[v, 2]
                wx, wy, wz = weight[v] * x, weight[v] * y, weight[v] * z
                xx, xy, xz, yy, yz, zz = xx + wx * x, xy + wx * y, xz + wx * z, yy + wy * y, yz + wy * z, zz + wz * z
                for k in range(channels):
                    sides[k, 0] += wx * shown[v, k]
                    sides[k, 1] += wy * shown[v, k]
                    sides[k, 2] += wz * shown[v, k]
            ridge = 1e-3 * (xx + yy + zz) + 1e-300
            matrix = (xx + ridge, xy, xz, yy + ridge, yz, zz + ridge)
            for k in range(channels):
                x, y, z, determinant = solve_by_cofactors(matrix, sides[k, 0], sides[k, 1], sides[k, 2])
                b[k, 0], b[k, 1], b[k, 2] = x / determinant, y / determinant, z / determinant
            total = 0.0
            for v in range(seen):
                error[v] = 0.0
                for k in range(channels):
                    model = b[k, 0] * towards[v, 0] + b[k, 1] * towards[v, 1] + b[k, 2] * towards[v, 2]
                    error[v] += (shown[v, k] - max(model, 0.0)) ** 2 / scale
                weight[v] = 1 / (1 + 4 * error[v])
                total += min(error[v], 1.0)
        out[n] = min(total / max(seen - 3, 1), 1.0)
        if left_out >= 0:
            square = 0.0
            for k in range(3):
                light[k] = centres[left_out, k] - points[n, k]
                square += light[k] ** 2
            for k in range(channels):
                model = (b[k, 0] * light[0] + b[k, 1] * light[1] + b[k, 2] * light[2]) * distance**2 / square**1.5
                predicted[n, k] = max(model, 0.0)


@dataclass(frozen=True)
class ShadingPhotographs:
    """Photographs of an object for `residuals`."""

    # (views, rows, columns, channels) float32, linear, 1 where the object is bright; cameras at that size
    pictures: np.ndarray
    cameras: list[Camera]
    silhouettes: np.ndarray  # (views, rows, columns) bool

    @classmethod
    def of(
        cls, pictures: Iterable[np.ndarray], silhouettes: list[np.ndarray], cameras: list[Camera], *, size_px: float
    ) -> "ShadingPhotographs":
        """Prepare linear pictures (rows, columns, channels), silhouettes (rows, columns) bool, at the cameras' size.

        size_px: root of the silhouette's area to which photographs are shrunk.
        """
        import cv2

        area = np.mean([max(silhouette.sum(), silhouette.size / 16) for silhouette in silhouettes])  # bounds the memory
        small = [scale_camera(camera, 1 / max(1, round(np.sqrt(area) / size_px))) for camera in cameras]
        size = small[0].columns, small[0].rows

        def shrunk(values: np.ndarray) -> np.ndarray:
            return cv2.resize(values.astype(np.float32), size, interpolation=cv2.INTER_AREA)

        def to_three_channels(picture: np.ndarray) -> np.ndarray:
            if picture.shape[2] > 3:
                picture = np.stack([group.mean(axis=2) for group in np.array_split(picture, 3, axis=2)], axis=-1)
            return shrunk(picture).reshape(*size[::-1], -1)

        values = np.stack([to_three_channels(picture) for picture in pictures])
        shown = np.stack([shrunk(silhouette) >= 0.5 for silhouette in silhouettes])
        bright = float(np.percentile(values[shown], 98))
        values /= np.float32(max(bright, 1e-9))
        return cls(values, small, shown)

    @cached_property
    def grown(self) -> list[np.ndarray]:
        """The silhouettes (rows, columns), a pixel wider: uint8, 0 outside."""
        import cv2

        return [cv2.dilate(each.astype(np.uint8), np.ones((3, 3), np.uint8)) for each in self.silhouettes]

    def inside(self, points: np.ndarray) -> bool:
        """Check whether all points (n, 3) project into all silhouettes, or within a pixel of them."""
        for camera, grown in zip(self.cameras, self.grown, strict=True):
            column, row = np.rint(camera.project(points)[0]).astype(int).T
            column, row = column.clip(0, camera.columns - 1), row.clip(0, camera.rows - 1)
            if not grown[row, column].all():
                return False
        return True

    def residuals(self, depths: list[np.ndarray], points: np.ndarray, normals: np.ndarray) -> np.ndarray:
        """Compute the contradiction (n,) of points in the views that see them, 0 to 1; -1 where too few do."""
        import cv2

        shown, square = (np.where(np.isfinite(depth), depth, 0) for depth in depths), np.ones((3, 3), np.uint8)
        return self.fit(np.stack([cv2.dilate(depth, square) for depth in shown]), points, normals)[0]

    def fit(self, seen: np.ndarray, points: np.ndarray, normals: np.ndarray, left_out: int = -1):
        """Return the residuals (n,), and what a view left out of the fit would show (n, channels), NaN if unknown.

        seen (views, rows, columns): depth about each pixel up to which a view sees.
        """
        centres = np.array([camera.centre for camera in self.cameras])
        distance = np.linalg.norm(centres - points.mean(axis=0), axis=1).mean()
        views = self.pictures, seen, *SilhouetteField.geometry_of(self.cameras), centres
        points, normals = (np.ascontiguousarray(values, np.float64) for values in (points, normals))
        out, predicted = np.empty(len(points)), np.full((len(points), self.pictures.shape[-1]), np.nan)
        limits = distance, 2.5 * self.pixel_at(distance), left_out
        over_rows(fit_matt_points, len(points), views, limits, points, normals, out, predicted)
        return out, predicted

    def pixel_at(self, distance: float) -> float:
        """Return the length across the line of sight of a pixel of the first camera at this distance."""
        return distance / np.sqrt(abs(np.linalg.det(self.cameras[0].intrinsics)))


def sink_hollows(mesh: Mesh, coarse: Mesh, photographed: ShadingPhotographs) -> tuple[Mesh, list[dict]]:
    """Sink the hollows of a mesh; return it and the figures of each hollow.

    The figures are vertices, depth, direction, residual before and after.

    coarse: the same surface with vertices in even distances, some ten thousand; regions and depths are sought on it.
    """
    from scipy.spatial import cKDTree

    fronts = [rasterise(coarse, camera) for camera in photographed.cameras]
    regions = contradicted_regions(coarse, fronts, photographed)
    if not regions:
        return mesh, []
    layers = [
        (front, rasterise(coarse, camera, behind=front.depth))
        for front, camera in zip(fronts, photographed.cameras, strict=True)
    ]
    hollows = [Hollow(coarse, region, layers, photographed) for region in regions]
    shift, figures = np.zeros_like(coarse.vertices), []
    for hollow in sorted(hollows, key=lambda hollow: (hollow.after - hollow.before) * hollow.pixels):
        if hollow.depth > 0 and not shift[hollow.region].any():
            shift += hollow.shift(hollow.depth)
            figure = {"vertices": int(hollow.region.sum()), "direction": hollow.direction.tolist()}
            figures.append({**figure, "depth": hollow.depth, "residual": [hollow.before, hollow.after]})
    if not figures:
        return mesh, []
    distance, nearest = cKDTree(coarse.vertices).query(mesh.vertices, k=4)
    weights = 1 / np.maximum(distance, 1e-9 * np.ptp(coarse.vertices))
    shift = np.einsum("nk,nkc->nc", weights / weights.sum(1, keepdims=True), shift[nearest])
    near, moved = neighbourhoods(mesh), shift.any(axis=1, keepdims=True)
    for _ in range(ROUNDS):
        shift = np.where(moved, near @ shift, 0)
    return Mesh.of(mesh.vertices + shift, mesh.triangles), figures


def contradicted_regions(mesh: Mesh, fronts: list[Raster], photographed: ShadingPhotographs) -> list[np.ndarray]:
    """List vertices (v,) bool of all regions, cut at each of LEVELS, that contradict by more than half."""
    values = photographed.residuals([front.depth for front in fronts], mesh.vertices, mesh.normals)
    near, regions = neighbourhoods(mesh), []
    total, count = np.where(values < 0, 0.0, values), (values >= 0).astype(np.float64)
    for _ in range(ROUNDS):
        total, count = near @ total, near @ count
    mean = total / np.maximum(count, 1 / 3)  # no more than that where fewer than a third is seen
    for level in LEVELS:
        for part in list_parts(mean > level, near):
            if part.sum() < 3 * ROUNDS**2:  # vertices within so many steps of one
                break
            region = close_region(part, near)
            if region.sum() >= 3 * ROUNDS**2 and mean[region].mean() > 0.5:
                regions.append(region)
    return regions


def list_parts(vertices: np.ndarray, near) -> list[np.ndarray]:
    """List the connected parts (v,) bool of some vertices, the largest first."""
    from scipy.sparse import diags
    from scipy.sparse.csgraph import connected_components

    among = diags(vertices.astype(np.float64))
    label = connected_components(among @ near @ among, directed=False)[1]
    sizes = np.bincount(label, weights=vertices)
    order = np.argsort(-sizes, kind="stable")
    return [vertices & (label == part) for part in order[: np.count_nonzero(sizes)]]


def neighbourhoods(mesh: Mesh):
    """Make the matrix (v, v), sparse, that averages each vertex and its neighbours."""
    from scipy.sparse import diags_array, eye_array

    joined = vertex_adjacency(mesh) + eye_array(len(mesh.vertices))
    return (diags_array(1 / joined.sum(axis=1)) @ joined).tocsr()


def close_region(region: np.ndarray, near, rim: int = 2) -> np.ndarray:
    """Close small holes and bays of a region, and remove the rim that its patches share with sound surface."""
    for _ in range(ROUNDS):
        region = near @ region > 0
    for _ in range(ROUNDS + rim):
        region = ~(near @ ~region > 0)
    return region


class Hollow:
    """A region (v,) bool of a mesh that may sink, and the depth at which the fewest views contradict.

    layers: the mesh and what lies behind it in each view. Of every third view every third pixel that shows the region
    is judged, for all depths the same.
    """

    def __init__(
        self,
        mesh: Mesh,
        region: np.ndarray,
        layers: list[tuple[Raster, Raster]],
        photographed: ShadingPhotographs,
    ):
        from scipy.sparse import eye
        from scipy.sparse.linalg import spsolve

        self.mesh, self.region, self.photographed = mesh, region, photographed
        inwards = -mesh.normals[region].sum(axis=0).astype(np.float64)
        self.direction = inwards / max(np.linalg.norm(inwards), 1e-12)
        # The root of the solution of Poisson's equation grows with the distance to the border, which makes a cone;
        # FLATNESS makes a bowl of it.
        self.profile = np.zeros(len(region))  # 0 at the border of the region and outside, 1 at its deepest
        inner = (eye(len(region)) - neighbourhoods(mesh)).tocsr()[region][:, region]
        self.profile[region] = np.maximum(spsolve(inner.tocsc(), np.ones(int(region.sum()))), 0)
        self.profile = (self.profile / max(self.profile.max(), 1e-12)) ** FLATNESS
        touched = region[mesh.triangles].any(axis=1)
        self.moving, self.used = np.flatnonzero(touched).astype(np.int32), np.unique(mesh.triangles[touched])
        self.local = np.searchsorted(self.used, mesh.triangles[touched]).astype(np.int32)
        touched, inside = np.append(touched, False), np.append(region[mesh.triangles].all(axis=1), False)
        numbers = np.where(touched, -1, np.arange(len(touched), dtype=np.int32))
        numbers[-1] = -1  # no triangle
        self.depths, self.sampled = [front.depth for front, _ in layers], {}
        for view, (front, back) in enumerate(layers):  # a view that does not show the region cannot look into it
            if (shown := touched[front.triangle]).any():
                self.depths[view] = np.where(shown, np.where(touched[back.triangle], np.inf, back.depth), front.depth)
                at = np.flatnonzero(inside[front.triangle] & (view % 3 == 0))[::3]
                still = numbers[back.triangle.ravel()[at]]
                self.sampled[view] = at, still, back.barycentric.reshape(-1, 2)[at]
        self.pixels, self.depth = sum(len(at) for at, *_ in self.sampled.values()), 0.0
        self.before = self.after = self.residual(0.0) if self.pixels else 0.0
        for factor in 2.0 ** -np.arange(5):
            self.attempt(0.95 * factor * float(np.ptp(mesh.vertices @ self.direction)))
        for step in (0.5, -0.5, 0.25, -0.25):
            self.attempt(2**step * self.depth)

    def shift(self, depth: float) -> np.ndarray:
        """Compute the shift (v, 3) of all vertices at a depth."""
        return depth * self.profile[:, None] * self.direction

    def attempt(self, depth: float) -> None:
        """Keep a depth if fewer views contradict it and it passes no silhouette."""
        deep = self.profile > 0.1
        if depth > 0 and self.photographed.inside((self.mesh.vertices + self.shift(depth))[deep]):
            after = self.residual(depth)
            if after < self.after:
                self.depth, self.after = depth, after

    def residual(self, depth: float) -> float:
        """Average the contradiction over the region's pixels; a point that few views see counts 1."""
        vertices, normals = self.mesh.vertices + self.shift(depth), self.mesh.normals.copy()
        part, depths, drawn = Mesh.of(vertices[self.used], self.local), list(self.depths), []
        normals[self.used] = part.normals
        for view, (at, triangle, weights) in self.sampled.items():
            moved = rasterise(part, self.photographed.cameras[view])
            nearer = (moved.depth < depths[view]).ravel()[at]
            depths[view] = np.minimum(moved.depth, depths[view])
            triangle = np.where(nearer, self.moving[moved.triangle.ravel()[at]], triangle)
            drawn.append((triangle, np.where(nearer[:, None], moved.barycentric.reshape(-1, 2)[at], weights)))
        triangle, weights = (np.concatenate(each) for each in zip(*drawn, strict=True))
        points, normals = (interpolate(each, self.mesh.triangles, triangle, weights) for each in (vertices, normals))
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
        values = self.photographed.residuals(depths, points, normals)
        return float(np.where((values < 0) | (triangle < 0), 1.0, values).mean())
