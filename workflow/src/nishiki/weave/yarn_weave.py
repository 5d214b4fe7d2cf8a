"""Model interlaced yarns of elliptical section: their surface and its reflection.

Lengths are in spacings of the warp yarns; x along the weft, y along the warp. A warp yarn of half width a1 and half
thickness b1 lies below some weft yarns of a repeat and above the others, as the `Binding` says. At a crossing both
yarns touch: the sum of their half thicknesses is shared between the amplitudes of warp and weft. A warp yarn's
surroundings are those of its neighbour, moved along, so the columns of a few warp yarns stand for the cloth.

    f(i, o) = 1 / (i_z o_z) sum_p w(p) / p_z V(p, i) V(p, o) (p.i)(p.o) (m + body / pi)

over points p of these columns; m is the reflection of anisotropic facets about p, as in `brdf.cloth.yarn_facets`. The
body has no Fresnel factors of the yarn's surface: light enters a yarn between fibres, whose surfaces stand at all
angles. V follows from the horizon of each point, marched over the surface. Light that has passed through yarns leaves
the cloth evenly: a Lambert term beside the two.
"""

import math
from dataclasses import astuple, dataclass, fields
from functools import cached_property
from math import gcd
from typing import Any, ClassVar, NamedTuple, Self

import numpy as np
from numba import njit

from nishiki.brdf.cloth.yarn_facets import (
    WEIGHT,
    YarnFacets,
    add_up,
    half_vector,
    in_blocks,
    in_lanes,
    reflect,
    smooth_step,
)
from nishiki.brdf.torrance_sparrow import fresnel_scalar
from nishiki.lanes import LANES, choose, load, splat
from nishiki.weave.section import WovenSurface

HOLE = -9.0  # height where no yarn lies
HORIZON = 10  # column of a point after those of `yarn_facets.NORMAL`: angle of the horizon in the first of AZIMUTHS
AZIMUTHS = 24
EVERY = np.ones(AZIMUTHS, bool)
SHORTEST, GROWTH, STEPS = 0.04, 1.12, 52  # of a ray over the surface, in spacings: to 13, for floats are long
NEARER, NEAR = 6, 1e-3  # most steps to the place of the middle that a point belongs to; the last one, in spacings
STEEPEST = 20.0  # slope to which the sides of a section are followed
REACHED = 2  # crossings to either side that count where a yarn changes sides
BLEND = 0.015  # height over which warp and weft pass into each other where they cross, so that sums are smooth
LEAST = 1e-3  # share of a place below which a yarn is left out


class Form(NamedTuple):
    """Arguments of the compiled functions from a weave; lengths in warp spacings."""

    up: np.ndarray  # (rows, columns) 1 where the warp lies on top, else -1, a whole repeat
    warp_middle: np.ndarray  # (columns,): middle of a warp yarn's one stretch below the others, in crossings
    weft_middle: np.ndarray  # (rows,): middle of a weft yarn's one stretch above the others, in crossings
    low: np.ndarray  # low, high: (2,) least and largest smoothed side of warp and weft at their crossings
    high: np.ndarray
    ratio: float
    half_width: np.ndarray
    half_thickness: np.ndarray
    amplitude: np.ndarray
    arch: np.ndarray  # (2,): rise of a float
    bend: float
    upright: float
    step: int
    together: int


@njit(cache=True, nogil=True, error_model="numpy")
def side_of(up, yarn, kind, place, bend):
    """Compute how far a yarn is above the cloth's middle at `place` in crossings, -1 to 1, its slope and that one's.

    A yarn changes sides half-way between two crossings, within `bend` crossings to either side of it, along a smooth
    step of fifth degree; elsewhere it lies flat. up: of `Form`; yarn: number of the warp (kind 0) or weft yarn (1).
    """
    count = up.shape[kind]
    near = math.floor(place + 0.5)
    before = (near - REACHED) % count
    side = up[before, yarn] if kind == 0 else -up[yarn, before]
    total, slope, curve = side, 0.0, 0.0
    for k in range(near - REACHED, near + REACHED):
        before = before + 1 if before + 1 < count else 0
        following = up[before, yarn] if kind == 0 else -up[yarn, before]
        if following != side:
            t = min(max((place - k - 0.5) / bend, -1.0), 1.0)
            square = t * t
            total += 0.5 * (following - side) * (1.0 + t * (1.875 - square * (1.25 - 0.375 * square)))
            slope += 0.9375 * (following - side) * (1.0 - square) ** 2 / bend
            curve -= 3.75 * (following - side) * t * (1.0 - square) / bend**2
            side = following
    return total, slope, curve


