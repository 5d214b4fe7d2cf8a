"""Model the height of the painting: canvas weave under paint, slopes, cast shadows, and one bounce of light on it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numba
import numpy as np

from nishiki.simulate.painting.settings import LampPose, Palette, SimulationSettings
from nishiki.simulate.reflection import ggx_gloss, rough_body
from nishiki.threads import over_rows, strips

THREAD_MM = 1.15  # distance of neighbouring threads
WEAVE_MM = 0.055  # height of a thread's crest over its trough
HIDING_MM = 0.20  # paint of this thickness hides the weave to 1/e


@dataclass(frozen=True)
class SimulatedObject:
    """A simulated object. Samples are finer than camera pixels by the supersampling s."""

    height_mm: np.ndarray  # (rows·s, columns·s) float32
    label: np.ndarray  # (rows·s, columns·s) uint8, paint of each sample
    palette: Palette  # the paints (spectra at `FINE_NM`)
    # (rows, columns, 2) float32 slopes of the varnish against the paint; on camera pixels: normals (rows, columns,
    # 3), mean_height_mm and steepest (radians), float32
    waves: np.ndarray
    normals: np.ndarray
    mean_height_mm: np.ndarray
    steepest: np.ndarray
    ceiling_mm: float  # highest point


def weave_under_paint(paint_mm: np.ndarray, *, step_mm: float, scale: float = 1.0) -> np.ndarray:
    """Compute the height (rows, columns) float32 in mm of canvas with paint of the given thickness on it.

    step_mm : distance of neighbouring samples. scale : size of the threads, 1 = 1.15 mm apart. Plain weave: warp and
    weft pass over each other in turn; a soft maximum joins their crests.
    """
    out = np.empty(paint_mm.shape, np.float32)
    x = (np.arange(paint_mm.shape[1]) + 0.5)[None, :] * step_mm / (THREAD_MM * scale)
    along, sign_x = np.sin(np.pi * x), np.cos(np.pi * np.floor(x))
    for band in strips(len(out)):
        y = (np.arange(len(out))[band] + 0.5)[:, None] * step_mm / (THREAD_MM * scale)
        across, sign_y = np.sin(np.pi * y), np.cos(np.pi * np.floor(y))
        warp = np.abs(along) * (0.5 + 0.5 * across * sign_x)
        weft = np.abs(across) * (0.5 - 0.5 * along * sign_y)
        weave = np.logaddexp(6.0 * warp, 6.0 * weft) / 6.0
        out[band] = paint_mm[band] + WEAVE_MM * scale * weave * np.exp(-paint_mm[band] / (HIDING_MM * scale))
    return out


def level_out(height_mm: np.ndarray) -> np.ndarray:
    """Smooth by one pass of the 3×3 binomial filter: wet paint and varnish round off detail finer than a sample."""
    out = np.empty_like(height_mm)
    quarter, half = np.float32(0.25), np.float32(0.5)
    for band in strips(len(out)):
        rows = np.clip(np.arange(band.start - 1, band.stop + 1), 0, len(out) - 1)
        part = height_mm[rows]
        part = half * part[1:-1] + quarter * (part[:-2] + part[2:])
        part = np.pad(part, ((0, 0), (1, 1)), mode="edge")
        out[band] = half * part[:, 1:-1] + quarter * (part[:, :-2] + part[:, 2:])
    return out


def pixel_maps(height_mm: np.ndarray, *, step_mm: float, supersampling: int):
    """Average over camera pixels: normals (rows, columns, 3), height (rows, columns) mm, steepest slope in radians.

    The normal of a pixel is the normalised mean of the unit normals of its samples. All float32.
    """
    s = supersampling
    rows, columns = height_mm.shape[0] // s, height_mm.shape[1] // s
    normals = np.empty((rows, columns, 3), np.float32)
    mean, steepest = np.empty((rows, columns), np.float32), np.empty((rows, columns), np.float32)
    for band in strips(rows):
        start, stop = band.start, band.stop
        blocks = (stop - start, s, columns, s)
        # slopes to the right and upwards by central differences, one-sided at the edges
        fine = np.arange(start * s, stop * s)
        up, down = np.maximum(fine - 1, 0), np.minimum(fine + 1, len(height_mm) - 1)
        q = (height_mm[up].astype(float) - height_mm[down]) / ((down - up) * step_mm)[:, None]
        p = np.gradient(height_mm[fine].astype(float), step_mm, axis=1)
        square = p * p + q * q
        inverse = 1.0 / np.sqrt(1.0 + square)
        total = np.stack([(v * inverse).reshape(blocks).mean(axis=(1, 3)) for v in (-p, -q, np.ones_like(p))], axis=-1)
        normals[start:stop] = total / np.linalg.norm(total, axis=-1, keepdims=True)
        mean[start:stop] = height_mm[start * s : stop * s].reshape(blocks).mean(axis=(1, 3), dtype=float)
        steepest[start:stop] = np.arctan(np.sqrt(square.reshape(blocks).max(axis=(1, 3))))
    return normals, mean, steepest


@numba.njit(cache=True)
def horizon_slope(height, i, j, ux, uy, step, ceiling, least):
    """Find the largest slope (rise over run) from sample (i, j) to the field towards (ux, uy), at least `least`.

    ux, uy : unit direction on the picture, x right, y up. step : mm between samples. ceiling : highest point of the
    field, mm. The march takes one sample distance a step and stops where even the highest point could not rise above
    the slope found so far.
    """
    start = np.float64(height[i, j])
    best = least
    y, x, run = np.float64(i), np.float64(j), 0.0
    last_row, last_column = height.shape[0] - 1.0, height.shape[1] - 1.0
    while True:
        y -= uy
        x += ux
        run += step
        if y < 0.0 or x < 0.0 or y > last_row or x > last_column or ceiling - start <= best * run:
            return best
        r, c = min(int(y), height.shape[0] - 2), min(int(x), height.shape[1] - 2)  # bilinear between the samples
        fy, fx = y - r, x - c
        top = np.float64(height[r, c]) * (1.0 - fx) + np.float64(height[r, c + 1]) * fx
        bottom = np.float64(height[r + 1, c]) * (1.0 - fx) + np.float64(height[r + 1, c + 1]) * fx
        slope = (top * (1.0 - fy) + bottom * fy - start) / run
        if slope > best:
            best = slope


@numba.njit(cache=True)
def lit_share(elevation, horizon, radius):
    """Compute the share of a lamp's disc (angular radius, centre `elevation`) above an edge at `horizon`, radians."""
    if radius <= 0.0:
        return 1.0 if elevation > horizon else 0.0
    z = (elevation - horizon) / radius
    if z >= 1.0:
        return 1.0
    if z <= -1.0:
        return 0.0
    return 0.5 + (math.asin(z) + z * math.sqrt(1.0 - z * z)) / math.pi


