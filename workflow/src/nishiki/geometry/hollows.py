"""Sink hollows that no outline shows: regions of a visual hull that the photographs contradict.

Object, camera and lamp: on a turntable the lamp keeps its place beside the camera, so every view of a surface point is
a photograph under another lamp. A matt point shows (Woodham, Photometric method for determining surface orientation
from multiple images, Optical Engineering 19, 1980)

    I_v = b . l_v        b: albedo times normal, l_v: towards the lamp of view v, times (distance / mean distance)^-2

with one b for each channel, whatever its paint. A point of a hull in front of a hollow shows other points of the object
in every view, and no b fits: there the robust residual of the fit is many times that of the rest.

A contradicted region sinks by depth * profile along the mean of its inward normals, the profile being 0 at the region's
border. The depth with the smallest residual over the pixels of the region is kept. Topology and outlines stay.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numba import njit

from nishiki.geometry.camera import Camera
from nishiki.geometry.hull import SilhouetteField
from nishiki.geometry.hull_kernels import project_point
from nishiki.geometry.mesh import Mesh
from nishiki.geometry.surface import vertex_adjacency
from nishiki.geometry.turn import scale_camera
from nishiki.geometry.visibility import interpolate, rasterise
from nishiki.small_matrices import solve_by_cofactors
from nishiki.threads import over_rows

RELATIVE_ERROR, ERROR = 0.02, 0.005
"""Deviation of a matt point from the model: part of its value, and of the object's bright values."""
LARGEST = 16.0
"""Cap of a view's squared residual, in squared deviations; also used for points seen in too few views."""
CONTRADICTED, OF_LOWER_TENTH = 7.0, 4.0
"""Residual above which a place is contradicted, also in tenth percentiles of the whole surface: the mouth of a
dish is three quarters of all that is seen, and raises the median."""
ROUNDS = 12
"""Averages over neighbouring vertices: of the residual before it is judged, and of a finer mesh's shift, since steps
between the coarse mesh's vertices would take five times the triangles."""
SMALLEST_REGION = 0.015
"""Share of all vertices below which a region stays: shadows contradict small places too."""
IMPROVEMENT = 0.7
"""Ratio of a region's residual to that before, above which the region stays as it was."""
FEWEST_VIEWS = 5
LEAST_COSINE = 0.25  # of a view with the normal
WIDTHS = (1.0, 0.7)
"""Parts of the limit above which neighbours of a contradicted place are tried as part of its region: towards its rim a
hollow is shallow, and there the residual falls."""
FLATNESS = 0.75  # power of the solution of Poisson's equation that is a hollow's profile
DEPTHS = np.geomspace(0.05, 0.94, 12)
"""Depths as parts of the object's extent along the direction."""


@njit(cache=True, nogil=True, error_model="numpy")
def fit_matt_points(start, stop, views, limits, points, normals, out, predicted):
    """Average the robust squared residual (n,) of I = b . l over the views that see a point; three rounds of weights.

    views: pictures (v, rows, columns, channels), depth of the farthest surface about each pixel (v, rows, columns),
    poses, lenses, centres (v, 3); limits: mean distance of the cameras, tolerance of the depth, view that is left out
    or -1; points and normals (n, 3). -1 where too few views see a point. predicted (n, channels): of the view left out.
    """
    (pictures, deepest, poses, lenses, centres), (distance, tolerance, left_out) = views, limits
    count, rows, columns, channels = pictures.shape
    shown, towards, light = np.empty((count, channels)), np.empty((count, 3)), np.empty(3)
    variance, weight, error = np.empty(count), np.empty(count), np.empty(count)
    sides, b = np.empty((channels, 3)), np.empty((channels, 3))
    for n in range(start, stop):
        seen = 0
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
            s, t, mean = row - i, column - j, 0.0
            for k in range(channels):
                above = (1 - t) * pictures[v, i, j, k] + t * pictures[v, i, j + 1, k]
                below = (1 - t) * pictures[v, i + 1, j, k] + t * pictures[v, i + 1, j + 1, k]
                shown[seen, k] = (1 - s) * above + s * below
                mean += shown[seen, k] / channels
            for k in range(3):
                towards[seen, k] = light[k] * distance**2 / square**1.5
            variance[seen] = (RELATIVE_ERROR * mean) ** 2 + ERROR**2
            weight[seen] = 1 / variance[seen]
            seen += 1
        out[n] = -1.0
        if seen < FEWEST_VIEWS:
            continue
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
                    error[v] += (shown[v, k] - max(model, 0.0)) ** 2 / (channels * variance[v])
                weight[v] = 1 / (variance[v] * (1 + error[v] / 4))
                total += min(error[v], LARGEST)
        out[n] = min(total / max(seen - 3, 1), LARGEST)
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
        """Compute the mean robust squared residual (n,) of points in the views that see them; -1 where too few do."""
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

    start, figures = coarse.vertices, []
    for regions in contradicted_regions(coarse, photographed):
        coarse, figure = sink(coarse, regions, photographed)
        figures += figure
    if not figures:
        return mesh, []
    distance, nearest = cKDTree(start).query(mesh.vertices, k=4)
    weights = 1 / np.maximum(distance, 1e-9 * np.ptp(start))
    shift = np.einsum("nk,nkc->nc", weights / weights.sum(1, keepdims=True), (coarse.vertices - start)[nearest])
    near, moved = neighbourhoods(mesh), shift.any(axis=1, keepdims=True)
    for _ in range(ROUNDS):
        shift = np.where(moved, near @ shift, 0)
    return Mesh.of(mesh.vertices + shift, mesh.triangles), figures


