"""Cast shadows from a height map: the horizon of each pixel towards a lamp, and how much of the lamp is above it.

The paper could not show these (P section 6 works with normals only).  Two ways to the same horizon:

sweep  lamps at infinity: parallel lines run across the map towards the lamp, one pixel apart; from the lamp's side each
       line keeps the upper convex hull of the heights it has passed, and the tangent from a point to that hull is the
       horizon of the point.  Constant work a pixel, however low the lamp.  A pixel between two lines takes the mean of
       theirs, weighted by nearness.
march  any lamp: each pixel walks its own ray, column by column (or row by row), until nothing on the map could rise
       above the horizon found so far.  Exact for heights interpolated along the grid lines; the work grows as
       1 / tan(elevation).

Heights that are not finite cast no shadow and receive none.
"""

from dataclasses import dataclass

import numpy as np
from numba import njit

from nishiki.errors import UserError
from nishiki.render.scene import Light
from nishiki.render.threads import over_rows

NO_HORIZON = np.float32(-1e30)  # nothing lies between the pixel and the lamp


@dataclass(frozen=True)
class CastShadows:
    """What the relief hides of the lamps; self-shadow (n . l <= 0) is the shading's affair."""

    visibility: np.ndarray  # (lights, rows, columns) float32, the share of each lamp that a pixel sees
    shadowed: np.ndarray  # (lights,) share of the lamps' light that the relief holds back, 0 .. 1
    heights_missing: int  # pixels without a finite height


def cast_shadows(height: np.ndarray, lights: list[Light], *, pitch: float, method: str = "sweep") -> CastShadows:
    """What each pixel sees of each lamp.  height: (rows, columns), in the unit of `pitch`.

    method: "sweep" (lamps at a finite distance are marched all the same) or "march".  A lamp of angular radius 0 gives
    hard edges; otherwise the lamp is a uniform disc that a straight horizon cuts.
    """
    if method not in ("sweep", "march"):
        raise UserError(f"shadow method: expected sweep or march, found {method!r}; choose one of the two")
    if height.ndim != 2:
        raise UserError(f"height: expected (rows, columns), found {height.shape}")
    known = np.isfinite(height)
    surface = np.ascontiguousarray(height, np.float32)
    if not known.all():
        surface = np.where(known, surface, np.float32(np.nan))
    visibility = np.empty((len(lights), *height.shape), np.float32)
    for j, light in enumerate(lights):
        if method == "sweep" and light.position_mm is None:
            x, y, z = light.central_direction()
            horizon = horizon_tangent(surface, pitch=pitch, azimuth=float(np.arctan2(y, x)))
            elevation = float(np.arctan2(z, np.hypot(x, y)))
            over_rows(_rows_of(_disc_above, horizon, elevation, light.angular_radius, visibility[j]), len(surface))
        else:
            _march_light(surface, light, pitch, visibility[j])
        visibility[j][~known] = 1
    shadowed = 1 - visibility.mean(axis=(1, 2), dtype=np.float64)
    return CastShadows(visibility, shadowed, int(known.size - np.count_nonzero(known)))


def horizon_tangent(height: np.ndarray, *, pitch: float, azimuth: float) -> np.ndarray:
    """Tangent of the horizon's elevation towards `azimuth` (radians, from x to y), by the sweep.

    height: (rows, columns) float32, NaN where unknown.  Result of the same shape; NO_HORIZON where nothing is there.
    """
    toward_column, toward_row = np.cos(azimuth), -np.sin(azimuth)
    # bring the lamp to the side of growing columns, within 45 degrees
    swap = abs(toward_row) > abs(toward_column)
    surface = height.T if swap else height
    along, across = (toward_row, toward_column) if swap else (toward_column, toward_row)
    flip = along < 0
    surface = np.ascontiguousarray(surface[:, ::-1] if flip else surface)
    # a multiple of 2^-20: lines along the grid and its diagonals then meet the pixels exactly, and the direction moves
    # by less than 1e-6
    slope = float(np.round(across / abs(along) * 2**20) / 2**20)
    rows, columns = surface.shape
    drift = slope * (columns - 1)
    first, last = int(np.floor(min(0.0, -drift))), int(np.ceil(rows - 1 + max(0.0, -drift)))
    step = pitch * np.hypot(1.0, slope)
    out = np.full(surface.shape, NO_HORIZON)

    def lines(begin, end):
        _sweep(first + begin, first + end, surface, slope, step, out)

    over_rows(lines, last - first + 2)
    out = out[:, ::-1] if flip else out
    return np.ascontiguousarray(out.T if swap else out)


