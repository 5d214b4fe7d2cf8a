"""Compute light and reflection at the samples of a cloth's picture: their points, lamps, ambient light, models."""

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numba import njit

from nishiki.atlas.adjacency import smoothed_vertices
from nishiki.brdf.cloth.interface import PHIS, THETAS, Dyed, gloss_of
from nishiki.brdf.cloth.store import load_brdf
from nishiki.errors import UserError
from nishiki.geometry.camera import Camera
from nishiki.geometry.mesh import face_vectors
from nishiki.geometry.visibility import GOLDEN_ANGLE, Raster, cast, disc_points, frames_about
from nishiki.render.cloth.scene import AmbientLight, Brdf, ClothScene, Lamp, together
from nishiki.render.display import three_channels
from nishiki.threads import over_items, strips

LEAST_COSINE = 0.02
"""Least cosine of the eye above the horizon; interpolated normals turned away from the eye are bent back to it."""
LIFT = 2e-4
"""Offset of shadow rays above the surface, in extents of the scene, so that no triangle shades itself."""


@dataclass(frozen=True)
class Fragments:
    """Visible points of a picture, in the order of the picture."""

    pixel: np.ndarray  # (n,) int64 in the band
    # (n,) int64: that of the pixel in the picture times a_pixel, the samples a pixel has, plus that of the sample in
    # its pixel
    number: np.ndarray
    triangle: np.ndarray  # (n,) int32
    weights: np.ndarray  # (n, 2) float32 of its corners 0 and 1
    material: np.ndarray  # (n,)
    back: np.ndarray  # (n,) bool: seen from behind
    place: np.ndarray  # (n, 3) float64
    frame: np.ndarray  # (n, 3, 3): weft, warp, normal, turned to the eye
    outgoing: np.ndarray  # (n, 3): the eye in this frame
    stands: np.ndarray  # (n,): the sample whose BRDF value serves for this one, itself included
    bent: int  # how many normals were turned
    a_pixel: int


@dataclass(frozen=True)
class IncidentLight:
    """A lamp at n points.

    incident (n, 3) in the cloth's frame; strength (n,): cosine times fall-off times visibility; before (n,): the same
    without shadows.
    """

    incident: np.ndarray
    strength: np.ndarray
    before: np.ndarray


