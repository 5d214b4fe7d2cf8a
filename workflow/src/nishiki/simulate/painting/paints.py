"""Paints: invented pigments, the ramps of their mixtures, and what each gives in XYZ.

No measured pigment is behind the numbers: they are shapes (edges and bands) that give colours of the kind their names
suggest. Mixing: Duncan's rule, K and S add by concentration; reflectance of a thick layer: Kubelka & Munk (1931);
reflection at the inner side of the surface: Saunderson (J. Opt. Soc. Am. 32, 1942). Every region of the painting is a
short ramp of mixtures, every step of a ramp is one label.
"""

from dataclasses import dataclass

import numpy as np

from nishiki.simulate.randomness import subkey

INNER_REFLECTION = 0.5  # share of diffuse light that the surface sends back into the paint layer (Saunderson's k2)
OUTER_REFLECTION = 0.04  # share lost on the way in (k1)


@dataclass(frozen=True)
class Pigment:
    """Absorption: floor + edges + bands, each (strength, nm, width), an edge absorbs below; scattering: power law."""

    scattering: float
    floor: float
    edges: tuple[tuple[float, float, float], ...] = ()
    bands: tuple[tuple[float, float, float], ...] = ()
    exponent: float = 0.5

    def absorption(self, wavelengths_nm: np.ndarray) -> np.ndarray:
        """K at the wavelengths, relative to the scattering of white."""
        total = np.full(wavelengths_nm.shape, self.floor)
        for strength, centre, width in self.edges:
            total += strength / (1.0 + np.exp((wavelengths_nm - centre) / width))
        for strength, centre, width in self.bands:
            total += strength * np.exp(-0.5 * ((wavelengths_nm - centre) / width) ** 2)
        return total

    def scatter(self, wavelengths_nm: np.ndarray) -> np.ndarray:
        """S at the wavelengths; the white has 1 at 550 nm."""
        return self.scattering * (wavelengths_nm / 550.0) ** -self.exponent


PIGMENTS = {
    "white": Pigment(1.0, 0.0009, edges=((1.2, 396.0, 6.0),)),
    "black": Pigment(0.08, 3.0, exponent=0.1),
    "ultramarine": Pigment(0.13, 0.03, edges=((0.5, 384.0, 12.0),), bands=((2.4, 592.0, 52.0), (0.5, 535.0, 30.0))),
    "cobalt": Pigment(0.20, 0.025, bands=((0.8, 545.0, 24.0), (1.3, 588.0, 21.0), (1.4, 634.0, 25.0))),
    "cerulean": Pigment(0.25, 0.035, edges=((0.4, 402.0, 14.0),), bands=((1.1, 612.0, 44.0), (0.6, 682.0, 40.0))),
    "viridian": Pigment(0.12, 0.05, bands=((1.9, 622.0, 60.0), (1.3, 412.0, 36.0))),
    "lemon": Pigment(0.55, 0.006, edges=((5.0, 468.0, 8.0),)),
    "yellow": Pigment(0.60, 0.010, edges=((6.0, 497.0, 9.0),)),
    "orange": Pigment(0.55, 0.012, edges=((6.0, 560.0, 11.0),)),
    "vermilion": Pigment(0.50, 0.015, edges=((6.0, 587.0, 10.0),)),
    "madder": Pigment(0.06, 0.015, bands=((1.6, 514.0, 31.0), (1.2, 556.0, 21.0), (0.5, 440.0, 45.0))),
    "violet": Pigment(0.12, 0.06, bands=((1.6, 562.0, 48.0), (0.25, 630.0, 40.0))),
    "ochre": Pigment(0.40, 0.05, edges=((1.3, 536.0, 27.0),), bands=((0.30, 478.0, 26.0), (0.10, 655.0, 42.0))),
    "sienna": Pigment(0.25, 0.10, edges=((2.0, 580.0, 29.0),), bands=((0.2, 690.0, 60.0),)),
    "umber": Pigment(0.20, 0.42, edges=((1.4, 560.0, 80.0),)),
}


def thick_layer(absorption: np.ndarray, scattering: np.ndarray) -> np.ndarray:
    """Reflectance of an opaque layer of paint inside the binder (Kubelka-Munk), any shape."""
    ratio = absorption / scattering
    # 1 + q − sqrt(q² + 2q) written as its reciprocal: no cancellation where q is large.
    return 1.0 / (1.0 + ratio + np.sqrt(ratio * ratio + 2.0 * ratio))


