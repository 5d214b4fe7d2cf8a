"""Sort pixels into diffuse, highlight and shadow, and colour differences into the levels of museums and libraries.

Both schemes of levels are defined for the patches of a colour target photographed with the object, read from the
finished file. Here the same thresholds are held against differences of pixels between prediction and photograph, which
also contain noise and geometry: a level named here gives the order of the difference and is no certificate.
"""

from dataclasses import dataclass

import numpy as np

from nishiki.errors import UserError

OUTSIDE, DIFFUSE, HIGHLIGHT, SHADOW = 0, 1, 2, 3
NAMES = {DIFFUSE: "diffuse", HIGHLIGHT: "highlight", SHADOW: "shadow"}
HIGHLIGHT_SHARE = 0.1
"""A pixel counts as highlight where the specular part exceeds this share of all the light that it returns."""


def classify(diffuse: np.ndarray, specular: np.ndarray, lit: np.ndarray, *, inside: np.ndarray) -> np.ndarray:
    """Return class of each pixel, uint8.

    diffuse, specular : (rows, columns) parts of the light that the pixel returns, same unit; lit : (rows, columns)
    share of the lamp that it sees, 0 to 1, in which n.l <= 0 counts as 0; inside : bool. Shadow: less than half lit.
    The parts may be true ones or predicted ones, never those of the photograph: a class that depended on the error to
    be measured would flatter it.
    """
    if not diffuse.shape == specular.shape == lit.shape == inside.shape:
        raise UserError(
            f"classes: expected equal shapes, found {diffuse.shape}, {specular.shape}, {lit.shape} and {inside.shape}"
        )
    classes = np.full(diffuse.shape, DIFFUSE, np.uint8)
    classes[specular > HIGHLIGHT_SHARE * (diffuse + specular)] = HIGHLIGHT
    classes[~(lit >= 0.5)] = SHADOW
    classes[~inside] = OUTSIDE
    return classes


@dataclass(frozen=True)
class Level:
    """A level and the largest mean (and 90th percentile, where the scheme has one) that it allows."""

    name: str
    mean: float
    p90: float | None


# FADGI, Technical Guidelines for Digitizing Cultural Heritage Materials, 3rd edition (2023): colour accuracy as mean
# and 90th percentile of Delta E 2000. The limit of one star on the 90th percentile is left open here.
FADGI = (
    Level("4 stars", 2.0, 4.0),
    Level("3 stars", 3.5, 7.0),
    Level("2 stars", 5.0, 10.0),
    Level("1 star", 6.5, None),
)
# ISO 19264-1:2021: mean difference of the patches of a target, levels A, B, C. Levels B and C share the mean; they
# differ elsewhere. The standard also limits the largest difference of a patch, which has no counterpart for pixels.
ISO_19264 = (Level("A", 4.0, None), Level("B", 5.0, None))


def level_of(mean: float | None, p90: float | None, levels: tuple[Level, ...]) -> str:
    """Name of the best level whose limits hold, or `none`. FADGI asks for below its limits, ISO for at most them."""
    if mean is None:
        return "not measured"
    strict = levels is FADGI
    for level in levels:
        within_mean = mean < level.mean if strict else mean <= level.mean
        within_p90 = level.p90 is None or (p90 is not None and p90 < level.p90)
        if within_mean and within_p90:
            return level.name
    return "none"


def levels(mean: float | None, p90: float | None) -> dict[str, str]:
    """Both schemes for one pair of figures."""
    return {"fadgi": level_of(mean, p90, FADGI), "iso_19264": level_of(mean, p90, ISO_19264)}
