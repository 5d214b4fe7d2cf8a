"""The yarns as solids: swept, flattened sections, periodic in x and y.

x along the weft, y along the warp, z up; lengths in mm. A yarn's section in a plane across it is the set
|ζ|² + |u|^e < 1 with u = v/a (v from the centre line) and ζ = (z − z_c − roll·v)/b. The compiled functions take the
solids as `Solids.numbers` and `Solids.free`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from nishiki.simulate.cloth.rays import POWERS, fill_voxels
from nishiki.simulate.cloth.settings import ClothSettings, YarnSettings
from nishiki.simulate.cloth.yarn_path import SAMPLES, Descent, centre_line, weave_pattern
from nishiki.simulate.randomness import subkey
from nishiki.threads import over_rows

_STEP = 0.12  # of the thinner yarn's thickness
_ACROSS, _UP = 20, 28  # voxels a yarn, and in the cloth's height, of the map of free distances


@dataclass(frozen=True)
class Yarns:
    """One system. spacing, length (a period along the yarn) in mm. shape : (yarns, 3) offset of the centre line
    sideways, half width a, half thickness b. path : (yarns, samples, 4) height of the centre line, its slope, roll
    (shear of the section) and its slope along the yarn. exponent : of the section. power : |u|^e at 0 .. 1."""

    spacing: float
    length: float
    shape: np.ndarray
    path: np.ndarray
    exponent: float
    power: np.ndarray
    descent: Descent


@dataclass(frozen=True)
class Solids:
    """Both systems. pattern : (weft, warp) bool over the whole cell, True where the warp is on top. free : (z, y, x)
    float32 mm, how far from a place in that voxel there is certainly no yarn."""

    warp: Yarns
    weft: Yarns
    pattern: np.ndarray
    free: np.ndarray

    @property
    def area(self) -> float:
        """Of the cell on the plane, mm²."""
        return self.warp.length * self.weft.length

    @property
    def numbers(self) -> np.ndarray:
        """What the compiled functions need beside `free`, in one row: see `_pack`."""
        return _pack(self.warp, self.weft)


_HEAD = 18


def _pack(warp: Yarns, weft: Yarns) -> np.ndarray:
    """0, 1 spacing of warp and weft; 2, 3 lowest and highest z; 4 step of a ray. Then for warp (5 ..) and weft (11 ..):
    number of yarns, samples of a path, exponent, and where shape, path and power begin. One row of numbers, because
    compiled functions count the references of every array that they hand on, which costs more than the arithmetic."""
    parts, head, end = [], [warp.spacing, weft.spacing, *_heights(warp, weft)], _HEAD
    for yarns in (warp, weft):
        head += [len(yarns.shape), yarns.path.shape[1], yarns.exponent]
        for values in (yarns.shape, yarns.path, yarns.power):
            head.append(end)
            parts.append(values.ravel())
            end += values.size
    return np.concatenate([np.array([*head, 0.0]), *parts])


def _heights(warp: Yarns, weft: Yarns) -> tuple[float, float, float]:
    """Lowest and highest z, length of a step of a ray; mm."""
    tops = [y.shape[:, 2] + np.abs(y.path[..., 2]).max(axis=1) * y.shape[:, 1] for y in (warp, weft)]
    low = min(np.min(y.path[..., 0].min(axis=1) - top) for y, top in zip((warp, weft), tops, strict=True))
    high = max(np.max(y.path[..., 0].max(axis=1) + top) for y, top in zip((warp, weft), tops, strict=True))
    return low, high, _STEP * 2.0 * min(warp.shape[:, 2].min(), weft.shape[:, 2].min())


def make_solids(settings: ClothSettings) -> Solids:
    """The yarns of one irregular cell. At a crossing warp and weft touch: their amplitudes add up to the sum of their
    half thicknesses, `warp_crimp` of it being the warp's."""
    pattern = weave_pattern(settings.weave, settings.harness, settings.step, face=settings.face)
    pattern = np.tile(pattern, (settings.repeats, settings.repeats))
    contact = 0.5 * (settings.warp.thickness_mm + settings.weft.thickness_mm)
    warp, weft = settings.warp_crimp * contact, (1.0 - settings.warp_crimp) * contact
    random = np.random.default_rng(subkey(settings.seed, "cloth yarns"))
    systems = (
        _system(settings, settings.warp, settings.weft.spacing_mm, pattern.T, warp, random),
        _system(settings, settings.weft, settings.warp.spacing_mm, ~pattern, weft, random),
    )
    return Solids(*systems, pattern, _free_distances(*systems))


