"""Model interlaced yarns of elliptical section: their surface, and what it reflects.

Lengths are in spacings of the warp yarns; x along the weft, y along the warp. A warp yarn of half width a1 and half
thickness b1 lies above the weft but for one binding a repeat of `harness` weft yarns; the binding moves on by `step`
from yarn to yarn (plain 2 and 1, twill 1, satin more). At a crossing both yarns touch: the sum of their half
thicknesses is shared between the amplitudes of warp and weft. Every warp yarn's surroundings are those of its
neighbour, moved along, so one column of the repeat stands for the cloth.

    f(i, o) = 1 / (i_z o_z) sum_p w(p) / p_z V(p, i) V(p, o) (p.i)(p.o) (m + body / pi (1 - F(p.i))(1 - F(p.o)))

over points p of that column; m is the reflection of anisotropic GGX facets about p, as in `brdf.cloth.yarn_facets`. V
follows from the horizon of each point, marched over the surface. Light that has passed through yarns leaves the cloth
evenly: a Lambert term beside the two.
"""

import math
from dataclasses import dataclass
from functools import cached_property
from math import gcd

import numpy as np
from numba import njit

from nishiki.brdf.cloth.yarn_facets import facet_reflection
from nishiki.brdf.torrance_sparrow import fresnel_scalar
from nishiki.weave.section import Surface

HALF_PI = 0.5 * math.pi
HOLE = -9.0  # height where no yarn lies
# Columns of a point: its normal, its yarn's direction on the surface, the third axis, share of the plane over n_z
NORMAL, ALONG, ACROSS, WEIGHT, COLUMNS = 0, 3, 6, 9, 10
SHORTEST, GROWTH, STEPS = 0.04, 1.26, 20  # of a ray over the surface, in spacings: to 3.2
STEEPEST = 20.0  # slope to which the sides of a section are followed
BLEND = 0.015  # height over which warp and weft pass into each other where they cross, so that sums are smooth
LEAST = 1e-3  # share of a place below which a yarn is left out


@njit(cache=True, nogil=True, error_model="numpy")
def bump(d, spacing, period, soft):
    """How far a yarn has changed sides at distance d from its binding, 1 there and 0 half a period away; its slope."""
    d = d - period * math.floor(d / period + 0.5)
    half, far = 0.5 * spacing, 0.5 * period
    low = math.tanh((far + half) / soft) - math.tanh((far - half) / soft)
    top = 2.0 * math.tanh(half / soft)
    right, left = math.tanh((d + half) / soft), math.tanh((d - half) / soft)
    slope = ((1.0 - right * right) - (1.0 - left * left)) / soft
    return (right - left - low) / (top - low), slope / (top - low)


@njit(cache=True, nogil=True, error_model="numpy")
def warp_at(x, y, form):
    """Height of the warp yarn's upper side at (x, y), and its slopes along x and y; HOLE beside it.

    form = (harness, step, q, a1, b1, a2, b2, amplitude 1, amplitude 2, soft, arch), lengths in warp spacings.
    """
    harness, q, a1, b1 = form[0], form[2], form[3], form[4]
    period = harness * q
    column = math.floor(x + 0.5)
    u = (x - column) / a1
    if abs(u) >= 1.0:
        return HOLE, 0.0, 0.0
    d = y - form[1] * column * q
    share, slope = bump(d, q, period, form[9] * q)
    root = math.sqrt(1.0 - u * u)
    turn = 2.0 * math.pi / period
    arch = 0.5 * form[10] * period if harness > 2.0 else 0.0
    height = form[7] * (1.0 - 2.0 * share) + arch * (1.0 - math.cos(turn * d)) + b1 * root
    across = -b1 * u / (a1 * max(root, 1e-9))
    along = -2.0 * form[7] * slope + arch * turn * math.sin(turn * d)
    return height, max(min(across, STEEPEST), -STEEPEST), along


@njit(cache=True, nogil=True, error_model="numpy")
def weft_at(x, y, form, binding):
    """Compute height and slope of the weft yarns; binding[k]: the column at which weft yarn k comes up."""
    q, a2, b2 = form[2], form[5], form[6]
    row = math.floor(y / q + 0.5)
    v = (y - row * q) / a2
    if abs(v) >= 1.0:
        return HOLE, 0.0, 0.0
    share, slope = bump(x - binding[int(row) % binding.size], 1.0, form[0], form[9])
    root = math.sqrt(1.0 - v * v)
    height = -form[8] * (1.0 - 2.0 * share) + b2 * root
    across = -b2 * v / (a2 * max(root, 1e-9))
    return height, 2.0 * form[8] * slope, max(min(across, STEEPEST), -STEEPEST)