def shadow_reach(height: np.ndarray, light: Light, *, pitch: float) -> int:
    """Pixels beyond a tile that can cast a shadow into it: the relief's range over the tangent of the elevation.

    For a lamp at a finite distance, of its lowest elevation over the map.
    """
    relief = float(np.nanmax(height) - np.nanmin(height))
    x, y, z = light.homogeneous()[:3]
    horizontal = float(np.hypot(x, y))
    if light.position_mm is not None:
        horizontal += 0.5 * pitch * float(np.hypot(*height.shape))
    elevation = np.arctan2(z, horizontal) - light.angular_radius
    longest = int(np.ceil(np.hypot(*height.shape)))
    if elevation <= 0:
        return longest
    return min(longest, int(np.ceil(relief / np.tan(elevation) / pitch)) + 1)


def _rows_of(kernel, *arguments):
    return lambda first, last: kernel(first, last, *arguments)


def _march_light(surface, light, pitch, out) -> None:
    source = light.homogeneous()
    rows, columns = surface.shape
    scaled = source[:3] / (pitch if source[3] else 1.0)
    # to pixels: columns to the right, rows downwards, heights in pixels too
    column, row = scaled[0], -scaled[1]
    if source[3]:
        column, row = column + (columns - 1) / 2, row + (rows - 1) / 2
    highest = float(np.nanmax(surface)) / pitch if np.any(np.isfinite(surface)) else 0.0
    over_rows(
        _rows_of(_march, surface, pitch, column, row, scaled[2], source[3], highest, light.angular_radius, out), rows
    )


@njit(cache=True, nogil=True, error_model="numpy")
def _disc_share(elevation, horizon, radius):
    """Share of a disc of angular `radius` centred at `elevation` above a straight horizon (angles, radians)."""
    if radius <= 0.0:
        return 1.0 if elevation > horizon else 0.0
    d = (elevation - horizon) / radius
    if d >= 1.0:
        return 1.0
    if d <= -1.0:
        return 0.0
    return 0.5 + (d * np.sqrt(1.0 - d * d) + np.arcsin(d)) / np.pi


@njit(cache=True, nogil=True, error_model="numpy")
def _disc_above(first, last, horizon, elevation, radius, out):
    low, high = np.tan(max(elevation - radius, -1.5)), np.tan(min(elevation + radius, 1.5))
    for row in range(first, last):
        for column in range(horizon.shape[1]):
            tangent = horizon[row, column]
            if tangent <= low and (radius > 0.0 or tangent < low):
                out[row, column] = 1.0
            elif tangent >= high and elevation + radius < 1.5:
                out[row, column] = 0.0
            else:
                out[row, column] = _disc_share(elevation, np.arctan(tangent), radius)


@njit(cache=True, nogil=True, error_model="numpy")
def _sweep_line(k, surface, slope, step, hull_at, hull_height, out):
    """Horizon along the line row = k + slope column into out (columns,); NaN where that is off the map or unknown."""
    rows, columns = surface.shape
    top = -1
    for column in range(columns - 1, -1, -1):
        out[column] = np.nan
        at = k + slope * column
        row = int(np.floor(at))
        share = at - row
        if row < 0 or row >= rows or (share > 0.0 and row + 1 >= rows):
            continue
        height = float(surface[row, column])
        if share > 0.0:
            height = (1.0 - share) * height + share * surface[row + 1, column]
        if not np.isfinite(height):
            continue
        tangent = -1e30
        if top >= 0:
            tangent = (hull_height[top] - height) / (hull_at[top] - column)
            while top >= 1:
                deeper = (hull_height[top - 1] - height) / (hull_at[top - 1] - column)
                if deeper < tangent:
                    break
                tangent = deeper  # the point at the top lies below the line to the one beneath it
                top -= 1
            tangent /= step
        out[column] = tangent
        top += 1
        hull_at[top] = column
        hull_height[top] = height


