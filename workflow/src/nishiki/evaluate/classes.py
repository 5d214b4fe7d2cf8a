"""What a pixel shows under one light: plain diffuse reflection, a highlight, or shadow."""

import numpy as np

from nishiki.errors import UserError

OUTSIDE, DIFFUSE, HIGHLIGHT, SHADOW = 0, 1, 2, 3
NAMES = {DIFFUSE: "diffuse", HIGHLIGHT: "highlight", SHADOW: "shadow"}
HIGHLIGHT_SHARE = 0.1
"""A pixel counts as highlight where the specular part exceeds this share of all the light that it returns."""


def classify(diffuse: np.ndarray, specular: np.ndarray, lit: np.ndarray, *, inside: np.ndarray) -> np.ndarray:
    """Class of each pixel, uint8.

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
