"""Fit the reflection parameters of a whole object, tile by tile.

1. Every texel by itself: the width sigma of its lobe, where a highlight was observed, and how well it is determined.
2. With sigma drawn towards the neighbours': K_s of every texel and how much its observations say of it.
3. With K_s drawn towards the neighbours' too: K_d and K_s, filled where nothing was observed.

How strongly texels are drawn follows from the data: the scatter of texels about their neighbourhood beyond their own
uncertainty.  Passes 1 and 2 leave some twenty bytes a texel in memory; texels are read anew in every pass.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from nishiki.brdf.fit import FitFlag
from nishiki.brdf.texels import texel_fit
from nishiki.brdf.texels.neighbours import Lattice, LatticeField, Neighbourhood, fill, spread
from nishiki.brdf.texels.parameters import Parameters, TexelFlag
from nishiki.brdf.texels.texel_fit import CaptureViews, Tile
from nishiki.threads import in_threads

CELL = 8  # edge of the finest lattice's cells, in texels
FAR = 1 << 16  # cells from the world's origin: half of it is near
SCATTER_SIGMA = 0.2  # of log sigma between neighbours: first guess
SCATTER_KS = 0.5  # of K_s, relative to its mean: first guess
LEAST_SCATTER = 0.02  # of either
SUBSET = 2000  # texels of a tile, at most, that the scatter is judged by
DEFAULT_SIGMA = 0.2  # radians, where no highlight was seen on the whole object
FREEDOMS = (1.0, 0.25, 0.0)  # factors on the scatter that are tried
JUDGED = 8  # tiles, about, on which they are
MOST_PULL = 1e20  # a precision that no data compare with
KS_UNCONSTRAINED = 0.1  # standard deviation of a texel's own K_s, relative to the mean K_d, above which it says nothing


@dataclass(frozen=True)
class ObjectFit:
    """Figures of the fit; shares are of the texels inside charts."""

    texels: int
    samples: int  # visible: texels times observations times channels
    psnr_db: float | None  # of the model alone over them, in the capture's encoding, peak 1
    highlight_share: float  # sigma determined from own observations
    filled_share: float  # K_s from the neighbours, for want of observations near the mirror direction
    unseen_share: float
    once_share: float
    median_sigma: float | None = None  # radians, of the texels with a highlight
    scatter_log_sigma: float = 0.0
    scatter_ks: float = 0.0
    freedom: float = 1.0  # factor on both, of FREEDOMS
    noise: float = 0.0  # root mean square of the weighted residuals of the median texel
    at_bound_share: float = 0.0  # own sigma at the end of its range (SIGMA_BOUNDS): the neighbours' is taken there


def fit_object(
    read: Callable[[int], Tile],
    tiles: Iterable[int],
    capture: CaptureViews,
    write: Callable[[int, Parameters], None],
    *,
    threads: int = 1,
) -> ObjectFit:
    """Fit all tiles: read(tile) gives its texels, write(tile, parameters) takes the result; from several threads.

    Sigma and K_s are drawn towards the neighbours' as far as the data allow.  Where tiles have components only sigma
    comes from the specular one, and K_d and K_s from the total, which is what a picture shows.  The result does not
    depend on `threads`.
    """
    tiles = list(tiles)
    some = [read(tile) for tile in tiles[:: max(len(tiles) // 6, 1)]]
    edge = CELL * spacing(some)
    first_texel = np.concatenate([tile.positions[tile.inside][:1] for tile in some] or [np.empty((0, 3))])[:1]
    # Far from the world's origin cells are counted from a multiple of FAR cells near the first texel.
    origin = FAR * edge * np.rint(first_texel.astype(float).sum(axis=0) / (FAR * edge))
    lattice = Lattice(edge, tuple(origin.tolist()))
    freedom = _choose_freedom(read, tiles[:: max(len(tiles) // JUDGED, 1)], capture, lattice, threads)
    first = _first_pass(read, tiles, capture, lattice, threads)
    passes = _Passes.of(read, tiles, capture, lattice, freedom, first, threads)

    def finish(k: int) -> tuple[np.ndarray, float, int]:
        tile = read(tiles[k]).joined
        parameters = _third(tile, capture, passes.widths, passes.gloss, passes.first[k])
        write(tiles[k], parameters)
        return _counts(parameters.flags), *capture.squares(parameters, tile)

    finished = list(in_threads(finish, range(len(tiles)), threads))
    return replace(_describe(passes.first, passes.widths, passes.gloss, finished), freedom=freedom)


def _choose_freedom(
    read: Callable[[int], Tile], tiles: list[int], capture: CaptureViews, lattice: Lattice, threads: int
) -> float:
    """Choose the factor on the scatter whose fit to two thirds of the views serves the others best, on some tiles.

    Wrong normals and shapes of the lobe that the model lacks scatter the texels' estimates, too, far beyond their
    uncertainty; a texel that follows its own then shows a highlight where the next view has none. Of three captured
    views in a row the middle one is hidden, and predicted by the model and the mean of its residuals in the two others.
    """
    captured = np.flatnonzero(np.any([read(number).visible.any(axis=(1, 2)) for number in tiles], axis=0))
    rows = list(zip(captured[::3], captured[1::3], captured[2::3], strict=False))

    def read_tile(number: int) -> Tile:
        tile = read(number)
        visible = tile.visible.copy()
        visible[[middle for _, middle, _ in rows]] = False
        return replace(tile, visible=visible)

    def error(k: int, passes: _Passes) -> float:
        tile, total = read(tiles[k]).joined, 0.0
        fitted = _third(read_tile(tiles[k]).joined, capture, passes.widths, passes.gloss, passes.first[k])
        for row in rows:
            seen = tile.visible[list(row)].all(axis=0) & tile.inside
            before, here, after = (capture.subtract_prediction(fitted, tile, int(view), seen) for view in row)
            total += float(np.nansum((here - (before + after) / 2) ** 2, dtype=np.float64))
        return total

    errors, first = [], _first_pass(read_tile, tiles, capture, lattice, threads)
    for freedom in FREEDOMS:
        passes = _Passes.of(read_tile, tiles, capture, lattice, freedom, first, threads)
        errors.append(sum(in_threads(partial(error, passes=passes), range(len(tiles)), threads)))
    return FREEDOMS[int(np.argmin(errors))]


def spacing(tiles: list[Tile]) -> float:
    """Compute the median distance between texels; 1 where no tile has two side by side."""
    values = [tile.spacing for tile in tiles]
    values = [v for v in values if np.isfinite(v) and v > 0]
    return float(np.median(values)) if values else 1.0


@dataclass(frozen=True)
class _First:
    """Pass 1 of a tile: the observed texels, their estimates of sigma, and a sample to estimate the scatter from."""

    texel: np.ndarray
    fit: texel_fit.FirstFit
    part: tuple
    sample: np.ndarray  # positions of every `stride`-th texel
    stride: int

    @classmethod
    def of(cls, tile: Tile, capture: CaptureViews, lattice: Lattice) -> "_First":
        total, specular = capture.observe(tile)
        fit = texel_fit.first_fit(total, specular)
        informed = fit.information > 0
        precision = np.where(informed, 1 / (1 / np.where(informed, fit.information, 1) + SCATTER_SIGMA**2), 0)
        # every texel of the charts counts as surface, also those that no view shows
        surface = np.flatnonzero(tile.inside)
        values, weights = (np.zeros(tile.inside.size) for _ in range(2))
        values[total.texel], weights[total.texel] = fit.log_sigma, precision
        places = tile.positions.reshape(-1, 3)
        part = spread(places[surface], values[surface, None], weights[surface], lattice)
        stride = max(len(informed) // SUBSET, 1)
        return cls(total.texel, fit, part, places[total.texel[::stride]], stride)


@dataclass(frozen=True)
class _Widths:
    """The rule for sigma from a texel's own estimate and the field of its neighbours."""

    field: LatticeField
    scatter: float

    @classmethod
    def of(cls, first: list[_First], lattice: Lattice, freedom: float) -> "_Widths":
        around = Neighbourhood(lattice, 1, [f.part for f in first])
        default = np.log([DEFAULT_SIGMA])
        guess = around.field(1 / SCATTER_SIGMA**2, default)
        log_sigma = np.concatenate([f.fit.log_sigma[:: f.stride] for f in first] or [np.empty(0)])
        information = np.concatenate([f.fit.information[:: f.stride] for f in first] or [np.empty(0)])
        near = np.concatenate([guess.at(f.sample)[:, 0] for f in first] or [np.empty(0)])
        scatter = max(freedom * _scatter(log_sigma - near, information, SCATTER_SIGMA), LEAST_SCATTER)
        return cls(around.field(1 / scatter**2, default), scatter)

    def sigma(self, positions: np.ndarray, log_sigma: np.ndarray, information: np.ndarray) -> np.ndarray:
        """Compute sigma (points,) float32, radians."""
        near = self.field.at(positions)[:, 0]
        share = information / (information + 1 / self.scatter**2)
        low, high = texel_fit.SIGMA_BOUNDS
        return np.clip(np.exp(share * log_sigma + (1 - share) * near), low, high).astype(np.float32)


