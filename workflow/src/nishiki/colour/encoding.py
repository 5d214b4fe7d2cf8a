"""The capture's own encoding of linear light, in which pictures are compared and residuals are coded."""

from __future__ import annotations

from typing import Literal

import numpy as np

Encoding = Literal["linear", "srgb"]
BLOCK = 1 << 16  # values at a time: temporaries stay in the cache
SLOPE = 12.92


def encode(linear: np.ndarray, encoding: Encoding) -> np.ndarray:
    """Linear values to code values, full scale 1, of any shape; float32 stays float32, all else is float64.

    srgb: the transfer curve of IEC 61966-2-1, continued below 0 by its straight part and above 1 by its power; linear:
    the values themselves (not a copy). Nothing is clipped; NaN stays NaN. ValueError for another encoding.
    """

    def curve(values: np.ndarray, out: np.ndarray) -> None:
        np.maximum(values, 0.0031308, out=out)
        np.power(out, 1 / 2.4, out=out)
        out *= 1.055
        out -= 0.055
        np.multiply(values, SLOPE, out=out, where=values <= 0.0031308)

    return _through(linear, encoding, curve)


def decode(values: np.ndarray, encoding: Encoding) -> np.ndarray:
    """Code values to linear ones: the inverse of `encode`."""

    def curve(values: np.ndarray, out: np.ndarray) -> None:
        np.maximum(values, 0.04045, out=out)
        out += 0.055
        out *= 1 / 1.055
        np.power(out, 2.4, out=out)
        np.multiply(values, 1 / SLOPE, out=out, where=values <= 0.04045)

    return _through(values, encoding, curve)


def _through(values: np.ndarray, encoding: str, curve) -> np.ndarray:
    values = np.asarray(values)
    values = values if values.dtype in (np.float32, np.float64) else values.astype(np.float64)
    if encoding == "linear":
        return values
    if encoding != "srgb":
        raise ValueError(f"encoding {encoding!r}: linear or srgb")
    flat = np.ascontiguousarray(values).reshape(-1)
    out = np.empty_like(flat)
    for start in range(0, len(flat), BLOCK):
        part = slice(start, start + BLOCK)
        curve(flat[part], out[part])
    return out.reshape(values.shape)
