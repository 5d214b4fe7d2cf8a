"""Fit the reflection parameters of a whole object, tile by tile.

A texel turns by ten degrees from view to view, so that one or two of them show its highlight: width and strength follow
from many texels together.  Each texel adds what its observations say of lobes of all widths, whatever its K_d
(`texel_fit.LobeProfile`); these sums are smoothed over the surface, and each texel takes the lobe that explains most of
the sums of its neighbours and of its own.  K_d is then its own.  The neighbours count as `pull` texels; `pull` is
the one of PULLS that predicts best the captured views hidden in a trial.  Profiles stay in memory on the
nodes of a lattice; texels are read anew in every pass.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from nishiki.brdf.texels import texel_fit
from nishiki.brdf.texels.neighbours import Lattice, LatticeField, Neighbourhood, fill, spread
from nishiki.brdf.texels.parameters import Parameters, TexelFlag
from nishiki.brdf.texels.texel_fit import WIDTHS, CaptureViews, LobeProfile, Tile, TileSamples
from nishiki.threads import in_threads

CELL = 8  # edge of the finest lattice's cells, in texels
FAR = 1 << 16  # cells from the world's origin: half of it is near
DEFAULT_SIGMA = 0.2  # radians, where no highlight was seen on the whole object
PULLS = (512.0, 64.0, 8.0, 1.0, 0.1)
"""Numbers of texels as which the neighbours may count; the first is used where too few views show the trial's tiles."""
FIRST_PULL = 64.0  # of the neighbours whose lobes decide which saturated values count
JUDGED = 8  # approximate number of tiles in the trial
LEAST_POWER = 0.04  # observations at a lobe's peak below which a texel's own K_s is taken to say nothing


@dataclass(frozen=True)
class ObjectFit:
    """Figures of the fit; shares are of the texels inside charts."""

    texels: int
    samples: int  # visible: texels times observations times channels
    psnr_db: float | None  # of the model alone over them, in the capture's encoding, peak 1
    highlight_share: float  # observed within sigma of the mirror direction
    filled_share: float  # K_s from the neighbours, for want of observations near the mirror direction
    unseen_share: float
    once_share: float
    at_bound_share: float = 0.0  # sigma at an end of WIDTHS
    median_sigma: float | None = None  # radians, of the texels with a highlight
    pull: float | None = None  # of PULLS; None without gloss