@njit(cache=True, nogil=True, error_model="numpy")
def height_field(x, y, form, binding, height, is_warp):
    """Fill height (y, x) and is_warp with the upper side of the cloth at places x and y; HOLE where no yarn lies."""
    for row in range(y.size):
        for column in range(x.size):
            warp = warp_at(x[column], y[row], form)[0]
            weft = weft_at(x[column], y[row], form, binding)[0]
            height[row, column] = max(warp, weft)
            is_warp[row, column] = warp >= weft


@njit(cache=True, nogil=True, error_model="numpy")
def height_table(form, binding, table):
    """Fill table (m, length) with heights over one warp yarn's column: x in -0.5 .. 0.5, y over a period."""
    rows, columns = table.shape
    for k in range(rows):
        for j in range(columns):
            x, y = (k + 0.5) / rows - 0.5, j / columns * form[0] * form[2]
            table[k, j] = max(warp_at(x, y, form)[0], weft_at(x, y, form, binding)[0])


@njit(cache=True, nogil=True, error_model="numpy")
def _looked_up(x, y, form, table):
    """Height from the table; every column is the first one, moved along by the step of the weave."""
    rows, columns = table.shape
    column = math.floor(x + 0.5)
    across = (x - column + 0.5) * rows - 0.5
    along = (y / form[2] - form[1] * column) / form[0]
    along = (along - math.floor(along)) * columns
    k = min(max(math.floor(across + 0.5), 0), rows - 1)
    j = int(along)
    share = along - j
    j = j % columns
    return table[k, j] * (1.0 - share) + table[k, (j + 1) % columns] * share


@njit(cache=True, nogil=True, error_model="numpy")
def points_of(form, binding, places, table, points, which, horizons):
    """Fill points (2 n, COLUMNS), which (2 n,), horizons (2 n, azimuths) at places (n, 3) = x, y, share of the plane.

    A place has a point on the warp and one on the weft, weighted by which of the two lies higher.
    """
    count, azimuths = places.shape[0], horizons.shape[1]
    for p in range(2 * count):
        x, y, share = places[p % count, 0], places[p % count, 1], places[p % count, 2]
        warp, weft = warp_at(x, y, form), weft_at(x, y, form, binding)
        z, dx, dy = warp if p < count else weft
        above = z - (weft[0] if p < count else warp[0])
        share *= 1.0 / (1.0 + math.exp(-min(max(above / BLEND, -40.0), 40.0)))
        points[p, :] = 0.0
        which[p] = 0
        if z == HOLE or share < LEAST * places[p % count, 2]:
            continue
        which[p] = 1 if p < count else 2
        nz = 1.0 / math.sqrt(1.0 + dx * dx + dy * dy)
        nx, ny = -dx * nz, -dy * nz
        if p < count:
            size = math.sqrt(1.0 + dy * dy)
            tx, ty, tz = 0.0, 1.0 / size, dy / size
        else:
            size = math.sqrt(1.0 + dx * dx)
            tx, ty, tz = 1.0 / size, 0.0, dx / size
        points[p, 0], points[p, 1], points[p, 2] = nx, ny, nz
        points[p, 3], points[p, 4], points[p, 5] = tx, ty, tz
        points[p, 6], points[p, 7], points[p, 8] = ny * tz - nz * ty, nz * tx - nx * tz, nx * ty - ny * tx
        points[p, 9] = share / nz
        for a in range(azimuths):
            turn = 2.0 * math.pi * a / azimuths
            cx, cy = math.cos(turn), math.sin(turn)
            rise, far = 0.0, SHORTEST
            for _ in range(STEPS):
                rise = max(rise, (_looked_up(x + cx * far, y + cy * far, form, table) - z) / far)
                far *= GROWTH
            horizons[p, a] = math.atan(rise)


@njit(cache=True, nogil=True, error_model="numpy")
def _free(horizons, p, direction, soft):
    """Share of a point's surroundings that lets a direction through."""
    azimuths = horizons.shape[1]
    place = math.atan2(direction[1], direction[0]) / (2.0 * math.pi) * azimuths
    place -= azimuths * math.floor(place / azimuths)
    low = int(place)
    share = place - low
    low = low % azimuths
    horizon = horizons[p, low] * (1.0 - share) + horizons[p, (low + 1) % azimuths] * share
    up = math.atan2(direction[2], math.hypot(direction[0], direction[1]))
    u = min(max(0.5 + 0.5 * (up - horizon) / soft, 0.0), 1.0)
    return u * u * (3.0 - 2.0 * u)