def surface_corrected(inside: np.ndarray) -> np.ndarray:
    """Diffuse reflectance seen from outside, the mirror reflection of the surface left out (Saunderson)."""
    return (1.0 - OUTER_REFLECTION) * (1.0 - INNER_REFLECTION) * inside / (1.0 - INNER_REFLECTION * inside)


def mixture(parts: dict[str, float], wavelengths_nm: np.ndarray) -> np.ndarray:
    """Reflectance (wavelengths,) of a mixture given as pigment name → concentration (any positive scale)."""
    wavelengths_nm = np.asarray(wavelengths_nm, float)
    total = sum(parts.values())
    absorption, scattering = np.zeros((2, *wavelengths_nm.shape))
    for name, share in parts.items():
        absorption += share / total * PIGMENTS[name].absorption(wavelengths_nm)
        scattering += share / total * PIGMENTS[name].scatter(wavelengths_nm)
    return surface_corrected(thick_layer(absorption, scattering))


def grey(reflectance: float) -> dict[str, float]:
    """Mix white and black to reflect `reflectance` at 550 nm (bisection in log concentration)."""
    low, high = -14.0, 14.0
    at = np.array([550.0])
    for _ in range(80):
        middle = 0.5 * (low + high)
        if mixture({"white": 1.0, "black": float(np.exp(middle))}, at)[0] > reflectance:
            low = middle
        else:
            high = middle
    return {"white": 1.0, "black": float(np.exp(0.5 * (low + high)))}


GREYS = (0.85, 0.55, 0.36, 0.20, 0.09, 0.012)  # 0.85 and 0.012 lie close to the pure white and black paints

_RAMPS: dict[str, tuple[dict, dict, int]] = {
    "ground": ({"sienna": 1.0, "white": 0.5}, {"sienna": 1.0, "white": 0.9}, 3),
    "sky high": ({"ultramarine": 1.0, "cobalt": 0.8, "white": 0.35}, {"cobalt": 1.0, "white": 0.9}, 7),
    "sky middle": ({"cerulean": 1.0, "cobalt": 0.4, "white": 0.6}, {"cerulean": 1.0, "white": 2.2}, 7),
    "sky low": ({"white": 1.0, "orange": 0.02, "madder": 0.25}, {"white": 1.0, "yellow": 0.10}, 7),
    "halo": ({"yellow": 1.0, "white": 0.7}, {"orange": 0.7, "yellow": 1.0, "white": 0.3}, 6),
    "sun": ({"lemon": 1.0, "white": 2.0}, {"yellow": 1.0, "white": 0.3}, 4),
    "cloud": ({"white": 1.0, "madder": 0.10}, {"white": 1.0, "ochre": 0.02}, 5),
    "gold cloud": ({"ochre": 1.0, "yellow": 0.25}, {"ochre": 0.6, "yellow": 0.5, "white": 0.5}, 4),
    "mountain lit": ({"violet": 1.0, "white": 0.7, "madder": 0.5}, {"violet": 1.0, "white": 1.6, "ochre": 0.3}, 5),
    "mountain shade": ({"ultramarine": 1.0, "violet": 0.6, "white": 0.12}, {"ultramarine": 1.0, "white": 0.45}, 5),
    "snow lit": ({"white": 1.0, "ochre": 0.01}, {"white": 1.0}, 3),
    "snow shade": ({"white": 1.0, "ultramarine": 0.5}, {"white": 1.0, "ultramarine": 0.2}, 4),
    "far hills": ({"cobalt": 1.0, "viridian": 0.5, "white": 0.8}, {"viridian": 0.8, "cerulean": 1.0, "white": 1.6}, 5),
    "middle hills": (
        {"viridian": 1.0, "cerulean": 0.6, "lemon": 0.4, "white": 0.2},
        {"viridian": 1.0, "lemon": 0.9, "white": 0.5},
        5,
    ),
    "near hills": ({"viridian": 1.0, "umber": 0.3, "lemon": 0.2}, {"viridian": 0.7, "lemon": 1.0}, 5),
    "lake": ({"cobalt": 1.0, "ultramarine": 0.5, "white": 0.12}, {"cerulean": 1.0, "white": 1.0}, 8),
    "glitter": ({"orange": 0.5, "yellow": 0.5, "white": 0.7}, {"yellow": 1.0, "white": 1.6}, 5),
    "meadow": ({"viridian": 1.0, "umber": 0.2, "lemon": 0.3}, {"viridian": 0.35, "lemon": 1.0, "white": 0.1}, 6),
    "rape field": ({"yellow": 1.0, "ochre": 0.5}, {"lemon": 1.0, "yellow": 0.4}, 5),
    "poppies": ({"vermilion": 1.0, "madder": 0.15}, {"vermilion": 0.4, "orange": 1.0, "white": 0.05}, 4),
    "blossom": ({"white": 1.0, "madder": 1.3}, {"white": 1.0, "madder": 0.06}, 6),
    "branch": ({"umber": 1.0, "black": 0.4}, {"umber": 1.0, "sienna": 0.6}, 4),
    "torii": ({"vermilion": 1.0, "sienna": 0.15}, {"vermilion": 0.6, "orange": 1.0}, 4),
    "black line": ({"black": 1.0}, {"black": 1.0, "umber": 0.3}, 2),
    "brocade red": ({"madder": 0.5, "vermilion": 1.0}, {"vermilion": 1.0, "madder": 0.08}, 4),
    "brocade indigo": ({"ultramarine": 1.0, "black": 0.03}, {"ultramarine": 1.0, "cobalt": 0.8}, 4),
    "brocade green": ({"viridian": 1.0, "white": 0.1}, {"viridian": 1.0, "white": 0.3, "lemon": 0.3}, 4),
    "brocade violet": ({"violet": 1.0, "madder": 0.3}, {"violet": 1.0, "white": 0.25}, 4),
    "brocade gold": ({"ochre": 1.0, "yellow": 0.2}, {"ochre": 1.0, "yellow": 0.7, "white": 0.2}, 5),
    "brocade cream": ({"white": 1.0, "ochre": 0.06}, {"white": 1.0, "ochre": 0.02}, 3),
    **{f"grey {index + 1}": (grey(value), grey(value), 1) for index, value in enumerate(GREYS)},
    "patch red": ({"vermilion": 1.0}, {"vermilion": 1.0}, 1),
    "patch orange": ({"orange": 1.0}, {"orange": 1.0}, 1),
    "patch yellow": ({"yellow": 1.0, "lemon": 0.3}, {"yellow": 1.0, "lemon": 0.3}, 1),
    "patch green": ({"viridian": 1.0, "lemon": 1.2}, {"viridian": 1.0, "lemon": 1.2}, 1),
    "patch blue": ({"cobalt": 1.0, "white": 0.3}, {"cobalt": 1.0, "white": 0.3}, 1),
    "patch violet": ({"violet": 1.0, "white": 0.3}, {"violet": 1.0, "white": 0.3}, 1),
}

