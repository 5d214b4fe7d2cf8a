"""Describe a cloth for rendering: surfaces with their weft, lamps, the light around, and its BRDF, also as a table.

Gloss changes fast with the half vector h of light and view and slowly with the difference between them (Rusinkiewicz, A
new change of variables for efficient BRDF representation, 1998). The table has these four coordinates:

    (u, v) = (p_x + p_y, p_x - p_y), p = h / (|h_x| + |h_y| + h_z): a square for the half space, without a pole;
    ring   = t / t_max, t the angle between light and h, t_max the one at which light or view meets the horizon:
             every node is a pair of directions above it;
    turn   : azimuth of the difference about h, from the x axis as the shortest turn carries it from the normal to h.

It holds q = sqrt(f i_z o_z), which is finite at the horizon, and is linear between nodes.
"""

from dataclasses import dataclass, fields
from itertools import product
from typing import ClassVar, Protocol

import numpy as np

from nishiki.brdf.cloth.interface import WITHIN, Dyed
from nishiki.errors import UserError
from nishiki.geometry.mesh import Mesh
from nishiki.geometry.visibility import RayTree, make_tree
from nishiki.render.display import three_channels
from nishiki.threads import over_items


class Brdf(Protocol):
    """Reflection model of a surface; every model of `nishiki.brdf.cloth` is one."""

    @property
    def channels(self) -> int:
        """Number of channels."""

    def evaluate(self, incident: np.ndarray, outgoing: np.ndarray) -> np.ndarray:
        """Evaluate (..., channels) sr^-1 for unit vectors (..., 3) in the frame weft, warp, normal; 0 below horizon."""


@dataclass(frozen=True)
class Matte:
    """A Lambert surface of reflectance albedo (channels,), for surfaces other than cloth."""

    KIND: ClassVar[str] = "matte"
    albedo: tuple[float, ...] = (0.5,)

    @property
    def channels(self) -> int:
        """Number of channels."""
        return len(self.albedo)

    def evaluate(self, incident: np.ndarray, outgoing: np.ndarray) -> np.ndarray:
        """Compute the reflection, see `Brdf`."""
        above = (np.asarray(incident)[..., 2] > 0) & (np.asarray(outgoing)[..., 2] > 0)
        return np.where(above[..., None], np.asarray(self.albedo) / np.pi, 0.0)


def together(brdfs: list[Brdf], incident: np.ndarray, outgoing: np.ndarray) -> list[np.ndarray]:
    """Compute (..., 3) values of each BRDF at directions (..., 3); common parts are evaluated once.

    Dyes share a gloss, and a model of yarns shares its terms with those that differ from it in colour only.
    """
    known: dict[tuple[int, ...], np.ndarray] = {}

    def of(brdf) -> np.ndarray:
        terms = getattr(brdf, "terms", None)
        parts = [getattr(brdf, f.name) for f in fields(brdf) if f.name not in WITHIN] if terms else [brdf]
        key = tuple(map(id, parts))
        if key not in known:
            known[key] = terms(incident, outgoing) if terms else three_channels(brdf.evaluate(incident, outgoing))
        return three_channels(brdf.colour(known[key])) if terms else known[key]

    return [
        of(brdf.gloss) + three_channels(brdf.body(incident, outgoing)) if isinstance(brdf, Dyed) else of(brdf)
        for brdf in brdfs
    ]


@dataclass(frozen=True)
class Surface:
    """Cloth on both sides; weft (v, 3): unit tangents, the other way on the back; material: its number in the scene."""

    mesh: Mesh
    weft: np.ndarray
    material: int = 0


@dataclass(frozen=True)
class Lamp:
    """A distant lamp towards `direction`, or a near one at `place` (one of the two)."""

    direction: tuple[float, float, float] | None = None
    place: tuple[float, float, float] | None = None
    # (3,): of white paper that faces it (at `distance` from a near one)
    colour: tuple[float, float, float] = (1.0, 1.0, 1.0)
    radius: float = 0.02  # its angular radius, radians, or that of a near lamp at `distance`
    distance: float = 1.0

    def __post_init__(self):
        given = self.direction if self.place is None else self.place
        if given is None or (self.direction is None) == (self.place is None) or np.linalg.norm(given) < 1e-9:
            raise UserError(f"lamp: expected a direction or a place, not 0, and not both; found {self}")
        if not (np.isfinite([*given, *self.colour, self.radius, self.distance]).all() and min(self.colour) >= 0):
            raise UserError(f"lamp: expected finite numbers and a colour of 0 or more, found {self}")
        if not (0 <= self.radius < np.pi / 2 and self.distance > 0):
            raise UserError(f"lamp: expected a radius from 0 to 90 degrees and a distance above 0, found {self}")


