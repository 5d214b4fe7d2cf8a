"""A synthetic training set: reflectances that paints of known pigments could have.

The project ships no measured reflectances. Pigments are drawn from a table of published absorption edges and bands
(`nishiki.colour.pigments`), mixed with each other, with white and black by Kubelka and Munk's law in a binder that may
have yellowed, laid thick or as a glaze over a white ground, and seen through the paint's own surface or without it.
Deterministic for a seed.
"""

from __future__ import annotations

import numpy as np

from nishiki.colour.pigments import draw_pigments
from nishiki.colour.sampling import WAVELENGTHS_NM, resample
from nishiki.errors import UserError

# How paints are made up. Chosen on one half of the makers of measured paints; the page of the stage names them and
# gives the errors on the other half (docs/stages/spectra.md).
PURE, TINTS = 0.1, 0.35  # shares of one pigment alone and of one with white; all others are mixtures
THIRD_PIGMENT, WHITE_IN_MIXTURES, BLACK = 0.6, 0.6, 0.8  # shares of the mixtures (black: also of the tints)
MINOR_AMOUNT = (0.01, 3.0)  # of the second and third pigment, the first being 1
WHITE_AMOUNT = (0.1, 30.0)
BLACK_ABSORPTION = (0.03, 3.0)
RUTILE = 0.8  # of the whites; the others (zinc, lead, chalk, anatase) absorb below 390 nm
GLAZES = 0.03
THROUGH_SURFACE = 0.6  # share with the inner reflections of a smooth surface


def synthetic_reflectances(count: int = 2000, *, seed: int = 20240) -> np.ndarray:
    """Reflectances of synthetic paints.

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
    _add_binder(draw, absorption, scattering)
    thick = reflectance_of_thick_layer(absorption, scattering)
    depth = draw.log_uniform(0.02, 3.0, count, 1)
    ground = draw.uniform(0.75, 0.95, count, 1) / (
        1.0 + np.exp(np.clip((draw.uniform(370.0, 402.0, count, 1) - WAVELENGTHS_NM) / 6.0, -50.0, 50.0))
    )
    glaze = draw.chance(GLAZES, count, 1)
    body = np.where(glaze, reflectance_of_layer(absorption, scattering, depth, ground), thick)
    internal, glare = draw.uniform(0.35, 0.6, count, 1), draw.uniform(0.0, 0.02, count, 1)
    seen = through_surface(body, external=0.04, internal=internal) + glare
    return np.clip(np.where(draw.chance(THROUGH_SURFACE, count, 1), seen, body), 1e-4, 1.0 - 1e-4)


def through_surface(
    body: np.ndarray,
    *,
    external: float | np.ndarray,
    internal: float | np.ndarray,
    transmission: np.ndarray | float = 1.0,
) -> np.ndarray:
    """Diffuse reflectance of paint seen through its surface or a varnish, without the gloss.

    `R = (1 - external) (1 - internal) t^2 body / (1 - internal t^2 body)`

    Parameters
    ----------
    body : (..., 61) reflectance below the surface.
    external : share of the incident light that the surface reflects outside (0.04 at index 1.5, near normal).
    internal : share of diffuse light that it reflects back inside (0.6 at index 1.5).
    transmission : t, (61,) or a number: of one way through the varnish, averaged over directions.

    Returns
    -------
    (..., 61). To train on spectra as they are seen through a varnish, divide by the same expression of a perfect white
    only where the white reference lies under the varnish as well.

    Source: Saunderson, J. Opt. Soc. Am. 32 (1942) 727-736, with absorption on the way in, out and at every inner turn.
    """
    passing = transmission**2 * body
    return (1.0 - external) * (1.0 - internal) * passing / (1.0 - internal * passing)


def reflectance_of_thick_layer(absorption: np.ndarray, scattering: np.ndarray) -> np.ndarray:
    """Kubelka and Munk's reflectance 1 + q - sqrt(q^2 + 2 q), q = K/S, of an opaque layer; without cancellation."""
    ratio = absorption / scattering
    return 1.0 / (1.0 + ratio + np.sqrt(ratio * ratio + 2.0 * ratio))