@dataclass(frozen=True)
class _Second:
    """Pass 2 of a tile: the texels' estimates of K_s."""

    part: tuple
    ks: np.ndarray  # of the sample, without a prior
    information: np.ndarray
    residual: np.ndarray
    sample: np.ndarray

    @classmethod
    def of(cls, tile: Tile, capture: CaptureViews, widths: _Widths, first: _First, lattice: Lattice) -> "_Second":
        total, _ = capture.observe(tile)
        places = tile.positions.reshape(-1, 3)
        sigma = widths.sigma(places[first.texel], first.fit.log_sigma, first.fit.information)
        strengths = texel_fit.strengths(total, sigma, np.zeros_like(first.fit.ks), 0.0)
        information = strengths.information
        surface = np.flatnonzero(tile.inside)
        channels = strengths.ks.shape[1]
        values, weights = np.zeros((tile.inside.size, channels)), np.zeros(tile.inside.size)
        values[first.texel], weights[first.texel] = strengths.ks, information
        part = spread(places[surface], values[surface], weights[surface], lattice)
        keep = slice(None, None, first.stride)
        return cls(part, strengths.ks[keep], information[keep], strengths.residual[keep], first.sample)


@dataclass(frozen=True)
class _Gloss:
    """The field of K_s, and how strongly a texel is drawn to it (in units of the texel's sums of squares)."""

    field: LatticeField
    scatter: float
    noise: float
    level: float  # mean K_d

    @classmethod
    def of(cls, second: list[_Second], first: list[_First], lattice: Lattice, freedom: float) -> "_Gloss":
        # of the observations that K_s is solved from: with components all light, whose diffuse part fits less well
        noise = texel_fit.noise_of(np.concatenate([s.residual for s in second] or [np.empty(0)]))
        channels = second[0].ks.shape[1] if second else 1
        around = Neighbourhood(lattice, channels, [s.part for s in second])
        mean = around.mean(np.zeros(channels))
        guess = SCATTER_KS * max(float(np.mean(mean)), 1e-30)
        rough = around.field(min((noise / guess) ** 2, MOST_PULL), mean)
        apart = np.concatenate([(s.ks - rough.at(s.sample)).mean(axis=1) for s in second] or [np.empty(0)])
        information = np.concatenate([s.information for s in second] or [np.empty(0)])
        scatter = _scatter(apart, information / noise**2, guess)
        scatter = max(freedom * scatter, LEAST_SCATTER * guess / SCATTER_KS)
        levels = [f.fit.kd.mean(dtype=float) for f in first if len(f.texel)]
        level = float(np.mean(levels)) if levels else 0.0
        return cls(around.field(min((noise / scatter) ** 2, MOST_PULL), mean), scatter, noise, level)

    @property
    def pull(self) -> float:
        """Precision of the prior, in the units of a texel's information."""
        return min((self.noise / self.scatter) ** 2, MOST_PULL)


