"""Render a surface on paper in a studio, with lamps relative to the camera, and dyes given by their colours.

Of each sample of a picture: what it shows, the light that reaches it, and the cloth's reflection of it.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from nishiki.colour.colour import decode
from nishiki.errors import UserError
from nishiki.geometry.camera import Camera, look_at
from nishiki.geometry.mesh import Mesh
from nishiki.geometry.turn import rotation_matrix, scale_camera
from nishiki.geometry.visibility import rasterise
from nishiki.render.cloth.models import Fragments, Surroundings, added_up, gather, light_from, share_of
from nishiki.render.cloth.scene import AmbientLight, Brdf, ClothScene, Lamp, Matte, Surface, together
from nishiki.render.cloth.surfaces import cylinder, paper
from nishiki.threads import over_items

BAND_SAMPLES = 1 << 18
"""Number of samples held at a time."""
AT_ONCE = 1 << 14
"""Number of directions evaluated by a BRDF at a time."""
WITHIN = np.radians(2.0)
"""Largest difference of frames between samples of a pixel that share their BRDF value."""
LEAST_COSINE = 0.05
"""Least cosine of the lamp's angle at a sample that represents others."""


@dataclass(frozen=True)
class RenderVariant:
    """One variant of a scene: the BRDF of each material, a factor for each lamp, and one for the ambient light."""

    materials: tuple[Brdf, ...]
    lamps: tuple[float, ...]
    around: float = 1.0


@dataclass(frozen=True)
class ClothPicture:
    """A picture of a cloth."""

    # (rows, columns, 3) float32: radiance relative to a white that faces a lamp of colour 1, mean over the whole pixel
    # (0 where nothing is)
    linear: np.ndarray
    # (rows, columns) float32: part of the pixel that shows a surface, cloth: that shows material 0
    coverage: np.ndarray
    cloth: np.ndarray
    samples: int  # points shaded
    evaluated: int  # places of the BRDF computed for all takes
    bent: float  # share of them whose normal was turned towards the eye
    shadowed: float  # share of the lamps' light on them that other surfaces took away


@dataclass
class _Tally:
    samples: int = 0
    bent: int = 0
    reaching: float = 0.0
    blocked: float = 0.0
    evaluated: int = 0


