"""The transfer curve of sRGB (IEC 61966-2-1), its inverse and its derivative; a capture's own encoding of linear light.

    code = 12.92 L                      L <= 0.0031308
    code = 1.055 L^(1 / 2.4) - 0.055    above

In the capture's encoding pictures are compared and residuals are coded.
"""

from __future__ import annotations

from typing import Literal

import numpy as np

Encoding = Literal["linear", "srgb"]
BLOCK = 1 << 16  # values at a time: temporaries stay in the cache
KNEE, CODED_KNEE = 0.0031308, 0.04045
"""Linear value, and code, at which the straight part ends."""
SLOPE, SCALE, OFFSET, POWER = 12.92, 1.055, 0.055, 1 / 2.4


def encode(linear: np.ndarray, encoding: Encoding) -> np.ndarray:
    """Linear values to code values, full scale 1, of any shape; float32 stays float32, all else is float64.

    srgb: the transfer curve of IEC 61966-2-1, continued below 0 by its straight part and above 1 by its power; linear:
    the values themselves (not a copy). Nothing is clipped; NaN stays NaN. ValueError for another encoding.
    """

    def curve(values: np.ndarray, out: np.ndarray) -> None:
        np.maximum(values, KNEE, out=out)
        np.power(out, POWER, out=out)
        out *= SCALE
        out -= OFFSET
        np.multiply(values, SLOPE, out=out, where=values <= KNEE)

    return _through(linear, encoding, curve)


def decode(values: np.ndarray, encoding: Encoding) -> np.ndarray:
    """Code values to linear ones: the inverse of `encode`."""

    def curve(values: np.ndarray, out: np.ndarray) -> None:
        np.maximum(values, CODED_KNEE, out=out)
        out += OFFSET
        out *= 1 / SCALE
        np.power(out, 1 / POWER, out=out)
        np.multiply(values, 1 / SLOPE, out=out, where=values <= CODED_KNEE)

    return _through(values, encoding, curve)


def encoding_slope(linear: np.ndarray, encoding: Encoding) -> np.ndarray:
    """Derivative of the encoding at linear values, of their type; that of the straight part up to its end."""
    if encoding == "linear":
        return np.ones_like(linear)
    high = np.maximum(linear, KNEE).astype(linear.dtype)
    return np.where(linear <= KNEE, linear.dtype.type(SLOPE), (SCALE * POWER) * high ** (POWER - 1))


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