def fit_object(
    read: Callable[[int], Tile],
    tiles: Iterable[int],
    capture: CaptureViews,
    write: Callable[[int, Parameters], None],
    *,
    threads: int = 1,
) -> ObjectFit:
    """Fit all tiles: read(tile) gives its texels, write(tile, parameters) takes the result; from several threads.

    Where tiles have components the lobe comes from the specular one, and K_d from what it leaves of the total.  The
    result does not depend on `threads`.
    """
    tiles = list(tiles)
    some = [read(tile) for tile in tiles[:: max(len(tiles) // 6, 1)]]
    edge = CELL * spacing(some)
    first_texel = np.concatenate([tile.positions[tile.inside][:1] for tile in some] or [np.empty((0, 3))])[:1]
    # Far from the world's origin cells are counted from a multiple of FAR cells near the first texel.
    origin = FAR * edge * np.rint(first_texel.astype(float).sum(axis=0) / (FAR * edge))
    lattice = Lattice(edge, tuple(origin.tolist()))
    pull = _choose_pull(read, tiles[:: max(len(tiles) // JUDGED, 1)], capture, lattice, threads)
    gloss = _Gloss.of(*_gather(read, tiles, capture, lattice, threads), pull)

    def finish(k: int) -> tuple[np.ndarray, float, int, np.ndarray]:
        tile = read(tiles[k])
        parameters = _fit_tile(tile, *_observe(tile, capture, gloss), gloss)
        write(tiles[k], parameters)
        shown = (parameters.flags & (TexelFlag.OUTSIDE | TexelFlag.NO_HIGHLIGHT)) == 0
        return _counts(parameters), *capture.squares(parameters, tile.joined), parameters.sigma[shown]

    finished = list(in_threads(finish, range(len(tiles)), threads))
    sigmas = np.concatenate([part[3] for part in finished] or [np.empty(0)])
    return replace(
        _totals([part[:3] for part in finished]),
        pull=pull,
        median_sigma=float(np.median(sigmas)) if sigmas.size else None,
    )


def _choose_pull(
    read: Callable[[int], Tile], tiles: list[int], capture: CaptureViews, lattice: Lattice, threads: int
) -> float:
    """Choose the pull whose fit to two thirds of the views predicts the others best, on some tiles.

    Of three captured views in a row the middle one is hidden, and predicted by the model plus the
    residuals of the two others, weighed as the renderer weighs them.
    """
    captured = np.flatnonzero(np.any([tile.visible.any(axis=(1, 2)) for tile in map(read, tiles)], axis=0))
    rows = list(zip(captured[::3], captured[1::3], captured[2::3], strict=False))

    def read_some(number: int) -> Tile:
        return read(number).hide([middle for _, middle, _ in rows])

    around = _gather(read_some, tiles, capture, lattice, threads)
    trials = [_Gloss.of(*around, pull) for pull in PULLS]

    def measure_errors(number: int) -> np.ndarray:
        tile, hidden, errors = read(number).joined, read_some(number), np.zeros(len(trials))
        observations, usable = _observe(hidden, capture, trials[0]), tile.usable & tile.inside
        for place, gloss in enumerate(trials):
            fitted = _fit_tile(hidden, *observations, gloss)
            for row in rows:
                seen = usable[list(row)].all(axis=0)
                parts = (capture.subtract_prediction(fitted, tile, int(view), seen) for view in row)
                left, weights = zip(*parts, strict=True)
                before, after = (weights[k] / (weights[0] + weights[2]) for k in (0, 2))
                lent = before[:, None] * left[0] + after[:, None] * left[2]
                errors[place] += np.nansum((left[1] - lent) ** 2, dtype=np.float64)
        return errors

    return PULLS[int(np.argmin(sum(in_threads(measure_errors, tiles, threads), np.zeros(len(PULLS)))))]


def spacing(tiles: list[Tile]) -> float:
    """Compute the median distance between texels; 1 where no tile has two side by side."""
    values = [tile.spacing for tile in tiles]
    values = [v for v in values if np.isfinite(v) and v > 0]
    return float(np.median(values)) if values else 1.0


def _gather(
    read: Callable[[int], Tile], tiles: list[int], capture: CaptureViews, lattice: Lattice, threads: int
) -> tuple[Neighbourhood, int]:
    """Spread the profiles of all texels over a lattice; return their number of channels too.

    A second pass adds the saturated values above the body and the lobes of the first.
    """

    def spread_tile(number: int, gloss: "_Gloss | None" = None) -> tuple:
        tile = read(number)
        total, profile = _observe(tile, capture, gloss)
        # every texel of the charts counts as surface, also those that no view shows
        surface = np.flatnonzero(tile.inside)
        columns = profile.columns
        values, weights = np.zeros((tile.inside.size, columns.shape[1])), np.zeros(tile.inside.size)
        values[total.texel], weights[total.texel] = columns, 1
        part = spread(tile.positions.reshape(-1, 3)[surface], values[surface], weights[surface], lattice)
        return part, tile.values.shape[-1], tile.saturated is not None and bool(tile.saturated.any())

    def spread_all(spread_one: Callable[[int], tuple]) -> tuple[Neighbourhood, int, bool]:
        spread_out = list(in_threads(spread_one, tiles, threads))
        parts = [part for part, _, _ in spread_out]
        around = Neighbourhood(lattice, parts[0][1].shape[1] - 1 if parts else len(WIDTHS), parts)
        return around, spread_out[0][1] if parts else 1, any(saturated for _, _, saturated in spread_out)

    around, channels, saturated = spread_all(spread_tile)
    if saturated:
        around, *_ = spread_all(partial(spread_tile, gloss=_Gloss.of(around, channels, FIRST_PULL)))
    return around, channels


@dataclass(frozen=True)
class _Gloss:
    """The field of profiles, the neighbours' pull, and sigma where no lobe gains, radians."""

    field: LatticeField
    pull: float
    sigma: float
    channels: int

    @classmethod
    def of(cls, around: Neighbourhood, channels: int, pull: float) -> "_Gloss":
        mean = around.mean(np.zeros(around.size))
        sigma = (
            float(LobeProfile.from_columns(mean[None], channels).solve()[0][0]) if around.size > len(WIDTHS) else 0.0
        )
        return cls(around.field(pull, mean), pull, sigma or DEFAULT_SIGMA, channels)

    def solve(self, positions: np.ndarray, own: np.ndarray | float = 0.0) -> tuple[np.ndarray, np.ndarray]:
        """Find sigma (n,) and K_s (n, channels) at positions (n, 3) from the field and the columns of own profiles."""
        columns = self.pull * self.field.at(positions).astype(np.float64) + own
        widths, strengths = LobeProfile.from_columns(columns, self.channels).solve()
        return np.where(widths > 0, widths, np.float32(self.sigma)), strengths


def _observe(tile: Tile, capture: CaptureViews, gloss: _Gloss | None) -> tuple[TileSamples, LobeProfile]:
    """Gather a tile's total radiance, and the profiles of its texels, from the specular component where it has one.

    A saturated value is a lower bound: it counts where body and neighbours' lobes stay below.
    """
    own, specular = capture.observe(tile)
    total = own if specular is None else capture.observe(tile.joined)[0]
    if gloss is None or total.saturated is None:
        return total, LobeProfile.of(own, specular)
    widths, strengths = gloss.solve(tile.positions.reshape(-1, 3)[total.texel])
    lobes = texel_fit.lobes_of(total, widths)[..., None] * strengths[:, None]
    expected = texel_fit.lambert(total, lobes)[:, None] * total.diffuse[..., None] + lobes
    exceeded = total.saturated & (expected >= total.values)
    return total, LobeProfile.of(total, weights=np.where(exceeded, np.float32(0), total.weights[..., None]))


def _fit_tile(tile: Tile, total: TileSamples, profile: LobeProfile, gloss: _Gloss) -> Parameters:
    """Find the parameters of a tile's texels, and fill K_d where it is unknown."""
    shape, channels = tile.inside.shape, tile.values.shape[-1]
    surface, place = np.flatnonzero(tile.inside), np.zeros(tile.inside.size, int)
    place[surface] = np.arange(len(surface))
    here = place[total.texel]
    columns = np.zeros((len(surface), profile.columns.shape[1]))
    columns[here] = profile.columns
    widths, strengths = gloss.solve(tile.positions.reshape(-1, 3)[surface], columns)
    lobes = texel_fit.lobes_of(total, widths[here])
    kd, ks = (np.zeros((tile.inside.size, channels), np.float32) for _ in range(2))
    sigma, flags = np.zeros(tile.inside.size, np.float32), np.full(tile.inside.size, TexelFlag.OUTSIDE, np.uint8)
    body = texel_fit.lambert(total, lobes[..., None] * strengths[here][:, None])
    # Without a body (K_d would be negative) all light is the lobe's, where an observation shows the lobe.
    alone = texel_fit.lambert(replace(total, diffuse=lobes.astype(np.float32)))
    capped = ((total.certain * lobes[..., None] ** 2).sum(axis=1) > 0) & (body <= 0)
    strengths[here] = np.where(capped, np.minimum(strengths[here], alone), strengths[here])
    kd[total.texel] = body
    sigma[surface], ks[surface] = widths, strengths
    flags[surface] = TexelFlag.UNSEEN | TexelFlag.NO_HIGHLIGHT | TexelFlag.KS_UNCONSTRAINED
    near = ((total.alpha <= widths[here, None]) & (total.weights > 0)).any(axis=1)
    nearest = np.abs(np.log(WIDTHS) - np.log(widths[here, None])).argmin(axis=1)
    weight = total.weights.sum(axis=1) / np.maximum((total.weights > 0).sum(axis=1), 1)
    informed = profile.power[np.arange(len(here)), nearest].max(axis=-1) > LEAST_POWER * weight
    told = np.where(total.seen < 2, TexelFlag.ONCE, 0) | np.where(informed, 0, TexelFlag.KS_UNCONSTRAINED)
    told |= np.where(near, 0, TexelFlag.NO_HIGHLIGHT)
    flags[total.texel] = np.where(total.seen > 0, told, flags[total.texel])
    flags = flags.reshape(shape)
    known = (flags & (TexelFlag.OUTSIDE | TexelFlag.UNSEEN)) == 0
    joined = np.concatenate([ks.reshape(*shape, channels), sigma.reshape(*shape, 1)], axis=-1)
    joined = fill(joined, tile.inside)
    if not tile.inside.any():
        joined[..., channels] = gloss.sigma
    return Parameters(fill(kd.reshape(*shape, channels), known), joined[..., :channels], joined[..., channels], flags)


def _counts(parameters: Parameters) -> np.ndarray:
    """Count texels inside charts: all, by four flags, and with a width at an end of WIDTHS."""
    inside = (parameters.flags & TexelFlag.OUTSIDE) == 0
    bits = (TexelFlag.NO_HIGHLIGHT, TexelFlag.KS_UNCONSTRAINED, TexelFlag.UNSEEN, TexelFlag.ONCE)
    ended = (parameters.sigma <= WIDTHS[0] * 1.001) | (parameters.sigma >= WIDTHS[-1] * 0.999)
    parts = [inside, *(inside & ((parameters.flags & bit) != 0) for bit in bits), inside & ended]
    return np.array([part.sum() for part in parts], np.int64)


def _totals(finished: list[tuple[np.ndarray, float, int]]) -> ObjectFit:
    """Compute the figures of all tiles from counts, squared errors and numbers of samples."""
    counts = sum((counted for counted, _, _ in finished), np.zeros(6, np.int64))
    squares = sum(squared for _, squared, _ in finished)
    samples = sum(number for _, _, number in finished)
    dark, filled, unseen, once, ended = (counts[1:] / int(counts[0])).tolist() if counts[0] else (1.0, 0, 0, 0, 0)
    psnr = -10 * float(np.log10(max(squares / samples, 1e-30))) if samples else None
    return ObjectFit(int(counts[0]), samples, psnr, 1 - dark, filled, unseen, once, ended)


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
        return _counts(parameters), *capture.squares(parameters, tile)

    return _totals(list(in_threads(finish, tiles, threads)))


def lambert_tile(tile: Tile, capture: CaptureViews) -> Parameters:
    """Fit the parameters of one tile; K_d of unobserved texels comes from their neighbours."""
    total, _ = capture.observe(tile)
    shape, channels = tile.inside.shape, tile.values.shape[-1]
    kd = np.zeros((tile.inside.size, channels), np.float32)
    kd[total.texel] = texel_fit.lambert(total)
    flags = np.full(tile.inside.size, TexelFlag.UNSEEN | TexelFlag.NO_HIGHLIGHT, np.uint8)
    told = TexelFlag.NO_HIGHLIGHT | np.where(total.seen < 2, TexelFlag.ONCE, 0)
    flags[total.texel] = np.where(total.seen > 0, told, flags[total.texel])
    flags[~tile.inside.ravel()] = TexelFlag.OUTSIDE
    flags = flags.reshape(shape)
    known = (flags & (TexelFlag.OUTSIDE | TexelFlag.UNSEEN)) == 0
    filled = fill(kd.reshape(*shape, channels), known)
    return Parameters(filled, np.zeros_like(filled), np.full(shape, DEFAULT_SIGMA, np.float32), flags)