def render(
    scene: ClothScene,
    takes: list[RenderVariant],
    lamps: list[Lamp],
    camera: Camera,
    *,
    surroundings: Surroundings | None = None,
    supersampling: int = 3,
    shadows: bool = True,
    within: float = WITHIN,
) -> list[ClothPicture]:
    """Draw the scene from a camera for every take; visibility, shadows and BRDF values are computed once.

    L = sum over lamps of pi f(i, o) cos theta_i E V, so that white paper that faces a lamp of colour 1 is 1; V: the
    lamp's visibility, one point of its disc for each sample. supersampling squared samples a pixel, even mean.
    Channels: three are shown as linear sRGB, any other number as the grey of their mean. Bytes do not depend on the
    number of threads.

    within: radians; the BRDF is evaluated once for the samples of a pixel whose frames differ by less, see `gather`.
    """
    if supersampling < 1:
        raise UserError(f"supersampling: expected 1 or more, found {supersampling}")
    needed = int(scene.material.max()) + 1
    for take in takes:
        if len(take.materials) < needed or len(take.lamps) != len(lamps):
            raise UserError(
                f"render: expected {needed} materials and {len(lamps)} lamps in every take, found "
                f"{len(take.materials)} and {len(take.lamps)}"
            )
    fine = scale_camera(camera, supersampling)
    linear = np.zeros((len(takes), camera.rows, camera.columns, 3), np.float32)
    coverage, cloth = np.zeros((2, camera.rows, camera.columns), np.float32)
    tally = _Tally()
    height = max(1, BAND_SAMPLES // (fine.columns * supersampling))
    for first in range(0, camera.rows, height):
        stop = min(first + height, camera.rows)
        raster = rasterise(scene.mesh, fine, rows=(first * supersampling, stop * supersampling))
        samples = gather(scene, raster, fine, supersampling, within=within)
        if not len(samples.pixel):
            continue
        size, shape = (stop - first) * camera.columns, (stop - first, camera.columns)
        sums = np.zeros((len(takes), size, 3))
        _add_lamps(sums, scene, takes, lamps, samples, shadows, tally)
        if surroundings is not None:
            _add_around(sums, takes, samples, surroundings)
        linear[:, first:stop] = (sums / supersampling**2).reshape(len(takes), *shape, 3)
        covered = np.bincount(samples.pixel, minlength=size) / supersampling**2
        coverage[first:stop] = covered.reshape(shape)
        covered = np.bincount(samples.pixel, weights=samples.material == 0, minlength=size) / supersampling**2
        cloth[first:stop] = covered.reshape(shape)
    shadowed = tally.blocked / tally.reaching if tally.reaching > 0 else 0.0
    bent = tally.bent / max(1, tally.samples)
    return [ClothPicture(one, coverage, cloth, tally.samples, tally.evaluated, bent, shadowed) for one in linear]


def _add_lamps(sums, scene, takes, lamps, samples: Fragments, shadows: bool, tally: _Tally) -> None:
    """Add the lamps' light reflected by the samples to the eye to sums (takes, pixels, 3)."""
    tally.samples += len(samples.pixel)
    tally.bent += samples.bent
    for number, lamp in enumerate(lamps):
        light = light_from(scene, samples, lamp, shadows)
        tally.reaching += float(light.before.sum())
        tally.blocked += float(light.before.sum() - light.strength.sum())
        reached = light.strength > 0
        stands = np.where(light.incident[samples.stands, 2] > LEAST_COSINE, samples.stands, np.arange(len(reached)))
        for material in range(int(scene.material.max()) + 1):
            rows = np.flatnonzero(reached & (samples.material == material))
            brdfs = {id(take.materials[material]): take.materials[material] for take in takes if take.lamps[number]}
            if not brdfs or not len(rows):
                continue
            values, where = _values(list(brdfs.values()), light.incident, samples.outgoing, stands[rows])
            tally.evaluated += len(values[0])
            for each, brdf in zip(values, brdfs, strict=True):
                sent = each[where] * (np.pi * light.strength[rows, None] * np.asarray(lamp.colour))
                picture = added_up(samples.pixel[rows], sent, sums.shape[1])
                for k, take in enumerate(takes):
                    if take.lamps[number] and id(take.materials[material]) == brdf:
                        sums[k] += take.lamps[number] * picture


def _values(brdfs: list[Brdf], incident: np.ndarray, outgoing: np.ndarray, samples: np.ndarray):
    """Evaluate each BRDF at the distinct samples, (m, 3) each; return these and the samples' places there (n,).

    Portions are shared among threads: models are compiled or array code, which lets others run beside it.
    """
    used = np.zeros(len(incident), bool)
    used[samples] = True
    distinct, where = np.flatnonzero(used), np.cumsum(used)[samples] - 1
    out = [np.empty((len(distinct), 3)) for _ in brdfs]

    def fill(start: int) -> None:
        rows = distinct[start : start + AT_ONCE]
        i, o = np.ascontiguousarray(incident[rows]), np.ascontiguousarray(outgoing[rows])
        for values, one in zip(out, together(brdfs, i, o), strict=True):
            values[start : start + AT_ONCE] = one

    over_items(fill, range(0, len(distinct), AT_ONCE))
    return out, where


def _add_around(sums, takes, samples: Fragments, surroundings: Surroundings) -> None:
    """Add the ambient light to sums (takes, pixels, 3)."""
    for material in range(max(len(take.materials) for take in takes)):
        rows = np.flatnonzero(samples.material == material)
        lit_takes = [k for k, take in enumerate(takes) if take.around and material < len(take.materials)]
        brdfs = {id(takes[k].materials[material]): takes[k].materials[material] for k in lit_takes}
        for key, brdf in brdfs.items():
            if key not in surroundings.tables:
                surroundings.tables[key] = brdf, share_of(brdf)
        if not brdfs or not len(rows):
            continue
        tables = [surroundings.tables[key][1] for key in brdfs]
        pictures = dict(zip(brdfs, surroundings.radiance(tables, samples, rows, sums.shape[1]), strict=True))
        for k in lit_takes:
            sums[k] += takes[k].around * pictures[id(takes[k].materials[material])]


def around(target, *, elevation: float, azimuth: float, distance: float) -> np.ndarray:
    """Compute a place (3,) about a target: azimuth from z (to the viewer) to x (right), elevation above the floor."""
    level = np.cos(elevation)
    towards = np.array([level * np.sin(azimuth), np.sin(elevation), level * np.cos(azimuth)])
    return np.asarray(target, np.float64) + distance * towards


MARGIN = 1.18
"""Ratio of a studio's picture to the extent of its content."""


def frame_camera(
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
    """A camera's angles about its target, radians, its distance in extents of the target, and its pixels."""

    elevation: float
    azimuth: float
    distance: float
    rows: int
    columns: int


@dataclass(frozen=True)
class Lighting:
    """A lamp relative to the camera, radians; colour (3,): linear sRGB of white paper that faces it."""

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

    def turn(self, angle: float) -> "Studio":
        """Rotate the cloth about the vertical, radians: as if the camera went round it with its lamps.

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
        """Rotate the lamps about the vertical."""
        return replace(self, lamps=tuple(light.lamp(self.azimuth + angle) for light in self.lights))

    def take(self, brdf: Brdf, lamps: tuple[float, ...] | None = None) -> RenderVariant:
        """Return the variant of a BRDF under the lamps with these factors; all lamps in full where none are given."""
        materials = (brdf,) if self.paper is None else (brdf, self.paper)
        return RenderVariant(materials, tuple(1.0 for _ in self.lamps) if lamps is None else lamps)

    def render(self, takes: list[RenderVariant], *, supersampling: int, shadows: bool = True) -> list[ClothPicture]:
        """Render the scene, see `frame.render`."""
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
    """Place surfaces of cloth with their lowest point on the floor, before a camera that frames them.

    level: radiance of the room above, a third of it below; reflectance: of the paper, 0 for none; wall: whether the
    paper rises behind. Lamps and paper turn with the camera's azimuth. The scene's unit is that of the surfaces.
    """
    points = np.concatenate([surface.mesh.vertices for surface in surfaces])
    extent = float(np.linalg.norm(np.ptp(points, axis=0)))
    camera, azimuth = frame_camera(points, **view._asdict(), margin=margin), view.azimuth
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
    below = paper(width, 0.95 * extent, height, bend, turn=azimuth)
    return replace(below, mesh=Mesh(below.mesh.vertices + foot, below.mesh.triangles, below.mesh.normals))


def tubes() -> list[Surface]:
    """Make three upright cylinders of the cloth side by side: warp upright, oblique, and around."""
    radius, height, gap = 0.11, 0.42, 0.07
    return [
        cylinder(radius, height, centre=((k - 1) * (2 * radius + gap), 0.0, 0.0), turn=-turn)
        for k, turn in enumerate((0.0, np.pi / 4, np.pi / 2))
    ]


def linear_colour(code: str) -> tuple[float, float, float]:
    """Convert #rrggbb to linear sRGB, IEC 61966-2-1."""
    coded = np.array([int(code[k : k + 2], 16) for k in (1, 3, 5)]) / 255
    red, green, blue = decode(coded, "srgb").tolist()
    return red, green, blue


def turning(count: int) -> Iterator[float]:
    """Yield azimuths of the frames of a full turn, radians; the last is a step before the first."""
    return (2 * np.pi * k / count for k in range(count))