@njit(cache=True, nogil=True, error_model="numpy")
def _way(along, number, form, kind):
    """Compute the height of the middle of a warp (kind 0) or weft yarn (1), its slope and that one's, at a place."""
    yarn = int(number) % form.up.shape[1 - kind]
    if kind == 0:
        pace, middle = form.ratio, form.warp_middle[yarn]
    else:
        pace, middle = 1.0, form.weft_middle[yarn] + 0.5 * form.up.shape[1]
    side, slope, curve = side_of(form.up, yarn, kind, along / pace, form.bend)
    lift = 2.0 * form.amplitude[kind] / (form.high[kind] - form.low[kind])
    height, slope, curve = lift * (side - form.low[kind]) - form.amplitude[kind], lift * slope / pace, lift * curve
    turn = 2.0 * math.pi / (form.up.shape[kind] * pace)
    rise, turned = math.pi * form.arch[kind] / turn, turn * (along - middle * pace)
    sine, cosine = math.sin(turned), math.cos(turned)
    return height + rise * (1.0 - cosine), slope + rise * turn * sine, curve / pace**2 + rise * turn * turn * cosine


@njit(cache=True, nogil=True, error_model="numpy")
def yarn_at(x, y, form, kind):
    """Compute the height of the upper side of the warp (kind 0) or weft yarn (1) at (x, y), its slopes along x and y.

    As far as the yarn's section stands across its way, a point of the surface belongs to a place of the middle beside
    it. The height is HOLE where the yarn does not lie.
    """
    across, along, spacing = (x, y, 1.0) if kind == 0 else (y, x, form.ratio)
    number = math.floor(across / spacing + 0.5)
    u = (across - number * spacing) / form.half_width[kind]
    if abs(u) >= 1.0:
        return HOLE, 0.0, 0.0
    root = math.sqrt(1.0 - u * u)
    thick = form.half_thickness[kind] * root
    place, step, upright = along, 1.0, form.upright
    for _ in range(NEARER):  # Newton's steps, shorter where the surface folds under a bend
        height, slope, curve = _way(place, number, form, kind)
        size = math.sqrt(1.0 + slope * slope)
        if abs(step) < NEAR:
            break
        aside = upright * thick / size
        step = (place - along - aside * slope) / max(1.0 - aside * curve / (size * size), 0.5)
        place -= step
    steep = -form.half_thickness[kind] * u / (form.half_width[kind] * max(root, 1e-9)) * (1.0 + upright * (size - 1.0))
    steep = max(min(steep, STEEPEST), -STEEPEST)
    height += thick * (1.0 + upright * (1.0 / size - 1.0))
    return (height, steep, slope) if kind == 0 else (height, slope, steep)


@njit(cache=True, nogil=True, error_model="numpy")
def height_field(x, y, form, height, is_warp):
    """Fill height (y, x) and is_warp with the upper side of the cloth at places x and y; HOLE where no yarn lies."""
    for row in range(y.size):
        for column in range(x.size):
            warp = yarn_at(x[column], y[row], form, 0)[0]
            weft = yarn_at(x[column], y[row], form, 1)[0]
            height[row, column] = max(warp, weft)
            is_warp[row, column] = warp >= weft