def contradicted_regions(mesh: Mesh, photographed: ShadingPhotographs) -> list[list[np.ndarray]]:
    """List vertices (v,) bool of each large region where no matt point fits the photographs, the largest first.

    Each as several candidates, one for each of WIDTHS, the narrowest first.
    """
    depths = [rasterise(mesh, camera).depth for camera in photographed.cameras]
    values = photographed.residuals(depths, mesh.vertices, mesh.normals)
    seen = values >= 0
    if not seen.any():
        return []
    near = neighbourhoods(mesh)
    total, count = np.where(seen, values, 0.0), seen.astype(np.float64)
    for _ in range(ROUNDS):
        total, count = near @ total, near @ count
    mean = np.where(count > 0.3, total / np.maximum(count, 1e-12), 0.0)
    limit = max(CONTRADICTED, OF_LOWER_TENTH * float(np.percentile(values[seen], 10)))
    parts = list_parts(mean > limit, near)
    large = [part for part in parts if part.sum() >= SMALLEST_REGION * len(mesh.vertices)]
    wider = [list_parts(mean > width * limit, near) for width in WIDTHS]
    return [[close_region(part, near) for among in wider for part in among if part[np.argmax(core)]] for core in large]


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


def close_region(region: np.ndarray, near, rounds: int = 6, rim: int = 2) -> np.ndarray:
    """Close small holes and bays of a region, and remove the rim that its patches share with sound surface."""
    for _ in range(rounds):
        region = near @ region > 0
    for _ in range(rounds + rim):
        region = ~(near @ ~region > 0)
    return region


@dataclass(frozen=True)
class Hollow:
    """A region (v,) bool that may be sunk, its depth profile (v,), and the unit vector along which it sinks.

    The profile is 0 at the border of the region and outside, 1 at its deepest.
    """

    region: np.ndarray
    profile: np.ndarray
    direction: np.ndarray

    @classmethod
    def of(cls, mesh: Mesh, region: np.ndarray) -> "Hollow":
        """Make a hollow that sinks along the mean of the region's inward normals."""
        from scipy.sparse import eye
        from scipy.sparse.linalg import spsolve

        direction = -mesh.normals[region].sum(axis=0).astype(np.float64)
        # The root of the solution of Poisson's equation grows with the distance to the border, which makes a cone;
        # FLATNESS makes a bowl of it.
        profile = np.zeros(len(region))
        inner = (eye(len(region)) - neighbourhoods(mesh)).tocsr()[region][:, region]
        profile[region] = np.maximum(spsolve(inner.tocsc(), np.ones(int(region.sum()))), 0)
        profile = (profile / max(profile.max(), 1e-12)) ** FLATNESS
        return cls(region, profile, direction / max(np.linalg.norm(direction), 1e-12))

    def sunk(self, mesh: Mesh, part: float) -> Mesh:
        """Sink a mesh by a part of its extent along the direction, times the profile."""
        shift = (part * np.ptp(mesh.vertices @ self.direction) * self.profile)[:, None] * self.direction
        return Mesh.of(mesh.vertices + shift, mesh.triangles)


