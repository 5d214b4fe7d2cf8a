"""A picture of a scene: what each sample shows, the light that reaches it, and the cloth's reflection of it."""

from dataclasses import dataclass

import numpy as np
from numba import njit

from nishiki.errors import UserError
from nishiki.geometry.camera import Camera
from nishiki.geometry.turn import scaled
from nishiki.geometry.visibility import rasterise
from nishiki.render.cloth.around import Surroundings
from nishiki.render.cloth.local import Fragments, gather, lit
from nishiki.render.cloth.models import share_of
from nishiki.render.cloth.scene import Brdf, ClothScene, Lamp, together
from nishiki.threads import over_items

BAND_SAMPLES = 1 << 18
"""Samples held at a time."""
AT_ONCE = 1 << 14
"""Directions that a BRDF is given at a time."""
WITHIN = np.radians(2.0)
"""Samples of a pixel whose frames differ by less than this share their BRDF value."""
LEAST_COSINE = 0.05
"""A sample that the lamp reaches at a lower angle than this does not stand for others."""


@dataclass(frozen=True)
class RenderVariant:
    """One way to show a scene: the BRDF of each material, a factor for each lamp, and one for the light around."""

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
    _check(scene, takes, lamps, supersampling)
    fine = scaled(camera, supersampling)
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


def _check(scene: ClothScene, takes: list[RenderVariant], lamps: list[Lamp], supersampling: int) -> None:
    if supersampling < 1:
        raise UserError(f"supersampling: expected 1 or more, found {supersampling}")
    needed = int(scene.material.max()) + 1
    for take in takes:
        if len(take.materials) < needed or len(take.lamps) != len(lamps):
            raise UserError(
                f"render: expected {needed} materials and {len(lamps)} lamps in every take, found "
                f"{len(take.materials)} and {len(take.lamps)}"
            )


def _add_lamps(sums, scene, takes, lamps, samples: Fragments, shadows: bool, tally: _Tally) -> None:
    """Add what the lamps make the samples send to the eye to sums (takes, pixels, 3)."""
    tally.samples += len(samples.pixel)
    tally.bent += samples.bent
    for number, lamp in enumerate(lamps):
        light = lit(scene, samples, lamp, shadows)
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
                picture = np.zeros(sums.shape[1:])
                _gather(samples.pixel, rows, where, each * (np.pi * np.asarray(lamp.colour)), light.strength, picture)
                for k, take in enumerate(takes):
                    if take.lamps[number] and id(take.materials[material]) == brdf:
                        sums[k] += take.lamps[number] * picture


@njit(cache=True, nogil=True, error_model="numpy")
def _gather(pixel, rows, where, values, strength, out):
    """Add up in out (pixels, 3) the values (m, 3) of samples at rows (n,), found at `where` (n,), times strength."""
    for k in range(rows.size):
        for c in range(3):
            out[pixel[rows[k]], c] += values[where[k], c] * strength[rows[k]]


def _values(brdfs: list[Brdf], incident: np.ndarray, outgoing: np.ndarray, samples: np.ndarray):
    """Each BRDF at the distinct samples among those wanted, (m, 3) each, and their places there (n,).

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
    """Add the light from around to sums (takes, pixels, 3)."""
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
