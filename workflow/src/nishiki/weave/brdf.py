"""The weave model as a BRDF of the whole hemisphere: both sections side by side.

A direction in space sees a section as its projection on the section's plane does. Both sections' surfaces are taken as
crossing each other independently: gloss and body are products of a factor of the weft plane and one of the warp plane,
which for light along the normal and views in either plane is eq. 15 of Takeda and Tanaka exactly (the other plane's
factor is 1 there).
"""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from nishiki.brdf.cloth.interface import ArrayFields, halves, off_horizon, only_above
from nishiki.weave.model import columns, rows_of


@dataclass(frozen=True)
class WeaveBrdf(ArrayFields):
    """Weave model in 4-D, reciprocal; see the fields of `nishiki.weave.fit.WeaveModel`.

    diffuse, specular (channels,): k_d and k_s F0, sr^-1. weft, warp (6,): theta_a, l, r, m, n, contact. width (2,): of
    the lobes, weft and warp plane. index: refractive index. reading: 0, 1 the paper's reading with Gaussian or GGX
    lobe, 2, 3 the shaded one, 4, 5 yarns.
    """

    KIND: ClassVar[str] = "weave"
    diffuse: np.ndarray
    specular: np.ndarray
    weft: np.ndarray
    warp: np.ndarray
    width: np.ndarray
    index: float
    reading: int

    @property
    def channels(self) -> int:
        """Number of channels."""
        return int(np.size(self.specular))

    def evaluate(self, incident: np.ndarray, outgoing: np.ndarray) -> np.ndarray:
        """BRDF, sr^-1: (..., channels) from unit vectors (..., 3) that broadcast; 0 below the horizon."""
        g = halves(incident, outgoing)
        incident, outgoing = np.broadcast_arrays(off_horizon(incident), off_horizon(outgoing))
        straight = (0.0, 0.0, 1.0)
        rows = rows_of(*(np.where(g.above[..., None], v, straight) for v in (incident, outgoing)))
        f0 = ((self.index - 1.0) / (self.index + 1.0)) ** 2
        parts = columns(self.weft, self.warp, self.width, rows, f0=f0, reading=int(self.reading))
        return only_above(
            g.above, parts[..., :1] * np.asarray(self.specular) + parts[..., 1:] * np.asarray(self.diffuse)
        )