@njit(cache=True, nogil=True, error_model="numpy")
def _looked_up(x, y, form, table):
    """Look up the height in the table; the columns beside it are the same, moved along by the step of the weave."""
    rows, columns = table.shape[0] - 1, table.shape[1] - 1
    place = (x + 0.5) / form.together
    group = math.floor(place)
    along = (y / form.ratio - form.step * group) / form.up.shape[0]
    across, along = (place - group) * rows, (along - math.floor(along)) * columns
    k, j = min(int(across), rows - 1), min(int(along), columns - 1)
    beside, share = across - k, along - j
    near = table[k, j] * (1.0 - share) + table[k, j + 1] * share
    far = table[k + 1, j] * (1.0 - share) + table[k + 1, j + 1] * share
    return near * (1.0 - beside) + far * beside


@njit(cache=True, nogil=True, error_model="numpy")
def points_of(form, places, table, needed, points, which):
    """Fill points (2 n, HORIZON + AZIMUTHS) and which (2 n,) at places (n, 3) = x, y, share of the plane.

    A place has a point on the warp and one on the weft, weighted by which of the two lies higher. needed: (AZIMUTHS,)
    horizons to be computed.
    """
    count, highest = places.shape[0], table.max()
    turns = 2.0 * math.pi * np.arange(AZIMUTHS) / AZIMUTHS
    toward_x, toward_y = np.cos(turns), np.sin(turns)
    for p in range(2 * count):
        x, y, share = places[p % count, 0], places[p % count, 1], places[p % count, 2]
        warp, weft = yarn_at(x, y, form, 0), yarn_at(x, y, form, 1)
        z, dx, dy = warp if p < count else weft
        above = z - (weft[0] if p < count else warp[0])
        share *= 1.0 / (1.0 + math.exp(-min(max(above / BLEND, -40.0), 40.0)))
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
        points[p, WEIGHT] = share / nz
        for a in np.flatnonzero(needed):
            rise, far = 0.0, SHORTEST
            for _ in range(STEPS):
                if highest - z <= rise * far:  # nothing farther off is high enough
                    break
                there = _looked_up(x + toward_x[a] * far, y + toward_y[a] * far, form, table)
                rise = max(rise, (there - z) / far)
                far *= GROWTH
            points[p, HORIZON + a] = math.atan(rise)


@njit(cache=True, nogil=True, error_model="numpy")
def _azimuth(direction):
    """Compute the rows of horizons beside a direction, the share of the second, and its angle above the plane.

    Everything that is a point is seen from above, so a direction along the normal is above every horizon.
    """
    flat = math.hypot(direction[0], direction[1])
    if flat < 1e-6:
        return HORIZON, HORIZON, 0.0, 1e9
    place = math.atan2(direction[1], direction[0]) / (2.0 * math.pi) * AZIMUTHS
    place -= AZIMUTHS * math.floor(place / AZIMUTHS)
    low = int(place)
    return HORIZON + low % AZIMUTHS, HORIZON + (low + 1) % AZIMUTHS, place - low, math.atan2(direction[2], flat)


def horizons_of(*directions: np.ndarray) -> np.ndarray:
    """Mark the horizons (AZIMUTHS,) that are read for directions (n, 3)."""
    rows = [_azimuth(direction)[:2] for direction in np.concatenate(directions)]
    return np.isin(np.arange(AZIMUTHS), np.array(rows) - HORIZON)


@njit(cache=True, nogil=True, error_model="numpy")
def _let_through(points, p, azimuth, soft):
    """Compute the share of the surroundings of LANES points from p on that lets a direction through."""
    low, high, share, up = azimuth
    horizon = load(points, (low, p)) * (1.0 - share) + load(points, (high, p)) * share
    return smooth_step(0.5 + (up - horizon) * (0.5 / soft))


