"""The studio: a surface on paper, lamps that stand where the camera says, dyes by their colours."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from nishiki.colour.colour import decode
from nishiki.geometry.camera import Camera, look_at
from nishiki.geometry.mesh import Mesh
from nishiki.geometry.turn import rotation_matrix
from nishiki.render.cloth.around import Surroundings
from nishiki.render.cloth.frame import ClothPicture, RenderVariant, render
from nishiki.render.cloth.scene import AmbientLight, Brdf, ClothScene, Lamp, Matte, Surface
from nishiki.render.cloth.surfaces import cylinder, paper


def around(target, *, elevation: float, azimuth: float, distance: float) -> np.ndarray:
    """Place (3,) about a target: azimuth from z (to the viewer) towards x (right), elevation above the floor."""
    level = np.cos(elevation)
    towards = np.array([level * np.sin(azimuth), np.sin(elevation), level * np.cos(azimuth)])
    return np.asarray(target, np.float64) + distance * towards


MARGIN = 1.18
"""Around what a studio shows, so much is its picture larger."""


def framed(
    points: np.ndarray,
    *,
    elevation: float,
    azimuth: float,
    rows: int,
    columns: int,
    distance: float,
    margin: float = 1.12,
) -> Camera:
    """Aim a camera at all points (n, 3), centred; distance: from their middle, in their extents."""
    low, high = points.min(axis=0), points.max(axis=0)
    middle, extent = (low + high) / 2, float(np.linalg.norm(high - low))
    eye = around(middle, elevation=elevation, azimuth=azimuth, distance=distance * extent)
    target = middle
    for _ in range(3):  # the middle of what is seen is not the middle of the points: a few steps settle it
        camera = look_at(eye, target, rows=rows, columns=columns, field_of_view=0.5)
        seen = (points - eye) @ camera.rotation.T
        plane = seen[:, :2] / seen[:, 2:]
        centre = (plane.min(axis=0) + plane.max(axis=0)) / 2
        depth = float((target - eye) @ camera.rotation[2])
        target = target + depth * (centre[0] * camera.rotation[0] + centre[1] * camera.rotation[1])
    half = np.abs(plane - centre).max(axis=0)
    high = margin * max(half[1], half[0] * rows / columns)
    return look_at(eye, target, rows=rows, columns=columns, field_of_view=float(2 * np.arctan(high)))


class Viewpoint(NamedTuple):
    """A camera's angles about what it shows, radians, its distance in extents of that, and its pixels."""

    elevation: float
    azimuth: float
    distance: float
    rows: int
    columns: int


@dataclass(frozen=True)
class Lighting:
    """A lamp as the camera sees it, radians; colour (3,): linear sRGB of white paper that faces it."""

    elevation: float
    azimuth: float
    colour: tuple[float, float, float]
    radius: float

    def lamp(self, camera_azimuth: float) -> Lamp:
        """Return the lamp in the scene."""
        towards = around((0, 0, 0), elevation=self.elevation, azimuth=self.azimuth + camera_azimuth, distance=1.0)
        return Lamp(direction=tuple(towards), colour=self.colour, radius=self.radius)


@dataclass(frozen=True)
class Studio:
    """A cloth with lamps and camera."""

    scene: ClothScene  # the cloth (material 0) and the paper (material 1, where there is one)
    camera: Camera
    azimuth: float  # of the camera, about `middle`
    middle: np.ndarray
    lights: tuple[Lighting, ...]
    lamps: tuple[Lamp, ...]  # the lights in the scene
    surroundings: Surroundings
    paper: Matte | None

    def turned(self, angle: float) -> "Studio":
        """Return the cloth turned about the vertical, radians: seen from a camera that went round it with its lamps.

        The paper must look the same from all sides (wall=False).
        """
        spin = rotation_matrix(np.array([0.0, -angle, 0.0]))
        rotation = self.camera.rotation @ spin.T
        centre = spin @ (self.camera.centre - self.middle) + self.middle
        camera = replace(self.camera, rotation=rotation, translation=-rotation @ centre)
        azimuth = self.azimuth - angle
        lamps = tuple(light.lamp(azimuth) for light in self.lights)
        return replace(self, camera=camera, azimuth=azimuth, lamps=lamps)

    def lit_from(self, angle: float) -> "Studio":
        """Return the lamps turned about the vertical."""
        return replace(self, lamps=tuple(light.lamp(self.azimuth + angle) for light in self.lights))

    def take(self, brdf: Brdf, lamps: tuple[float, ...] | None = None) -> RenderVariant:
        """Return the cloth of a BRDF under the lamps with these factors; all lamps in full where none are given."""
        materials = (brdf,) if self.paper is None else (brdf, self.paper)
        return RenderVariant(materials, tuple(1.0 for _ in self.lamps) if lamps is None else lamps)

    def render(self, takes: list[RenderVariant], *, supersampling: int, shadows: bool = True) -> list[ClothPicture]:
        """See `frame.render`."""
        return render(
            self.scene, takes, list(self.lamps), self.camera, surroundings=self.surroundings,
            supersampling=supersampling, shadows=shadows,
        )  # fmt: skip


