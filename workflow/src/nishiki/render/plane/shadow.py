"""Cast shadows from a height map: the horizon of each pixel towards a lamp, and how much of the lamp is above it.

Tominaga and Tanaka (2004, section 6) work with normals only, and so without these.  Two ways to the same horizon:

sweep  lamps at infinity: parallel lines run across the map towards the lamp, one pixel apart; from the lamp's side each
       line keeps the upper convex hull of the heights it has passed, and the tangent from a point to that hull is the
       horizon of the point.  Constant work a pixel, however low the lamp.  A pixel between two lines takes the mean of
       theirs, weighted by nearness.
march  any lamp: each pixel walks its own ray, column by column (or row by row), until nothing on the map could rise
       above the horizon found so far.  Exact for heights interpolated along the grid lines; the work grows as
       1 / tan(elevation).

Heights that are not finite (outside the mask, no estimate) cast no shadow and receive none.  Pieces of the relief that
no chain of neighbouring heights connects cast none on each other: normals do not tell their relative level.
"""

from dataclasses import dataclass

import numpy as np

from nishiki.errors import UserError
from nishiki.render.plane import horizon
from nishiki.render.plane.scene import Light
from nishiki.threads import over_rows


@dataclass(frozen=True)
class CastShadows:
    """What the relief hides of the lamps; self-shadow (n . l <= 0) is the shading's affair."""

    visibility: np.ndarray  # (lights, rows, columns) float32, the share of each lamp that a pixel sees
    shadowed: np.ndarray  # (lights,) share of the lamps' light that the relief holds back, 0 .. 1
    heights_missing: int  # pixels without a finite height


def cast_shadows(height: np.ndarray, lights: list[Light], *, pitch: float, method: str = "sweep") -> CastShadows:
    """Return what each pixel sees of each lamp. height: (rows, columns), in the unit of `pitch`.

    method: "sweep" (lamps at a finite distance are marched all the same) or "march".  A lamp of angular radius 0 gives
    hard edges; otherwise it is a uniform disc that a straight horizon cuts.
    """
    if method not in ("sweep", "march"):
        raise UserError(f"shadow method: expected sweep or march, found {method!r}; choose one of the two")
    if height.ndim != 2:
        raise UserError(f"height: expected (rows, columns), found {height.shape}")
    known = np.isfinite(height)
    surface = np.ascontiguousarray(height, np.float32)
    pieces, count = np.zeros((0, 0), np.int32), 1  # all is one piece
    if not known.all():
        from scipy import ndimage

        surface = np.where(known, surface, np.float32(np.nan))
        # connected pieces, by the neighbours that the integration joins; 0 where unknown
        numbers, found = ndimage.label(known)
        if found > 1:
            pieces, count = np.ascontiguousarray(numbers, np.int32), found + 1
    visibility = np.empty((len(lights), *height.shape), np.float32)
    for j, light in enumerate(lights):
        if method == "sweep" and light.position_mm is None:
            visibility[j] = _sweep_light(surface, pieces, count, light, pitch)
        else:
            _march_light(surface, pieces, light, pitch, visibility[j])
        visibility[j][~known] = 1
    shadowed = 1 - visibility.mean(axis=(1, 2), dtype=np.float64)
    return CastShadows(visibility, shadowed, int(known.size - np.count_nonzero(known)))


def _sweep_light(surface, pieces, count: int, light: Light, pitch: float) -> np.ndarray:
    """Return visibility (rows, columns) of a lamp at infinity; the same lines from either side."""
    x, y, z = light.central_direction()
    elevation = float(np.arctan2(z, np.hypot(x, y)))
    azimuth = np.arctan2(y, x)
    toward_column, toward_row = np.cos(azimuth), -np.sin(azimuth)
    # bring the lamp to the side of growing columns, within 45 degrees
    swap = abs(toward_row) > abs(toward_column)
    along, across = (toward_row, toward_column) if swap else (toward_column, toward_row)
    flip = along < 0

    def turned(values):
        values = values.T if swap else values
        return np.ascontiguousarray(values[:, ::-1] if flip else values)

    surface, pieces = turned(surface), turned(pieces)
    # a multiple of 2^-20: lines along the grid and its diagonals then meet the pixels exactly, and the direction moves
    # by less than 1e-6
    slope = float(np.round(across / abs(along) * 2**20) / 2**20)
    rows, columns = surface.shape
    drift = slope * (columns - 1)
    first, last = int(np.floor(min(0.0, -drift))) - 1, int(np.ceil(rows - 1 + max(0.0, -drift))) + 1
    phase = (-slope * (columns - 1)) % 1.0 if flip else 0.0
    step = pitch * np.hypot(1.0, slope)
    # Horizons below the floor cannot matter: half the tangent of the lamp's lower edge, as the sweep averages two
    # lines. Not the edge itself: a line that is lit would then weigh too little against one in shadow.
    lower = elevation - light.angular_radius
    floor = 0.5 * float(np.tan(lower)) if lower > 0 else -1e30
    out = np.ones(surface.shape, np.float32)

    def lines(begin, end):
        begin, end = first + begin, first + end
        lamp = elevation, light.angular_radius, floor
        horizon.sweep(begin, end, (phase, slope, step), surface, pieces, count, lamp, out)

    over_rows(lines, last - first + 1)
    out = out[:, ::-1] if flip else out
    return out.T if swap else out


def _march_light(surface, pieces, light, pitch, out) -> None:
    source = light.homogeneous()
    rows, columns = surface.shape
    scaled = source[:3] / (pitch if source[3] else 1.0)
    # to pixels: columns to the right, rows downwards, heights in pixels too
    column, row = scaled[0], -scaled[1]
    if source[3]:
        column, row = column + (columns - 1) / 2, row + (rows - 1) / 2
    highest = float(np.nanmax(surface)) / pitch if np.any(np.isfinite(surface)) else 0.0
    lamp = column, row, scaled[2], source[3], light.angular_radius
    over_rows(horizon.march, len(surface), surface, pieces, pitch, lamp, highest, out)
