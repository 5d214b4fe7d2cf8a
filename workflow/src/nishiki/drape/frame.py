"""A picture of a scene: what each sample shows, the light that reaches it, and the cloth's reflection of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from nishiki.drape.around import Surroundings, shares
from nishiki.drape.local import Samples, gather, lit
from nishiki.drape.scene import Brdf, Lamp, Scene, three
from nishiki.errors import UserError
from nishiki.geometry.camera import Camera
from nishiki.patches.raster import rasterise
from nishiki.turntable.turn import scaled

BAND_SAMPLES = 1 << 20
"""Samples held at a time."""
AT_ONCE = 1 << 16
"""Directions that a BRDF is given at a time."""


@dataclass(frozen=True)
class Take:
    """One way to show a scene from one camera: the BRDF of each material, a factor for each lamp, and one for the light
    from around."""

    materials: tuple[Brdf, ...]
    lamps: tuple[float, ...]
    around: float = 1.0


@dataclass(frozen=True)
class Picture:
    """linear (rows, columns, 3) float32: radiance relative to a white that faces a lamp of colour 1, mean over the
    whole pixel (0 where nothing is); coverage (rows, columns) float32: part of the pixel that shows a surface;
    samples: points shaded; bent: share of them whose normal was turned towards the eye; shadowed: share of the
    lamps' light on them that other surfaces took away."""

    linear: np.ndarray
    coverage: np.ndarray
    samples: int
    bent: float
    shadowed: float


@dataclass
class _Tally:
    samples: int = 0
    bent: int = 0
    reaching: float = 0.0
    blocked: float = 0.0


def render(
    scene: Scene,
    takes: list[Take],
    lamps: list[Lamp],
    camera: Camera,
    *,
    surroundings: Surroundings | None = None,
    supersampling: int = 3,
    shadows: bool = True,
) -> list[Picture]:
    """The scene from a camera, once for every take; what they share (visibility, shadows, BRDF values) is computed
    once.

    L = sum over lamps of pi f(i, o) cos theta_i E V, so that white paper that faces a lamp of colour 1 is 1; V: the
    lamp's visibility, one point of its disc for each sample. supersampling squared samples a pixel, even mean.
    Channels: three are shown as linear sRGB, any other number as the grey of their mean. Bytes do not depend on the
    number of threads.
    """
    _check(scene, takes, lamps, supersampling)
    fine = scaled(camera, supersampling)
    linear = np.zeros((len(takes), camera.rows, camera.columns, 3), np.float32)
    coverage = np.zeros((camera.rows, camera.columns), np.float32)
    tally, tables = _Tally(), {}
    height = max(1, BAND_SAMPLES // (fine.columns * supersampling))
    for first in range(0, camera.rows, height):
        stop = min(first + height, camera.rows)
        raster = rasterise(scene.mesh, fine, rows=(first * supersampling, stop * supersampling))
        samples = gather(scene, raster, fine, supersampling)
        if not len(samples.pixel):
            continue
        colours = np.zeros((len(takes), len(samples.pixel), 3))
        _add_lamps(colours, scene, takes, lamps, samples, shadows, tally)
        if surroundings is not None:
            _add_around(colours, takes, samples, surroundings, tables)
        size, shape = (stop - first) * camera.columns, (stop - first, camera.columns)
        for take in range(len(takes)):
            for channel in range(3):
                sums = np.bincount(samples.pixel, weights=colours[take, :, channel], minlength=size)
                linear[take, first:stop, :, channel] = (sums / supersampling**2).reshape(shape)
        covered = np.bincount(samples.pixel, minlength=size) / supersampling**2
        coverage[first:stop] = covered.reshape(shape)
    shadowed = tally.blocked / tally.reaching if tally.reaching > 0 else 0.0
    bent = tally.bent / max(1, tally.samples)
    return [Picture(one, coverage, tally.samples, bent, shadowed) for one in linear]


def _check(scene: Scene, takes: list[Take], lamps: list[Lamp], supersampling: int) -> None:
    if supersampling < 1:
        raise UserError(f"supersampling: expected 1 or more, found {supersampling}")
    needed = int(scene.material.max()) + 1
    for take in takes:
        if len(take.materials) < needed or len(take.lamps) != len(lamps):
            raise UserError(
                f"render: expected {needed} materials and {len(lamps)} lamps in every take, found "
                f"{len(take.materials)} and {len(take.lamps)}"
            )


def _parts(samples: Samples, material: int, wanted: np.ndarray | None = None):
    """Rows of the samples of a material, in portions."""
    rows = np.flatnonzero((samples.material == material) if wanted is None else (samples.material == material) & wanted)
    for start in range(0, len(rows), AT_ONCE):
        yield rows[start : start + AT_ONCE]


def _add_lamps(colours, scene, takes, lamps, samples: Samples, shadows: bool, tally: _Tally) -> None:
    """Add what the lamps make the samples send to the eye to colours (takes, n, 3)."""
    tally.samples += len(samples.pixel)
    tally.bent += samples.bent
    for number, lamp in enumerate(lamps):
        light = lit(scene, samples, lamp, shadows)
        tally.reaching += float(light.before.sum())
        tally.blocked += float(light.before.sum() - light.strength.sum())
        for material in range(int(scene.material.max()) + 1):
            brdfs = {id(take.materials[material]): take.materials[material] for take in takes if take.lamps[number]}
            for rows in _parts(samples, material, light.strength > 0):
                strength = np.pi * light.strength[rows, None] * np.asarray(lamp.colour)
                values = {
                    key: three(brdf.evaluate(light.incident[rows], samples.outgoing[rows])) * strength
                    for key, brdf in brdfs.items()
                }
                for k, take in enumerate(takes):
                    if take.lamps[number]:
                        colours[k, rows] += take.lamps[number] * values[id(take.materials[material])]


def _add_around(colours, takes, samples: Samples, surroundings: Surroundings, tables: dict) -> None:
    """Add the light from around to colours (takes, n, 3); tables: of the materials, by identity, filled as needed."""
    for k, take in enumerate(takes):
        for material, brdf in enumerate(take.materials):
            if take.around and id(brdf) not in tables:
                tables[id(brdf)] = shares(brdf)
            for rows in _parts(samples, material) if take.around else ():
                colours[k, rows] += take.around * surroundings.radiance(tables[id(brdf)], samples.take(rows))
