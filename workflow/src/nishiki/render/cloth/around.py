"""Light from all around: how much of it reaches each vertex of both sides, and what a cloth makes of it."""

from dataclasses import dataclass, field

import numpy as np

from nishiki.atlas.adjacency import smoothed_vertices
from nishiki.geometry.visibility import cast, disc_points, frames_about
from nishiki.render.cloth.local import LIFT, Fragments
from nishiki.render.cloth.scene import AmbientLight, Brdf, ClothScene, together
from nishiki.threads import over_items, strips

THETAS, PHIS, LIGHTS = 10, 16, (14, 28)
"""Grid of view directions at which the reflected share of even light is tabulated, and rings and sectors of light."""
RAYS = 1 << 18  # at a time


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
        share, from_above = (
            # the grain of few rays goes, folds stay
            smoothed_vertices(values, corners, rounds=2)
            for values in openness(scene, light.rays, light.reach)
        )
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


def openness(scene: ClothScene, rays: int, reach: float) -> tuple[np.ndarray, np.ndarray]:
    """See `Surroundings`: (v, 2) and (v, 2) float64, front and back; `reach` in the scene's unit."""
    vertices, normals, lift = scene.mesh.vertices, np.asarray(scene.mesh.normals, np.float64), 4 * LIFT * scene.scale
    free, up = np.empty((len(vertices), 2)), np.empty((len(vertices), 2))
    # Points of equal projected area: every vertex tests the same directions about its normal.
    disc = disc_points(rays)
    local = np.column_stack([disc, np.sqrt(np.maximum(1 - (disc**2).sum(axis=1), 0))])
    for some in strips(len(vertices), max(1, RAYS // rays)):
        for side, sign in enumerate((1.0, -1.0)):
            n = sign * normals[some]
            directions = local @ np.concatenate([frames_about(n), n[:, None]], axis=1)
            origins = np.repeat(vertices[some] + lift * n, rays, axis=0)
            hits = cast(scene.tree, origins, directions.reshape(-1, 3), far=reach, any_hit=True)
            clear = (hits.triangle < 0).reshape(-1, rays)
            seen, height = clear.sum(axis=1), (0.5 * (1 + directions[..., 1]) * clear).sum(axis=1)
            free[some, side], up[some, side] = seen / rays, np.where(seen, height / np.maximum(seen, 1), 0.5)
    return free, up
