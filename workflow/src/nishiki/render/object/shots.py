"""Describe a picture of an object: a camera, captured views with their weights, or lamps chosen by the user.

Lamps of one's own stand in the lamp frame of the camera (x right, y up, z to the camera) and turn with it, as those of
a capture do. Of N points p_k on a lamp's disc, evenly spread,

    I = encode(sum over lamps of E V (I_d + I_s) + K_d E_around),     V = (number of p_k that the texel sees) / N

at every texel: direction and fall-off are those of the lamp's middle, and V is its visible share. Models and texels are
those of `nishiki.render.object.renderer`; a residual belongs to the light of the capture and is left out.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from nishiki.brdf.texels.model import DISTANT, HARMONICS, POINT, TO_LAMP_FRAME, ViewLamp, predict
from nishiki.geometry.camera import Camera
from nishiki.geometry.mesh import Mesh
from nishiki.geometry.turn import CameraPath
from nishiki.geometry.visibility import RayTree, cast, disc_points, make_tree


@dataclass(frozen=True)
class Neighbours:
    """views (n,) int: contributing captured views, and their weights (n,) float64, which sum to 1."""

    views: np.ndarray
    weights: np.ndarray

    @classmethod
    def around(cls, turn: CameraPath, position: float, *, without: frozenset[int] = frozenset()) -> "Neighbours":
        """Return the captured views around `position` (radians along the path) and their weights.

        The two nearest, one to each side, by distance (Miyazaki et al. 2007, section 4.3.3); one alone at its own place
        and beyond the ends of an open path.  without: views that may not take part (left out, or the one that is
        predicted).
        """
        usable = np.array([k for k in range(len(turn.position)) if k not in without], int)
        if not len(usable):
            raise ValueError("expected at least one captured view, found none")
        offset = turn.position[usable] - position
        if turn.closed:
            offset = (offset + 0.5 * turn.length) % turn.length - 0.5 * turn.length
        order = np.argsort(offset, kind="stable")
        usable, offset = usable[order], offset[order]
        best, first = int(np.argmin(np.abs(offset))), int(np.searchsorted(offset, 0.0))
        beyond = first in (0, len(usable)) and not turn.closed
        if len(usable) == 1 or beyond or np.abs(offset[best]) <= 1e-9 * max(turn.length, 1e-300):
            return cls(usable[best : best + 1], np.ones(1))
        pair = np.array([first - 1, first]) % len(usable)
        before, after = np.abs(offset[pair])
        if turn.closed:  # a view across the end of the turn
            before, after = (-offset[pair[0]]) % turn.length, offset[pair[1]] % turn.length
        return cls(usable[pair], np.array([after, before]) / (before + after))


@dataclass(frozen=True)
class Shot:
    """A picture from `camera` under weights L_j / L, to which captured `views` lend what the model leaves.

    captured: the view whose photograph this is, None of any other picture.
    """

    camera: Camera
    views: Neighbours
    lights: tuple[tuple[int, float], ...] = ((0, 1.0),)
    captured: int | None = None

    def lit_by(self, lights: tuple[tuple[int, float], ...]) -> "Shot":
        """Return the same picture under a sum of captured lights (index, L_j / L) (Miyazaki et al. 2007, eq. 13-15)."""
        return replace(self, lights=lights)


@dataclass(frozen=True)
class ObjectPicture:
    """A picture of an object.

    linear (rows, columns, channels) float32, 0 where nothing is shown; covered (rows, columns) bool: pixel centres on
    the surface; reached: covered, or carried on beyond the edge by `rim` pixels; triangle, barycentric: what the pixels
    show (see `nishiki.geometry.visibility.Raster`); depth (rows, columns) float32, +inf where not covered.
    """

    linear: np.ndarray
    covered: np.ndarray
    reached: np.ndarray
    triangle: np.ndarray
    barycentric: np.ndarray
    depth: np.ndarray


LIFT = 0.25
"""Offset of rays above the surface, in median edges of the mesh. Normals are smooth and triangles flat: without it
triangles that lie a little turned away from the lamp would be in their neighbours' shadow. What is smaller than an edge
the mesh does not show, so that no shadow of it is lost."""


@dataclass(frozen=True)
class FreeLamp:
    """A lamp in the frame of the camera."""

    azimuth: float  # from the right upwards
    elevation: float  # towards the camera, radians
    intensity: float = 1.0  # of a white diffuser that faces it
    radius: float = 0.0  # angular, radians
    # from the object's middle in diameters of the object, at which the intensity counts, with fall-off by the inverse
    # square; None: very far
    distance: float | None = None

    @property
    def towards(self) -> np.ndarray:
        """Unit vector (3,) to the lamp, in the lamp frame."""
        across = np.cos(self.elevation)
        return np.array([across * np.cos(self.azimuth), across * np.sin(self.azimuth), np.sin(self.elevation)])


@dataclass(frozen=True)
class FreeLighting:
    """Lamps set by the user; around: even light; shadows: cast ones; rays: to points of each lamp's disc, 1 if none."""

    lamps: tuple[FreeLamp, ...]
    around: float = 0.0
    shadows: bool = True
    rays: int = 32