@dataclass(frozen=True)
class _Passes:
    """The first two passes over all tiles."""

    first: list[_First]
    widths: _Widths
    gloss: _Gloss

    @classmethod
    def of(
        cls, read: Callable[[int], Tile], tiles: list[int], capture: CaptureViews, lattice: Lattice, freedom: float,
        first: list[_First], threads: int,
    ) -> "_Passes":  # fmt: skip
        """Run the second pass after the first; freedom: factor on the scatter about the neighbours."""
        widths = _Widths.of(first, lattice, freedom)

        def second(k: int) -> _Second:
            return _Second.of(read(tiles[k]).joined, capture, widths, first[k], lattice)

        gloss = _Gloss.of(list(in_threads(second, range(len(tiles)), threads)), first, lattice, freedom)
        return cls(first, widths, gloss)


def _first_pass(
    read: Callable[[int], Tile], tiles: list[int], capture: CaptureViews, lattice: Lattice, threads: int
) -> list[_First]:
    """Run the first pass over all tiles."""
    return list(in_threads(lambda number: _First.of(read(number), capture, lattice), tiles, threads))


def _third(tile: Tile, capture: CaptureViews, widths: _Widths, gloss: _Gloss, first: _First) -> Parameters:
    """Run pass 3 on a tile: fit K_d and K_s with the prior, and fill unknown texels."""
    total, _ = capture.observe(tile)
    shape, channels = tile.inside.shape, tile.values.shape[-1]
    places = tile.positions.reshape(-1, 3)
    surface = np.flatnonzero(tile.inside)
    log_sigma, information = np.zeros(tile.inside.size), np.zeros(tile.inside.size)
    log_sigma[first.texel], information[first.texel] = first.fit.log_sigma, first.fit.information
    sigma = np.zeros(tile.inside.size, np.float32)
    sigma[surface] = widths.sigma(places[surface], log_sigma[surface], information[surface])
    ks, kd = (np.zeros((tile.inside.size, channels), np.float32) for _ in range(2))
    ks[surface] = np.maximum(gloss.field.at(places[surface]), 0)
    strengths = texel_fit.strengths(total, sigma[first.texel], ks[first.texel], gloss.pull)
    kd[first.texel], ks[first.texel] = strengths.kd, strengths.ks
    unconstrained = gloss.noise > KS_UNCONSTRAINED * gloss.level * np.sqrt(strengths.information)
    flags = np.full(tile.inside.size, TexelFlag.UNSEEN | TexelFlag.NO_HIGHLIGHT | TexelFlag.KS_UNCONSTRAINED, np.uint8)
    of_seen = np.where(total.seen < 2, TexelFlag.ONCE, 0) | np.where(unconstrained, TexelFlag.KS_UNCONSTRAINED, 0)
    of_seen |= np.where(first.fit.information > 0, 0, TexelFlag.NO_HIGHLIGHT)
    flags[first.texel] = np.where(total.seen > 0, of_seen, flags[first.texel])
    flags[~tile.inside.ravel()] = TexelFlag.OUTSIDE
    flags = flags.reshape(tile.inside.shape)
    known = (flags & (TexelFlag.OUTSIDE | TexelFlag.UNSEEN)) == 0
    inside = tile.inside
    joined = np.concatenate([ks.reshape(*shape, channels), sigma.reshape(*shape, 1)], axis=-1)
    joined = fill(joined, inside)
    if not inside.any():
        joined[..., channels] = np.exp(widths.field.mean[0])
    return Parameters(fill(kd.reshape(*shape, channels), known), joined[..., :channels], joined[..., channels], flags)