@dataclass(frozen=True)
class AmbientLight:
    """Even light from all around.

    Radiance (channels of the display) above and below, relative to a white that faces a lamp; rays: tested at each
    vertex for what stands in the way; reach: farther things do not.
    """

    above: tuple[float, float, float] = (0.12, 0.12, 0.12)
    below: tuple[float, float, float] = (0.03, 0.03, 0.03)
    rays: int = 24
    reach: float = 0.6


@dataclass(frozen=True)
class ClothScene:
    """Surfaces as one mesh: mesh; weft (v, 3) float64; material (f,) uint8; tree of all triangles; scale: extent."""

    mesh: Mesh
    weft: np.ndarray
    material: np.ndarray
    tree: RayTree
    scale: float

    @classmethod
    def of(cls, surfaces: list[Surface]) -> "ClothScene":
        """Join the surfaces. UserError where there is no triangle, or a number that is not finite."""
        if not surfaces or not all(len(surface.mesh.triangles) for surface in surfaces):
            raise UserError("scene: expected surfaces with at least one triangle each")
        starts = np.cumsum([0] + [len(surface.mesh.vertices) for surface in surfaces])
        mesh = Mesh(
            np.concatenate([surface.mesh.vertices for surface in surfaces]),
            np.concatenate([s.mesh.triangles + start for s, start in zip(surfaces, starts, strict=False)]).astype(
                np.int32
            ),
            np.concatenate([surface.mesh.normals for surface in surfaces]).astype(np.float32),
        )
        weft = np.concatenate([np.asarray(surface.weft, np.float64) for surface in surfaces])
        if not (np.isfinite(mesh.vertices).all() and np.isfinite(weft).all() and np.isfinite(mesh.normals).all()):
            raise UserError("scene: expected finite vertices, normals and tangents")
        material = np.concatenate([np.full(len(s.mesh.triangles), s.material, np.uint8) for s in surfaces])
        scale = float(np.linalg.norm(np.ptp(mesh.vertices, axis=0)))
        return cls(mesh, weft, material, make_tree(mesh.vertices, mesh.triangles), scale)


SIDES, RINGS, TURNS = 41, 13, 16
"""Nodes along u and v, along the ring, and of a whole turn. Measured in docs/notes/stages/cloth_viewer.md."""
EDGE = 0.98
"""Largest |u| and |v|: at 1 the half vector is on the horizon, and light and view with it."""
OUTERMOST = 0.995
"""The last ring: at 1 light or view is on the horizon, where BRDFs are 0."""
STEPS = 4095
"""Number of steps of the stored numbers, from 0 to the largest."""
AT_ONCE = 1 << 14