@njit(cache=True, nogil=True, error_model="numpy")
def weave_sums(incident, outgoing, surface, facets, soft, out):
    """Fill out (n, 4), 1/sr, with mirror reflection and white body of the warp, then of the weft.

    surface: `YarnWeave.points`; facets: (2, 2) roughness along and across the fibres of warp and weft, tail, see
    `facet_reflection`, and refractive index.
    """
    (points, split), (rough, tail, index) = surface, facets
    scratch = np.empty(LANES)
    for k in range(incident.shape[0]):
        i, o = incident[k], outgoing[k]
        out[k, :] = 0.0
        if not (i[2] > 0.0 and o[2] > 0.0):
            continue
        half, cosine = half_vector(i, o)
        lit_from, seen_from = _azimuth(i), _azimuth(o)
        for family in range(2):
            mirror, body, widths = splat(0.0), splat(0.0), (rough[family, 0], rough[family, 1])
            for p in range(family * split, split if family == 0 else points.shape[1], LANES):
                reached = _let_through(points, p, lit_from, soft) * _let_through(points, p, seen_from, soft)
                reached = reached * load(points, (WEIGHT, p))
                glossy, ci, co = reflect(points, p, i, o, half, widths, tail)
                mirror += reached * glossy
                body += reached * choose((ci > 0.0) & (co > 0.0), ci * co, 0.0)
            scale = 1.0 / (i[2] * o[2])
            out[k, 2 * family] = scale * 0.5 * fresnel_scalar(cosine, index) * add_up(mirror, scratch)
            out[k, 2 * family + 1] = scale * add_up(body, scratch) / math.pi


POINTS, COARSE = 2160, 768  # places over a repeat of a yarn, however short: 200 were too few for twills
GOLDEN = 0.5 * (5**0.5 - 1)  # their step across the warp yarn: so they lie evenly however many they are
GAP = 0.12  # share of places, of either system, that lie on the gaps between yarns
SOFT = 0.05  # radians over which a horizon lets through: enough for smooth sums, and grazing light is not lost
TABLE = (24, 20)  # heights over a column, and from weft yarn to weft yarn
INDEX = 1.54  # of refraction


