"""The finishes of a scene from a sample of its pixels: one gloss, or several and the places that have them.

Highlights bias the normals and the normals decide where highlights are. So: specular samples with the normals as they
stand -> profile (normals' errors undone) -> joint fit of the sample's pixels -> and again. Every round starts the
pixels from the same normals; only profile, normals and reflectances of the last round are handed to the next.

A painting may be varnished in part. Cells of the picture are then given to the profile under which the joint fit costs
least, and each profile is fitted again to its cells, like the means and members of k-means (S. P. Lloyd, Least squares
quantization in PCM, IEEE Trans. Inf. Theory 28, 1982). Two finishes start from the gloss of the whole scene and from
no gloss; a further one splits a gloss into a narrower and a wider one (Y. Linde, A. Buzo and R. M. Gray, An algorithm
for vector quantizer design, IEEE Trans. Commun. 28, 1980).
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from nishiki.brdf.gloss_profile import LADDER, GlossProfile, SpecularHistogram, fit_gloss, specular_samples, unit_of
from nishiki.photometric import flags as bits
from nishiki.photometric.gloss import RefinedNormals, refine_normals

ROUNDS = 3
LARGEST_SIGMA = 0.1  # radians: where the normals are worse the blur is no longer a small one
FIRST_LOOK = 4000  # pixels of a thinner sample
WORTHWHILE = 0.03  # gain of robust cost a value, from which gloss counts as shown
TRANSMISSIONS = (0.0, 0.5, 1.0)  # tried; the least of the parabola through their costs is taken
SIDE = 15  # pixels: of a cell of the picture that has one finish
FEWEST_CELLS = 4  # of a finish
MOST_FINISHES = 4
MEASURED = 0.01  # fall of the robust cost, relative, from which the lamps tell the transmission from a tilt


@dataclass(frozen=True)
class GlossTile:
    """Pixels under one set of directions, with the normals that the fit starts from.

    observations (lights, rows, columns, channels); valid (lights, rows, columns) bool; directions (lights, 3); normals
    (rows, columns, 3); flags, sigma (rows, columns); reflectance (rows, columns, channels); cells (rows, columns) int:
    number of the cell of the picture, where finishes are told apart.
    """

    observations: np.ndarray
    valid: np.ndarray
    directions: np.ndarray
    normals: np.ndarray
    flags: np.ndarray
    sigma: np.ndarray
    reflectance: np.ndarray
    cells: np.ndarray | None = None

    def only(self, chosen: np.ndarray) -> "GlossTile":
        """Return the same of some pixels of a tile (lights, 1, pixels, ...): numbers, or bool (pixels,)."""
        of_lights = {name: getattr(self, name)[:, :, chosen] for name in ("observations", "valid")}
        names = ("normals", "flags", "sigma", "reflectance", "cells")
        of_pixels = {name: value[:, chosen] for name in names if (value := getattr(self, name)) is not None}
        return replace(self, **of_lights, **of_pixels)


@dataclass(frozen=True)
class SceneGloss:
    """The gloss of a scene.

    profile, without gloss where none is significant; found: whether or not; gain: robust cost a value (light and
    channel) that the profile takes off the fit without gloss; significant: whether that is WORTHWHILE; pixels of the
    sample.
    """

    profile: GlossProfile
    found: GlossProfile
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
    tiles: Sequence[GlossTile], *, refractive_index: float = 1.45, rounds: int = ROUNDS, **settings
) -> SceneGloss:
    """Profile of the scene from a sample of its pixels; settings: of `refine_normals`.

    The body is taken to lie below a dielectric surface (transmission 1) while the gloss is sought; the last round uses
    the transmission that the samples show, if they show any (`measure_transmission`). Where no gloss is significant
    there is no surface to show it, and the profile returned has no transmission loss either.
    """
    unit = unit_of([tile.reflectance for tile in tiles])  # noise and cells of the histogram are relative to it
    nothing = GlossProfile(np.zeros(LADDER.size), LADDER, refractive_index, unit=unit)
    profile: GlossProfile = nothing
    fits: Sequence[RefinedNormals | None] = [None] * len(tiles)
    for number in range(rounds):
        if number > 0 and number == rounds - 1:
            transmission = measure_transmission(tiles, profile, **settings)
            if transmission != profile.transmission:
                profile, nothing = (replace(p, transmission=transmission) for p in (profile, nothing))
                fits = [refined(tile, profile, **settings) for tile in tiles]
        histogram = SpecularHistogram.empty(refractive_index=refractive_index, value_unit=unit)
        for tile, fit in zip(tiles, fits, strict=True):
            histogram = add_tile(histogram, tile, fit, profile)
        profile = fit_gloss(histogram, transmission=profile.transmission)
        fits = [refined(tile, profile, **settings) for tile in tiles]
    without = [refined(tile, nothing, **settings) for tile in tiles]
    gain = mean_cost(tiles, without) - mean_cost(tiles, fits)
    significant = bool(gain > WORTHWHILE)
    shown = profile if significant else replace(nothing, transmission=0.0)
    return SceneGloss(shown, profile, gain, significant, sum(tile.flags.size for tile in tiles))


def find_finishes(
    tiles: Sequence[GlossTile], gloss: GlossProfile, **settings
) -> Iterator[tuple[list[SceneGloss], np.ndarray, np.ndarray]]:
    """Divide the cells among two finishes, then three and so on, while each has FEWEST_CELLS and a gloss of its own.

    Parameters
    ----------
    tiles : of pixels (lights, 1, pixels, ...), with the numbers of their cells.
    gloss : of the whole scene.
    settings : of `refine_normals`.

    Yields
    ------
    (finishes, labels, clear): the gloss of each, its number for every cell (cells,), and which cells are clearly its
    own (cells,) bool: those whose cost under any other exceeds their own by the median of the finish or more.
    """
    nothing = replace(gloss, beta=np.zeros(gloss.beta.size), transmission=0.0)
    starts = [[replace(gloss, transmission=1.0), nothing]]
    while starts and len(starts[0]) <= MOST_FINISHES:
        tries = [_settle(tiles, start, **settings) for start in starts]
        tries = [each for each in tries if np.bincount(each[1], minlength=len(each[0])).min() >= FEWEST_CELLS]
        if not tries:
            return
        profiles, labels, costs = min(tries, key=lambda each: each[2].min(axis=0).mean())
        least, second = np.sort(costs, axis=0)[:2]
        usual = np.array([np.median((second - least)[labels == k]) for k in range(len(profiles))])
        clear = second - least >= usual[labels]
        finishes = fit_glosses(tiles, labels, gloss.refractive_index)
        if sum(not finish.profile.beta.any() for finish in finishes) > 1:
            return  # what differs is not the gloss
        yield finishes, labels, clear
        starts = [
            [*profiles[:k], profile.wider(-1), profile.wider(1), *profiles[k + 1 :]]
            for k, profile in enumerate(profiles)
            if profile.beta.any()
        ]


def fit_glosses(tiles: Sequence[GlossTile], labels: np.ndarray, refractive_index: float) -> list[SceneGloss]:
    """Fit the gloss of each label of the cells (cells,) by itself; that of all where the tiles hold none of it."""
    parts = [[tile.only(labels[tile.cells[0]] == k) for tile in tiles] for k in range(int(labels.max()) + 1)]
    parts = [[tile for tile in part if tile.flags.size] or list(tiles) for part in parts]
    return [fit_scene_gloss(part, refractive_index=refractive_index) for part in parts]


def _settle(tiles, profiles, **settings) -> tuple[list[GlossProfile], np.ndarray, np.ndarray]:
    """Return profiles fitted to their cells, the labels of the cells, and all costs (profiles, cells), after ROUNDS."""
    profiles = list(profiles)
    for number in range(ROUNDS + 1):
        fits = [[refined(tile, profile, **settings) for tile in tiles] for profile in profiles]
        costs = np.stack([cell_costs(tiles, each) for each in fits])
        labels = costs.argmin(axis=0)
        if number == ROUNDS:
            break
        for k, profile in enumerate(profiles):
            histogram = SpecularHistogram.empty(refractive_index=profile.refractive_index, value_unit=profile.unit)
            for tile, fit in zip(tiles, fits[k], strict=True):
                histogram = add_tile(histogram, tile, fit, profile, labels[tile.cells] == k)
            if profile.beta.any() and histogram.rows.any():
                profiles[k] = fit_gloss(histogram, transmission=profile.transmission)
    return profiles, labels, costs


def cell_costs(tiles: Sequence[GlossTile], fits: Sequence[RefinedNormals]) -> np.ndarray:
    """Return the mean robust cost a value of every cell (cells,); 0 without a fitted pixel."""
    count = 1 + max(int(tile.cells.max()) for tile in tiles)
    total, values = np.zeros(count), np.zeros(count)
    for tile, fit in zip(tiles, fits, strict=True):
        done = (fit.flags & (bits.NO_ESTIMATE | bits.FALLBACK)) == 0
        total += np.bincount(tile.cells[done], fit.cost[done], count)
        values += np.bincount(tile.cells[done], tile.valid.sum(axis=0)[done], count) * tile.observations.shape[-1]
    return total / np.maximum(values, 1)


def measure_transmission(tiles: Sequence[GlossTile], profile: GlossProfile, **settings) -> float:
    """Share of the surface's loss that the body suffers, 0 to 1, by the robust cost of the fit on a thinner sample.

    Bodies without a smooth surface, or with a rough one, lose less light than the exact losses of a dielectric say; the
    joint fit with those losses then tilts their normals by degrees. Lamps at several incidences show it. Where the cost
    does not fall by that part, MEASURED, below that of the profile's own transmission (a ring of lamps at one
    incidence), that one is kept.
    """
    every = max(sum(tile.flags.size for tile in tiles) // FIRST_LOOK, 1)
    few = [tile.only(np.s_[::every]) for tile in tiles]
    costs = np.array(
        [mean_cost(few, [refined(t, replace(profile, transmission=x), **settings) for t in few]) for x in TRANSMISSIONS]
    )
    curve = np.polynomial.Polynomial.fit(TRANSMISSIONS, costs, 2, domain=(0, 1), window=(0, 1))
    bend = curve.coef[2]
    best = TRANSMISSIONS[int(costs.argmin())] if bend <= 0 else float(np.clip(-curve.coef[1] / (2 * bend), 0, 1))
    return best if curve(best) < (1 - MEASURED) * curve(profile.transmission) else profile.transmission


def add_tile(
    histogram, tile: GlossTile, fit: RefinedNormals | None, profile: GlossProfile, where: np.ndarray | bool = True
) -> SpecularHistogram:
    """Add a tile's specular samples to the histogram, by the last round's fit or by what the tile came with.

    where: (rows, columns) bool, pixels that count.
    """
    source = tile if fit is None else fit
    valid = tile.valid & ((tile.flags & bits.NO_ESTIMATE) == 0) & where
    samples = specular_samples(
        tile.observations, tile.directions, source.normals, source.reflectance, profile, valid=valid
    )
    sigma = np.minimum(source.sigma, LARGEST_SIGMA) / np.sqrt(2)
    return histogram.add_samples(*samples, sigma=sigma)


def refined(tile: GlossTile, profile: GlossProfile, **settings) -> RefinedNormals:
    """Fit one tile jointly."""
    return refine_normals(
        tile.observations,
        tile.directions,
        normals=tile.normals,
        gloss=profile,
        valid=tile.valid,
        flags=tile.flags,
        reflectance=tile.reflectance,
        **settings,
    )


def mean_cost(tiles, fits) -> float:
    """Robust cost a value over all tiles."""
    total, values = 0.0, 0
    for tile, fit in zip(tiles, fits, strict=True):
        done = (fit.flags & (bits.NO_ESTIMATE | bits.FALLBACK)) == 0
        total += float(fit.cost[done].sum(dtype=np.float64))
        values += int(tile.valid[:, done].sum()) * tile.observations.shape[-1]
    return total / max(values, 1)
