"""A synthetic training set: reflectances that pigments, dyes and mixtures of them could have.

The project ships no measured reflectances. This generator draws materials from simple optics instead: absorption edges
(yellow to red pigments), absorption bands (blues, greens, violets), scattering whites with their edge in the violet,
black, mixed by Kubelka and Munk's law, with or without the inner reflections of a smooth binder; dyes and glazes that
filter the light on a white ground; and smooth random spectra for what these leave out. Deterministic for a seed.
"""

from __future__ import annotations

import numpy as np

from nishiki.errors import UserError
from nishiki.spectra.sampling import BANDS, WAVELENGTHS_NM, resample

# Shares of the set: opaque mixtures, filtering layers, smooth random spectra.
SHARES = (0.8, 0.1, 0.1)


def synthetic_reflectances(count: int = 2000, *, seed: int = 20240) -> np.ndarray:
    """(count, 61) reflectances in (0, 1), count >= 10, the same for the same seed on every machine (to rounding).

    80 % opaque paint mixtures by Kubelka and Munk (Z. tech. Phys. 12 (1931) 593-601), half of them with Saunderson's
    correction (J. Opt. Soc. Am. 32 (1942) 727-736), 10 % absorbing layers over white (Beer and Lambert), 10 % smooth
    random spectra (logistic of a band-limited Gaussian process).
    """
    if count < 10:
        raise UserError(f"synthetic training set: expected at least 10 spectra, found {count}; ask for more")
    draw = _Draw(seed)
    opaque, layers = round(SHARES[0] * count), round(SHARES[1] * count)
    parts = [_paint_mixtures(draw, opaque), _filter_layers(draw, layers), _smooth_random(draw, count - opaque - layers)]
    return np.clip(np.concatenate(parts), 1e-4, 1.0 - 1e-4)


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


class _Draw:
    """Random numbers from the uniform stream of PCG64 alone, whose values numpy keeps from version to version."""

    def __init__(self, seed: int):
        self._stream = np.random.Generator(np.random.PCG64(seed))

    def uniform(self, low, high, *shape: int) -> np.ndarray:
        return low + (high - low) * self._stream.random(shape)

    def log_uniform(self, low: float, high: float, *shape: int) -> np.ndarray:
        return np.exp(self.uniform(np.log(low), np.log(high), *shape))

    def normal(self, *shape: int) -> np.ndarray:
        radius = np.sqrt(-2.0 * np.log1p(-self._stream.random(shape)))
        return radius * np.cos(2.0 * np.pi * self._stream.random(shape))


# Families of pigments: share, then edge or band positions, widths in nm and rests (absorption beside the main feature).
_FAMILIES = {
    "edge": 0.33,  # yellow, orange, red: semiconductors and organics that pass all light beyond an edge
    "earth": 0.15,  # ochre, sienna, umber: a wide edge on a grey rest
    "blue": 0.20,  # one broad band in the orange, the far red coming back
    "green": 0.13,  # a band in the red and one in the violet
    "purple": 0.12,  # magenta to violet: a band in the green
    "other": 0.07,  # one to three bands anywhere
}


def _edge(draw: _Draw, count: int, position: tuple, width: tuple, rest: tuple) -> np.ndarray:
    """Absorption (count, 61): 1 below an edge, a rest above it."""
    place, slope = draw.uniform(*position, count, 1), draw.log_uniform(*width, count, 1)
    floor = draw.log_uniform(*rest, count, 1)
    return floor + (1.0 - floor) / (1.0 + np.exp((WAVELENGTHS_NM - place) / slope))


def _band(draw: _Draw, count: int, position: tuple, width: tuple, rest: tuple) -> np.ndarray:
    """Absorption (count, 61): a Gaussian band on a rest."""
    place, spread = draw.uniform(*position, count, 1), draw.log_uniform(*width, count, 1)
    return draw.log_uniform(*rest, count, 1) + np.exp(-0.5 * ((WAVELENGTHS_NM - place) / spread) ** 2)


def _bands(draw: _Draw, count: int, terms: int = 3) -> np.ndarray:
    """Absorption (count, 61) of one to three Gaussian bands anywhere on a small rest."""
    centre = draw.uniform(380.0, 680.0, count, terms, 1)
    width = draw.log_uniform(30.0, 100.0, count, terms, 1)
    height = draw.log_uniform(0.05, 1.0, count, terms, 1)
    height[:, 1:] *= draw.uniform(0.0, 1.0, count, terms - 1, 1) < 0.4
    total = np.sum(height * np.exp(-0.5 * ((WAVELENGTHS_NM - centre) / width) ** 2), axis=1)
    return draw.log_uniform(3e-3, 0.15, count, 1) + total