@njit(cache=True, nogil=True, error_model="numpy")
def weave_sums(incident, outgoing, surface, rough, index, soft, out):
    """Fill out (n, 2): mirror reflection and white body, 1/sr; rough (2, 2) along and across the fibres of warp, weft.

    surface: `YarnWeave.points`.
    """
    points, which, horizons = surface
    for k in range(incident.shape[0]):
        i, o = incident[k], outgoing[k]
        out[k, 0] = out[k, 1] = 0.0
        if not (i[2] > 0.0 and o[2] > 0.0):
            continue
        hx, hy, hz = i[0] + o[0], i[1] + o[1], i[2] + o[2]
        length = math.sqrt(hx * hx + hy * hy + hz * hz)
        hx, hy, hz = hx / length, hy / length, hz / length
        fresnel = 0.5 * fresnel_scalar(min(0.5 * length, 1.0), index)
        mirror = body = 0.0
        upright = i[0] * i[0] + i[1] * i[1] < 1e-12
        for p in range(points.shape[0]):
            if which[p] == 0:
                continue
            a = points[p]
            ci = a[0] * i[0] + a[1] * i[1] + a[2] * i[2]
            co = a[0] * o[0] + a[1] * o[1] + a[2] * o[2]
            if ci <= 0.0 or co <= 0.0:
                continue
            seen = a[9] * _free(horizons, p, o, soft)
            if not upright:
                seen *= _free(horizons, p, i, soft)
            if seen <= 0.0:
                continue
            ra, rc = rough[which[p] - 1, 0], rough[which[p] - 1, 1]
            facets = facet_reflection(a, i, o, (hx, hy, hz), ci, co, ra, rc)
            mirror += seen * fresnel * facets
            body += seen * ci * co * (1.0 - fresnel_scalar(ci, index)) * (1.0 - fresnel_scalar(co, index))
        scale = 1.0 / (i[2] * o[2])
        out[k, 0], out[k, 1] = scale * mirror, scale * body / math.pi


AZIMUTHS = 24  # of a point's horizon
POINTS_ACROSS, POINTS_ALONG = 16, 8  # points over a warp yarn's column, and from weft yarn to weft yarn
COARSE = (10, 6)
GAP = 2  # places on a gap between yarns
TABLE = (24, 20)  # heights over a column, and from weft yarn to weft yarn
INDEX = 1.54


@dataclass(frozen=True)
class Binding:
    """weave: plain, twill or satin; harness: yarns of a repeat; step: shift of the binding from yarn to yarn."""

    weave: str
    harness: int
    step: int

    def __str__(self) -> str:
        if self.weave == "plain":
            return "plain weave"
        return f"{self.weave} of {self.harness} yarns" + (f", step {self.step}" if self.step > 1 else "")

    def columns(self) -> np.ndarray:
        """(harness,) warp yarn that lies below each weft yarn of a repeat."""
        out = np.empty(self.harness)
        out[(self.step * np.arange(self.harness)) % self.harness] = np.arange(self.harness)
        return out


