"""Light from all around: how much of it reaches each vertex of both sides, and what a cloth makes of it."""

from dataclasses import dataclass, field

import numpy as np
from numba import njit

from nishiki.geometry.visibility import GOLDEN_ANGLE, blocked
from nishiki.render.cloth.local import LIFT, Fragments
from nishiki.render.cloth.scene import AmbientLight, Brdf, ClothScene, together
from nishiki.threads import over_items, over_rows

THETAS, PHIS, LIGHTS = 10, 16, (14, 28)
"""Grid of view directions at which the reflected share of even light is tabulated, and rings and sectors of light."""


@dataclass(frozen=True)
class Surroundings:
    """What surrounds the vertices."""

    light: AmbientLight
    open: np.ndarray  # (v, 2): cosine-weighted share of unblocked directions at each vertex, front and back
    from_above: np.ndarray  # (v, 2): how far up those point, 0 to 1
    corners: np.ndarray  # (f, 3): of the triangles
    tables: dict = field(default_factory=dict)  # `shares` of the materials drawn, by identity: (material, table)

    @classmethod
    def of(cls, scene: ClothScene, light: AmbientLight) -> "Surroundings":
        """Test light.rays directions over each side of every vertex."""
        corners = np.ascontiguousarray(scene.mesh.triangles)
        share, from_above = (smoothed(values, corners) for values in openness(scene, light.rays, light.reach))
        return cls(light, share, from_above, corners)

    def radiance(self, tables: list[np.ndarray], samples: Fragments, rows: np.ndarray, pixels: int) -> np.ndarray:
        """(tables, pixels, 3): sums over samples, by their pixels, of the even light that they reflect to the eye.

        tables: `shares` of materials; rows: of the samples. Blocked directions show cloth of the same kind: with
        openness a and albedo r its light comes back r (1 - a) times, again and again, hence a / (1 - r (1 - a)).
        """
        table = np.concatenate(tables, axis=2)
        returned = np.clip(table.mean(axis=(0, 1)), 0, 0.95)
        sky = np.stack([np.tile(colour, len(tables)) for colour in (self.light.above, self.light.below)])
        u, v = samples.weights[rows].astype(np.float64).T
        weights, corner = np.stack([u, v, 1 - u - v], axis=1), self.corners[samples.triangle[rows]]
        side = samples.back[rows, None].astype(int)
        clear, high = (
            np.einsum("nk,nk->n", weights, values[corner, side])[:, None] for values in (self.open, self.from_above)
        )
        light = high * sky[0] + (1 - high) * sky[1]
        sent = light * lookup(table, samples.outgoing[rows]) * clear / (1 - returned * (1 - clear))
        out = added_up(samples.pixel[rows], sent, pixels)
        return np.moveaxis(out.reshape(pixels, len(tables), 3), 1, 0)


def added_up(pixel: np.ndarray, values: np.ndarray, pixels: int) -> np.ndarray:
    """Sum values (n, k) by their pixels (n,) into (pixels, k)."""
    return np.stack([np.bincount(pixel, column, pixels) for column in values.T], axis=1)


def grid_views() -> np.ndarray:
    """(THETAS + 1, PHIS + 1, 3): views of the grid; phi = 2 pi repeats phi = 0, the last theta is 87 degrees."""
    theta = np.minimum(np.arange(THETAS + 1) / THETAS * np.pi / 2, np.radians(87.0))
    theta, phi = np.meshgrid(theta, np.arange(PHIS + 1) / PHIS * 2 * np.pi, indexing="ij")
    return np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=-1)


def shares(*brdfs: Brdf) -> list[np.ndarray]:
    """(THETAS + 1, PHIS + 1, 3) each: what cloths send to each view of the grid of even light, as a share, at most 1.

    Integrated over LIGHTS directions of equal projected area.
    """
    rings, sectors = LIGHTS
    radius2, turn = (np.arange(rings) + 0.5) / rings, (np.arange(sectors) + 0.5) / sectors * 2 * np.pi
    r, p = np.sqrt(radius2)[:, None], turn[None]
    up = np.broadcast_to(np.sqrt(1 - radius2)[:, None], LIGHTS)
    lights = np.stack([r * np.cos(p), r * np.sin(p), up], axis=-1).reshape(-1, 3)
    views = grid_views()
    tables = np.empty((len(brdfs), THETAS + 1, PHIS + 1, 3))

    def fill(k: int) -> None:
        for table, values in zip(tables, together([*brdfs], lights[None], views[k, :PHIS, None]), strict=True):
            table[k, :PHIS] = np.pi * values.mean(axis=1)

    over_items(fill, range(THETAS + 1))
    tables[:, :, PHIS] = tables[:, :, 0]
    return [*np.clip(tables, 0, 1)]