def studio(
    surfaces: list[Surface],
    lights: list[Lighting],
    view: Viewpoint,
    *,
    level: float,
    reflectance: float,
    wall: bool = True,
    margin: float = MARGIN,
) -> Studio:
    """Return surfaces of cloth with their lowest point on the floor, before a camera that holds them in its picture.

    level: radiance of the room above, a third of it below; reflectance: of the paper, 0 for none; wall: whether the
    paper rises behind. Lamps and paper turn with the camera's azimuth. The scene's unit is that of the surfaces.
    """
    points = np.concatenate([surface.mesh.vertices for surface in surfaces])
    extent = float(np.linalg.norm(np.ptp(points, axis=0)))
    camera, azimuth = framed(points, **view._asdict(), margin=margin), view.azimuth
    ground = None
    if reflectance > 0:
        ground = Matte((reflectance,) * 3)
        surfaces = [*surfaces, paper_below(points, azimuth=azimuth, wall=wall)]
    scene = ClothScene.of(surfaces)
    light = AmbientLight((level,) * 3, (level / 3,) * 3, reach=0.45 * extent)
    lamps = tuple(light.lamp(azimuth) for light in lights)
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    return Studio(scene, camera, azimuth, middle, tuple(lights), lamps, Surroundings.of(scene, light), ground)


def paper_below(points: np.ndarray, *, azimuth: float, wall: bool = True) -> Surface:
    """Return the paper on which points (n, 3) stand, for a camera at this azimuth; see `studio`."""
    extent = float(np.linalg.norm(np.ptp(points, axis=0)))
    width, height, bend = (3.0 * extent, 2.6 * extent, 0.55 * extent) if wall else (12 * extent, 0.0, 0.0)
    low, high = points.min(axis=0), points.max(axis=0)
    # a little below the lowest point, so that the two do not touch
    foot = np.array([(low[0] + high[0]) / 2, low[1] - 4e-4 * extent, (low[2] + high[2]) / 2])
    return moved(paper(width, 0.95 * extent, height, bend, turn=azimuth), foot)


def moved(surface: Surface, by: np.ndarray) -> Surface:
    """Return the surface shifted by a vector (3,)."""
    mesh = surface.mesh
    return replace(surface, mesh=Mesh(mesh.vertices + by, mesh.triangles, mesh.normals))


def tubes() -> list[Surface]:
    """Return three upright cylinders of the cloth side by side: warp upright, oblique, and around."""
    radius, height, gap = 0.11, 0.42, 0.07
    return [
        cylinder(radius, height, centre=((k - 1) * (2 * radius + gap), 0.0, 0.0), turn=-turn)
        for k, turn in enumerate((0.0, np.pi / 4, np.pi / 2))
    ]


def linear_colour(code: str) -> tuple[float, float, float]:
    """Return linear sRGB of #rrggbb, IEC 61966-2-1."""
    coded = np.array([int(code[k : k + 2], 16) for k in (1, 3, 5)]) / 255
    red, green, blue = decode(coded, "srgb").tolist()
    return red, green, blue


def turning(count: int) -> Iterator[float]:
    """Yield azimuths of the frames of a full turn, radians; the last is a step before the first."""
    return (2 * np.pi * k / count for k in range(count))