def _pigments(draw: _Draw, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Absorption and scattering (count, 61) of chromatic pigments of the families above; scatter falls to the red."""
    small, grey = (3e-3, 0.05), (0.03, 0.3)
    choices = [
        _edge(draw, count, (470.0, 610.0), (8.0, 22.0), small),
        _edge(draw, count, (530.0, 600.0), (22.0, 45.0), grey),
        _band(draw, count, (580.0, 640.0), (45.0, 75.0), small),
        _band(draw, count, (620.0, 680.0), (35.0, 60.0), small)
        + draw.uniform(0.3, 1.2, count, 1) * _band(draw, count, (390.0, 450.0), (25.0, 50.0), small),
        _band(draw, count, (510.0, 575.0), (28.0, 55.0), small),
        _bands(draw, count),
    ]
    family = np.searchsorted(np.cumsum(list(_FAMILIES.values()))[:-1], draw.uniform(0.0, 1.0, count), side="right")
    absorption = np.stack(choices)[family, np.arange(count)]
    scattering = draw.log_uniform(0.03, 1.0, count, 1) * (WAVELENGTHS_NM / 550.0) ** -draw.uniform(0.0, 2.0, count, 1)
    return absorption * draw.log_uniform(0.3, 3.0, count, 1), scattering


def _paint_mixtures(draw: _Draw, count: int) -> np.ndarray:
    """Opaque mixtures of white, black and one to three chromatic pigments."""
    amount = draw.log_uniform(0.01, 4.0, count, 3, 1)
    amount[:, 1] *= draw.uniform(0.0, 1.0, count, 1) < 0.4
    amount[:, 2] *= draw.uniform(0.0, 1.0, count, 1) < 0.15
    black = draw.log_uniform(1e-4, 0.5, count, 1) * (draw.uniform(0.0, 1.0, count, 1) < 0.6)
    white = draw.uniform(0.0, 1.0, count, 1) < 0.85
    # Half rutile, whose edge is within sight of the camera; half anatase, zinc, lead or chalk.
    rutile = draw.uniform(0.0, 1.0, count, 1) < 0.5
    edge = np.where(rutile, draw.uniform(396.0, 412.0, count, 1), draw.uniform(350.0, 390.0, count, 1))
    absorb = draw.log_uniform(2e-4, 5e-3, count, 1) + 0.6 / (1.0 + np.exp((WAVELENGTHS_NM - edge) / 6.0))
    absorption, scattering = (
        black * (WAVELENGTHS_NM / 550.0) ** draw.uniform(-0.2, 0.4, count, 1) + white * absorb,
        white * 1.0,
    )
    for i in range(3):
        k, s = _pigments(draw, count)
        absorption, scattering = absorption + amount[:, i] * k, scattering + amount[:, i] * s
    ratio = absorption / np.maximum(scattering, 1e-3)
    inner = 1.0 / (1.0 + ratio + np.sqrt(ratio * ratio + 2.0 * ratio))  # = 1 + q - sqrt(q^2 + 2q), without cancellation
    trapped = draw.uniform(0.0, 0.6, count, 1) * (draw.uniform(0.0, 1.0, count, 1) < 0.5)
    return (1.0 - trapped) * inner / (1.0 - trapped * inner)


def _filter_layers(draw: _Draw, count: int) -> np.ndarray:
    """Dyes, inks and glazes over a white ground: ground * exp(-2 optical depth)."""
    first, second = _bands(draw, count), _bands(draw, count)
    depth = draw.log_uniform(0.02, 1.8, count, 1) * first
    depth += draw.log_uniform(0.02, 1.5, count, 1) * second * (draw.uniform(0.0, 1.0, count, 1) < 0.4)
    edge = draw.uniform(350.0, 430.0, count, 1)
    ground = draw.uniform(0.6, 0.98, count, 1) / (1.0 + np.exp((edge - WAVELENGTHS_NM) / 12.0))
    return ground * np.exp(-2.0 * depth)


def _smooth_random(draw: _Draw, count: int) -> np.ndarray:
    """Logistic of a band-limited Gaussian process, correlation length 60 to 200 nm, round a random grey."""
    length = draw.log_uniform(60.0, 200.0, count, 1)
    terms = 12
    order = np.arange(1, terms + 1)
    # Cosine series on 300-800 nm with the spectrum of a Gaussian correlation of that length.
    weight = np.exp(-0.25 * (np.pi * order / 500.0 * length) ** 2)
    weight /= np.sqrt(np.sum(weight**2, axis=1, keepdims=True))
    cosines = np.cos(np.pi * np.outer(order, (WAVELENGTHS_NM - 300.0) / 500.0)) * np.sqrt(2.0)
    process = (weight * draw.normal(count, terms)) @ cosines
    level, strength = draw.uniform(-3.0, 2.5, count, 1), draw.uniform(0.1, 1.3, count, 1)
    return 1.0 / (1.0 + np.exp(-(level + strength * process).reshape(count, BANDS)))