def _free_distances(warp: Yarns, weft: Yarns) -> np.ndarray:
    """Distance of every voxel's centre from the nearest voxel whose centre is in a yarn, less a voxel's diagonal: what
    of a yarn reaches beyond such voxels is much smaller than that, because sections are blunt."""
    from scipy.ndimage import distance_transform_edt

    counts = (_UP, len(weft.shape) * _ACROSS, len(warp.shape) * _ACROSS)
    numbers = _pack(warp, weft)
    sizes = np.array([(numbers[3] - numbers[2]) / _UP, weft.spacing / _ACROSS, warp.spacing / _ACROSS])
    empty = np.empty(counts, np.uint8)
    over_rows(fill_voxels, counts[0], sizes, numbers, empty)
    margin = _ACROSS  # distances beyond the cloth's height are of no use: the period need only be extended a little
    padded = np.pad(empty, ((0, 0), (margin, margin), (margin, margin)), mode="wrap")
    distance = distance_transform_edt(padded, sampling=sizes)[:, margin:-margin, margin:-margin]
    reach = 0.9 * margin * sizes[1:].min()
    return np.clip(distance - np.linalg.norm(sizes), 0.0, reach).astype(np.float32)


def _system(settings: ClothSettings, yarn: YarnSettings, crossed: float, on_top, amplitude: float, random) -> Yarns:
    count, crossings = on_top.shape
    paths = []
    for row in on_top:
        height, slope, descent = centre_line(
            row,
            spacing=crossed,
            amplitude=amplitude,
            bend=settings.bend,
            rest=settings.rest,
            arch=math.tan(math.radians(settings.arch_deg)),
        )
        paths.append(np.stack([height, slope], axis=-1))
    length = crossings * crossed
    waves = _waves(random, count, crossings * SAMPLES, length)
    uneven = settings.irregularity
    thickness, roll = 0.5 * yarn.thickness_mm, 0.05 * uneven
    path = np.concatenate([np.array(paths), roll * waves[1]], axis=-1)
    path[..., :2] += 0.04 * uneven * yarn.thickness_mm * waves[0]
    half = 0.5 * yarn.spacing_mm * yarn.fill
    free = 0.5 * yarn.spacing_mm - half
    shape = np.empty((count, 3))
    shape[:, 0] = np.clip(0.02 * uneven * yarn.spacing_mm * random.standard_normal(count), -0.9 * free, 0.9 * free)
    shape[:, 1] = np.minimum(half * (1.0 + 0.03 * uneven * random.uniform(-1.0, 1.0, count)), half + 0.1 * free)
    shape[:, 2] = thickness * (1.0 + 0.05 * uneven * random.uniform(-1.0, 1.0, count))
    power = np.linspace(0.0, 1.0, POWERS + 1) ** yarn.flatness
    return Yarns(yarn.spacing_mm, length, shape, path, yarn.flatness, power, descent)


def _waves(random, count: int, samples: int, length: float) -> np.ndarray:
    """(2, count, samples, 2) smooth periodic curves of variance about 1, and their slopes: a mean and two waves."""
    t = 2.0 * math.pi * np.arange(samples) / samples
    amplitude, phase = random.standard_normal((2, count, 3)), random.uniform(0.0, 2.0 * math.pi, (2, count, 3))
    curve = np.repeat(amplitude[..., :1, None], samples, axis=2)[..., 0] * 0.7
    slope = np.zeros_like(curve)
    for wave in (1, 2):
        a, p = amplitude[..., wave, None] * 0.7, phase[..., wave, None]
        curve = curve + a * np.cos(wave * t + p)
        slope = slope - a * wave * np.sin(wave * t + p) * (2.0 * math.pi / length)
    return np.stack([curve, slope], axis=-1)