def reflectance_of_layer(
    absorption: np.ndarray, scattering: np.ndarray, depth: np.ndarray, ground: np.ndarray
) -> np.ndarray:
    """Reflectance (..., 61) of a layer of a depth over a ground (Kubelka 1948, eq. 24).

    absorption, scattering : (..., 61) per unit of depth, both > 0; depth : (..., 1); ground : (..., 61), reflectance.
    """
    a = 1.0 + absorption / scattering
    b = np.sqrt(a * a - 1.0)
    turns = b / np.tanh(np.clip(b * scattering * depth, 1e-9, 40.0))
    return (1.0 - ground * (a - turns)) / (a - ground + turns)


def measured_reflectances(wavelengths_nm: np.ndarray, columns: np.ndarray, *, name: str) -> np.ndarray:
    """(M, 61) training set from a user's table: wavelengths (W,) in nm, reflectances (W, M), one column a sample.

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
        """(count, *shape) between low and high."""
        order = np.argsort(self._stream.random((count, *shape)), axis=0)
        return low + (high - low) * (order + self._stream.random((count, *shape))) / count

    def log_uniform(self, low: float, high: float, *shape: int) -> np.ndarray:
        """Numbers whose logarithm is uniform."""
        return np.exp(self.uniform(np.log(low), np.log(high), *shape))

    def normal(self, *shape: int) -> np.ndarray:
        """Standard normal numbers (Box and Muller)."""
        radius = np.sqrt(-2.0 * np.log1p(-self.uniform(0.0, 1.0, *shape)))
        return radius * np.cos(2.0 * np.pi * self.uniform(0.0, 1.0, *shape))

    def log_normal(self, spread: float, *shape: int) -> np.ndarray:
        """Numbers with the median 1 whose logarithm has this standard deviation."""
        return np.exp(spread * self.normal(*shape))

    def chance(self, share: float, *shape: int) -> np.ndarray:
        """True for this share."""
        return self.uniform(0.0, 1.0, *shape) < share


def _mixtures(draw: Draw, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Absorption and scattering (count, 61) of pure pigments, tints and mixtures."""
    kind = draw.uniform(0.0, 1.0, count, 1)
    mixed, pure = kind > PURE + TINTS, kind < PURE
    second = mixed * draw.log_uniform(*MINOR_AMOUNT, count, 1)
    third = mixed * draw.log_uniform(*MINOR_AMOUNT, count, 1) * draw.chance(THIRD_PIGMENT, count, 1)
    white = ~pure & (~mixed | draw.chance(WHITE_IN_MIXTURES, count, 1))
    white = white * draw.log_uniform(*WHITE_AMOUNT, count, 1)
    absorption, scattering = (white * part for part in _whites(draw, count))
    for amount in (1.0, second, third):
        k, s = draw_pigments(draw, count)
        absorption, scattering = absorption + amount * k, scattering + amount * s
    black = ~pure & draw.chance(BLACK, count, 1)
    return absorption + black * draw.log_uniform(*BLACK_ABSORPTION, count, 1), scattering


def _whites(draw: Draw, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Absorption and scattering (count, 61) of white pigments: the band edge of rutile is at 3.05 eV (406 nm)."""
    rutile = draw.chance(RUTILE, count, 1)
    place = np.where(rutile, draw.uniform(392.0, 399.0, count, 1), draw.uniform(370.0, 385.0, count, 1))
    decay = draw.uniform(4.5, 6.5, count, 1)
    tail = np.exp(-np.maximum((WAVELENGTHS_NM - place) / decay, -1.0))
    absorption = tail + draw.log_uniform(2e-4, 3e-3, count, 1) + _yellow(draw, count, (2e-4, 3e-2))
    return absorption, (WAVELENGTHS_NM / 550.0) ** -draw.uniform(0.0, 0.6, count, 1)


def _add_binder(draw: Draw, absorption: np.ndarray, scattering: np.ndarray) -> None:
    """Absorption and scattering of oil, egg, gum or resin, in place: little of both, yellow with age."""
    count = len(absorption)
    absorption += _yellow(draw, count, (1e-3, 3e-2))
    scattering += draw.log_uniform(1e-3, 3e-2, count, 1)


def _yellow(draw: Draw, count: int, strength: tuple[float, float]) -> np.ndarray:
    """Absorption (count, 61) that falls exponentially from 400 nm on, over 25 to 70 nm, as that of dried oil does."""
    decay = draw.uniform(25.0, 70.0, count, 1)
    return draw.log_uniform(*strength, count, 1) * np.exp(-(WAVELENGTHS_NM - 400.0) / decay)
