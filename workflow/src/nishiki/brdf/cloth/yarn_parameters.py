"""The numbers that a fit of yarn facets searches, and what is known of textile yarns before any measurement.

All are logarithms (the weft's share a logit), so that no bound is needed and prior spreads are relative.  The priors
are wide statements about yarns and fibres, not about one cloth:

* slopes along a yarn about 0.2 (warp) and 0.3 (weft), across it 0.6, within a factor of 1.8 either way; the shape of a
  section between an ellipse (k = 2) and a flattened one (k = 1);
* facets of filaments 0.15 rough along and 0.3 across the fibres;
* textile fibres have indices of 1.46 (acetate) to 1.60 (silk, polyester: mean of both axes);
* humps lie 1.1 to 1.3 of their widths apart; the reflectance scale is known within 5 %.
"""

import numpy as np

from nishiki.brdf.cloth.yarn_facets import YarnShape

NAMES = (
    *(f"log {what} {family} {side}" for what in ("slope", "power", "rough") for family in ("warp", "weft")
      for side in ("along", "across")),
    "logit weft_share", "log gain", "log index-1",
    *(f"log spacing {family} {side}" for family in ("warp", "weft") for side in ("along", "across")),
    "log softness",
)  # fmt: skip
CENTRE = np.concatenate([
    np.log([0.2, 0.6, 0.3, 0.6]), np.log([1.5, 1.4, 2.0, 1.4]), np.log([0.15, 0.3, 0.15, 0.3]),
    [np.log(0.25 / 0.75), 0.0, np.log(0.54)], np.log([1.3, 1.1, 1.1, 1.1]), [np.log(0.25)],
])  # fmt: skip
SPREAD = np.concatenate([
    [0.6] * 4, [0.5, 0.4, 0.5, 0.4], [0.5, 0.3, 0.5, 0.3], [0.6, 0.05, 0.08], [0.3, 0.15, 0.15, 0.15], [0.5],
])  # fmt: skip


def shape_of(x: np.ndarray) -> YarnShape:
    """The shape of a vector of parameters in the order of NAMES."""
    e = np.exp(x)
    return YarnShape(
        slope=e[0:4].reshape(2, 2),
        power=e[4:8].reshape(2, 2),
        rough=e[8:12].reshape(2, 2),
        weft_share=float(e[12] / (1 + e[12])),
        gain=float(e[13]),
        index=float(1 + e[14]),
        spacing=e[15:19].reshape(2, 2),
        softness=float(e[19]),
    )


def vector_of(shape: YarnShape) -> np.ndarray:
    """The inverse of `shape_of`."""
    shares = [shape.weft_share / (1 - shape.weft_share), shape.gain, shape.index - 1]
    arrays = [np.ravel(a) for a in (shape.slope, shape.power, shape.rough)]
    return np.log(np.concatenate([*arrays, shares, np.ravel(shape.spacing), [shape.softness]]))
