"""The gloss of a scene from a sample of its pixels: profile and pixels in turn, and whether it is worth using.

Highlights bias the normals and the normals decide where highlights are. So: specular samples with the normals as they
stand -> profile (normals' errors undone) -> joint fit of the sample's pixels -> and again. Every round starts the
pixels from the same normals; only profile, normals and reflectances of the last round are handed to the next.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from nishiki.brdf.gloss_profile import LADDER, GlossProfile, SpecularHistogram, fit_gloss, specular_samples, unit_of
from nishiki.photometric import flags as bits
from nishiki.photometric.gloss import RefinedNormals, refine_normals

ROUNDS = 3
LARGEST_SIGMA = 0.1  # radians: where the normals are worse the blur is no longer a small one
FIRST_LOOK = 4000  # pixels of a thinner sample; of fewer than 1500 the profile can be far off
WORTHWHILE = 0.03  # gain of robust cost a value, from which gloss counts as shown
TRANSMISSIONS = (0.0, 0.5, 1.0)  # tried; the least of the parabola through their costs is taken
MEASURED = 0.01  # fall of the robust cost, relative, from which the lamps tell the transmission from a tilt


@dataclass(frozen=True)
class GlossTile:
    """Pixels under one set of directions, with the normals that the fit starts from.

    observations (lights, rows, columns, channels); valid (lights, rows, columns) bool; directions (lights, 3); normals
    (rows, columns, 3); flags, sigma (rows, columns); reflectance (rows, columns, channels).
    """

    observations: np.ndarray
    valid: np.ndarray
    directions: np.ndarray
    normals: np.ndarray
    flags: np.ndarray
    sigma: np.ndarray
    reflectance: np.ndarray


@dataclass(frozen=True)
class SceneGloss:
    """profile; gain: robust cost a value (light and channel) that the profile takes off the fit without gloss;
    significant: whether that is WORTHWHILE; pixels of the sample; costs: with and without the profile."""

    profile: GlossProfile
    gain: float
    significant: bool
    pixels: int
    costs: tuple[float, float]

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
    unit = radiance_unit(tiles)
    nothing = GlossProfile(np.zeros(LADDER.size), LADDER, refractive_index, unit=unit)
    profile, fits = nothing, [None] * len(tiles)
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
    costs = mean_cost(tiles, fits), mean_cost(tiles, without)
    gain = costs[1] - costs[0]
    significant = bool(gain > WORTHWHILE)
    if not significant:
        profile = replace(profile, transmission=0.0)
    return SceneGloss(profile, gain, significant, sum(tile.flags.size for tile in tiles), costs)


def measure_transmission(tiles: Sequence[GlossTile], profile: GlossProfile, **settings) -> float:
    """Share of the surface's loss that the body suffers, 0 to 1, by the robust cost of the fit on a thinner sample.

    Bodies without a smooth surface, or with a rough one, lose less light than the exact losses of a dielectric say; the
    joint fit with those losses then tilts their normals by degrees. Lamps at several incidences show it. Where the cost
    does not fall by that part, MEASURED, below that of the profile's own transmission (a ring of lamps at one
    incidence), that one is kept.
    """
    few = thinned(tiles) or tiles
    costs = np.array(
        [mean_cost(few, [refined(t, replace(profile, transmission=x), **settings) for t in few]) for x in TRANSMISSIONS]
    )
    curve = np.polynomial.Polynomial.fit(TRANSMISSIONS, costs, 2, domain=(0, 1), window=(0, 1))
    bend = curve.coef[2]
    best = TRANSMISSIONS[int(costs.argmin())] if bend <= 0 else float(np.clip(-curve.coef[1] / (2 * bend), 0, 1))
    return best if curve(best) < (1 - MEASURED) * curve(profile.transmission) else profile.transmission


def thinned(tiles: list[GlossTile], pixels: int = FIRST_LOOK) -> list[GlossTile] | None:
    """About so many pixels of the tiles (lights, 1, pixels, ...), evenly; None where that is most of them."""
    every = sum(tile.flags.size for tile in tiles) // pixels
    if every < 2:
        return None
    out, seen = [], 0
    for tile in tiles:
        chosen = np.arange((-seen) % every, tile.flags.shape[1], every)
        seen += tile.flags.shape[1]
        if chosen.size:
            of_lights = {name: getattr(tile, name)[:, :, chosen] for name in ("observations", "valid")}
            of_pixels = {name: getattr(tile, name)[:, chosen] for name in ("normals", "flags", "sigma", "reflectance")}
            out.append(replace(tile, **of_lights, **of_pixels))
    return out


def radiance_unit(tiles: Sequence[GlossTile]) -> float:
    """`unit_of` the tiles' reflectances. Noise and the cells of the histogram are relative to it."""
    return unit_of([tile.reflectance for tile in tiles])


def add_tile(histogram, tile: GlossTile, fit: RefinedNormals | None, profile: GlossProfile) -> SpecularHistogram:
    """The histogram with a tile's specular samples, by the last round's fit or by what the tile came with."""
    source = tile if fit is None else fit
    valid = tile.valid & ((tile.flags & bits.NO_ESTIMATE) == 0)
    samples = specular_samples(
        tile.observations, tile.directions, source.normals, source.reflectance, profile, valid=valid
    )
    sigma = np.minimum(source.sigma, LARGEST_SIGMA) / np.sqrt(2)
    return histogram.add_samples(*samples, sigma=sigma)


def refined(tile: GlossTile, profile: GlossProfile, **settings) -> RefinedNormals:
    """The joint fit of one tile."""
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