@njit(cache=True, nogil=True, error_model="numpy")
def _sweep(first, last, surface, slope, step, out):
    """Pixels between the lines k - 1 and k, for k = first .. last - 1: exactly one a column."""
    rows, columns = surface.shape
    hull_at, hull_height = np.empty(columns), np.empty(columns)
    before, here = np.empty(columns), np.empty(columns)
    _sweep_line(first - 1, surface, slope, step, hull_at, hull_height, before)
    for k in range(first, last):
        _sweep_line(k, surface, slope, step, hull_at, hull_height, here)
        for column in range(columns):
            lower = k - 1 + slope * column
            row = int(np.floor(lower)) + 1
            if row < 0 or row >= rows:
                continue
            share = row - lower  # 0 < share <= 1: 1 is the line k
            a, b = before[column], here[column]
            if share == 1.0 or not np.isfinite(a):
                tangent = b
            elif not np.isfinite(b):
                tangent = a
            else:
                tangent = (1.0 - share) * a + share * b
            out[row, column] = tangent if np.isfinite(tangent) else -1e30
        before, here = here, before


@njit(cache=True, nogil=True, error_model="numpy")
def _march_pixel(row, column, surface, pitch, to_column, to_row, lowest, highest, end):
    """Tangent of the horizon of a pixel along the unit direction (to_column, to_row); -1e30 where nothing is there.

    Stops where a height of `highest` could no longer pass the horizon found, or `lowest`, and after `end` pixels.
    """
    rows, columns = surface.shape
    by_column = abs(to_column) >= abs(to_row)
    main = abs(to_column) if by_column else abs(to_row)
    length = 1.0 / main
    step_column, step_row = to_column * length, to_row * length
    start = surface[row, column] / pitch
    tangent = -1e30
    k = 1
    while True:
        distance = k * length
        c, r = column + k * step_column, row + k * step_row
        if distance > end or (highest - start) <= distance * max(tangent, lowest):
            return tangent
        inside = -1e-9 <= c <= columns - 1 + 1e-9 and -1e-9 <= r <= rows - 1 + 1e-9
        if not inside:
            return tangent
        r0, c0 = int(np.floor(r + 1e-9)), int(np.floor(c + 1e-9))
        if by_column:
            c0 = int(np.round(c))
            share = max(0.0, r - r0)
            other = surface[min(r0 + 1, rows - 1), c0]
        else:
            r0 = int(np.round(r))
            share = max(0.0, c - c0)
            other = surface[r0, min(c0 + 1, columns - 1)]
        here = float(surface[r0, c0])
        height = here if share < 1e-8 else (1.0 - share) * here + share * other
        value = (height / pitch - start) / distance
        if value > tangent:  # false for NaN
            tangent = value
        k += 1


@njit(cache=True, nogil=True, error_model="numpy")
def _march(first, last, surface, pitch, light_column, light_row, light_z, w, highest, radius, out):
    """Visibility of a lamp at (column, row, z) in pixels from each pixel, or in that direction where w is 0."""
    for row in range(first, last):
        for column in range(surface.shape[1]):
            start = surface[row, column] / pitch
            dc, dr = light_column - w * column, light_row - w * row
            horizontal = np.sqrt(dc * dc + dr * dr)
            rise = light_z - (w * start if w > 0.0 else 0.0)
            if not np.isfinite(start) or horizontal <= 1e-12 * abs(rise):
                out[row, column] = 1.0
                continue
            elevation = np.arctan2(rise, horizontal)
            lowest = np.tan(max(elevation - radius, -1.5))
            end = horizontal if w > 0.0 else 1e30
            tangent = _march_pixel(row, column, surface, pitch, dc / horizontal, dr / horizontal, lowest, highest, end)
            out[row, column] = _disc_share(elevation, np.arctan(tangent), radius)
