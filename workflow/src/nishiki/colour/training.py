"""Synthesise reflectances of paints of known pigments as a training set.

Every curve is built from general facts of its pigment's spectrum: the wavelength of an absorption edge, the positions
and widths of absorption bands, how strongly it absorbs and scatters beside a white. No measured curve is stored. The
wavelengths are those by which pigments are recognised in reflectance spectra; see Johnston-Feller, Color Science in
the Examination of Museum Objects (Getty, 2001); Artists' Pigments, volumes 1-4 (National Gallery of Art, 1986-2007);
Cosentino, e-conservation Journal 2 (2014) 53-65; cobalt: Bacci and Picollo, Studies in Conservation 41 (1996) 136-144;
iron oxides: Strens and Wood, Mineralogical Magazine 43 (1979) 347-354; madder and cochineal: Fonseca et al., Heritage
Science 7 (2019) 92. They are rounded, strengths are orders of magnitude, and every paint that is drawn
varies all of them.

The project ships no measured reflectances. Pigments are drawn from a table of published absorption edges and bands
(`nishiki.colour.training`), mixed with each other, with white and black by Kubelka and Munk's law in a binder that may
have yellowed, laid thick or as a glaze over a white ground, and seen through the paint's own surface or without it.
Deterministic for a seed.
"""

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from nishiki.colour.sampling import BANDS, WAVELENGTHS_NM, resample
from nishiki.errors import UserError

EDGE_RATIO = 0.25  # K/S at which an edge is placed: reflectance 0.5 of a thick layer
# Spread of a paint's parameters about those of the table: makers, particle sizes and recipes differ. Standard
# deviations of the natural logarithm, of band centres in nm. They are wider than among makers of one paint, so that
# errors of the table are covered; chosen on one half of the makers of measured paints (docs/notes/stages/spectra.md).
STRENGTH_SPREAD, SCATTERING_SPREAD, FLOOR_SPREAD = 0.9, 0.9, 1.2
WIDTH_SPREAD, HEIGHT_SPREAD, CENTRE_SPREAD_NM = 0.15, 0.3, 5.0


@dataclass(frozen=True)
class Pigment:
    """One pigment or group of pigments; absorption K and scattering S relative to the scattering of a white pigment."""

    name: str
    share: float  # how often it is drawn, relative to the others
    strength: float  # largest K
    scattering: float  # S at 550 nm; opaque pigments have 0.2 or more, transparent ones less
    slope: float  # S falls as wavelength to this power
    floor: float  # K/S where no edge or band absorbs
    # (least and largest wavelength, nm, at which the reflectance of a thick layer of the pure pigment rises through
    # one half; decay of K beyond it, nm; height relative to the strength)
    edges: tuple[tuple[float, float, float, float], ...]
    # (centre, nm; standard deviation, nm; height relative to the strength)
    bands: tuple[tuple[float, float, float], ...]


FILE = Path(__file__).with_name("pigments.json")
PIGMENTS = tuple(Pigment(*row) for kind in json.loads(FILE.read_text(encoding="utf-8")).values() for row in kind)
"""Pigments by kind; the rows of the file are the fields of `Pigment` in their order."""


