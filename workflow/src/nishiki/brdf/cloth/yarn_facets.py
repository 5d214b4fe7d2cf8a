"""Evaluate facets on yarns: the facets of fibres about the slopes of two families of yarns.

Local ratio: the logarithm of measured over modelled value is taken for a Gaussian process over half vector and
difference angle (Rusinkiewicz 1998), in which a model's errors lie still: mean 0, standard deviation MODEL_ERROR,
correlation Wendland's function of the distance, summed over the mirror images in the planes of weft and warp, so that
the result has this symmetry exactly (Wendland, Scattered Data Approximation, 2005; Rasmussen and Williams, Gaussian
Processes for Machine Learning, 2006). Farther than the reaches from all images the model stands alone.

A cloth's surface is that of warp and weft yarns.  A yarn's surface tilts across the yarn (its section) and along it
(its way over and under the others), and on it the fibres' facets scatter about that tilt.  With w(p) the share of the
cloth's plane under surface of slope p,

    f(i, o) = 1 / (i_z o_z) sum_p w(p) / p_z V(p; i, o) (p.i)(p.o) (m(p; i, o) + body / pi (1 - F(p.i))(1 - F(p.o))),
    m = F(h.i) D(h; p) G(i, o; p) / (4 (p.i)(p.o)),

D the anisotropic GGX distribution about p, rougher across the fibres than along them, G its masking by
height-correlated Smith (Heitz 2014), F the exact Fresnel reflectance, and V what neighbouring yarns leave lit and
seen.  Exchange of i and o changes nothing: the model is reciprocal by construction.

w of a family is a product of a distribution of slopes along the yarn, exp(-(t / s)^k), and one across it, (1 + (t /
s)^k)^(-3 / k).  Along: k = 2 a bell, large k yarns of one steepness, small k flat floats with steep ends.  Across: k
= 2 is an ellipse exactly, smaller k a section with a flat top; a round edge always falls off with the third power.

V takes the yarns as trains of equal convex humps, which the distribution of their slopes determines: sorted by slope,
a hump's surface has its points at the places x(t) where that share of its width is reached, and at the height z =
-int t dx. A direction that rises at slope c passes the next hump, a width times `spacing` away, above its tangent
point; so it reaches all points whose z - c x is at least that tangent's: those up to a limiting slope.  Of light and
view from one side only the lower limit counts, which is how shadowing and masking correlate.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from itertools import product
from typing import Any, ClassVar, NamedTuple, Self

import numpy as np
from numba import njit

from nishiki.brdf.cloth.interface import halves, off_horizon, only_above
from nishiki.brdf.torrance_sparrow import exp2_negative, fresnel_scalar
from nishiki.formats.stored import ArrayFields
from nishiki.lanes import LANES, choose, load, root, splat, store
from nishiki.threads import over_items, strips

HALF_PI = 0.5 * math.pi
OPEN = 9.0  # limit of a side that the direction does not come from
# Rows of points in lanes: their normal, their yarn's direction on the surface, the third axis, share of the plane over
# n_z; of facets also their tilts along x and y
NORMAL, ALONG, ACROSS, WEIGHT, TILT_X, TILT_Y, ATOM = 0, 3, 6, 9, 10, 11, 12
PER_OCTAVE = 1.0 / math.log(2.0)


@njit(cache=True, nogil=True, error_model="numpy")
def _limit(table, component, up):
    """Interpolate the steepest tilt that a direction reaches in one plane, from a table over its angle in 0 .. pi/2."""
    last = table.shape[0] - 1
    place = math.atan2(abs(component), up) / HALF_PI * last
    low = min(int(place), last - 1)
    share = place - low
    return table[low] * (1.0 - share) + table[low + 1] * share


@njit(cache=True, nogil=True, error_model="numpy")
def _narrow(tables, family, direction, limits):
    """Lower limits[family] = (x >= 0, x < 0, y >= 0, y < 0) to the tilts that a direction reaches."""
    for axis in range(2):
        limit = _limit(tables[family, axis], direction[axis], direction[2])
        side = 2 * axis + (0 if direction[axis] >= 0.0 else 1)
        limits[family, side] = min(limits[family, side], limit)


@njit(cache=True, nogil=True, error_model="numpy")
def smooth_step(u):
    """Compute the share that is reached of lanes, 0 for u <= 0 to 1 for u >= 1."""
    u = choose(u > 0.0, choose(u < 1.0, u, 1.0), 0.0)
    return u * u * (3.0 - 2.0 * u)


@njit(cache=True, nogil=True, error_model="numpy")
def beckmann_shadow(cosine, reach):
    """Compute Smith's Lambda of Beckmann's distribution as numerator and denominator, so that few quotients are left.

    Walter et al. 2007, eq. 15, as a rational function. cosine: of a direction with the normal; reach: root of its
    square and of the tangential parts times roughness.
    """
    square = reach * reach - cosine * cosine
    steep = square * 2.56 > cosine * cosine
    rough = root(choose(steep, square, 1.0))
    return (
        choose(steep, square - 1.259 * cosine * rough + 0.396 * cosine * cosine, 0.0),
        cosine * (3.535 * rough + 2.181 * cosine),
    )


@njit(cache=True, nogil=True, error_model="numpy")
def _entering(cosine, index):
    """Compute the share of light that enters a fibre, less `fresnel_scalar`, as numerator and denominator."""
    contrast = (index - 1.0) * (index + 1.0)
    s = root(contrast + cosine * cosine) + cosine
    low, high = s * (cosine * s - 1.0), cosine * contrast + s
    whole = s * s * high
    return whole * whole - (0.5 * contrast * contrast) * (high * high + low * low), whole * whole


@njit(cache=True, nogil=True, error_model="numpy")
def _dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@njit(cache=True, nogil=True, error_model="numpy")
def facet_reflection(axes, i, o, half, ci, co, rough, tail):
    """Compute D G / 2 of anisotropic facets at a point of a yarn (Walter et al. 2007), of a number or of lanes.

    The point's share of the cloth's reflectance is F / 2 times it: n.i n.o / (i_z o_z) F D G / (4 n.i n.o), where the
    facets' own cosines cancel those of the yarn's surface. axes: normal, along and across the fibres; i, o, half:
    directions of light, view and between them; ci, co: cosines of i and o with the normal; rough: along and across the
    fibres; tail: share of GGX's slopes with their long tails, the rest are Beckmann's of the same roughness; Smith's
    masking is linear in the distribution of slopes.
    """
    (normal, fibre, side), (along, across) = axes, rough
    h1, h2, h3 = _dot(fibre, half) * (1.0 / along), _dot(side, half) * (1.0 / across), _dot(normal, half)
    tilted, up = h1 * h1 + h2 * h2, h3 * h3
    i1, i2 = _dot(fibre, i) * along, _dot(side, i) * across
    o1, o2 = _dot(fibre, o) * along, _dot(side, o) * across
    si, so = root(i1 * i1 + i2 * i2 + ci * ci), root(o1 * o1 + o2 * o2 + co * co)
    spread = (tilted + up) * (tilted + up)
    scale = 1.0 / (math.pi * along * across)
    if tail == 1.0:
        return ci * co * scale / (spread * (co * si + ci * so))
    inverse = 1.0 / choose(up > 1e-9, up, 1e-9)
    steep = tilted * inverse * PER_OCTAVE
    short = choose(steep < 60.0, exp2_negative(choose(steep < 60.0, steep, 60.0)), 0.0) * inverse * inverse
    (in_shadow, of_light), (masked, of_view) = beckmann_shadow(ci, si), beckmann_shadow(co, so)
    both, every = ci * co, of_light * of_view
    shadow = every * (0.5 * tail * (si * co + so * ci) + (1.0 - tail) * both)
    shadow += (1.0 - tail) * both * (in_shadow * of_view + masked * of_light)
    return (0.5 * scale) * (tail + (1.0 - tail) * short * spread) * both * every / (spread * shadow)


@njit(cache=True, nogil=True, error_model="numpy")
def reflect(points, p, i, o, half, rough, tail):
    """Compute D G / 2 of LANES points of a yarn from p on, all lit and visible, and the cosines of light and view."""
    axes = (
        (load(points, (0, p)), load(points, (1, p)), load(points, (2, p))),
        (load(points, (3, p)), load(points, (4, p)), load(points, (5, p))),
        (load(points, (6, p)), load(points, (7, p)), load(points, (8, p))),
    )
    ci, co = _dot(axes[0], i), _dot(axes[0], o)
    mirror = facet_reflection(axes, i, o, half, ci, co, rough, tail)
    return choose((ci > 0.0) & (co > 0.0), mirror, 0.0), ci, co


@njit(cache=True, nogil=True, error_model="numpy")
def half_vector(i, o):
    """Compute the unit vector between two, and the cosine of either with it."""
    x, y, z = i[0] + o[0], i[1] + o[1], i[2] + o[2]
    length = math.sqrt(x * x + y * y + z * z)
    return (x / length, y / length, z / length), min(0.5 * length, 1.0)


@njit(cache=True, nogil=True, error_model="numpy")
def add_up(lanes, scratch):
    """Add up the numbers of lanes, always in the same order; scratch: (LANES,)."""
    store(scratch, 0, lanes)
    total = 0.0
    for k in range(LANES):
        total += scratch[k]
    return total


def in_lanes(warp: np.ndarray, weft: np.ndarray) -> tuple[np.ndarray, int]:
    """Arrange points (n, rows), see NORMAL, in rows: the warp's, then the weft's; and the place of the weft's first.

    Either family is filled up to whole lanes with points of no weight.
    """
    split = len(warp) + -len(warp) % LANES
    points = np.zeros((warp.shape[1], split + len(weft) + -len(weft) % LANES))
    points[NORMAL + 2] = points[ALONG] = points[ACROSS + 1] = 1.0
    points[:, : len(warp)], points[:, split : split + len(weft)] = warp.T, weft.T
    return points, split


class Facets(NamedTuple):
    """Facets and limits of a shape, as `sums` reads them."""

    points: np.ndarray  # (ATOM, p) see `in_lanes`
    split: int  # place of the weft's first
    rough: np.ndarray  # (2, 2) along and across the fibres of warp and weft
    index: float
    tables: np.ndarray  # (2, 2, ANGLES) limits by family and plane
    softness: float


@njit(cache=True, nogil=True, error_model="numpy")
def sums(incident, outgoing, facets, out):
    """Sum mirror reflection and body, 1 / sr, of warp and weft at directions (n, 3) into out (n, 4)."""
    points, split, rough, index, tables, softness = facets
    limits, scratch, steep = np.empty((2, 4)), np.empty(LANES), 0.25 / softness
    for k in range(incident.shape[0]):
        i, o = incident[k], outgoing[k]
        out[k, :] = 0.0
        if not (i[2] > 0.0 and o[2] > 0.0):
            continue
        half, cosine = half_vector(i, o)
        limits[:] = OPEN
        for family in range(2):
            _narrow(tables, family, i, limits)
            _narrow(tables, family, o, limits)
        for family in range(2):
            mirror, body, widths = splat(0.0), splat(0.0), (rough[family, 0], rough[family, 1])
            for p in range(family * split, split if family == 0 else points.shape[1], LANES):
                reached = load(points, (WEIGHT, p))
                for side in range(4):
                    if limits[family, side] < HALF_PI:
                        tilt = load(points, (TILT_X + side // 2, p)) * (1.0 - 2.0 * (side % 2))
                        reached = reached * smooth_step(0.5 + (limits[family, side] - tilt) * steep)
                glossy, ci, co = reflect(points, p, i, o, half, widths, 1.0)
                (entering, of_light), (leaving, of_view) = _entering(ci, index), _entering(co, index)
                matt = ci * co * (entering * leaving) / (of_light * of_view)
                mirror += reached * glossy
                body += reached * choose((ci > 0.0) & (co > 0.0), matt, 0.0)
            scale = 1.0 / (i[2] * o[2])
            out[k, 2 * family] = scale * 0.5 * fresnel_scalar(cosine, index) * add_up(mirror, scratch)
            out[k, 2 * family + 1] = scale * add_up(body, scratch) / math.pi


MODEL_ERROR, NOISE = 0.15, 0.03  # of the logarithm: of the model's errors, and of a measurement
REACH_HALF, REACH_DIFFERENCE = 0.8, 0.6  # chord between half vectors, radians between difference angles
LARGEST = 1.0  # logarithm of a ratio that is still taken for a model's error


def likeness(first: np.ndarray, second: np.ndarray, quarter: bool) -> np.ndarray:
    """Correlate a model's errors at places (n, 4) and (m, 4), see `places_of`: (n, m).

    Wendland's function of their distance; quarter: added up over mirror images in the planes of weft and warp.
    """
    apart = ((first[:, None, 3] - second[:, 3]) / REACH_DIFFERENCE) ** 2
    total = np.zeros(apart.shape)
    for x, y in product((1.0, -1.0), repeat=2) if quarter else ((1.0, 1.0),):
        square = 2.0 - 2.0 * first[:, :3] @ (second[:, :3] * (x, y, 1.0)).T  # of the distance of unit vectors
        inside = np.maximum(1.0 - np.sqrt(np.maximum(square, 0.0) / REACH_HALF**2 + apart), 0.0)
        total += inside * (inside * inside) ** 2 * (6.0 - 5.0 * inside)
    return total


def places_of(incident: np.ndarray, outgoing: np.ndarray) -> np.ndarray:
    """Return half vector and difference angle (radians) of directions (n, 3): (n, 4)."""
    g = halves(incident, outgoing)
    return np.concatenate([g.h, np.arccos(g.cos_d)[..., None]], axis=-1)


def fit_ratio(places: np.ndarray, measured: np.ndarray, modelled: np.ndarray, quarter: bool) -> np.ndarray:
    """Fit weights (n,) of the images at places (n, 4) to measured and modelled values (n,)."""
    known = (measured > 0) & (modelled > 0)
    safe = np.where(known, measured, 1.0) / np.where(known, modelled, 1.0)
    target = np.clip(np.log(safe), -LARGEST, LARGEST)
    covariance = MODEL_ERROR**2 * likeness(places, places, quarter) + NOISE**2 * np.eye(len(places))
    return MODEL_ERROR**2 * np.linalg.solve(covariance, target)


def ratio(incident: np.ndarray, outgoing: np.ndarray, images: np.ndarray, weights: np.ndarray, quarter: bool):
    """Compute the factor (n,) of a model at directions (n, 3)."""
    places = places_of(incident, outgoing)
    parts = [likeness(places[some], images, quarter) @ weights for some in strips(len(places))]
    return np.exp(np.clip(np.concatenate([np.empty(0), *parts]), -LARGEST, LARGEST))


WARP, WEFT = 0, 1
SIDE_ALONG, SIDE_ACROSS = 0, 1
NODES = (7, 10)  # slopes of either sign, along and across: 280 facets a family
ANGLES = 65  # of the tables of limits


@dataclass(frozen=True)
class YarnShape(ArrayFields):
    """Geometry and roughness of both families; arrays (2, 2) are [warp, weft][along, across] the yarn."""

    slope: np.ndarray  # s, tangent of the tilt, > 0
    power: np.ndarray  # k, > 0
    rough: np.ndarray  # GGX roughness of the facets along and across the fibres, > 0
    weft_share: float  # of the cloth's plane, 0 .. 1
    gain: float  # of everything the surface reflects: 1 where the white reference is exact and the cloth without holes
    index: float  # refractive index of the fibres
    spacing: np.ndarray  # (2, 2) distance of the humps over their width, > 0
    softness: float  # radians: scatter of the limits, for yarns differ

    def facets(self) -> Facets:
        """Return the facets and limits that `sums` reads."""
        points, split = in_lanes(self.atoms(WARP), self.atoms(WEFT))
        return Facets(points, split, self.rough, self.index, self.limits(), self.softness)

    def atoms(self, family: int) -> np.ndarray:
        """Compute (280, ATOM) facets of a family: equal shares of each distribution, at their middle quantiles."""
        share = self.weft_share if family == WEFT else 1 - self.weft_share
        along, across = (self._slopes(family, k) for k in (SIDE_ALONG, SIDE_ACROSS))
        x, y = np.meshgrid(*((across, along) if family == WARP else (along, across)), indexing="ij")
        x, y = x.ravel(), y.ravel()
        z = 1 / np.sqrt(1 + x * x + y * y)
        normal = np.stack([x * z, y * z, z], axis=1)
        zero = np.zeros_like(z)
        # the yarn's direction has no part across the yarn: (0, 1, slope) of the warp, (1, 0, slope) of the weft
        yarn = np.stack([zero, z, -y * z] if family == WARP else [z, zero, -x * z], axis=1)
        yarn /= np.linalg.norm(yarn, axis=1, keepdims=True)
        out = np.empty((x.size, ATOM))
        out[:, :3], out[:, 3:6], out[:, 6:9] = normal, yarn, np.cross(normal, yarn)
        out[:, WEIGHT], out[:, TILT_X], out[:, TILT_Y] = self.gain * share / (x.size * z), np.arctan(x), np.arctan(y)
        return out

    def _slopes(self, family: int, side: int) -> np.ndarray:
        nodes = NODES[side]
        t = hump(self.slope[family, side], self.power[family, side], side, (np.arange(nodes) + 0.5) / nodes)[0]
        return np.concatenate([-t[::-1], t])

    def limits(self) -> np.ndarray:
        """Compute the steepest tilts reached, radians, by angle 0 .. pi/2: (2, 2, ANGLES) [family][plane x, y]."""
        out = np.empty((2, 2, ANGLES))
        for family, planes in ((WARP, (SIDE_ACROSS, SIDE_ALONG)), (WEFT, (SIDE_ALONG, SIDE_ACROSS))):
            for plane, side in enumerate(planes):
                s, k = self.slope[family, side], self.power[family, side]
                out[family, plane] = hump_limits(s, k, side, self.spacing[family, side])
        # across the warp, weft that shows between warp yarns has these for neighbours, not other weft
        out[WEFT, 0] = np.minimum(out[WEFT, 0], out[WARP, 0])
        return out


def hump(slope: float, power: float, side: int, share: np.ndarray):
    """Compute slope, place and height of the points of a hump of width 1 within which `share` (0 .. 1) of it lies.

    side SIDE_ALONG: slopes exp(-(t / s)^k); SIDE_ACROSS: (1 + (t / s)^k)^(-3 / k).
    """
    from scipy.special import beta, betainc, betaincinv, gamma, gammainc, gammaincinv

    a, b = 1 / power, 2 / power
    if side == SIDE_ALONG:
        q = gammaincinv(a, share)
        return slope * q**a, share / 2, -slope * gamma(b) / gamma(a) / 2 * gammainc(b, q)
    v = np.minimum(betaincinv(a, b, share), 1 - 1e-15)  # a slope of 1e15 is upright
    # beta(2/k, 1/k) = beta(1/k, 2/k): the height is the same integral with its ends exchanged
    return slope * (v / (1 - v)) ** a, share / 2, -slope / 2 * betainc(b, a, v) * beta(b, a) / beta(a, b)


def hump_limits(slope: float, power: float, side: int, spacing: float, *, points: int = 160) -> np.ndarray:
    """Find the steepest tilts (ANGLES,) (radians, signed, pi/2: all) of a hump that directions at 0 .. pi/2 reach."""
    # points grow denser towards the edge, where slopes change fastest
    t, x, z = hump(slope, power, side, np.sin(np.linspace(0, 0.985 * HALF_PI, points)))
    t, x, z = (np.concatenate([sign * v[:0:-1], v]) for sign, v in ((-1, t), (-1, x), (1, z)))
    angles = np.linspace(0, HALF_PI, ANGLES)[1:]
    rise = np.cos(angles) / np.sin(angles)
    level = z[None] - rise[:, None] * x[None]
    top = level.argmax(axis=1)  # where the ray is tangent to a hump: it meets the next one's nowhere lower
    need = level[np.arange(rise.size), top] - rise * spacing
    reached = (level >= need[:, None]) | (np.arange(t.size) < top[:, None])
    last = np.where(reached.all(axis=1), t.size - 1, reached.argmin(axis=1) - 1)
    here, there = (level[np.arange(rise.size), np.minimum(last + k, t.size - 1)] for k in (0, 1))
    share = np.clip((here - need) / np.where(here > there, here - there, 1.0), 0, 1)
    tilt = t[last] + share * (t[np.minimum(last + 1, t.size - 1)] - t[last])
    return np.concatenate([[HALF_PI], np.where(last == t.size - 1, HALF_PI, np.arctan(tilt))])


@dataclass(frozen=True)
class YarnFacets:
    """The BRDF: a shape, the body of its fibres, and corrections to the measured facets and oblique images."""

    KIND: ClassVar[str] = "yarn_facets"
    SHAPE: ClassVar[Any] = YarnShape
    RECIPROCAL: ClassVar[bool] = True
    shape: YarnShape
    body: np.ndarray  # (channels,) albedo within the fibres
    lambert: np.ndarray  # (channels,) albedo of a Lambert term: light that met several yarns
    correction: (
        np.ndarray
    )  # (nt, np) factor of the mirror reflection by the half vector; theta_h 0 .. pi/4, phi 0 .. 2 pi
    images: np.ndarray = field(default_factory=lambda: np.zeros((0, 4)))  # places of the oblique images used
    image_weights: np.ndarray = field(default_factory=lambda: np.zeros(0))  # see local_ratio
    quarter: bool = True  # whether mirror images in the planes of weft and warp count as the same

    @property
    def channels(self) -> int:
        """Number of channels."""
        return int(np.size(self.body))

    @cached_property
    def _compiled(self):
        return self.shape.facets()

    def _parts(self, incident: np.ndarray, outgoing: np.ndarray) -> np.ndarray:
        return shape_parts(self.shape, incident, outgoing, compiled=self._compiled)

    def parts(self, incident: np.ndarray, outgoing: np.ndarray) -> np.ndarray:
        """Compute mirror reflection and white body (..., 4), 1 / sr, of warp and weft, without the correction."""
        incident, outgoing = np.broadcast_arrays(off_horizon(incident), off_horizon(outgoing))
        flat = [np.ascontiguousarray(d.reshape(-1, 3)) for d in (incident, outgoing)]
        return self._parts(*flat).reshape(*incident.shape[:-1], 4)

    def evaluate(self, incident: np.ndarray, outgoing: np.ndarray) -> np.ndarray:
        """Evaluate the BRDF, 1 / sr: (..., channels)."""
        return self.colour(self.terms(incident, outgoing))

    def terms(self, incident: np.ndarray, outgoing: np.ndarray) -> np.ndarray:
        """Compute gloss, white body and white Lambert term (..., 3), 1 / sr: all that `gloss_of` a model shares."""
        parts, g = self.parts(incident, outgoing), halves(incident, outgoing)
        mirror = (parts[..., 0] + parts[..., 2]) * interpolate_correction(self.correction, g.h)
        each = np.stack([mirror, parts[..., 1] + parts[..., 3], np.full(mirror.shape, 1 / np.pi)], axis=-1)
        return only_above(g.above, each * self.ratio(incident, outgoing)[..., None])

    def colour(self, terms: np.ndarray) -> np.ndarray:
        """Compute the BRDF (..., channels), 1 / sr, from the terms (..., 3)."""
        return terms[..., :1] + terms[..., 1:2] * self.body + terms[..., 2:] * self.lambert

    def ratio(self, incident: np.ndarray, outgoing: np.ndarray) -> np.ndarray:
        """Compute the factor (...,) by which the oblique images around a pair of directions differ from the model."""
        incident, outgoing = np.broadcast_arrays(np.asarray(incident, float), np.asarray(outgoing, float))
        if not len(self.images):
            return np.ones(incident.shape[:-1])
        flat = ratio(incident.reshape(-1, 3), outgoing.reshape(-1, 3), self.images, self.image_weights, self.quarter)
        return flat.reshape(incident.shape[:-1])

    def as_arrays(self) -> dict[str, np.ndarray]:
        """Return the shape's numbers under their names, then the rest."""
        return {**self.shape.as_arrays(), **{name: np.asarray(getattr(self, name)) for name in BESIDE}}

    @classmethod
    def from_arrays(cls, arrays: dict[str, np.ndarray]) -> Self:
        """Restore the model of `as_arrays`."""
        beside = {name: np.asarray(arrays[name], float) for name in BESIDE if name != "quarter"}
        return cls(cls.SHAPE.from_arrays(arrays), **beside, quarter=bool(arrays["quarter"]))


