"""Interlaced yarns of elliptical section: the surface of a weave, and what it reflects.

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

from dataclasses import dataclass
from functools import cached_property
from math import gcd

import numpy as np

from nishiki.weave.surface import Surface
from nishiki.weave.yarn_kernels import COLUMNS, HOLE, height_field, height_table, points_of, weave_sums

AZIMUTHS = 24  # of a point's horizon
ACROSS, ALONG = 16, 8  # points over a warp yarn's column, and from weft yarn to weft yarn
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
    """Places over one spacing, its yarn in the middle, and their shares of it: `count` on the yarn, denser towards its
    sides, and GAP on the gap beside it."""
    turn = (np.arange(count) + 0.5) / count * np.pi - 0.5 * np.pi
    on, share = half_width * np.sin(turn), np.cos(turn) / np.cos(turn).sum() * 2 * half_width / spacing
    gap = spacing - 2 * half_width
    beside = half_width + (np.arange(GAP) + 0.5) / GAP * gap
    return np.concatenate([on, beside]), np.concatenate([share, np.full(GAP, gap / GAP / spacing)])


@dataclass(frozen=True)
class YarnWeave:
    """A weave of elliptical yarns. spacing_ratio: spacing of the weft over that of the warp. fill: width of a yarn over
    its spacing; aspect: thickness over width; both (2,) warp, weft. crimp: the warp's share of the amplitudes. bend:
    length on which a yarn changes sides, in spacings of the crossed yarns. arch: rise of a float over its period.
    rough (2, 2): GGX roughness of warp and weft along and across the fibres. gain: of the gloss. soft: radians,
    scatter of the horizons, for yarns differ."""

    binding: Binding
    spacing_ratio: float
    fill: np.ndarray
    aspect: np.ndarray
    crimp: float
    bend: float
    arch: float
    rough: np.ndarray
    gain: float
    soft: float
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

    def points(self, density: tuple[int, int] = (ACROSS, ALONG)):
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

    def parts(self, incident: np.ndarray, outgoing: np.ndarray, density=(ACROSS, ALONG)) -> np.ndarray:
        """(n, 2) gloss and white body, 1/sr, at directions (n, 3)."""
        out = np.empty((len(incident), 2))
        weave_sums(
            np.ascontiguousarray(incident), np.ascontiguousarray(outgoing), *self.points(density), self.rough,
            self.index, self.soft, out,
        )  # fmt: skip
        out[:, 0] *= self.gain
        return out

    def slopes(self) -> dict[str, float]:
        """Mean and 90th percentile, degrees, of the slope in the planes of weft and warp over what is seen from
        above, and the weft's share of it."""
        points, which, _ = self.points((3 * ACROSS, 4 * ALONG))
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