def bindings(weave: str = "unknown", most: int = 10, harness: int | None = None) -> list[Binding]:
    """Every plain weave, twill and satin with at most `most` yarns a repeat; mirror images count as one."""
    out = [Binding("plain", 2, 1)]
    for yarns in range(3, most + 1) if harness is None else (harness,):
        out += [Binding("twill", yarns, 1)] if yarns > 2 else []
        out += [Binding("satin", yarns, step) for step in range(2, yarns // 2 + 1) if gcd(step, yarns) == 1]
    if harness is not None:
        out = [one for one in out if one.harness == harness]
    return [one for one in out if weave in ("unknown", one.weave)]


def _over_a_yarn(half_width: float, spacing: float, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Place samples over one spacing, its yarn in the middle; return places and their shares.

    `count` lie on the yarn, denser towards its sides, and GAP on the gap beside it.
    """
    turn = (np.arange(count) + 0.5) / count * np.pi - 0.5 * np.pi
    on, share = half_width * np.sin(turn), np.cos(turn) / np.cos(turn).sum() * 2 * half_width / spacing
    gap = spacing - 2 * half_width
    beside = half_width + (np.arange(GAP) + 0.5) / GAP * gap
    return np.concatenate([on, beside]), np.concatenate([share, np.full(GAP, gap / GAP / spacing)])


@dataclass(frozen=True)
class YarnWeave:
    """Describe a weave of elliptical yarns."""

    binding: Binding
    spacing_ratio: float  # spacing of the weft over that of the warp
    fill: np.ndarray  # width of a yarn over its spacing
    aspect: np.ndarray  # thickness over width; both (2,) warp, weft
    crimp: float  # the warp's share of the amplitudes
    bend: float  # length on which a yarn changes sides, in spacings of the crossed yarns
    arch: float  # rise of a float over its period
    rough: np.ndarray  # (2, 2): GGX roughness of warp and weft along and across the fibres
    gain: float  # of the gloss
    soft: float  # radians, scatter of the horizons, for yarns differ
    index: float = INDEX

    @cached_property
    def form(self) -> np.ndarray:
        """What the compiled functions take."""
        q = self.spacing_ratio
        a1, a2 = 0.5 * self.fill[0], 0.5 * self.fill[1] * q
        b1, b2 = a1 * self.aspect[0], a2 * self.aspect[1]
        both = b1 + b2
        return np.array([
            self.binding.harness, self.binding.step, q, a1, b1, a2, b2, self.crimp * both, (1 - self.crimp) * both,
            self.bend, self.arch,
        ])  # fmt: skip

    def points(
        self, density: tuple[int, int] = (POINTS_ACROSS, POINTS_ALONG)
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Points of one column: (n, COLUMNS), which yarn (n,), horizons (n, AZIMUTHS)."""
        across, along = density
        q, harness, form = self.spacing_ratio, self.binding.harness, self.form
        x, wide = _over_a_yarn(form[3], 1.0, across)
        y, long = _over_a_yarn(form[5], q, along)
        y = (y + q * np.arange(harness)[:, None]).ravel()
        xx, yy = np.meshgrid(x, y, indexing="ij")
        places = np.stack([xx.ravel(), yy.ravel(), np.outer(wide, np.tile(long, harness) / harness).ravel()], axis=1)
        table = np.empty((TABLE[0], harness * TABLE[1]))
        columns = self.binding.columns()
        height_table(form, columns, table)
        count = 2 * len(places)
        points, which, horizons = np.empty((count, COLUMNS)), np.empty(count, np.int64), np.empty((count, AZIMUTHS))
        points_of(form, columns, places, table, points, which, horizons)
        seen = which > 0
        return points[seen], which[seen], horizons[seen]

    def surface(self, samples: int = 24) -> Surface:
        """One repeat as a height field, `samples` points a yarn spacing; holes lie as low as the lowest yarn."""
        q, harness = self.spacing_ratio, self.binding.harness
        steps = np.arange(harness * samples + 1) / samples
        height, is_warp = np.empty((steps.size, steps.size)), np.empty((steps.size, steps.size), bool)
        height_field(steps - 0.5, (steps - 0.5) * q, self.form, self.binding.columns(), height, is_warp)
        lowest = height[height > HOLE].min()
        pattern = np.ones((harness, harness), bool)
        yarns = np.arange(harness)
        pattern[(self.binding.step * yarns) % harness, yarns] = False
        return Surface(steps, steps * q, np.maximum(height, lowest), is_warp, pattern)

    def parts(self, incident: np.ndarray, outgoing: np.ndarray, density=(POINTS_ACROSS, POINTS_ALONG)) -> np.ndarray:
        """(n, 2) gloss and white body, 1/sr, at directions (n, 3)."""
        out = np.empty((len(incident), 2))
        weave_sums(
            np.ascontiguousarray(incident), np.ascontiguousarray(outgoing), self.points(density), self.rough,
            self.index, self.soft, out,
        )  # fmt: skip
        out[:, 0] *= self.gain
        return out

    def slopes(self) -> dict[str, float]:
        """Compute mean and 90th percentile of the visible slope in the planes of weft and warp, in degrees.

        Also the weft's share of the surface visible from above.
        """
        points, which, _ = self.points((3 * POINTS_ACROSS, 4 * POINTS_ALONG))
        weight = points[:, 9] * points[:, 2]
        weight /= weight.sum()
        out = {}
        for axis, plane in enumerate(("weft", "warp")):
            angle = np.degrees(np.arctan2(np.abs(points[:, axis]), points[:, 2]))
            order = np.argsort(angle)
            out[f"mean_slope_{plane}"] = float(weight @ angle)
            out[f"p90_slope_{plane}"] = float(angle[order][np.searchsorted(np.cumsum(weight[order]), 0.9)])
        out["weft_share"] = float(weight[which == 2].sum())
        return out
