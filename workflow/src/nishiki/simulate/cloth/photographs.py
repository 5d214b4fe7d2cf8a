"""Photographs of a cloth on the goniometer, of the white board in its place and of the closed lens."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numba
import numpy as np

from nishiki.simulate.cloth.reflectance import Cloth, blocks, cell_maps
from nishiki.simulate.cloth.settings import GoniometerSettings, unit
from nishiki.simulate.randomness import subkey, uniform
from nishiki.simulate.sensor import expose
from nishiki.threads import over_rows

BASE_S = 1.0 / 15.0  # exposure in which a perfect white that faces the lamp reaches camera.white_level
STOPS = (-3, 8)  # exposures are base · 2^k
BRIGHTEST = 0.85  # share of full scale that the brightest pixel of a photograph may reach
TINT = (0.86, 1.0, 0.78)  # what a white gives in each channel, the largest = 1
_SAMPLES = 24  # a pixel
_R2 = (0.7548776662466927, 0.5698402909980532)  # Roberts' sequence in two dimensions: 1/p, 1/p², p³ = p + 1


@dataclass(frozen=True)
class Shot:
    """One photograph: row of the session's angles, codes (rows, columns, channels) uint16, exposure in seconds, and the
    noise-free reflectances (cloths, channels) in 1/sr."""

    row: int
    codes: np.ndarray
    exposure_s: float
    reflectance: np.ndarray


def photographs(cloths: tuple[Cloth, ...], settings: GoniometerSettings) -> Iterator[Shot]:
    """All photographs of the session, not in its order: those that share their rays come together."""
    angles = settings.angles_deg
    incident, outgoing = unit(angles[:, 0], angles[:, 1]), unit(angles[:, 2], angles[:, 3])
    for parts in zip(*(blocks(cloth, incident, outgoing) for cloth in cloths), strict=True):
        maps = [cell_maps(cloth, *part[1:]) for cloth, part in zip(cloths, parts, strict=True)]
        for k, row in enumerate(parts[0][0]):
            cells = [pictures[k] for pictures in maps]
            reflectance = np.array([cell.mean(axis=(0, 1)) for cell in cells])
            light = on_sensor(cells, cloths, angles[row], settings) * (math.pi * incident[row, 2] * np.array(TINT))
            exposure = exposure_for(light, settings)
            signal = light * (settings.camera.white_level * exposure / BASE_S)
            key = subkey(settings.seed, f"cloth noise {row}")
            yield Shot(int(row), expose(signal, settings.camera, key=key), exposure, reflectance)


def on_sensor(cells: list[np.ndarray], cloths, angles_deg: np.ndarray, settings: GoniometerSettings) -> np.ndarray:
    """BRDF (rows, columns, channels) seen by the pixels: the periodic pictures, turned and foreshortened; the warp
    points upwards as far as it can. Of two cloths the first lies on the left, the second on the right of the middle."""
    view = unit(angles_deg[2], angles_deg[3])
    up = np.array([0.0, 1.0, 0.0]) - view[1] * view
    up /= np.linalg.norm(up)
    right = np.cross(up, view)
    to_cloth = np.linalg.inv(np.array([right[:2], up[:2]]))
    sizes = np.array([[cloth.solids.weft.length, cloth.solids.warp.length] for cloth in cloths])
    out = np.empty((settings.rows, settings.columns, cells[0].shape[2]))
    key = np.uint64(subkey(settings.seed, "cloth pixels"))
    args = (key, to_cloth, settings.pitch_mm, sizes, cells[0], cells[-1], len(cells) > 1, out)
    over_rows(_project, settings.rows, *args)
    return out


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _project(start, stop, key, to_cloth, pitch, sizes, ground, figure, two, out):
    """Means over a point sequence in each pixel, shifted at random from pixel to pixel: the period of the cloth and a
    regular grid of samples would beat against each other."""
    rows, columns, channels = out.shape
    share = 1.0 / _SAMPLES
    for row in range(start, stop):
        for column in range(columns):
            for channel in range(channels):
                out[row, column, channel] = 0.0
            place = np.uint64(2 * (row * columns + column))
            a, b = uniform(key, place), uniform(key, place + np.uint64(1))
            for _ in range(_SAMPLES):
                a, b = a + _R2[0], b + _R2[1]
                a, b = a - math.floor(a), b - math.floor(b)
                u, w = pitch * (column + a - 0.5 * columns), pitch * (0.5 * rows - row - b)
                x, y = to_cloth[0, 0] * u + to_cloth[0, 1] * w, to_cloth[1, 0] * u + to_cloth[1, 1] * w
                k = 1 if two and x > 0.0 else 0
                cell = figure if k == 1 else ground
                s, t = x / sizes[k, 0], y / sizes[k, 1]
                i = min(int((s - math.floor(s)) * cell.shape[1]), cell.shape[1] - 1)
                j = min(int((t - math.floor(t)) * cell.shape[0]), cell.shape[0] - 1)
                for channel in range(channels):
                    out[row, column, channel] += share * cell[j, i, channel]


def region_labels(settings: GoniometerSettings, *, pixels: int = 256, coarser: float = 4.0) -> tuple[np.ndarray, float]:
    """Label picture (pixels, pixels) uint16 of two cloths as seen along the normal, 1 and 2, and its pitch in mm. It
    reaches much farther than a photograph along the normal: oblique ones show more of the cloth."""
    columns = np.where(np.arange(pixels) < pixels // 2, 1, 2).astype(np.uint16)
    return np.tile(columns, (pixels, 1)), coarser * settings.pitch_mm


def exposure_for(light: np.ndarray, settings: GoniometerSettings) -> float:
    """The longest exposure of the series, in seconds, at which no pixel is brighter than BRIGHTEST."""
    level = max(float(light.max()) * settings.camera.white_level, 1e-9)
    stop = math.floor(math.log2(BRIGHTEST / level))
    return BASE_S * 2.0 ** min(max(stop, STOPS[0]), STOPS[1])


def white_board(number: int, theta_i_deg: float, settings: GoniometerSettings) -> tuple[np.ndarray, float]:
    """Codes and exposure of the matt board under one lamp. Its reflectance varies a little from place to place."""
    random = np.random.default_rng(subkey(settings.seed, "cloth board"))
    texture = 1.0 + settings.white_texture * random.standard_normal((settings.rows, settings.columns, 1))
    cosine = math.cos(math.radians(theta_i_deg))
    light = settings.white_reflectance * cosine * texture * np.array(TINT)
    exposure = exposure_for(light, settings)
    signal = light * (settings.camera.white_level * exposure / BASE_S)
    return expose(signal, settings.camera, key=subkey(settings.seed, f"cloth noise white {number}")), exposure
