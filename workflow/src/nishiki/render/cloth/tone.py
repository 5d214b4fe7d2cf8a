"""From radiance to the display: exposure, and a soft shoulder in place of hard clipping."""

from __future__ import annotations

import numpy as np

from nishiki.colour.colour import srgb_matrix
from nishiki.colour.encoding import decode
from nishiki.render.cloth.frame import ClothPicture
from nishiki.render.display import DisplayImage, display_image

_WEIGHTS = np.float32([0.2126, 0.7152, 0.0722])  # luminance of linear sRGB, IEC 61966-2-1


def exposure_for(pictures: list[ClothPicture], *, level: float = 0.7, rest: float = 0.95) -> float:
    """One factor for several pictures: the brightest cloth comes to `level` of the display's white, unless what else is
    in the pictures would then exceed `rest`. Judged by the 98th percentile; 1 where all is black."""
    tops = []
    for picture in pictures:
        shown = picture.linear @ _WEIGHTS
        parts = (shown[picture.cloth > 0.9], level), (shown[picture.coverage > 0.5], rest)
        tops += [float(np.percentile(values, 98)) / wanted for values, wanted in parts if values.size]
    top = max(tops, default=0.0)
    return 1 / top if top > 0 else 1.0


def shoulder(linear: np.ndarray, *, start: float = 0.6) -> np.ndarray:
    """Linear sRGB (..., 3) with luminances above `start` bent so that they reach 1 only at infinity.

    y -> start + (1 - start) t / (1 + t), t = (y - start) / (1 - start): value and slope go on at `start`. Channels
    share one factor, which keeps the hue; what then still exceeds 1 in a channel is drawn towards grey of the same
    luminance.
    """
    y = np.maximum(linear @ _WEIGHTS, 0)[..., None]
    t = np.maximum(y - start, 0) / (1 - start)
    bent = np.where(y > start, start + (1 - start) * t / (1 + t), y)
    out = linear * (bent / np.maximum(y, 1e-12))
    top = out.max(axis=-1, keepdims=True)
    grey = np.where(top > 1, (1 - bent) / np.maximum(top - bent, 1e-12), 1)
    return bent + (out - bent) * np.clip(grey, 0, 1)


def developed(
    linear: np.ndarray, coverage: np.ndarray, *, exposure: float = 1.0, soft: bool = True, background: float = 1.0
) -> DisplayImage:
    """8-bit picture of linear sRGB (rows, columns, 3), of which `coverage` is surface, over an even grey background."""
    values = linear * np.float32(exposure)
    clipped = float(np.mean((values > 1.001).any(axis=-1)))
    shown = shoulder(values) if soft else values
    behind = decode(np.float64(background), "srgb")
    mixed = shown + np.float32(behind) * (1 - coverage[..., None])
    image = display_image((mixed @ np.linalg.inv(srgb_matrix()).T).astype(np.float32))
    return DisplayImage(image.pixels, clipped, image.clipped_low)