@dataclass(frozen=True)
class BrdfTable:
    """codes (SIDES, SIDES, RINGS, TURNS, 3) uint16: sqrt(f i_z o_z) in steps of largest / STEPS; f in 1 / sr."""

    codes: np.ndarray
    largest: float
    channels: int = 3

    @classmethod
    def of(cls, *brdfs: Brdf) -> "list[BrdfTable]":
        """Evaluate BRDFs at the nodes, on all threads; exchange of light and view is half a turn."""
        square = EDGE * np.linspace(-1, 1, SIDES)
        rings = np.minimum(np.linspace(0, 1, RINGS), OUTERMOST)
        reciprocal = all(getattr(brdf, "RECIPROCAL", False) for brdf in brdfs)
        turns = np.arange(TURNS // 2 if reciprocal else TURNS) / TURNS
        nodes = [axis.ravel() for axis in np.meshgrid(square, square, rings, turns, indexing="ij")]
        values = np.empty((len(brdfs), nodes[0].size, 3))

        def fill(start: int) -> None:
            rows = slice(start, start + AT_ONCE)
            incident, outgoing = directions(*(axis[rows] for axis in nodes))
            scale = incident[:, 2:] * outgoing[:, 2:]
            for k, f in enumerate(together([*brdfs], incident, outgoing)):
                values[k, rows] = np.sqrt(np.maximum(f * scale, 0))

        over_items(fill, range(0, len(nodes[0]), AT_ONCE))
        tables = []
        for each in values.reshape(len(brdfs), SIDES, SIDES, RINGS, -1, 3):
            largest = float(each.max()) or 1.0
            codes = np.round(each / largest * STEPS).astype(np.uint16)
            tables.append(cls(np.concatenate([codes, codes], axis=3) if reciprocal else codes, largest))
        return tables

    def evaluate(self, incident: np.ndarray, outgoing: np.ndarray) -> np.ndarray:
        """Interpolate (..., 3) sr^-1 for unit vectors (..., 3) in the frame weft, warp, normal; 0 below the horizon."""
        incident, outgoing = np.broadcast_arrays(incident, outgoing)
        above = (incident[..., 2] > 0) & (outgoing[..., 2] > 0)
        out = np.zeros((*above.shape, 3))
        i, o = incident[above], outgoing[above]
        u, v, ring, turn = coordinates(i, o)
        square = [(np.clip(axis / EDGE, -1, 1) + 1) / 2 * (SIDES - 1) for axis in (u, v)]
        places = [*square, ring * (RINGS - 1), turn * TURNS]
        last = (SIDES - 2, SIDES - 2, RINGS - 2, TURNS)
        lowest = [np.minimum(np.floor(place).astype(int), most) for place, most in zip(places, last, strict=True)]
        q = np.zeros((len(i), 3))
        for corner in product((0, 1), repeat=4):
            shares = [p - low if far else 1 - p + low for p, low, far in zip(places, lowest, corner, strict=True)]
            a, b, c, d = (low + far for low, far in zip(lowest, corner, strict=True))
            q += np.prod(shares, axis=0)[:, None] * self.codes[a, b, c, d % TURNS]
        out[above] = (q * (self.largest / STEPS)) ** 2 / (i[:, 2:] * o[:, 2:])
        return out


def coordinates(incident: np.ndarray, outgoing: np.ndarray) -> tuple[np.ndarray, ...]:
    """Compute u and v, each -1 to 1, ring, 0 to 1, and turn, 0 to 1, of unit vectors (n, 3) above the horizon."""
    total, apart = incident + outgoing, incident - outgoing
    twice_cosine, twice_sine = (np.linalg.norm(vectors, axis=1) for vectors in (total, apart))
    h = total / twice_cosine[:, None]
    along = np.where(twice_sine[:, None] > 1e-9, apart / np.maximum(twice_sine, 1e-300)[:, None], (1.0, 0.0, 0.0))
    x, y = axes_about(h)
    turn = np.mod(np.arctan2(np.sum(along * y, axis=1), np.sum(along * x, axis=1)) / (2 * np.pi), 1.0)
    ring = np.arctan2(twice_sine, twice_cosine) / np.maximum(np.arctan2(h[:, 2], np.abs(along[:, 2])), 1e-12)
    p = h[:, :2] / np.abs(h).sum(axis=1)[:, None]
    return p[:, 0] + p[:, 1], p[:, 0] - p[:, 1], np.clip(ring, 0, 1), turn


def directions(u: np.ndarray, v: np.ndarray, ring: np.ndarray, turn: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Compute unit vectors (n, 3) to light and eye of these coordinates."""
    h = np.stack([(u + v) / 2, (u - v) / 2, 1 - np.maximum(np.abs(u), np.abs(v))], axis=1)
    h /= np.linalg.norm(h, axis=1)[:, None]
    x, y = axes_about(h)
    angle = 2 * np.pi * turn[:, None]
    along = np.cos(angle) * x + np.sin(angle) * y
    apart = (ring * np.arctan2(h[:, 2], np.abs(along[:, 2])))[:, None]
    return np.cos(apart) * h + np.sin(apart) * along, np.cos(apart) * h - np.sin(apart) * along


def axes_about(h: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Compute axes x and y (n, 3) after the shortest turn that carries z to unit vectors (n, 3) above the horizon."""
    p = -1 / (1 + h[:, 2])
    xy = h[:, 0] * h[:, 1] * p
    x = np.stack([1 + h[:, 0] ** 2 * p, xy, -h[:, 0]], axis=1)
    return x, np.stack([xy, 1 + h[:, 1] ** 2 * p, -h[:, 1]], axis=1)
