"""The weave model as a BRDF of the whole hemisphere: both sections side by side.

A direction in space sees a section as its projection on the section's plane does. Both sections' surfaces are taken as
crossing each other independently: gloss and body are products of a factor of the weft plane and one of the warp plane,
which for light along the normal and views in either plane is W eq. 15 exactly (the other plane's factor is 1 there).
"""

from dataclasses import dataclass
from math import atan2
from typing import ClassVar

import numpy as np
from numba import njit

from nishiki.fabric.interface import ArrayFields, halves, only_above
from nishiki.weave.reading import SHADED, lobe, pieces, schlick
from nishiki.weave.visibility import share_seen


@dataclass(frozen=True)
class WeaveBrdf(ArrayFields):
    """Weave model in 4-D, reciprocal; see the fields of `nishiki.weave.fit.WeaveModel`.

    diffuse, specular (channels,): k_d and k_s F0, sr^-1. weft, warp (6,): theta_a, l, r, m, n, contact. width (2,): of
    the lobes, weft and warp plane. index: refractive index. reading: 0, 1 W's reading with Gaussian or GGX lobe, 2, 3
    the shaded one.
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
        incident, outgoing = np.broadcast_arrays(np.asarray(incident, float), np.asarray(outgoing, float))
        rows = (np.where(g.above[..., None], v, (0.0, 0.0, 1.0)).reshape(-1, 3) for v in (incident, outgoing))
        f0 = ((self.index - 1.0) / (self.index + 1.0)) ** 2
        shapes = (tuple(map(float, self.weft)), tuple(map(float, self.warp)))
        widths = (float(self.width[0]), float(self.width[1]))
        parts = _evaluate(*rows, g.cos_d.reshape(-1), *shapes, *widths, f0, int(self.reading))
        parts = parts.reshape(*g.above.shape, 2)
        return only_above(
            g.above, parts[..., :1] * np.asarray(self.specular) + parts[..., 1:] * np.asarray(self.diffuse)
        )


@njit(cache=True, nogil=True, error_model="numpy")
def _plane_factor(shape, width, reading, i, r, half):
    """Gloss and body factor of one plane at signed angles, 1 along the normal; the gloss times cos i cos r."""
    if reading < SHADED:
        seen = share_seen(shape, i, r)
        return lobe(half, width, reading % 2) * seen, seen
    above = pieces(shape, width, reading % 2, 0.0, 0.0, 0.0)
    gloss, body = pieces(shape, width, reading % 2, i, r, half)
    slant = np.cos(i) * np.cos(r)
    return gloss / above[0] if above[0] > 0.0 else 0.0, body / (above[1] * slant)


@njit(cache=True, nogil=True, error_model="numpy")
def _evaluate(incident, outgoing, cos_d, weft, warp, width_weft, width_warp, f0, reading):
    out = np.empty((len(incident), 2))
    for k in range(len(incident)):
        i, o = incident[k], outgoing[k]
        h0, h1, h2 = i[0] + o[0], i[1] + o[1], i[2] + o[2]
        x = _plane_factor(weft, width_weft, reading, atan2(i[0], i[2]), atan2(o[0], o[2]), atan2(h0, h2))
        y = _plane_factor(warp, width_warp, reading, atan2(i[1], i[2]), atan2(o[1], o[2]), atan2(h1, h2))
        out[k, 0] = schlick(f0, cos_d[k]) * x[0] * y[0] / (i[2] * o[2])
        out[k, 1] = x[1] * y[1]
    return out