def sink(mesh: Mesh, regions: list[np.ndarray], photographed: ShadingPhotographs) -> tuple[Mesh, list[dict]]:
    """Sink the candidate region that lowers the residual most, as deep as the photographs support.

    Return the mesh and its figures; no figures where nothing is gained.
    """
    seen = Shown(mesh, np.any(regions, axis=0), photographed)
    core, widest = (seen.pixels_of(regions[k]) for k in (0, -1))

    def judge(hollow: Hollow, part: float) -> float:
        sunk = hollow.sunk(mesh, part)
        fits = photographed.inside(sunk.vertices[hollow.region & (hollow.profile > 0.1)])
        return seen.residual(sunk, widest) if fits else np.inf

    trials = [(hollow, part) for region in regions for hollow in (Hollow.of(mesh, region),) for part in DEPTHS]
    residuals = [judge(*trial) for trial in trials]
    hollow, part = trials[int(np.argmin(residuals))]
    if not np.isfinite(min(residuals)):  # every depth passes a silhouette
        return mesh, []
    result = hollow.sunk(mesh, part)
    before, after = (seen.residual(each, core) for each in (mesh, result))
    if not after < IMPROVEMENT * before:
        return mesh, []
    depth = float(part * np.ptp(mesh.vertices @ hollow.direction))
    figure = {"vertices": int(hollow.region.sum()), "direction": hollow.direction.tolist(), "depth": depth}
    return result, [{**figure, "residual": [before, after]}]


class Shown:
    """A mesh drawn in all views while only a region (v,) bool of it moves; the rest is drawn once.

    Every third view also keeps the triangle and the weights at each pixel.
    """

    def __init__(self, mesh: Mesh, region: np.ndarray, photographed: ShadingPhotographs):
        self.photographed, self.triangles = photographed, mesh.triangles
        touched = region[mesh.triangles].any(axis=1)
        self.moving, self.used = np.flatnonzero(touched).astype(np.int32), np.unique(mesh.triangles[touched])
        self.local = np.searchsorted(self.used, mesh.triangles[touched]).astype(np.int32)
        rest, numbers = replace(mesh, triangles=mesh.triangles[~touched]), np.append(np.flatnonzero(~touched), -1)
        self.depths, self.sampled = [], {}
        for view, camera in enumerate(photographed.cameras):
            still = rasterise(rest, camera)
            self.depths.append(still.depth)
            if view % 3 == 0:
                self.sampled[view] = numbers.astype(np.int32)[still.triangle.ravel()], still.barycentric.reshape(-1, 2)
        self.drawn = self.draw(mesh, {view: np.arange(len(each[0])) for view, each in self.sampled.items()})[1]

    def draw(self, mesh: Mesh, pixels: dict[int, np.ndarray]) -> tuple[list[np.ndarray], dict[int, tuple]]:
        """Draw depths (rows, columns) of the moved mesh by view, triangle (n,) and weights (n, 2) at flat pixels."""
        part, depths, sampled = Mesh(mesh.vertices[self.used], self.local, mesh.normals[self.used]), [], {}
        for view, (camera, depth) in enumerate(zip(self.photographed.cameras, self.depths, strict=True)):
            moved = rasterise(part, camera)
            depths.append(np.minimum(moved.depth, depth))
            if view in pixels:
                at, (triangle, weights) = pixels[view], self.sampled[view]
                nearer = (moved.depth < depth).ravel()[at]
                triangle = np.where(nearer, self.moving[moved.triangle.ravel()[at]], triangle[at])
                weights = np.where(nearer[:, None], moved.barycentric.reshape(-1, 2)[at], weights[at])
                sampled[view] = triangle, weights
        return depths, sampled

    def pixels_of(self, region: np.ndarray) -> dict[int, np.ndarray]:
        """Find flat indexes of every third pixel showing a region in every third view: the same for all candidates."""
        inside = np.append(region[self.triangles].all(axis=1), False)
        return {view: np.flatnonzero(inside[triangle])[::3] for view, (triangle, _) in self.drawn.items()}

    def residual(self, mesh: Mesh, pixels: dict[int, np.ndarray]) -> float:
        """Average the residual of a mesh over these pixels; a point that few views see counts as contradicted."""
        points, normals, (depths, sampled) = [], [], self.draw(mesh, pixels)
        for triangle, weights in sampled.values():
            for values, out in ((mesh.vertices, points), (mesh.normals, normals)):
                out.append(interpolate(values, mesh.triangles, triangle, weights)[triangle >= 0])
        normal = np.concatenate(normals)
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9)
        values = self.photographed.residuals(depths, np.concatenate(points), normal)
        return float(np.where(values < 0, LARGEST, values).sum() / len(values))