def _counts(flags: np.ndarray) -> np.ndarray:
    inside = (flags & TexelFlag.OUTSIDE) == 0
    bits = (TexelFlag.NO_HIGHLIGHT, TexelFlag.KS_UNCONSTRAINED, TexelFlag.UNSEEN, TexelFlag.ONCE)
    return np.array([inside.sum(), *(np.sum(inside & ((flags & bit) != 0)) for bit in bits)], np.int64)


def _describe(first: list[_First], widths: _Widths, gloss: _Gloss, finished: list) -> ObjectFit:
    found, _ = _totals(finished)
    log_sigma = np.concatenate([f.fit.log_sigma[f.fit.information > 0] for f in first] or [np.empty(0)])
    ended = sum(int(np.sum((f.fit.flags & FitFlag.AT_BOUND) != 0)) for f in first)
    return replace(
        found,
        median_sigma=float(np.exp(np.median(log_sigma))) if log_sigma.size else None,
        scatter_log_sigma=widths.scatter,
        scatter_ks=gloss.scatter,
        noise=gloss.noise,
        at_bound_share=ended / max(found.texels, 1),
    )


def _totals(finished: list[tuple[np.ndarray, float, int]]) -> tuple[ObjectFit, float]:
    """Compute the figures of all tiles from counts of flags, squared errors and samples; and the mean squared error."""
    counts = sum((counted for counted, _, _ in finished), np.zeros(5, np.int64))
    squares = sum(squared for _, squared, _ in finished)
    samples = sum(number for _, _, number in finished)
    dark, filled, unseen, once = (counts[1:] / max(int(counts[0]), 1)).tolist()
    mean = squares / max(samples, 1)
    psnr = -10 * float(np.log10(max(mean, 1e-30))) if samples else None
    found = ObjectFit(int(counts[0]), samples, psnr, 1 - dark, filled, unseen, once)
    return found, mean