@numba.njit(cache=True)
def visible_share(height, i, j, towards, step, ceiling, radius):
    """Compute the share of the lamp visible from sample (i, j) past the relief; towards: unit vector to its centre."""
    lx, ly, lz = towards
    flat = math.sqrt(lx * lx + ly * ly)
    elevation = math.atan2(lz, flat)
    if flat < 1e-9 or elevation - radius >= 1.5:
        return 1.0
    least = math.tan(max(elevation - radius, 0.0))  # relief below the lamp's lower rim hides nothing
    slope = horizon_slope(height, i, j, lx / flat, ly / flat, step, ceiling, least)
    if slope <= least:
        return 1.0 if elevation > radius else lit_share(elevation, 0.0, radius)
    return lit_share(elevation, math.atan(slope), radius)


DIRECTIONS = 16  # around a pixel
REACH_PIXELS = 8  # of light from paint to paint


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _gather(start, stop, surface, irradiance, pitch, rings, out):
    (height, slope_x, slope_y), (offsets, sizes) = surface, rings
    rows, columns = height.shape
    for i in range(start, stop):
        for j in range(columns):
            p, q, here = slope_x[i, j] * pitch, slope_y[i, j] * pitch, np.float64(height[i, j])
            total = 0.0
            for direction in range(offsets.shape[0]):
                horizon = -1e30
                for ring in range(offsets.shape[1]):
                    down, right = offsets[direction, ring, 0], offsets[direction, ring, 1]
                    row, column = i + down, j + right
                    if row < 0 or column < 0 or row >= rows or column >= columns:
                        break
                    run = sizes[direction, ring, 0]
                    rise = np.float64(height[row, column]) - here
                    if rise <= horizon * run:
                        continue  # hidden behind something nearer
                    horizon = rise / run
                    arriving = rise - p * right + q * down
                    if arriving <= 0.0:
                        continue  # below the own tangent plane
                    # cosθ cosθ′ dA/(π r²): the area on the plane over n_z′ cancels the length of the other normal.
                    leaving = (slope_x[row, column] * right - slope_y[row, column] * down) * pitch - rise
                    if leaving > 0.0:
                        square = run * run + rise * rise
                        total += (
                            irradiance[row, column] * arriving * leaving * sizes[direction, ring, 1] / (square * square)
                        )
            out[i, j] = total / math.sqrt(1.0 + slope_x[i, j] ** 2 + slope_y[i, j] ** 2)


def bounced_irradiance(
    irradiance: np.ndarray, height_mm: np.ndarray, slope_x: np.ndarray, slope_y: np.ndarray, *, pitch_mm: float
) -> np.ndarray:
    """Compute the irradiance (rows, columns) float32 of each pixel from its surroundings, were those perfectly white.

    A quadrature of the one-bounce integral on camera pixels: 16 directions, 8 rings, with occlusion by whatever rises
    higher on the way. irradiance : direct, any scale. slope_x, slope_y : dh/dx to the right and dh/dy upwards.
    Relief finer than a pixel, farther than 8 pixels, and further bounces are left out.
    """
    out = np.empty(irradiance.shape, np.float32)
    ring = np.arange(1, REACH_PIXELS + 1)
    turn = 2.0 * math.pi / DIRECTIONS
    angle = turn * (np.arange(DIRECTIONS)[:, None] + 0.5)
    offsets = np.floor(np.stack([-ring * np.sin(angle), ring * np.cos(angle)], axis=-1) + 0.5).astype(np.int64)
    run = pitch_mm * np.hypot(offsets[..., 0], offsets[..., 1])
    # The area of a ring's sector about the rounded place: r · Δφ · Δr.
    area = np.broadcast_to(ring * turn * pitch_mm * pitch_mm, run.shape) / math.pi
    rings = offsets, np.stack([run, area], axis=-1)
    over_rows(_gather, len(out), (height_mm, slope_x, slope_y), irradiance, pitch_mm, rings, out)
    return out


BODY_SIGMA = 0.20  # roughness of the paint itself, radians (Oren-Nayar)


@dataclass(frozen=True)
class LampShading:
    """Shading of some rows of the picture by one lamp, relative to a white diffuser facing the lamp; all float32."""

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
) -> LampShading:
    """Shade the given rows (all if None).

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
    return LampShading(body[inner], gloss[inner], direct[inner], lit[inner])
