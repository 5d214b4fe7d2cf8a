"""A picture of the cloth through a microscope: rays from the pixels to the yarns, and from there to the lamp."""

from __future__ import annotations

import math

import numba
import numpy as np

from nishiki.simulate.cloth.filament import body, facets, in_frame
from nishiki.simulate.cloth.points import turned_frame
from nishiki.simulate.cloth.rays import escapes, first_hit
from nishiki.simulate.cloth.reflectance import Cloth
from nishiki.threads import over_rows

_FAR_MM = 50.0


def close_up(
    cloth: Cloth, lamps, view, *, rows: int, columns: int, pitch_mm: float, samples: int = 3, ambient: float = 0.0
) -> np.ndarray:
    """Radiance (rows, columns, channels), a perfect white facing the lamps = 1: direct light without further bounces.

    lamps : (n, 3) unit directions, together of strength 1. view : (3,) unit direction to the camera, which sees in
    parallel, the projected y axis upwards. pitch_mm : of a pixel. samples : rays a pixel in each direction.
    ambient : light from everywhere, as a share of a white's, without shadows.
    """
    settings, solids = cloth.settings, cloth.solids
    lamps, view = np.atleast_2d(np.asarray(lamps, float)), np.asarray(view, float)
    up = np.array([0.0, 1.0, 0.0]) - view[1] * view
    up /= np.linalg.norm(up)
    axes = np.stack([np.cross(up, view), up, view])
    lift = 2e-3 * min(settings.warp.spacing_mm, settings.weft.spacing_mm)
    twist = np.radians([settings.warp.twist_deg, settings.weft.twist_deg])
    out = np.zeros((rows, columns, cloth.dye.shape[1]))
    over_rows(
        _rows, rows, axes, lamps, pitch_mm, samples, lift, ambient, solids.numbers, solids.free, twist,
        cloth.surface, cloth.dye, out,
    )  # fmt: skip
    return out


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _rows(start, stop, axes, lamps, pitch, samples, lift, ambient, numbers, free, twist, surface, dye, out):
    f = np.empty(6)
    rows, columns, channels = out.shape
    dx, dy, dz = axes[2]
    for row in range(start, stop):
        for sample in range(columns * samples * samples):
            column, part = sample // (samples * samples), sample % (samples * samples)
            u = pitch * (column + (part % samples + 0.5) / samples - 0.5 * columns)
            v = pitch * (0.5 * rows - row - (part // samples + 0.5) / samples)
            # Start above the cloth: slide the ray's point along the view until it is high enough.
            far = (_FAR_MM - u * axes[0, 2] - v * axes[1, 2]) / dz
            x = u * axes[0, 0] + v * axes[1, 0] + far * dx
            y = u * axes[0, 1] + v * axes[1, 1] + far * dy
            t, which = first_hit(x, y, _FAR_MM, -dx, -dy, -dz, numbers, free)
            if which == 0:
                continue
            x, y, z = x - t * dx, y - t * dy, _FAR_MM - t * dz
            turned_frame(x, y, z, which, numbers, twist, f)
            k = 0 if which > 0 else 1
            x, y, z = x + lift * f[0], y + lift * f[1], z + lift * f[2]
            ox, oy, oz = in_frame(dx, dy, dz, f)
            share = 1.0 / (samples * samples)
            for channel in range(channels):
                out[row, column, channel] += share * ambient * dye[k, channel]
            for lamp in range(lamps.shape[0]):
                lx, ly, lz = lamps[lamp]
                ix, iy, iz = in_frame(lx, ly, lz, f)
                if iz > 0.0 and oz > 0.0 and escapes(x, y, z, lx, ly, lz, numbers, free):
                    mirror = facets(ix, iy, iz, ox, oy, oz, surface[k, 0], surface[k, 1], surface[k, 2])
                    white = body(iz, oz, surface[k, 2])
                    for channel in range(channels):
                        value = math.pi * iz * (mirror + dye[k, channel] * white) / lamps.shape[0]
                        out[row, column, channel] += share * value
