"""What is rendered: surfaces with the direction of their weft, what they are made of, lamps, and the light around."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Protocol

import numpy as np

from nishiki.errors import UserError
from nishiki.geometry.mesh import Mesh
from nishiki.geometry.ray_tree import RayTree, make_tree


class Brdf(Protocol):
    """What a surface is made of; every model of `nishiki.brdf.cloth` is one."""

    channels: int

    def evaluate(self, incident: np.ndarray, outgoing: np.ndarray) -> np.ndarray:
        """(..., channels) sr^-1 for unit vectors (..., 3) in the frame weft, warp, normal; 0 below the horizon."""


@dataclass(frozen=True)
class Matte:
    """A Lambert surface of reflectance albedo (channels,), for what is not cloth."""

    KIND: ClassVar[str] = "matte"
    albedo: tuple[float, ...] = (0.5,)

    @property
    def channels(self) -> int:
        """Number of channels."""
        return len(self.albedo)

    def evaluate(self, incident: np.ndarray, outgoing: np.ndarray) -> np.ndarray:
        """See `Brdf`."""
        above = (np.asarray(incident)[..., 2] > 0) & (np.asarray(outgoing)[..., 2] > 0)
        return np.where(above[..., None], np.asarray(self.albedo) / np.pi, 0.0)


@dataclass(frozen=True)
class Surface:
    """mesh; weft (v, 3): unit tangents at the vertices; material: its number in the scene. Both sides are cloth; on the
    back the warp runs the same way and the weft the other way."""

    mesh: Mesh
    weft: np.ndarray
    material: int = 0


@dataclass(frozen=True)
class Lamp:
    """A distant lamp towards `direction`, or a near one at `place` (one of the two); colour (3,): of white paper
    that faces it (at `distance` from a near one); radius: its angular radius, radians, or that of a near lamp at
    `distance`."""

    direction: tuple[float, float, float] | None = None
    place: tuple[float, float, float] | None = None
    colour: tuple[float, float, float] = (1.0, 1.0, 1.0)
    radius: float = 0.02
    distance: float = 1.0

    def __post_init__(self):
        given = self.direction if self.place is None else self.place
        if (self.direction is None) == (self.place is None) or np.linalg.norm(given) < 1e-9:
            raise UserError(f"lamp: expected a direction or a place, not 0, and not both; found {self}")
        if not (np.isfinite([*given, *self.colour, self.radius, self.distance]).all() and min(self.colour) >= 0):
            raise UserError(f"lamp: expected finite numbers and a colour of 0 or more, found {self}")
        if not (0 <= self.radius < np.pi / 2 and self.distance > 0):
            raise UserError(f"lamp: expected a radius from 0 to 90 degrees and a distance above 0, found {self}")


@dataclass(frozen=True)
class AmbientLight:
    """Even light from all around: radiance (channels of the display) above and below, relative to a white that faces a
    lamp; rays: tested at each vertex for what stands in the way; reach: farther things do not."""

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
    def of(cls, surfaces: list[Surface]) -> ClothScene:
        """The surfaces together. UserError where there is no triangle, or a number that is not finite."""
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


def three(values: np.ndarray) -> np.ndarray:
    """(..., 3): three channels as they are, any other number as the grey of their mean."""
    if values.shape[-1] == 3:
        return values
    return np.repeat(values.mean(axis=-1, keepdims=True), 3, axis=-1)
