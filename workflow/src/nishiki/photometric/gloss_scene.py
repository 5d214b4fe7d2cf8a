"""The finishes of a scene from a sample of its pixels: one gloss, or several and the places that have them.

Highlights bias the normals and the normals decide where highlights are. So: specular samples with the normals as they
stand -> profile (normals' errors undone) -> joint fit of the sample's pixels -> and again. Every round starts the
pixels from the same normals; only profile, normals and reflectances of the last round are handed to the next.

A painting may be varnished in part. Cells of the picture are then given to the profile under which the joint fit costs
least, and each profile is fitted again to its cells, like the means and members of k-means (S. P. Lloyd, Least squares
quantization in PCM, IEEE Trans. Inf. Theory 28, 1982). Two finishes start from the gloss of the whole scene and from
no gloss; a further one splits a gloss into a narrower and a wider one (Y. Linde, A. Buzo and R. M. Gray, An algorithm
for vector quantizer design, IEEE Trans. Commun. 28, 1980).

Gold and other coloured metals mirror in their colour and have no body. Where the brightest light of the scene is not
white, a metal of that colour is tried as a further finish.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from nishiki.brdf.gloss_profile import GlossProfile, SpecularHistogram, fit_gloss, specular_samples, unit_of
from nishiki.brdf.torrance_sparrow import MIRROR
from nishiki.photometric.flags import NO_ESTIMATE, NormalFlag
from nishiki.photometric.gloss import LARGEST_SIGMA, GlossTile, RefinedNormals, refine_normals, step

WIDTHS = np.geomspace(0.01, 0.3, 9)  # radians, half widths: what is wider is light from paint to paint as well
ROUNDS = 2
MOST_ROUNDS = 8  # of cells and profiles in turn
THIN = 3  # one pixel in so many tells the cells' finishes
WORTHWHILE = 0.03  # gain of robust cost a value, from which gloss counts as shown
SIDE = 15  # pixels: of a cell of the picture that has one finish
FEWEST_CELLS = 4  # of a finish
MOST_FINISHES = 4
BRIGHTEST = 1e-3  # share of the samples whose mean is the colour of a metal
COLOURED = 0.8  # least channel of a metal, relative to its largest: others mirror like a dielectric of no body
METAL_LEVEL, METAL_WIDTHS = 0.7, slice(5, 8)  # of metals to start from: reflectance, and lobes among WIDTHS


@dataclass(frozen=True)
class SceneGloss:
    """The gloss of a scene.

    profile, without gloss where none is significant; found: whether or not; first: before the steps that free the
    pixels' own unknowns; gain: robust cost a value (light and channel) that the profile takes off the fit without
    gloss; significant: whether that is WORTHWHILE; pixels of the sample.
    """

    profile: GlossProfile
    found: GlossProfile
    first: GlossProfile
    gain: float
    significant: bool
    pixels: int

    @property
    def described(self) -> dict:
        """Plain numbers for a list of results."""
        return {
            "gloss_gain": self.gain,
            "gloss_significant": self.significant,
            "gloss_sample_pixels": self.pixels,
            **self.profile.described,
        }


def fit_scene_gloss(
    tiles: Sequence[GlossTile], *, refractive_index: float = 1.45, start: GlossProfile | None = None
) -> SceneGloss:
    """Fit the gloss of the scene, or of one finish, to a sample of its pixels.

    start : gloss of an earlier fit; without it, specular samples of the selection's normals and of a first joint fit
    tell one. Where no gloss is significant there is no surface either, and the profile returned has no transmission
    loss.
    """
    unit = unit_of([tile.reflectance for tile in tiles])  # noise and cells of the histogram are relative to it
    nothing = GlossProfile(np.zeros(WIDTHS.size), WIDTHS, refractive_index, unit=unit)
    profile = nothing if start is None else replace(start, unit=unit)
    fits: list[RefinedNormals] = []
    for _ in range(ROUNDS if start is None else 1):
        profile = fit_strengths(profile, tiles, fits or [None] * len(tiles)) if start is None else profile
        fits = [refine_tile(tile, profile) for tile in tiles]
    first = profile
    for _ in range(ROUNDS):
        profile = step(tiles, fits, profile) if profile.colour is None else fit_strengths(profile, tiles, fits)
        fits = [refine_tile(tile, profile) for tile in tiles]
    nothing = replace(nothing, transmission=profile.transmission)
    without = [refine_tile(tile, nothing) for tile in tiles]
    gain = mean_cost(tiles, without) - mean_cost(tiles, fits)
    significant = bool(gain > WORTHWHILE)
    shown = profile if significant else replace(nothing, transmission=0.0)
    return SceneGloss(shown, profile, first, gain, significant, sum(tile.flags.size for tile in tiles))


def find_finishes(
    tiles: Sequence[GlossTile], gloss: GlossProfile
) -> Iterator[tuple[list[SceneGloss], np.ndarray, np.ndarray]]:
    """Divide the cells among two finishes, then three and so on, while each has FEWEST_CELLS and a gloss of its own.

    Parameters
    ----------
    tiles : of pixels (lights, 1, pixels, ...), with the numbers of their cells.
    gloss : of the whole scene.

    Yields
    ------
    (finishes, labels, clear): the gloss of each, its number for every cell (cells,), and which cells are clearly its
    own (cells,) bool: those whose cost under any other exceeds their own by the median of the finish or more.
    """
    nothing, metals = gloss.bare(), brightest_metals(tiles, gloss)
    few = [tile.only(slice(None, None, THIN)) for tile in tiles]
    cells, dielectric = 1 + max(int(tile.places.max()) for tile in tiles), replace(gloss, transmission=1.0)

    @cache  # profiles are told apart by identity
    def fits_of(profile: GlossProfile) -> list[RefinedNormals]:
        return [refine_tile(tile, profile) for tile in few]

    starts = [[dielectric, other] for other in (nothing, *metals)]
    while starts and len(starts[0]) <= MOST_FINISHES:
        tries = [_settle(few, start, cells, fits_of) for start in starts]
        if len(metals) > 1:  # that which fits best beside the gloss of the scene is tried beside more finishes
            metals = [min(tries[1:], key=lambda each: each[2].min(axis=0).mean())[0][1]]
        tries = [each for each in tries if np.bincount(each[1], minlength=len(each[0])).min() >= FEWEST_CELLS]
        if not tries:
            return
        profiles, labels, costs = min(tries, key=lambda each: each[2].min(axis=0).mean())
        least, second = np.sort(costs, axis=0)[:2]
        usual = np.array([np.median((second - least)[labels == k]) for k in range(len(profiles))])
        clear = second - least >= usual[labels]
        finishes = fit_glosses(tiles, labels, gloss.refractive_index, profiles)
        if sum(not finish.profile.beta.any() for finish in finishes) > 1:
            return  # what differs is not the gloss
        yield finishes, labels, clear
        starts = [
            [*profiles[:k], profile.wider(-1), profile.wider(1), *profiles[k + 1 :]]
            for k, profile in enumerate(profiles)
            if profile.beta.any() and profile.colour is None
        ]
        missing = [] if any(not profile.beta.any() for profile in profiles) else [nothing]
        if all(profile.colour is None for profile in profiles):
            missing += metals
        starts += [[*profiles, other] for other in missing]


def brightest_metals(tiles: Sequence[GlossTile], gloss: GlossProfile) -> list[GlossProfile]:
    """Return metals of the colour of the brightest light, with lobes of several widths, to start from.

    None where that light is about white, as gloss of a dielectric is.
    """
    samples = np.concatenate([tile.observations[tile.valid] for tile in tiles])
    count = max(1, int(BRIGHTEST * len(samples)))
    colour = samples[np.argpartition(samples.mean(axis=-1), -count)[-count:]].mean(axis=0, dtype=np.float64)
    if not 0 < colour.min() < COLOURED * colour.max():
        return []
    metal = replace(gloss, refractive_index=MIRROR, transmission=0.0, gamma=WIDTHS)
    metal = replace(metal, colour=METAL_LEVEL * gloss.unit / colour.mean() * colour)
    return [replace(metal, beta=lobe) for lobe in np.diag(np.log(2) / (4 * WIDTHS**2))[METAL_WIDTHS]]


def fit_glosses(
    tiles: Sequence[GlossTile],
    labels: np.ndarray,
    refractive_index: float,
    starts: Sequence[GlossProfile | None] | None = None,
) -> list[SceneGloss]:
    """Fit the gloss of each label of the cells (cells,) by itself; that of all where the tiles hold none of it."""
    parts = [[tile.only(labels[tile.places[0]] == k) for tile in tiles] for k in range(int(labels.max()) + 1)]
    parts = [[tile for tile in part if tile.flags.size] or list(tiles) for part in parts]
    starts = [None] * len(parts) if starts is None else starts
    fits = zip(parts, starts, strict=True)
    return [fit_scene_gloss(part, refractive_index=refractive_index, start=start) for part, start in fits]


def _settle(tiles, profiles, cells: int, fits_of) -> tuple[list[GlossProfile], np.ndarray, np.ndarray]:
    """Return profiles fitted to their cells, the labels of the cells, and all costs (profiles, cells), settled."""
    profiles, labels = list(profiles), np.zeros(cells, np.int64)
    for number in range(MOST_ROUNDS):
        fits = [fits_of(profile) for profile in profiles]
        costs = np.stack([cell_costs(tiles, each, cells) for each in fits])
        before, labels = labels, costs.argmin(axis=0)
        if number == MOST_ROUNDS - 1 or (number and np.array_equal(labels, before)):
            break
        for k, profile in enumerate(profiles):
            if profile.beta.any() and (labels == k).any():
                profiles[k] = fit_strengths(profile, tiles, fits[k], [labels[tile.places] == k for tile in tiles])
    return profiles, labels, costs


def cell_costs(tiles: Sequence[GlossTile], fits: Sequence[RefinedNormals], count: int) -> np.ndarray:
    """Return the mean robust cost a value of every cell (count,); 0 without a fitted pixel."""
    total, values = np.zeros(count), np.zeros(count)
    for tile, fit in zip(tiles, fits, strict=True):
        done = (fit.flags & (NO_ESTIMATE | NormalFlag.FALLBACK)) == 0
        total += np.bincount(tile.places[done], fit.cost[done], count)
        values += np.bincount(tile.places[done], tile.valid.sum(axis=0)[done], count) * tile.observations.shape[-1]
    return total / np.maximum(values, 1)


def fit_strengths(
    profile: GlossProfile,
    tiles: Sequence[GlossTile],
    fits: Sequence[RefinedNormals | None],
    where: Sequence[np.ndarray | bool] | None = None,
) -> GlossProfile:
    """Fit the lobes to specular samples, by the last round's fits or, for None, by the tiles' own fields.

    where : of each tile, (rows, columns) bool, pixels that count.
    """
    histogram = SpecularHistogram.empty(refractive_index=profile.refractive_index, value_unit=profile.unit)
    for tile, fit, here in zip(tiles, fits, where or [True] * len(tiles), strict=True):
        source = tile if fit is None else fit
        valid = tile.valid & ((tile.flags & NO_ESTIMATE) == 0) & here
        given = tile.observations, tile.directions, source.normals, source.reflectance, profile
        sigma = np.minimum(source.sigma, LARGEST_SIGMA) / np.sqrt(2)
        histogram = histogram.add_samples(*specular_samples(*given, valid=valid), sigma=sigma)
    return profile.with_strengths(fit_gloss(histogram, ladder=profile.gamma).beta)


def refine_tile(tile: GlossTile, profile: GlossProfile) -> RefinedNormals:
    """Fit one tile jointly."""
    return refine_normals(
        tile.observations,
        tile.directions,
        normals=tile.normals,
        gloss=profile,
        valid=tile.valid,
        flags=tile.flags,
        reflectance=tile.reflectance,
    )


def mean_cost(tiles, fits) -> float:
    """Average the robust cost a value over all tiles."""
    total, values = 0.0, 0
    for tile, fit in zip(tiles, fits, strict=True):
        done = (fit.flags & (NO_ESTIMATE | NormalFlag.FALLBACK)) == 0
        total += float(fit.cost[done].sum(dtype=np.float64))
        values += int(tile.valid[:, done].sum()) * tile.observations.shape[-1]
    return total / max(values, 1)