@dataclass(frozen=True)
class Binding:
    """The crossings of warp and weft.

    A warp yarn lies above `over` weft yarns, then below `under`; the place moves on by `step` weft yarns after every
    `together` warp yarns.
    """

    over: int
    under: int
    step: int = 1
    together: int = 1

    @property
    def harness(self) -> int:
        """Weft yarns of a repeat."""
        return self.over + self.under

    @property
    def weave(self) -> str:
        """Name of the kind: plain, twill, satin, rib or basket."""
        if self.together > 1 or gcd(self.step, self.harness) > 1:
            return "basket" if self.step == self.together == self.over == self.under else "rib"
        return "plain" if self.harness == 2 else "twill" if self.step == 1 else "satin"

    def __str__(self) -> str:
        if self.weave == "plain":
            return "plain weave"
        step = f", step {self.step}" if self.weave == "satin" else ""
        several = f", {self.together} warp yarns together" if self.weave == "rib" and self.together > 1 else ""
        return f"{self.over}/{self.under} {self.weave}{step}{several}"

    def pattern(self) -> np.ndarray:
        """Mark where the warp lies on top in a repeat: (weft yarns, warp yarns) bool."""
        columns = self.harness // gcd(self.step, self.harness) * self.together
        row, column = np.arange(self.harness)[:, None], np.arange(columns)
        return (row - self.step * (column // self.together)) % self.harness >= self.under


PLAIN = Binding(1, 1)
DERIVED = (  # ribs and baskets: plain weave with yarns that go two or three together
    Binding(2, 2, 2), Binding(1, 1, 1, 2), Binding(2, 2, 2, 2),
    Binding(3, 3, 3), Binding(1, 1, 1, 3), Binding(3, 3, 3, 3),
)  # fmt: skip


def bindings(weave: str = "unknown", most: int = 8, harness: int | None = None) -> list[Binding]:
    """List every regular weave with at most `most` yarns a repeat, by rising harness; mirror images count as one."""
    every = [PLAIN]
    for yarns in range(3, most + 1) if harness is None else (harness,):
        steps = [step for step in range(1, yarns // 2 + 1) if gcd(step, yarns) == 1] if yarns > 2 else []
        every += [Binding(yarns - under, under, step) for under in range(1, yarns) for step in steps]
    every += [one for one in DERIVED if one.harness <= most]
    every = [one for one in every if harness in (None, one.harness) and weave in ("unknown", one.weave)]
    return sorted(every, key=lambda one: one.harness)


def _over_a_yarn(share: np.ndarray, half_width: float, spacing: float) -> tuple[np.ndarray, np.ndarray]:
    """Place shares (n,) of 0 to 1 over one spacing; return the places and the spacing's share at each of them.

    They lie on the yarn in the middle, denser towards its sides, and on the gap beside it.
    """
    turn, gap = np.pi * (share / (1 - GAP) - 0.5), spacing - 2 * half_width
    on, beside = share < 1 - GAP, half_width + (share - 1 + GAP) / GAP * gap
    density = np.where(on, np.pi * half_width * np.cos(turn) / (1 - GAP), gap / GAP) / spacing
    return np.where(on, half_width * np.sin(turn), beside), density


def _middles(crossed: np.ndarray) -> np.ndarray:
    """Find the middle of each yarn's one stretch of crossings that are True, in crossings; NaN where it has several.

    crossed: (yarns, crossings) bool, periodic.
    """
    out = np.full(len(crossed), np.nan)
    for k, yarn in enumerate(crossed):
        starts = np.flatnonzero(yarn & ~np.roll(yarn, 1))
        if starts.size == 1:
            out[k] = starts[0] + 0.5 * (yarn.sum() - 1)
    return out


@dataclass(frozen=True)
class YarnWeave:
    """A weave of elliptical yarns."""

    binding: Binding
    spacing_ratio: float  # spacing of the weft over that of the warp
    fill: np.ndarray  # width of a yarn over its spacing
    aspect: np.ndarray  # thickness over width; both (2,) warp, weft
    crimp: float  # the warp's share of the amplitudes
    bend: float  # length on which a yarn changes sides, in spacings of the crossed yarns
    arch: float  # rise of a float over its period
    rough: np.ndarray  # (2, 2): roughness of warp and weft along and across the fibres
    tail: float  # share of GGX's long tails in the facets' distribution
    gain: float  # of the gloss
    index: float = INDEX
    soft: float = SOFT
    upright: float = 1.0  # 1: a section stands across the yarn's way, 0: across the cloth, for its fibres slide

    def as_arrays(self) -> dict[str, np.ndarray]:
        """Return the numbers by name, the binding as (over, under, step, together)."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        return {name: np.array(value) for name, value in (values | {"binding": astuple(self.binding)}).items()}

    @classmethod
    def from_arrays(cls, arrays) -> Self:
        """Restore the weave from the result of `as_arrays`."""
        values = {field.name: arrays[field.name] for field in fields(cls)}
        values = {name: value if np.ndim(value) else float(value) for name, value in values.items()}
        return cls(**values | {"binding": Binding(*map(int, arrays["binding"]))})

    @cached_property
    def form(self) -> Form:
        """Arguments of the compiled functions."""
        pattern = self.binding.pattern()
        up = np.where(pattern, 1.0, -1.0)
        half_width = 0.5 * self.fill * [1.0, self.spacing_ratio]
        half_thickness = half_width * self.aspect
        sides = [[side_of(up, 0, kind, k, self.bend)[0] for k in range(up.shape[kind])] for kind in (0, 1)]
        low, high = (np.array([end(side) for side in sides]) for end in (np.min, np.max))
        warp_middle, weft_middle = _middles(~pattern.T), _middles(~pattern)
        floats = np.array([self.binding.over > 1, self.binding.under > 1 and not np.isnan(weft_middle[0])])
        amplitude = np.array([self.crimp, 1 - self.crimp]) * half_thickness.sum()
        return Form(
            up, warp_middle, np.nan_to_num(weft_middle), low, high, self.spacing_ratio, half_width,
            half_thickness, amplitude, self.arch * floats, self.bend, self.upright,
            self.binding.step, self.binding.together,
        )  # fmt: skip

    def points(self, density: int = POINTS, needed: np.ndarray = EVERY):
        """Compute points of the columns that stand for the cloth and their horizons, in lanes; see `in_lanes`.

        density: places over a repeat of each yarn; needed: (AZIMUTHS,) horizons to be computed, see `horizons_of`; the
        others are level.
        """
        q, harness, together, form = self.spacing_ratio, self.binding.harness, self.binding.together, self.form
        number = np.arange(density * together)
        along, across = (number + 0.5) / number.size * harness, number * GOLDEN % 1.0 * together
        x, wide = _over_a_yarn(across % 1.0, form.half_width[0], 1.0)
        y, long = _over_a_yarn(along % 1.0, form.half_width[1], q)
        places = np.stack([x + np.floor(across), y + q * np.floor(along), wide * long / number.size], axis=1)
        rows, columns = together * TABLE[0], harness * TABLE[1]
        x = np.arange(rows + 1) / rows * together - 0.5
        y = np.arange(columns + 1) / columns * form.up.shape[0] * form.ratio
        heights = np.empty((columns + 1, rows + 1))
        height_field(x, y, form, heights, np.empty(heights.shape, np.bool_))
        table = np.ascontiguousarray(heights.T)
        points, which = np.zeros((2 * len(places), HORIZON + AZIMUTHS)), np.empty(2 * len(places), np.int64)
        points_of(form, places, table, needed, points, which)
        return in_lanes(points[which == 1], points[which == 2])

    def surface(self, samples: int = 24) -> WovenSurface:
        """Make one repeat's height field, `samples` points a yarn spacing; holes lie as low as the lowest yarn."""
        pattern = self.binding.pattern()
        y, x = (np.arange(count * samples + 1) / samples for count in pattern.shape)
        height, is_warp = np.empty((y.size, x.size)), np.empty((y.size, x.size), bool)
        height_field(x - 0.5, (y - 0.5) * self.spacing_ratio, self.form, height, is_warp)
        lowest = height[height > HOLE].min()
        return WovenSurface(x, y * self.spacing_ratio, np.maximum(height, lowest), is_warp, pattern)

    def parts(self, incident: np.ndarray, outgoing: np.ndarray, points) -> np.ndarray:
        """Evaluate gloss and white body of warp and weft at directions (n, 3): (n, 4), 1/sr; see `points`."""
        facets = self.rough, self.tail, self.index
        out = in_blocks(lambda i, o, out: weave_sums(i, o, points, facets, self.soft, out), incident, outgoing)
        out[:, ::2] *= self.gain
        return out

    def slopes(self) -> dict[str, float]:
        """Compute mean and 90th percentile of the visible slope in the planes of weft and warp, in degrees.

        Also the weft's share of the surface visible from above.
        """
        points, split = self.points(5 * POINTS, ~EVERY)
        weight = points[WEIGHT] * points[2]
        weight /= weight.sum()
        out = {}
        for axis, plane in enumerate(("weft", "warp")):
            angle = np.degrees(np.arctan2(np.abs(points[axis]), points[2]))
            order = np.argsort(angle)
            out[f"mean_slope_{plane}"] = float(weight @ angle)
            out[f"p90_slope_{plane}"] = float(angle[order][np.searchsorted(np.cumsum(weight[order]), 0.9)])
        out["weft_share"] = float(weight[split:].sum())
        return out


@dataclass(frozen=True)
class InterlacedYarns(YarnFacets):
    """The reflection of interlaced yarns and of the interior of their fibres."""

    KIND: ClassVar[str] = "yarns"
    SHAPE: ClassVar[Any] = YarnWeave
    shape: YarnWeave

    @cached_property
    def points(self):
        """Points of `YarnWeave.points` that stand for the cloth."""
        return self.shape.points(COARSE)

    def _parts(self, incident: np.ndarray, outgoing: np.ndarray) -> np.ndarray:
        return self.shape.parts(incident, outgoing, self.points)
