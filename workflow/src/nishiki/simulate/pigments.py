"""Invented pigments with smooth absorption curves, mixed by the Kubelka-Munk theory.

No measured pigment is behind the numbers: they are shapes (edges and bands) that give colours of the kind their names
suggest. Mixing: Duncan's rule, K and S add by concentration; reflectance of a thick layer: Kubelka & Munk (1931);
reflection at the inner side of the surface: Saunderson (J. Opt. Soc. Am. 32, 1942).
"""

from dataclasses import dataclass

import numpy as np

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
    absorption = sum(share / total * PIGMENTS[name].absorption(wavelengths_nm) for name, share in parts.items())
    scattering = sum(share / total * PIGMENTS[name].scatter(wavelengths_nm) for name, share in parts.items())
    return surface_corrected(thick_layer(absorption, scattering))


def grey(reflectance: float) -> dict[str, float]:
    """The mixture of white and black that reflects `reflectance` at 550 nm (bisection in log concentration)."""
    low, high = -14.0, 14.0
    at = np.array([550.0])
    for _ in range(80):
        middle = 0.5 * (low + high)
        if mixture({"white": 1.0, "black": float(np.exp(middle))}, at)[0] > reflectance:
            low = middle
        else:
            high = middle
    return {"white": 1.0, "black": float(np.exp(0.5 * (low + high)))}
