"""The model at the texels of a tile, in the capture's own encoding: the same for the encoder and the renderer.

A picture is a bilinear look-up among texels, each encode(I_d + I_s) plus its residual; so the model is evaluated and
encoded at the texels too.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from nishiki.brdf.texels.lighting import Lamp
from nishiki.brdf.texels.model import predict
from nishiki.colour.encoding import encode


@dataclass(frozen=True)
class Surface:
    """Geometry of a tile: positions, normals (T, T, 3) float32 in the object's frame, inside (T, T) bool."""

    positions: np.ndarray
    normals: np.ndarray
    inside: np.ndarray


def predict_texels(
    kd: np.ndarray,
    ks: np.ndarray,
    sigma: np.ndarray,
    surface: Surface,
    centres: np.ndarray,
    lamps: Sequence[Lamp],
    encoding: str,
    *,
    component: str = "total",
) -> np.ndarray:
    """(C, observations, T, T) float32: encode(model) of kd, ks (T, T, C), sigma (T, T), for each camera and lamp.

    centres (observations, 3). component: "total", "diffuse" or "specular".
    """
    out = np.empty((kd.shape[-1], len(lamps), *sigma.shape), np.float32)
    for o, (centre, lamp) in enumerate(zip(centres, lamps, strict=True)):
        parts = predict(kd, ks, sigma, surface.positions, surface.normals, centre, lamp)
        total = {"total": sum(parts), "diffuse": parts[0], "specular": parts[1]}[component]
        out[:, o] = np.moveaxis(encode(total, encoding), -1, 0)
    return out