def gather(scene: ClothScene, raster: Raster, camera: Camera, supersampling: int, *, within: float = 0.0) -> Fragments:
    """Gather the points behind a band of a picture's samples and their frames.

    within: radians; samples of a pixel, of one material and side, share a BRDF value with one whose normal and weft are
    this near. 0: each has its own.
    """
    rows, columns = np.nonzero(raster.triangle >= 0)
    triangle = raster.triangle[rows, columns]
    weights = raster.barycentric[rows, columns]
    across = camera.columns // supersampling
    pixel = (rows // supersampling) * across + columns // supersampling
    count, a_pixel = len(triangle), supersampling**2
    place, frame, outgoing, back, bent = _frames(scene, triangle, weights, camera.centre)
    inside = (rows % supersampling) * supersampling + columns % supersampling
    number = ((rows + raster.first_row) // supersampling * np.int64(across) + columns // supersampling) * a_pixel
    number += inside
    material = scene.material[triangle]
    stands = np.arange(count)
    if within > 0 and count:
        groups = pixel * 2 * (int(material.max()) + 1) + 2 * material + back
        _share(np.argsort(groups, kind="stable"), groups, frame, np.cos(within), stands)
    return Fragments(
        pixel, number, triangle, weights, material, back, place, frame, outgoing, stands, int(bent.sum()), a_pixel
    )


def light_from(scene: ClothScene, samples: Fragments, lamp: Lamp, shadows: bool) -> IncidentLight:
    """Compute the light from a lamp that reaches the samples."""
    near, reach, level = lamp.place is not None, np.full(len(samples.pixel), 2 * scene.scale), np.ones(())
    if near:
        towards, reach = _unit(np.asarray(lamp.place, np.float64) - samples.place)
        level = lamp.distance / np.maximum(reach, 1e-9)
    else:
        towards = np.broadcast_to(_unit(np.asarray(lamp.direction, np.float64))[0], samples.place.shape)
    incident = np.einsum("nam,nm->na", samples.frame, towards)
    before = level**2 * np.maximum(incident[:, 2], 0)
    strength = before.copy()
    some = np.flatnonzero(before > 0) if shadows else np.arange(0)
    if len(some):
        number, towards = samples.number[some], towards[some]
        off = disc_point(*np.divmod(number, samples.a_pixel), samples.a_pixel) * np.tan(lamp.radius)
        off *= np.broadcast_to(level, len(strength))[some, None]
        rays = towards + np.einsum("na,nam->nm", off, frames_about(towards))
        origins = samples.place[some] + LIFT * scene.scale * samples.frame[some, 2]
        hits = cast(scene.tree, origins, rays, far=reach[some], any_hit=True)
        strength[some[hits.triangle >= 0]] = 0
    return IncidentLight(incident, strength, before)


def _unit(vectors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Divide vectors (..., 3) by their lengths (...); return both."""
    lengths = np.linalg.norm(vectors, axis=-1)
    return vectors / np.maximum(lengths, 1e-300)[..., None], lengths


def _frames(scene: ClothScene, triangle: np.ndarray, weights: np.ndarray, eye: np.ndarray) -> tuple[np.ndarray, ...]:
    """Compute place, frame, outgoing and back of `Fragments`, and which normals were bent.

    The frame is turned to the eye: seen from behind, normal and weft change sign, not the warp.
    """
    mesh, (u, v) = scene.mesh, weights.astype(np.float64).T
    shares, corners = np.stack([u, v, 1 - u - v], axis=1), mesh.triangles[triangle]
    place, n, t = (
        np.einsum("nk,nkm->nm", shares, values[corners]) for values in (mesh.vertices, mesh.normals, scene.weft)
    )
    face, view = face_vectors(mesh.vertices, mesh.triangles)[triangle], _unit(eye - place)[0]
    n, lengths = _unit(n)
    # normals of the corners that cancel, or turn their back on their triangle
    wrong = (lengths < 1e-9) | (np.einsum("nm,nm->n", n, face) < 0)
    n[wrong] = _unit(face[wrong])[0]
    back = np.einsum("nm,nm->n", face, view) < 0
    n[back], t[back] = -n[back], -t[back]
    facing = np.einsum("nm,nm->n", n, view)
    bent = facing < LEAST_COSINE
    n[bent] = _unit(n[bent] + (LEAST_COSINE - facing[bent])[:, None] * view[bent])[0]
    t, lengths = _unit(t - np.einsum("nm,nm->n", t, n)[:, None] * n)
    along = lengths < 1e-9  # a weft along the normal: any direction across it
    t[along] = frames_about(n[along])[:, 0]
    frame = np.stack([t, np.cross(n, t), n], axis=1)
    return place, frame, np.einsum("nam,nm->na", frame, view), back, bent


@njit(cache=True, nogil=True, error_model="numpy")
def _share(order, groups, frame, cosine, stands):
    """Map samples of a group with normal and weft within the cosine to one representative, middle ones first."""
    first = 0
    while first < len(order):
        last = first + 1
        while last < len(order) and groups[order[last]] == groups[order[first]]:
            last += 1
        count = last - first
        for step in range(count):
            # from the middle outwards: m, m + 1, m - 1, m + 2, ..
            reach = (step + 1) // 2
            here = order[first + (count // 2 + (reach if step % 2 == 1 else -reach)) % count]
            stands[here] = here
            for before in range(step):
                reach = (before + 1) // 2
                other = order[first + (count // 2 + (reach if before % 2 == 1 else -reach)) % count]
                if stands[other] != other:
                    continue
                normal, weft = 0.0, 0.0
                for m in range(3):
                    normal += frame[here, 2, m] * frame[other, 2, m]
                    weft += frame[here, 0, m] * frame[other, 0, m]
                if normal >= cosine and weft >= cosine:
                    stands[here] = other
                    break
        first = last


def disc_point(pixel: np.ndarray, index: np.ndarray, count: int) -> np.ndarray:
    """Return the points (..., 2) of the unit disc for samples `index` of the `count` of pixels (...), int64.

    A spiral of equal areas, turned at random from pixel to pixel by a hash of its number, so that the samples of each
    pixel cover the disc evenly.
    """
    h = (pixel + 1).astype(np.uint64) * np.uint64(0x9E3779B97F4A7C15)
    h = (h ^ (h >> np.uint64(32))) * np.uint64(0xD6E8FEB86659FD93)
    h = h ^ (h >> np.uint64(32))
    shift, spin = (((h >> np.uint64(bits)) & np.uint64(0xFFFFFF)) / 2.0**24 for bits in (0, 24))
    radius, angle = np.sqrt((index + shift) / count), GOLDEN_ANGLE * index + 2.0 * np.pi * spin
    return np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=-1)


VIEW_THETAS, VIEW_PHIS, LIGHTS = 10, 16, (14, 28)
"""Grid of view directions for tables of the reflected share of even light, and rings and sectors of light."""
RAYS = 1 << 18  # at a time


@dataclass(frozen=True)
class Surroundings:
    """Visibility of the surroundings from the vertices."""

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
        """Compute (tables, pixels, 3): sums over samples, by pixel, of the even light that they reflect to the eye.

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
    """Compute (VIEW_THETAS + 1, VIEW_PHIS + 1, 3): views; the last phi repeats the first, the last theta is 87°."""
    theta = np.minimum(np.arange(VIEW_THETAS + 1) / VIEW_THETAS * np.pi / 2, np.radians(87.0))
    theta, phi = np.meshgrid(theta, np.arange(VIEW_PHIS + 1) / VIEW_PHIS * 2 * np.pi, indexing="ij")
    return np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=-1)


def shares(*brdfs: Brdf) -> list[np.ndarray]:
    """Compute the share of even light sent to each view of the grid, (VIEW_THETAS + 1, VIEW_PHIS + 1, 3), at most 1.

    Integrated over LIGHTS directions of equal projected area.
    """
    rings, sectors = LIGHTS
    radius2, turn = (np.arange(rings) + 0.5) / rings, (np.arange(sectors) + 0.5) / sectors * 2 * np.pi
    r, p = np.sqrt(radius2)[:, None], turn[None]
    up = np.broadcast_to(np.sqrt(1 - radius2)[:, None], LIGHTS)
    lights = np.stack([r * np.cos(p), r * np.sin(p), up], axis=-1).reshape(-1, 3)
    views = grid_views()
    tables = np.empty((len(brdfs), VIEW_THETAS + 1, VIEW_PHIS + 1, 3))

    def fill(k: int) -> None:
        for table, values in zip(tables, together([*brdfs], lights[None], views[k, :VIEW_PHIS, None]), strict=True):
            table[k, :VIEW_PHIS] = np.pi * values.mean(axis=1)

    over_items(fill, range(VIEW_THETAS + 1))
    tables[:, :, VIEW_PHIS] = tables[:, :, 0]
    return [*np.clip(tables, 0, 1)]


def lookup(table: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Interpolate bilinearly in (theta, phi): (n, 3) at unit vectors (n, 3) above the horizon."""
    from scipy.ndimage import map_coordinates

    theta = np.arccos(np.clip(directions[:, 2], 0, 1)) / (np.pi / 2) * VIEW_THETAS
    phi = np.mod(np.arctan2(directions[:, 1], directions[:, 0]), 2 * np.pi) / (2 * np.pi) * VIEW_PHIS
    channels = [
        map_coordinates(channel, (theta, phi), order=1, mode="nearest") for channel in np.moveaxis(table, -1, 0)
    ]
    return np.stack(channels, axis=1)


def openness(scene: ClothScene, rays: int, reach: float) -> tuple[np.ndarray, np.ndarray]:
    """Compute `open` and `from_above` of `Surroundings`, (v, 2) each, front and back; `reach` in the scene's unit."""
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


class ClothModels:
    """Reader of an artifact of the stage cloth_brdf."""

    def __init__(self, folder: Path):
        """Open the artifact. UserError where there is no cloth_brdf.json."""
        self.folder = Path(folder)
        path = self.folder / "cloth_brdf.json"
        if not path.is_file():
            raise UserError(f"{path}: file not found. Remedy: run the stage cloth_brdf first")
        self.description: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))

    @property
    def regions(self) -> list[str]:
        """Regions of the capture."""
        return list(self.description["regions"])

    @property
    def default(self) -> str:
        """Model used by default for the cloth."""
        return self.description["default"]

    def names(self, region: str) -> list[str]:
        """Return models of a region."""
        return list(self._region(region))

    def brdf(self, region: str, model: str | None = None):
        """Load the BRDF of a region: of this model, or of the default one. UserError where there is none."""
        name = model or self.default
        if name not in self._region(region):
            known = ", ".join(self._region(region))
            raise UserError(f"{self.folder}: expected a model among {known}, found {name!r}. Remedy: correct `model`")
        return load_brdf(self.folder / "models" / region / f"{name}.npz")

    def rows_of_fit(self, region: str, model: str) -> list[int]:
        """Return rows of the reflectance table used in the fit of a model."""
        return list(self._region(region)[model]["used"])

    def facts(self, region: str, model: str) -> dict[str, Any]:
        """Return the fit's diagnostics."""
        return {name: value for name, value in self._region(region)[model].items() if name != "used"}

    def _region(self, region: str) -> dict[str, Any]:
        if region not in self.description["models"]:
            known = ", ".join(self.regions)
            raise UserError(
                f"{self.folder}: expected a region among {known}, found {region!r}. Remedy: correct `region`"
            )
        return self.description["models"][region]


def apply_dyes(
    brdf: Brdf, colours: dict[str, tuple[float, float, float]], share: np.ndarray | None = None
) -> dict[str, Dyed]:
    """Return the gloss of a cloth over dyes of these colours (linear sRGB albedo); share: of the gloss, where known.

    The gloss' directional albedo is read from the table of `shares`: by reciprocity, what comes out of even
    light is what is reflected in all directions.
    """
    if not colours:
        return {}
    gloss = gloss_of(brdf)
    theta, phi = (np.arange(THETAS) + 0.5) * (np.pi / 2 / THETAS), np.arange(PHIS) * (2 * np.pi / PHIS)
    t, p = (a.ravel() for a in np.meshgrid(theta, phi, indexing="ij"))
    views = np.stack([np.sin(t) * np.cos(p), np.sin(t) * np.sin(p), np.cos(t)], axis=1)
    gloss_albedo = np.clip(lookup(shares(gloss)[0] if share is None else share, views).mean(axis=1), 0, 1).reshape(
        THETAS, PHIS
    )
    weight = (np.sin(theta) * np.cos(theta))[:, None]
    mean = float(np.sum(weight * gloss_albedo) / np.sum(weight) / PHIS)
    return {name: Dyed(gloss, np.asarray(colour, float), gloss_albedo, mean) for name, colour in colours.items()}


def share_of(brdf: Brdf) -> np.ndarray:
    """Compute `shares` of a BRDF; of a dyed cloth the limit a + albedo (1 - a), a being its gloss' share."""
    if not isinstance(brdf, Dyed):
        return shares(brdf)[0]
    gloss_albedo = brdf.gloss_albedo_at(grid_views())[..., None]
    return np.clip(gloss_albedo + (1 - gloss_albedo) * three_channels(brdf.albedo), 0, 1)
