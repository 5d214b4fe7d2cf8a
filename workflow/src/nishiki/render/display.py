"""From linear light to what a screen shows, for all renderers: exposure, tone, background, 8 bits; normals as colours.

Pure array functions; `output` writes the files.
"""

from dataclasses import dataclass

import numpy as np

from nishiki.colour.colour import decode, srgb_encode, xyz_to_srgb_linear
from nishiki.errors import UserError

_LUMINANCE = np.array([0.2126, 0.7152, 0.0722], np.float32)  # of linear sRGB, IEC 61966-2-1
ADAPTED_PERCENTILE, ADAPTED_LEVEL, ADAPTED_BOUNDS = 98, 0.8, (0.5, 8.0)


@dataclass(frozen=True)
class DisplayImage:
    """A picture for looking, and what its 8 bits could not show."""

    pixels: np.ndarray  # (rows, columns, 3) uint8 sRGB
    clipped_high: float  # share of pixels with a channel above 1 before coding
    clipped_low: float  # share of pixels with a channel below 0


def display_image(xyz: np.ndarray, *, white: np.ndarray | None = None, exposure: float = 1.0) -> DisplayImage:
    """Return 8-bit sRGB of linear XYZ (rows, columns, 3).

    A perfect white of Y = 1 gets 255 at exposure 1.  white: XYZ (3,) of the scene's white, which Bradford adaptation
    turns into the display's (as the eye adapts to lamp light); None shows the colours as a D65 display measures them.
    """
    if not (np.isfinite(exposure) and exposure > 0):
        raise UserError(f"exposure: expected a finite factor above 0, found {exposure!r}")
    return encoded(xyz_to_srgb_linear(np.asarray(xyz, np.float32) * np.float32(exposure), white=white))


def encoded(linear: np.ndarray) -> DisplayImage:
    """Return 8 bits of linear sRGB (rows, columns, 3)."""
    # half a step of the coding is not clipping: a perfect white is 1 to within rounding
    high = np.count_nonzero((linear > 1.0 + 1e-3).any(axis=2)) / max(1, linear[..., 0].size)
    low = np.count_nonzero((linear < -1e-3).any(axis=2)) / max(1, linear[..., 0].size)
    return DisplayImage(np.floor(srgb_encode(linear) * 255 + 0.5).astype(np.uint8), high, low)


def three_channels(linear: np.ndarray) -> np.ndarray:
    """(..., 3): three channels stand for linear sRGB, which is a guess about the camera; any other number for grey."""
    if linear.shape[-1] == 3:
        return linear
    return np.repeat(linear.mean(axis=-1, keepdims=True), 3, axis=-1)


def developed(
    linear: np.ndarray, coverage: np.ndarray, *, exposure: float = 1.0, soft: bool = False, background: float = 0.0
) -> DisplayImage:
    """Return 8-bit picture over an even background.

    Parameters
    ----------
    linear : (rows, columns, channels) linear light of the surface in a pixel, times the share of it that it covers.
    coverage : (rows, columns) float, that share.
    exposure : factor of the light.
    soft : whether luminances near white are bent (`shoulder`) or clipped.
    background : sRGB-coded grey.

    Returns
    -------
    DisplayImage
        clipped_high is the share of the pixels that show the surface whose light is beyond the screen's white.
    """
    values = three_channels(linear) * np.float32(exposure)
    seen = coverage > 0
    beyond = (values > (1.0 + 1e-3) * coverage[..., None]).any(axis=-1) & seen
    high = np.count_nonzero(beyond) / max(1, np.count_nonzero(seen))
    behind = np.float32(decode(np.asarray(background, np.float64), "srgb"))
    image = encoded((shoulder(values) if soft else values) + behind * (1 - coverage[..., None]))
    return DisplayImage(image.pixels, high, image.clipped_low)


def exposure_for(parts: list[tuple[np.ndarray, float]]) -> float:
    """Choose one factor at which no part (linear sRGB (n, 3), level of its 98th percentile) is too bright."""
    tops = [np.percentile(linear @ _LUMINANCE, ADAPTED_PERCENTILE) / level for linear, level in parts if len(linear)]
    top = float(max(tops, default=0.0))
    return 1 / top if top > 0 else 1.0


def shoulder(linear: np.ndarray, *, start: float = 0.6) -> np.ndarray:
    """Return linear sRGB (..., 3) with luminances above `start` bent so that they reach 1 only at infinity.

    y -> start + (1 - start) t / (1 + t), t = (y - start) / (1 - start): value and slope go on at `start`. Channels
    share one factor, which keeps the hue; what then still exceeds 1 in a channel is drawn towards grey of the same
    luminance.
    """
    y = np.maximum(linear @ _LUMINANCE, 0)[..., None]
    t = np.maximum(y - start, 0) / (1 - start)
    bent = np.where(y > start, start + (1 - start) * t / (1 + t), y)
    out = linear * (bent / np.maximum(y, 1e-12))
    top = out.max(axis=-1, keepdims=True)
    grey = np.where(top > 1, (1 - bent) / np.maximum(top - bent, 1e-12), 1)
    return bent + (out - bent) * np.clip(grey, 0, 1)


def adapted_exposure(xyz: np.ndarray, *, seen: np.ndarray, sheet: float, bounded: bool = True) -> float:
    """Return the exposure at which an eye that has adapted to the light would see a picture.

    Brings the 98th percentile of the luminance to 0.8, within bounds that keep a black object dark and a highlight from
    darkening everything else: half and 8 times the exposure at which a white sheet beside the object is white.

    Parameters
    ----------
    xyz : (rows, columns, 3) linear picture, Y = 1 for a perfect white that faces the lamp.
    seen : (rows, columns) bool, pixels of the object.
    sheet : luminance of a perfect white sheet in the plane of the object.
    bounded : bool, whether these bounds hold; not where no white board says how light the object is.

    Returns
    -------
    float
        Factor for `display_image`, two significant digits; 1 where nothing is lit.
    """
    if not sheet > 0:
        return 1.0
    light = xyz[..., 1][seen]
    bright = float(np.percentile(light, ADAPTED_PERCENTILE)) if light.size else 0.0
    factor = ADAPTED_LEVEL / bright if bright > 0 else np.inf
    bounds = [bound / sheet for bound in ADAPTED_BOUNDS] if bounded or not bright > 0 else [0.0, np.inf]
    return float(f"{np.clip(factor, *bounds):.2g}")


def normals_as_colours(normals: np.ndarray) -> np.ndarray:
    """(rows, columns, 3) uint16 of unit normals, OpenGL convention: (n + 1) / 2 of x right, y up, z out of the surface.

    A missing normal (zero or not finite) is (0, 0, 0), which no unit normal maps to.
    """
    values = np.asarray(normals, np.float64)
    with np.errstate(invalid="ignore", over="ignore"):
        known = np.abs(np.sum(values * values, axis=2) - 1) < 0.02
        coded = np.floor((np.clip(values, -1, 1) + 1) / 2 * 65535 + 0.5)
    return np.where(known[..., None], coded, 0).astype(np.uint16)