def draw_pigments(draw, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Draw absorption and scattering (count, 61), one pigment a row, by `draw` (`nishiki.colour.training.Draw`)."""
    share = np.cumsum([pigment.share for pigment in PIGMENTS])
    picked = np.searchsorted(share[:-1] / share[-1], draw.uniform(0.0, 1.0, count), side="right")
    edges, bands = _pad([p.edges for p in PIGMENTS], 4)[picked], _pad([p.bands for p in PIGMENTS], 3)[picked]
    table = np.array([(p.strength, p.scattering, p.slope, p.floor) for p in PIGMENTS])
    strength, scattering, slope, floor = table[picked].T[..., None]
    strength = strength * draw.log_normal(STRENGTH_SPREAD, count, 1)
    scattering = scattering * draw.log_normal(SCATTERING_SPREAD, count, 1)
    absorption = floor * draw.log_normal(FLOOR_SPREAD, count, 1) * scattering * np.ones(BANDS)
    for low, high, decay, height in edges.transpose(1, 2, 0)[..., None]:
        place = low + (high - low) * draw.uniform(0.0, 1.0, count, 1)
        absorption += edge(place, decay * draw.log_normal(WIDTH_SPREAD, count, 1), height * strength, scattering)
    for centre, width, height in bands.transpose(1, 2, 0)[..., None]:
        place = centre + CENTRE_SPREAD_NM * draw.normal(count, 1)
        spread = width * draw.log_normal(WIDTH_SPREAD, count, 1)
        peak = height * strength * draw.log_normal(HEIGHT_SPREAD, count, 1)
        absorption += peak * np.exp(-0.5 * ((WAVELENGTHS_NM - place) / spread) ** 2)
    return absorption, scattering * (WAVELENGTHS_NM / 550.0) ** -slope


def edge(place: np.ndarray, decay: np.ndarray, strength: np.ndarray, scattering: np.ndarray) -> np.ndarray:
    """Model K (..., 61) of an absorption edge: constant below, exponential beyond (Urbach, Phys. Rev. 92, 1953, 1324).

    place, decay : nm; K/S is `EDGE_RATIO` at `place`. strength : K below the edge, scattering : S; all (..., 1). Of a
    pigment whose strength is below EDGE_RATIO of its scattering the edge lies beyond `place` by up to 4.6 decays.
    """
    ahead = decay * np.log(np.maximum(strength / (EDGE_RATIO * scattering) - 1.0, 1e-2))
    return strength / (1.0 + np.exp(np.clip((WAVELENGTHS_NM - (place - ahead)) / decay, -50.0, 50.0)))


def _pad(rows: list[tuple], columns: int) -> np.ndarray:
    """Pad rows to (pigments, most features, columns) with features of no height at the end of shorter rows."""
    table = np.ones((len(rows), max(len(row) for row in rows), columns))
    table[:, :, -1] = 0.0
    for row, features in zip(table, rows, strict=True):
        row[: len(features)] = np.array(features).reshape(-1, columns)
    return table


# How paints are made up. Chosen on one half of the makers of measured paints; the page of the stage names them and
# gives the errors on the other half (docs/notes/stages/spectra.md).
PURE, TINTS = 0.1, 0.35  # shares of one pigment alone and of one with white; all others are mixtures
THIRD_PIGMENT, WHITE_IN_MIXTURES, BLACK = 0.6, 0.6, 0.8  # shares of the mixtures (black: also of the tints)
MINOR_AMOUNT = (0.01, 3.0)  # of the second and third pigment, the first being 1
WHITE_AMOUNT = (0.1, 30.0)
BLACK_ABSORPTION = (0.03, 3.0)
RUTILE = 0.8  # of the whites; the others (zinc, lead, chalk, anatase) absorb below 390 nm
GLAZES = 0.03  # share of the training spectra with a glaze
THROUGH_SURFACE = 0.6  # share with the inner reflections of a smooth surface


def synthetic_reflectances(count: int = 2000, *, seed: int = 20240) -> np.ndarray:
    """Generate reflectances of synthetic paints.

    Parameters
    ----------
    count : int, optional
        Number of spectra, at least 10.
    seed : int, optional
        The same set for the same seed on every machine (to rounding).

    Returns
    -------
    (count, 61) float64 ndarray
        Reflectances above 0 and below 1, over 400 to 700 nm in steps of 5 nm.

    Raises
    ------
    nishiki.errors.UserError
        For fewer than 10.

    References
    ----------
    P. Kubelka and F. Munk (1931), Ein Beitrag zur Optik der Farbanstriche.
    P. Kubelka (1948), New contributions to the optics of intensely light-scattering materials, eq. 24 (glazes).
    J. L. Saunderson (1942), Calculation of the color of pigmented plastics (the paint's surface).

    Examples
    --------
    >>> import nishiki
    >>> paints = nishiki.synthetic_reflectances(100)
    >>> paints.shape
    (100, 61)
    >>> bool((paints > 0).all() and (paints < 1).all())
    True
    """
    if count < 10:
        raise UserError(f"synthetic training set: expected at least 10 spectra, found {count}; ask for more")
    draw = Draw(seed)
    absorption, scattering = _mixtures(draw, count)
    absorption += _yellow(draw, count, (1e-3, 3e-2))  # the binder: oil, egg, gum or resin, yellow with age
    scattering += draw.log_uniform(1e-3, 3e-2, count, 1)
    thick = reflectance_of_layer(absorption, scattering)
    depth = draw.log_uniform(0.02, 3.0, count, 1)
    ground = draw.uniform(0.75, 0.95, count, 1) / (
        1.0 + np.exp(np.clip((draw.uniform(370.0, 402.0, count, 1) - WAVELENGTHS_NM) / 6.0, -50.0, 50.0))
    )
    glaze = draw.chance(GLAZES, count, 1)
    body = np.where(glaze, reflectance_of_layer(absorption, scattering, depth, ground), thick)
    internal, glare = draw.uniform(0.35, 0.6, count, 1), draw.uniform(0.0, 0.02, count, 1)
    seen = through_surface(body, external=0.04, internal=internal) + glare
    return np.clip(np.where(draw.chance(THROUGH_SURFACE, count, 1), seen, body), 1e-4, 1.0 - 1e-4)


def through_surface(body: np.ndarray, *, external: float, internal: float | np.ndarray) -> np.ndarray:
    """Compute the diffuse reflectance of paint seen through its surface, without the gloss.

    `R = (1 - external) (1 - internal) body / (1 - internal body)`

    Parameters
    ----------
    body : (..., 61) reflectance below the surface.
    external : share of the incident light that the surface reflects outside (0.04 at index 1.5, near normal).
    internal : share of diffuse light that it reflects back inside (0.6 at index 1.5).

    Source: Saunderson, J. Opt. Soc. Am. 32 (1942) 727-736.
    """
    return (1.0 - external) * (1.0 - internal) * body / (1.0 - internal * body)


def reflectance_of_layer(
    absorption: np.ndarray, scattering: np.ndarray, depth: np.ndarray | float = np.inf, ground: np.ndarray | float = 0.0
) -> np.ndarray:
    """Compute the reflectance (..., 61) of a layer of a depth over a ground (Kubelka 1948, eq. 24); opaque by default.

    absorption, scattering : (..., 61) per unit of depth, both > 0; depth : (..., 1); ground : (..., 61), reflectance.
    """
    ratio = absorption / scattering
    a, b = 1.0 + ratio, np.sqrt(ratio * ratio + 2.0 * ratio)
    turns = b / np.tanh(np.clip(b * scattering * depth, 1e-9, 40.0))
    return (1.0 - ground * (a - turns)) / (a - ground + turns)


def measured_reflectances(wavelengths_nm: np.ndarray, columns: np.ndarray, *, name: str) -> np.ndarray:
    """Make a training set (M, 61) of a user's table: wavelengths (W,) in nm, reflectances (W, M), one column a sample.

    Raises UserError where the range does not cover 400-700 nm, or values leave [-0.02, 1.2]: percent instead of
    fractions is the usual mistake; fluorescence is not reflectance.
    """
    values = np.asarray(columns, dtype=float)
    if values.ndim == 1:
        values = values[:, None]
    spectra = resample(wavelengths_nm, values.T, name=name)
    if spectra.min() < -0.02 or spectra.max() > 1.2:
        raise UserError(
            f"{name}: expected reflectances between 0 and 1, found {spectra.min():g} to {spectra.max():g}; "
            "divide percent by 100, and leave fluorescent samples out"
        )
    return spectra


class Draw:
    """Random numbers from the uniform stream of PCG64 alone, whose values numpy keeps from version to version.

    Along the first axis the numbers are stratified: one in each of `count` equal parts, in random order (McKay, Beckman
    and Conover, Technometrics 21 (1979) 239-245). A set then differs less from the next seed's.
    """

    def __init__(self, seed: int):
        self._stream = np.random.Generator(np.random.PCG64(seed))

    def uniform(self, low, high, count: int, *shape: int) -> np.ndarray:
        """Draw (count, *shape) numbers between low and high."""
        order = np.argsort(self._stream.random((count, *shape)), axis=0)
        return low + (high - low) * (order + self._stream.random((count, *shape))) / count

    def log_uniform(self, low: float, high: float, *shape: int) -> np.ndarray:
        """Draw numbers whose logarithm is uniform."""
        return np.exp(self.uniform(np.log(low), np.log(high), *shape))

    def normal(self, *shape: int) -> np.ndarray:
        """Draw standard normal numbers (Box and Muller)."""
        radius = np.sqrt(-2.0 * np.log1p(-self.uniform(0.0, 1.0, *shape)))
        return radius * np.cos(2.0 * np.pi * self.uniform(0.0, 1.0, *shape))

    def log_normal(self, spread: float, *shape: int) -> np.ndarray:
        """Draw numbers with the median 1 whose logarithm has this standard deviation."""
        return np.exp(spread * self.normal(*shape))

    def chance(self, share: float, *shape: int) -> np.ndarray:
        """Draw booleans that are True with this share."""
        return self.uniform(0.0, 1.0, *shape) < share


def _mixtures(draw: Draw, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Draw absorption and scattering (count, 61) of pure pigments, tints and mixtures."""
    kind = draw.uniform(0.0, 1.0, count, 1)
    mixed, pure = kind > PURE + TINTS, kind < PURE
    second = mixed * draw.log_uniform(*MINOR_AMOUNT, count, 1)
    third = mixed * draw.log_uniform(*MINOR_AMOUNT, count, 1) * draw.chance(THIRD_PIGMENT, count, 1)
    white = ~pure & (~mixed | draw.chance(WHITE_IN_MIXTURES, count, 1))
    white = white * draw.log_uniform(*WHITE_AMOUNT, count, 1)
    # white pigments: the band edge of rutile is at 3.05 eV (406 nm)
    rutile = draw.chance(RUTILE, count, 1)
    place = np.where(rutile, draw.uniform(392.0, 399.0, count, 1), draw.uniform(370.0, 385.0, count, 1))
    decay = draw.uniform(4.5, 6.5, count, 1)
    tail = np.exp(-np.maximum((WAVELENGTHS_NM - place) / decay, -1.0))
    absorption = white * (tail + draw.log_uniform(2e-4, 3e-3, count, 1) + _yellow(draw, count, (2e-4, 3e-2)))
    scattering = white * (WAVELENGTHS_NM / 550.0) ** -draw.uniform(0.0, 0.6, count, 1)
    for amount in (1.0, second, third):
        k, s = draw_pigments(draw, count)
        absorption, scattering = absorption + amount * k, scattering + amount * s
    black = ~pure & draw.chance(BLACK, count, 1)
    return absorption + black * draw.log_uniform(*BLACK_ABSORPTION, count, 1), scattering


def _yellow(draw: Draw, count: int, strength: tuple[float, float]) -> np.ndarray:
    """Draw absorption (count, 61) that falls exponentially from 400 nm on, over 25 to 70 nm, like that of dried oil."""
    decay = draw.uniform(25.0, 70.0, count, 1)
    return draw.log_uniform(*strength, count, 1) * np.exp(-(WAVELENGTHS_NM - 400.0) / decay)