def ball_around(mesh: Mesh) -> tuple[np.ndarray, float]:
    """Compute the middle (3,) of a mesh's box, and the distance from it to the farthest vertex."""
    centre = 0.5 * (mesh.vertices.min(axis=0) + mesh.vertices.max(axis=0))
    return centre, float(np.linalg.norm(mesh.vertices - centre, axis=1).max())


def shadow_lift(mesh: Mesh) -> float:
    """Compute the offset of rays above the surface, in the mesh's unit; see `LIFT`."""
    corners = mesh.vertices[mesh.triangles]
    return LIFT * float(np.median(np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)))


class LitObject:
    """A mesh under lamps chosen by the user."""

    def __init__(self, mesh: Mesh, lighting: FreeLighting):
        self.mesh, self.lighting = mesh, lighting
        self.centre, self.radius = ball_around(mesh)
        self.lift = shadow_lift(mesh)

    @cached_property
    def tree(self) -> RayTree:
        """Tree of the whole mesh, for shadows."""
        return make_tree(self.mesh.vertices, self.mesh.triangles)

    def visible(
        self, middle, ends: np.ndarray, positions: np.ndarray, normals: np.ndarray, *, near: bool
    ) -> np.ndarray:
        """Compute (n,) float32 in 0..1: share of a lamp's disc visible from points (n, 3); 0 where they face away.

        middle (3,), ends (k, 3): of the disc, places where it is near, else directions.
        """
        facing = np.flatnonzero(((middle - positions if near else middle) * normals).sum(axis=1) > 0)
        starts = positions[facing].astype(np.float64) + self.lift * normals[facing].astype(np.float64)
        seen, out = np.zeros(len(starts), np.int64), np.zeros(len(positions), np.float32)
        for end in ends:
            rays = end - starts if near else np.broadcast_to(end, starts.shape)
            seen += cast(self.tree, starts, rays, far=1.0 if near else 4 * self.radius, any_hit=True).triangle < 0
        out[facing] = seen / len(ends)
        return out

    def seen_by(self, camera: Camera) -> "LampsInView":
        """Return the lamps in the frame of a camera that views the object."""
        return LampsInView(self, TO_LAMP_FRAME @ camera.rotation, camera.centre)


@dataclass(frozen=True)
class LampsInView:
    """rotation (3, 3): object to lamp frame; eye (3,)."""

    lit: LitObject
    rotation: np.ndarray
    eye: np.ndarray

    def predict(self, kd, ks, sigma, positions, normals) -> tuple[np.ndarray, np.ndarray]:
        """Predict diffuse and specular radiance (n, channels) float32, as `nishiki.brdf.texels.model.predict`."""
        lighting = self.lit.lighting
        diffuse, specular = np.zeros(kd.shape, np.float32), np.zeros(kd.shape, np.float32)
        for lamp in lighting.lamps:
            body, gloss = predict(kd, ks, sigma, positions, normals, self.eye, self._in_object_frame(lamp))
            strength = np.float32(lamp.intensity) * self.visible(lamp, positions, normals)[:, None]
            diffuse += strength * body
            specular += strength * gloss
        diffuse += np.float32(lighting.around) * np.asarray(kd, np.float32)
        return diffuse, specular

    def visible(self, lamp: FreeLamp, positions: np.ndarray, normals: np.ndarray) -> np.ndarray:
        """Compute (n,) float32 in 0..1: share of a lamp's disc visible from points (n, 3); 0 where they face away."""
        lighting = self.lit.lighting
        if not lighting.shadows:
            return np.ones(len(positions), np.float32)
        disc = self._disc(lamp, lighting.rays if lamp.radius > 0 else 1)
        return self.lit.visible(*disc, positions, normals, near=lamp.distance is not None)

    def _disc(self, lamp: FreeLamp, count: int) -> tuple[np.ndarray, np.ndarray]:
        """Compute middle (3,) and points (count, 3) of a lamp's disc, in the object's frame, or unit directions."""
        towards = self.rotation.T @ lamp.towards
        first = np.cross((1.0, 0, 0) if abs(towards[0]) < 0.6 else (0, 1.0, 0), towards)
        first /= np.linalg.norm(first)
        off = np.tan(lamp.radius) * disc_points(count) @ np.stack([first, np.cross(towards, first)])
        if lamp.distance is None:
            ends = towards + off
            return towards, ends / np.linalg.norm(ends, axis=1, keepdims=True)
        length = 2 * self.lit.radius * lamp.distance
        middle = self.lit.centre + length * towards
        return middle, middle + length * off

    def _in_object_frame(self, lamp: FreeLamp) -> ViewLamp:
        middle, _ = self._disc(lamp, 1)
        near = lamp.distance is not None
        return ViewLamp(
            POINT if near else DISTANT,
            np.ascontiguousarray(middle, np.float32),
            np.ascontiguousarray(self.rotation, np.float32),
            np.zeros((HARMONICS, 1), np.float32),
            2 * self.lit.radius * lamp.distance if near else 0.0,
        )