def lookup(table: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Bilinear in (theta, phi): (n, 3) at unit vectors (n, 3) above the horizon."""
    from scipy.ndimage import map_coordinates

    theta = np.arccos(np.clip(directions[:, 2], 0, 1)) / (np.pi / 2) * THETAS
    phi = np.mod(np.arctan2(directions[:, 1], directions[:, 0]), 2 * np.pi) / (2 * np.pi) * PHIS
    channels = [
        map_coordinates(channel, (theta, phi), order=1, mode="nearest") for channel in np.moveaxis(table, -1, 0)
    ]
    return np.stack(channels, axis=1)


def smoothed(values: np.ndarray, triangles: np.ndarray, *, rounds: int = 2) -> np.ndarray:
    """Values (v, k) at vertices averaged with their neighbours', twice: the grain of few rays goes, folds stay."""
    from scipy.sparse import coo_matrix, diags

    i = np.concatenate([triangles[:, k] for k in (0, 1, 2, 1, 2, 0)])
    j = np.concatenate([triangles[:, k] for k in (1, 2, 0, 0, 1, 2)])
    matrix = coo_matrix((np.ones(len(i)), (i, j)), (len(values), len(values))).tocsr()
    degree = np.asarray(matrix.sum(axis=1)).ravel()
    mean = diags(1 / np.maximum(degree, 1)) @ matrix
    for _ in range(rounds):
        values = np.where(degree[:, None] > 0, 0.5 * values + 0.5 * (mean @ values), values)
    return values


def openness(scene: ClothScene, rays: int, reach: float) -> tuple[np.ndarray, np.ndarray]:
    """See `Surroundings`: (v, 2) and (v, 2) float64, front and back; `reach` in the scene's unit."""
    count = len(scene.mesh.vertices)
    free, up = np.empty((count, 2)), np.empty((count, 2))
    normals = np.ascontiguousarray(scene.mesh.normals, np.float64)
    tree, surface = (scene.tree.boxes, scene.tree.triangles), (scene.mesh.vertices, normals)
    test = rays, reach, 4 * LIFT * scene.scale
    over_rows(lambda a, b: _open(tree, surface, test, a, b, (free, up)), count)
    return free, up


@njit(cache=True, nogil=True, error_model="numpy")
def _open(tree, surface, test, first, last, out):
    (boxes, triangles), (vertices, normals), (rays, reach, lift), (free, up) = tree, surface, test, out
    stack = np.empty(64, np.int32)
    for k in range(first, last):
        for side in range(2):
            sign = 1.0 - 2.0 * side
            nx, ny, nz = sign * normals[k, 0], sign * normals[k, 1], sign * normals[k, 2]
            s = 1.0 if nz >= 0.0 else -1.0
            p = -1.0 / (s + nz)
            q = nx * ny * p
            ox, oy, oz = vertices[k, 0] + lift * nx, vertices[k, 1] + lift * ny, vertices[k, 2] + lift * nz
            seen, height = 0, 0.0
            for ray in range(rays):
                # A spiral of equal projected area: every vertex tests the same directions about its normal.
                radius = np.sqrt((ray + 0.5) / rays)
                angle = GOLDEN_ANGLE * ray
                x, y = radius * np.cos(angle), radius * np.sin(angle)
                z = np.sqrt(max(0.0, 1.0 - radius * radius))
                dx = z * nx + x * (1.0 + s * nx * nx * p) + y * q
                dy = z * ny + x * s * q + y * (s + ny * ny * p)
                dz = z * nz - x * s * nx - y * ny
                if not blocked((boxes, triangles, stack), (ox, oy, oz), (dx, dy, dz), reach):
                    seen += 1
                    height += 0.5 * (1.0 + dy)
            free[k, side] = seen / rays
            up[k, side] = height / seen if seen else 0.5
