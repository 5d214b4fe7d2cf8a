"""Light that leaves the object towards the camera under one lamp, averaged over each camera pixel."""

import math
from dataclasses import dataclass

import numba
import numpy as np

from nishiki.simulate.painting.objects import SimulatedObject
from nishiki.simulate.painting.relief import REACH_PIXELS, bounced_irradiance, visible_share
from nishiki.simulate.painting.settings import LampPose, SimulationSettings
from nishiki.simulate.reflection import ggx_gloss, rough_body
from nishiki.threads import over_rows

BODY_SIGMA = 0.20  # roughness of the paint itself, radians (Oren-Nayar)


@dataclass(frozen=True)
class Shading:
    """What one lamp does to some rows of the picture, relative to a white diffuser facing the lamp; all float32."""

    body: np.ndarray  # (rows, columns, tables) body reflection through each column of the colour table, bounce included
    gloss: np.ndarray  # (rows, columns) mirror reflection, the same at all wavelengths
    irradiance: np.ndarray  # (rows, columns) direct, with shadows
    lit: np.ndarray  # (rows, columns) share of the pixel's area times the lamp's disc that is lit


@numba.njit(cache=True, error_model="numpy")
def _shade_sample(height, i, j, step, lamp, optics, alpha, wave):
    """Compute (lit share, irradiance, body, gloss) of one sample.

    lamp: unit direction, and the inverse length of light + view; optics as of `_shade`.
    """
    (lx, ly, lz, half), (radius, ceiling, index, sigma) = lamp, optics
    up, down = max(i - 1, 0), min(i + 1, height.shape[0] - 1)
    left, right = max(j - 1, 0), min(j + 1, height.shape[1] - 1)
    p = (np.float64(height[i, right]) - np.float64(height[i, left])) / ((right - left) * step)
    q = (np.float64(height[up, j]) - np.float64(height[down, j])) / ((down - up) * step)
    n_v = 1.0 / math.sqrt(1.0 + p * p + q * q)
    n_l = (lz - p * lx - q * ly) * n_v
    if n_l <= 0.0:
        return 0.0, 0.0, 0.0, 0.0
    visible = visible_share(height, i, j, (lx, ly, lz), step, ceiling, radius)
    if visible <= 0.0:
        return 0.0, 0.0, 0.0, 0.0
    body = n_l * visible
    if sigma > 0.0:
        body *= rough_body(n_l, n_v, lz, sigma, index)
    gloss = 0.0
    if alpha > 0.0:
        # The varnish is not quite parallel to the paint: its own gentle waves tilt the mirror.
        p, q = p + wave[0], q + wave[1]
        m_v = 1.0 / math.sqrt(1.0 + p * p + q * q)
        m_l = (lz - p * lx - q * ly) * m_v
        m_h = ((lz + 1.0) - p * lx - q * ly) * half * m_v
        gloss = visible * ggx_gloss(m_l, m_v, m_h, (lz + 1.0) * half, alpha, index)
    return visible, n_l * visible, body, gloss


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _shade(start, stop, first, maps, paints, grid, lamp, out):
    """Shade rows of camera pixels, of which `first` is the picture's row of the first.

    lamp: its place, and optics: its angular radius, ceiling, refractive index, roughness of the body.
    """
    (height, label, wave), (table, alpha), (pitch, s), (position, optics) = maps, paints, grid, lamp
    body, gloss, direct, lit = out
    columns, tables = body.shape[1], body.shape[2]
    step, share = pitch / s, 1.0 / (s * s)
    sums = np.empty(tables)
    for r in range(start, stop):
        row = first + r
        y = (0.5 * (height.shape[0] // s) - 0.5 - row) * pitch
        for column in range(columns):
            x = (column + 0.5 - 0.5 * columns) * pitch
            lx, ly, lz = position[0] - x, position[1] - y, position[2]
            inverse = 1.0 / math.sqrt(lx * lx + ly * ly + lz * lz)
            lx, ly, lz = lx * inverse, ly * inverse, lz * inverse
            half = 1.0 / math.sqrt(2.0 + 2.0 * lz)
            sums[:] = 0.0
            shine, light, seen = 0.0, 0.0, 0.0
            for i in range(row * s, row * s + s):
                for j in range(column * s, column * s + s):
                    paint = label[i, j]
                    visible, received, value, mirror = _shade_sample(
                        height, i, j, step, (lx, ly, lz, half), optics, alpha[paint], wave[row, column]
                    )
                    seen += visible
                    light += received
                    shine += mirror
                    for k in range(tables):
                        sums[k] += value * table[paint, k]
            for k in range(tables):
                body[r, column, k] = sums[k] * share
            gloss[r, column], direct[r, column], lit[r, column] = shine * share, light * share, seen * share


def shade(
    thing: SimulatedObject, lamp: LampPose, settings: SimulationSettings, *, table, squared, rows: slice | None = None
) -> Shading:
    """Shading of the given rows (all if None).

    table : (labels, tables) weighted reflectance of each paint, 1 for a perfect white; squared : likewise of the
    reflectance squared: bounced light has met the paint twice (the neighbour is taken to carry the same paint).
    """
    rows = rows or slice(0, settings.rows)
    # The bounce needs the direct irradiance of its neighbourhood: shade a margin, then cut it off.
    margin = REACH_PIXELS + 1 if settings.bounce else 0
    first, last = max(rows.start - margin, 0), min(rows.stop + margin, settings.rows)
    shape = (last - first, settings.columns)
    body = np.empty((*shape, table.shape[1]), np.float32)
    gloss, direct, lit = (np.empty(shape, np.float32) for _ in range(3))
    optics = (
        0.5 * math.radians(settings.lights.angular_diameter_deg),
        thing.ceiling_mm,
        settings.refractive_index if settings.gloss != "none" else 1.0,
        BODY_SIGMA if settings.body == "rough" else 0.0,
    )
    over_rows(
        _shade,
        len(body),
        first,
        (thing.height_mm, thing.label, thing.waves),
        (np.ascontiguousarray(table, np.float64), np.ascontiguousarray(thing.palette.roughness, np.float64)),
        (settings.pitch_mm, settings.supersampling),
        (lamp.position_mm, optics),
        (body, gloss, direct, lit),
    )
    if settings.bounce and thing.ceiling_mm > 0.0:
        band = slice(first, last)
        normals = thing.normals[band]
        slope_x, slope_y = -normals[..., 0] / normals[..., 2], -normals[..., 1] / normals[..., 2]
        bounced = bounced_irradiance(direct, thing.mean_height_mm[band], slope_x, slope_y, pitch_mm=settings.pitch_mm)
        s = settings.supersampling
        light = np.maximum(bounced, 0.0)[..., None].astype(float) * (1.0 / (s * s))
        label = thing.label[first * s : last * s]
        for i, j in np.ndindex(s, s):
            body += (light * squared[label[i::s, j::s]]).astype(np.float32)
    inner = slice(rows.start - first, rows.stop - first)
    return Shading(body[inner], gloss[inner], direct[inner], lit[inner])