BESIDE = ("body", "lambert", "correction", "images", "image_weights", "quarter")
"""Fields of the BRDF beside the shape."""


def shape_parts(shape: YarnShape, incident: np.ndarray, outgoing: np.ndarray, *, compiled=None) -> np.ndarray:
    """Compute mirror reflection and white body (n, 4), 1 / sr, of warp and weft, at directions (n, 3)."""
    facets = compiled or shape.facets()
    return in_blocks(lambda i, o, out: sums(i, o, facets, out), incident, outgoing)


def in_blocks(fill: Callable, incident: np.ndarray, outgoing: np.ndarray) -> np.ndarray:
    """Return out (n, 4), filled by fill(incident, outgoing, out) in blocks of the directions (n, 3), on all threads."""
    out = np.empty((len(incident), 4))
    over_items(lambda some: fill(incident[some], outgoing[some], out[some]), strips(len(incident)))
    return out


def interpolate_correction(correction: np.ndarray, h: np.ndarray) -> np.ndarray:
    """Interpolate the factor at half vectors (..., 3): bilinear in theta_h and phi_h, constant beyond 45 degrees."""
    nt, around = correction.shape
    theta = np.arctan2(np.hypot(h[..., 0], h[..., 1]), h[..., 2])
    down = np.minimum(theta / (np.pi / 4), 1) * (nt - 1)
    turn = np.mod(np.arctan2(h[..., 1], h[..., 0]) / (2 * np.pi), 1) * around
    row, column = np.minimum(down.astype(int), nt - 2), np.floor(turn).astype(int)
    u, v = down - row, turn - column
    left, right = column % around, (column + 1) % around
    upper = (1 - v) * correction[row, left] + v * correction[row, right]
    lower = (1 - v) * correction[row + 1, left] + v * correction[row + 1, right]
    return (1 - u) * upper + u * lower