def _scatter(apart: np.ndarray, information: np.ndarray, guess: float) -> float:
    """Estimate the deviation of true values about the neighbourhood: apart (n,), less its variance 1 / information."""
    apart, information = apart.astype(np.float64), information.astype(np.float64)
    informed = information * guess**2 > 1
    if informed.sum() < 30:
        return guess
    variance = 1 / information[informed]
    square = np.minimum(apart[informed] ** 2, (4 * guess) ** 2 + 9 * variance)
    weight = 1 / (variance + guess**2) ** 2
    return float(np.sqrt(max(np.sum(weight * (square - variance)) / np.sum(weight), 0)))


def fit_lambert(
    read: Callable[[int], Tile],
    tiles: Iterable[int],
    capture: CaptureViews,
    write: Callable[[int, Parameters], None],
    *,
    threads: int = 1,
) -> ObjectFit:
    """Fit K_d of all tiles by weighted least squares (Miyazaki et al. 2007, section 3.1); K_s = 0, one sigma.

    Of tiles with components the total is fitted: without gloss it is the diffuse one.
    """
    tiles = list(tiles)

    def finish(number: int) -> tuple[np.ndarray, float, int]:
        tile = read(number).joined
        parameters = lambert_tile(tile, capture)
        write(number, parameters)
        return _counts(parameters.flags), *capture.squares(parameters, tile)

    found, mean = _totals(list(in_threads(finish, tiles, threads)))
    return replace(found, highlight_share=0.0, noise=float(np.sqrt(mean)))


def lambert_tile(tile: Tile, capture: CaptureViews) -> Parameters:
    """Fit the parameters of one tile; K_d of unobserved texels comes from their neighbours."""
    total, _ = capture.observe(tile)
    shape, channels = tile.inside.shape, tile.values.shape[-1]
    kd = np.zeros((tile.inside.size, channels), np.float32)
    kd[total.texel] = texel_fit.lambert(total)
    flags = np.full(tile.inside.size, TexelFlag.UNSEEN | TexelFlag.NO_HIGHLIGHT, np.uint8)
    flags[total.texel] = TexelFlag.NO_HIGHLIGHT | np.where(total.seen < 2, TexelFlag.ONCE, 0)
    flags[~tile.inside.ravel()] = TexelFlag.OUTSIDE
    flags = flags.reshape(shape)
    known = (flags & (TexelFlag.OUTSIDE | TexelFlag.UNSEEN)) == 0
    filled = fill(kd.reshape(*shape, channels), known)
    return Parameters(filled, np.zeros_like(filled), np.full(shape, DEFAULT_SIGMA, np.float32), flags)