REGIONS = tuple(_RAMPS)
REGION = {name: index for index, name in enumerate(REGIONS)}


@dataclass(frozen=True)
class Palette:
    """Hold the paints of a picture.

    first, steps : (regions,) first label of a region and how many it has; region : (labels,) region of a label; names :
    (labels,) text; spectra : (labels, wavelengths) reflectance; roughness : (labels,) GGX alpha.
    """

    first: np.ndarray
    steps: np.ndarray
    region: np.ndarray
    names: tuple[str, ...]
    spectra: np.ndarray
    roughness: np.ndarray


def make_palette(wavelengths_nm: np.ndarray, *, alpha: float, seed: int) -> Palette:
    """All paints at the given wavelengths; roughness varies by ±20 % between regions and ±5 % within one."""
    steps = np.array([ramp[2] for ramp in _RAMPS.values()])
    first = np.concatenate([[0], np.cumsum(steps)[:-1]])
    region = np.repeat(np.arange(steps.size), steps)
    names, spectra = [], []
    for name, (start, end, count) in _RAMPS.items():
        for step in range(count):
            share = step / max(count - 1, 1)
            parts = {
                pigment: (1.0 - share) * start.get(pigment, 0.0) + share * end.get(pigment, 0.0)
                for pigment in {**start, **end}
            }
            spectra.append(mixture(parts, wavelengths_nm))
            names.append(f"{name} {step + 1}/{count}" if count > 1 else name)
    random = np.random.default_rng(subkey(seed, "roughness"))
    between = random.uniform(0.8, 1.2, steps.size)[region]
    roughness = alpha * between * random.uniform(0.95, 1.05, region.size)
    return Palette(first, steps, region, tuple(names), np.array(spectra), np.clip(roughness, 0.0, 1.0))


def xyz_tables(spectra: np.ndarray, illuminant: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(table (labels, 3), squared, white (3,)): XYZ of spectra (labels, 61) at 400..700/5 nm under an illuminant (61,).

    Y of a perfect white is 1. Plain sums over the 61 bands.
    """
    from nishiki.colour.colour import xyz_matrix

    return (
        xyz_matrix(illuminant, spectra).T,
        xyz_matrix(illuminant, spectra**2).T,
        xyz_matrix(illuminant, np.ones((1, spectra.shape[1])))[:, 0],
    )