def without_correction(shape: YarnShape, body, lambert) -> YarnFacets:
    """Make the BRDF whose facets are the shape's alone."""
    return YarnFacets(shape, np.atleast_1d(body), np.atleast_1d(lambert), np.ones((2, 8)))


# What a fit searches: logarithms (the weft's share a logit), so that no bound is needed and prior spreads are
# relative. The priors are wide statements about yarns and fibres, not about one cloth: slopes along a yarn about 0.2
# (warp) and 0.3 (weft), across it 0.6, within a factor of 1.8 either way; a section between an ellipse (k = 2) and a
# flattened one (k = 1); facets of filaments 0.15 rough along and 0.3 across the fibres; textile fibres have indices
# of 1.46 (acetate) to 1.60 (silk, polyester: mean of both axes); humps lie 1.1 to 1.3 of their widths apart; the
# reflectance scale is known to 5 %.
NAMES = (
    *(f"log {what} {family} {side}" for what in ("slope", "power", "rough") for family in ("warp", "weft")
      for side in ("along", "across")),
    "logit weft_share", "log gain", "log index-1",
    *(f"log spacing {family} {side}" for family in ("warp", "weft") for side in ("along", "across")),
    "log softness",
)  # fmt: skip
CENTRE = np.concatenate([
    np.log([0.2, 0.6, 0.3, 0.6]), np.log([1.5, 1.4, 2.0, 1.4]), np.log([0.15, 0.3, 0.15, 0.3]),
    [np.log(0.25 / 0.75), 0.0, np.log(0.54)], np.log([1.3, 1.1, 1.1, 1.1]), [np.log(0.25)],
])  # fmt: skip
SPREAD = np.concatenate([
    [0.6] * 4, [0.5, 0.4, 0.5, 0.4], [0.5, 0.3, 0.5, 0.3], [0.6, 0.05, 0.08], [0.3, 0.15, 0.15, 0.15], [0.5],
])  # fmt: skip


def shape_of(x: np.ndarray) -> YarnShape:
    """Make the shape of a vector of parameters in the order of NAMES."""
    e = np.exp(x)
    return YarnShape(
        slope=e[0:4].reshape(2, 2),
        power=e[4:8].reshape(2, 2),
        rough=e[8:12].reshape(2, 2),
        weft_share=float(e[12] / (1 + e[12])),
        gain=float(e[13]),
        index=float(1 + e[14]),
        spacing=e[15:19].reshape(2, 2),
        softness=float(e[19]),
    )
