"""Reflection parameters as the coder stores them: solved for in the pictures, then coded by what they do to a prediction.

K_d and K_s enter the model linearly. Values fitted to point-sampled texels are blurred twice by interpolation; here they
are corrected until the *picture* of the model is right, through the renderer's own look-up. That is where most of the
texture goes, once instead of once a view.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from nishiki.ingest.encoding import encode
from nishiki.reflection.lighting import Lamp
from nishiki.reflection.model import predict
from nishiki.residual.interpolate import Footprints
from nishiki.residual.prediction import Surface

WIDTH_FLOOR = 1e-3


@dataclass(frozen=True)
class Maps:
    """kd, ks (T, T, C) float32, sigma (T, T) float32, radians."""

    kd: np.ndarray
    ks: np.ndarray
    sigma: np.ndarray


@dataclass(frozen=True)
class Weights:
    """How much the squared error of the pictures grows with each texel's squared change: kd, ks (T, T, C) per unit, sigma
    (T, T) per unit of log sigma."""

    kd: np.ndarray
    ks: np.ndarray
    sigma: np.ndarray


@dataclass(frozen=True)
class Factors:
    """What multiplies K_d and K_s in each observation: irradiance (C, M, T, T), lobe (M, T, T); lobe_slope (M, T, T):
    derivative of the lobe by log sigma."""

    irradiance: np.ndarray
    lobe: np.ndarray
    lobe_slope: np.ndarray


def model_factors(sigma: np.ndarray, channels: int, surface: Surface, centres, lamps: Sequence[Lamp]) -> Factors:
    """Factors of a tile for every observation, from the model itself with K_d = K_s = 1."""
    size = sigma.shape[0]
    ones = np.ones((size, size, channels), np.float32)
    irradiance = np.empty((channels, len(lamps), size, size), np.float32)
    lobe = np.empty((len(lamps), size, size), np.float32)
    wider = np.empty_like(lobe)
    for o, (centre, lamp) in enumerate(zip(centres, lamps, strict=True)):
        diffuse, specular = predict(ones, ones, sigma, surface.positions, surface.normals, centre, lamp)
        irradiance[:, o], lobe[o] = np.moveaxis(diffuse, -1, 0), specular[..., 0]
        wider[o] = predict(ones, ones, sigma * np.float32(1.01), surface.positions, surface.normals, centre, lamp)[1][
            ..., 0
        ]
    return Factors(irradiance, lobe, (wider - lobe) / np.float32(np.log(1.01)))


def slope(linear: np.ndarray, encoding: str) -> np.ndarray:
    """Derivative of the capture's encoding at linear values; that of the straight part below 0.0031308."""
    if encoding == "linear":
        return np.ones_like(linear)
    high = np.maximum(linear, 0.0031308).astype(linear.dtype)
    return np.where(linear <= 0.0031308, linear.dtype.type(12.92), (1.055 / 2.4) * high ** (1 / 2.4 - 1))


def refine(
    maps: Maps,
    factors: Factors,
    feet: Footprints,
    values: np.ndarray,
    encoding: str,
    *,
    iterations: int,
    move_ks: bool = True,
) -> Maps:
    """K_d and K_s whose picture is nearest to pixel values (C, n) in the capture's encoding, from the given ones.

    Accelerated gradient with each texel's own step; values stay at 0 or above. Texels that no pixel sees stay as given.
    """
    kd, ks = (np.moveaxis(a, -1, 0).astype(np.float32) for a in (maps.kd, maps.ks))
    weights = texel_weights(maps, factors, feet, encoding)
    pace_d, pace_s = (_pace(np.moveaxis(w, -1, 0)) for w in (weights.kd, weights.ks))
    ahead_d, ahead_s, momentum = kd, ks, 1.0
    for _ in range(iterations):
        linear = factors.irradiance * ahead_d[:, None] + factors.lobe[None] * ahead_s[:, None]
        left = values - feet.look_up(encode(linear, encoding))
        back = feet.spread(left) * slope(linear, encoding)
        new_d = np.maximum(ahead_d + pace_d * np.sum(back * factors.irradiance, axis=1), 0)
        new_s = np.maximum(ahead_s + pace_s * np.sum(back * factors.lobe[None], axis=1), 0) if move_ks else ks
        following = (1 + np.sqrt(1 + 4 * momentum**2)) / 2
        factor = np.float32((momentum - 1) / following)
        ahead_d, ahead_s = new_d + factor * (new_d - kd), new_s + factor * (new_s - ks)
        kd, ks, momentum = new_d, new_s, following
    return replace(maps, kd=np.moveaxis(kd, 0, -1), ks=np.moveaxis(ks, 0, -1))


def texel_weights(maps: Maps, factors: Factors, feet: Footprints, encoding: str) -> Weights:
    """Diagonal of the error's curvature at the given parameters, off-diagonal terms added (so that it bounds it)."""
    density = feet.density()
    kd, ks = np.moveaxis(maps.kd, -1, 0), np.moveaxis(maps.ks, -1, 0)
    rise = slope(factors.irradiance * kd[:, None] + factors.lobe[None] * ks[:, None], encoding) ** 2 * density[None]
    by_d = np.sum(rise * factors.irradiance**2, axis=1)
    by_s = np.sum(rise * factors.lobe[None] ** 2, axis=1)
    by_w = np.sum(rise * (factors.lobe_slope[None] * ks[:, None]) ** 2, axis=(0, 1))
    return Weights(np.moveaxis(by_d, 0, -1), np.moveaxis(by_s, 0, -1), by_w)


def _pace(weight: np.ndarray) -> np.ndarray:
    """Step of each texel: half the inverse curvature (two parameters share the data), 0 where nothing is seen."""
    floor = 0.02 * weight.max(initial=0)
    return np.where(weight > 0, 0.5 / np.maximum(weight, max(floor, 1e-20)), 0).astype(np.float32)
