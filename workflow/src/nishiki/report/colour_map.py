"""Colour maps for maps of one quantity: lightness grows evenly, so that they read the same in grey print."""

import numpy as np

from nishiki.colour.colour import srgb_encode, srgb_matrix

# Control points in CIELAB (D65): hue and chroma only steer; lightness is replaced by an even ramp.
_HEAT = np.array([[8, 12, -18], [28, 26, -40], [46, 42, -16], [62, 44, 22], [80, 14, 58], [97, -6, 34]], float)
_SEA = np.array([[14, 4, -22], [34, -4, -30], [52, -16, -18], [70, -26, 6], [86, -16, 38], [97, -6, 24]], float)
_BALANCE = np.array([[36, 14, -46], [95, 0, 1], [38, 50, 34]], float)
MISSING = np.array([226, 226, 222], np.uint8)
"""Colour of pixels without a value."""


def heat() -> np.ndarray:
    """(256, 3) uint8, dark to light: for errors, where light means much."""
    return _table(_HEAT)


def sea() -> np.ndarray:
    """(256, 3) uint8, dark to light: for counts and measures that are no errors."""
    return _table(_SEA)


def balance() -> np.ndarray:
    """(256, 3) uint8, blue over a light grey to red: for signed errors, where the middle is none."""
    t = np.linspace(0, 1, 256)
    lab = np.stack([np.interp(t, [0, 0.5, 1], _BALANCE[:, k]) for k in range(3)], axis=1)
    return np.round(255 * srgb_encode(_rgb_of(lab))).astype(np.uint8)


def coloured(values: np.ndarray, table: np.ndarray, low: float, high: float) -> np.ndarray:
    """(rows, columns, 3) uint8 of values (rows, columns); below low and above high the ends; NaN: `MISSING`."""
    span = high - low if high > low else 1.0
    known = np.isfinite(values)
    places = np.clip((np.where(known, values, low) - low) / span * 255.0 + 0.5, 0, 255).astype(np.uint8)
    picture = table[places]
    picture[~known] = MISSING
    return picture


def hexadecimal(colour: np.ndarray) -> str:
    """#rrggbb of a colour (3,) uint8."""
    return "#{:02x}{:02x}{:02x}".format(*(int(c) for c in colour))


def _table(points: np.ndarray) -> np.ndarray:
    t = np.linspace(0, 1, 256)
    at = np.linspace(0, 1, len(points))
    lab = np.stack([np.interp(t, at, points[:, k]) for k in range(3)], axis=1)
    lab[:, 0] = np.interp(t, [0, 1], points[[0, -1], 0])
    return np.round(255 * srgb_encode(_rgb_of(lab))).astype(np.uint8)


def _rgb_of(lab: np.ndarray) -> np.ndarray:
    """Linear sRGB of CIELAB relative to D65, CIE 015:2018 eq. 8.11-8.16."""
    fy = (lab[:, 0] + 16) / 116
    f = np.stack([fy + lab[:, 1] / 500, fy, fy - lab[:, 2] / 200], axis=1)
    limit = 6 / 29
    white = np.linalg.solve(srgb_matrix(), np.ones(3))
    xyz = np.where(f > limit, f**3, 3 * limit**2 * (f - 4 / 29)) * white
    return xyz @ srgb_matrix().T
