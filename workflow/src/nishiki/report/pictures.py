"""Encode pictures for a page: maps and photographs reduced, coloured by perceptually even scales."""

import base64
from dataclasses import dataclass

import numpy as np

from nishiki.artifacts.maps import shrink
from nishiki.colour.colour import decode, srgb_encode
from nishiki.formats.banded_pictures import jpeg_bytes, png_bytes
from nishiki.report.svg import plain

# Control points in CIELAB (D65): hue and chroma only steer; lightness is replaced by an even ramp.
_HEAT = np.array([[8, 12, -18], [28, 26, -40], [46, 42, -16], [62, 44, 22], [80, 14, 58], [97, -6, 34]], float)
_SEA = np.array([[14, 4, -22], [34, -4, -30], [52, -16, -18], [70, -26, 6], [86, -16, 38], [97, -6, 24]], float)
_BALANCE = np.array([[36, 14, -46], [95, 0, 1], [38, 50, 34]], float)
MISSING = np.array([226, 226, 222], np.uint8)
"""Colour of pixels without a value."""


def heat() -> np.ndarray:
    """Return (256, 3) uint8, dark to light: for errors, light meaning large."""
    return _table(_HEAT)


def sea() -> np.ndarray:
    """Return (256, 3) uint8, dark to light: for counts and measures other than errors."""
    return _table(_SEA)


def balance() -> np.ndarray:
    """Return (256, 3) uint8, blue over a light grey to red: for signed errors, the middle meaning none."""
    return _table(_BALANCE, even=False)


def colour_map(values: np.ndarray, table: np.ndarray, low: float, high: float) -> np.ndarray:
    """Colour values (rows, columns) as (rows, columns, 3) uint8; below low and above high the ends; NaN: `MISSING`."""
    span = high - low if high > low else 1.0
    known = np.isfinite(values)
    places = np.clip((np.where(known, values, low) - low) / span * 255.0 + 0.5, 0, 255).astype(np.uint8)
    picture = table[places]
    picture[~known] = MISSING
    return picture


def hexadecimal(colour: np.ndarray) -> str:
    """Return #rrggbb of a colour (3,) uint8."""
    return "#{:02x}{:02x}{:02x}".format(*(int(c) for c in colour))


def _table(points: np.ndarray, *, even: bool = True) -> np.ndarray:
    """Compute sRGB codes (256, 3) of a line through CIELAB colours (n, 3); even: in lightness."""
    import cv2

    t = np.linspace(0, 1, 256)
    lab = np.stack([np.interp(t, np.linspace(0, 1, len(points)), column) for column in points.T], axis=1)
    if even:
        lab[:, 0] = np.linspace(*points[[0, -1], 0], 256)
    return np.asarray(np.round(255 * cv2.cvtColor(np.float32(lab[None]), cv2.COLOR_LAB2RGB)[0]), np.uint8)


@dataclass(frozen=True)
class Scale:
    """Colour bar under a map: labels of its ends and its colours from left to right."""

    low: str
    high: str
    unit: str
    stops: tuple[str, ...]


@dataclass(frozen=True)
class PagePicture:
    """A picture inside the page.

    `source` is a data URI; columns, rows its size; scale its colour bar, or None; key: (colour, meaning) of a map of
    classes; marks: (x, y, text), numbered places in pixels of the picture.
    """

    source: str
    columns: int
    rows: int
    scale: Scale | None = None
    key: tuple[tuple[str, str], ...] = ()
    marks: tuple[tuple[float, float, str], ...] = ()


RULER_SHARE = 0.3
"""Longest scale bar, as a share of the width of the picture."""


@dataclass(frozen=True)
class Ruler:
    """Scale bar of a picture that shows the whole width of the maps."""

    percent: float
    label: str


def ruler(columns: int, pitch_mm: float | None) -> Ruler | None:
    """Choose the longest scale bar of 1, 2 or 5 times a power of ten for maps of this width; None without a pitch."""
    if not pitch_mm:
        return None
    longest = RULER_SHARE * columns * pitch_mm
    power = 10.0 ** np.floor(np.log10(longest))
    length = max(power * step for step in (1, 2, 5) if power * step <= longest * (1 + 1e-9))
    units = (("m", 1e-3), ("mm", 1.0), ("µm", 1e3))
    unit, factor = next(((name, each) for name, each in units if length * each >= 1), units[-1])
    return Ruler(float(100 * length / (columns * pitch_mm)), f"{plain(length * factor)} {unit}")


def block_of(columns: int, widest: int) -> int:
    """Compute the side of the square blocks whose means make a picture at most `widest` pixels wide."""
    return max(1, -(-columns // widest))


def colour_picture(linear: np.ndarray, *, inside: np.ndarray | None = None) -> PagePicture:
    """Encode linear sRGB (rows, columns, 3), white at 1; NaN and pixels outside in the colour of missing values."""
    codes = np.round(255 * srgb_encode(linear)).astype(np.uint8)
    codes[~np.isfinite(linear).all(axis=-1)] = MISSING
    if inside is not None:
        codes[~inside] = MISSING
    return encode_picture(codes)


def brightening(linear: np.ndarray) -> float:
    """Compute the factor, 1 or a round number, that brings the light parts of a dark picture (..., 3) to a good level.

    1 where the 99.5th percentile of green is at least 0.5. A picture so shown must say so.
    """
    green = linear[..., 1]
    green = green[np.isfinite(green)]
    top = float(np.percentile(green, 99.5)) if green.size else 1.0
    if not 0 < top < 0.5:
        return 1.0
    factor = 0.85 / top
    power = 10.0 ** np.floor(np.log10(factor))
    return float(max(power * step for step in (1, 1.5, 2, 3, 5, 7) if power * step <= factor))


def describe_brightening(factor: float) -> str:
    """Describe the brightening for a caption."""
    return "" if factor == 1 else f" Shown {factor:g} times brighter than it is."


def scalar_picture(values: np.ndarray, table: np.ndarray, *, unit: str, low=None, high=None, digits=2) -> PagePicture:
    """Encode one quantity; ends of the scale: given, else the 1st and 99th percentile of the known values."""
    known = values[np.isfinite(values)]
    low = float(np.percentile(known, 1)) if low is None and known.size else float(low or 0.0)
    high = float(np.percentile(known, 99)) if high is None and known.size else float(high or 1.0)
    if not high > low:
        high = low + 1.0
    stops = tuple(hexadecimal(colour) for colour in table[:: 255 // 5])
    scale = Scale(plain(low, digits), plain(high, digits), unit, stops)
    return encode_picture(colour_map(values, table, low, high), scale=scale)


def class_picture(classes: np.ndarray, key: dict[int, tuple[str, str]]) -> PagePicture:
    """Encode classes (rows, columns); key: class -> (#rrggbb, meaning); other values in the colour of missing."""
    codes = np.empty((*classes.shape, 3), np.uint8)
    codes[...] = MISSING
    for value, (colour, _) in key.items():
        codes[classes == value] = [int(colour[k : k + 2], 16) for k in (1, 3, 5)]
    return encode_picture(codes, lossless=True, key=tuple(key.values()))


def normal_picture(normals: np.ndarray) -> PagePicture:
    """Colour normals in the OpenGL convention: red x, green y (up), blue z, from -1..1 to 0..255."""
    with np.errstate(invalid="ignore", divide="ignore"):
        unit = normals / np.linalg.norm(normals, axis=-1, keepdims=True)
    codes = np.round(np.clip(np.nan_to_num(unit) * 127.5 + 127.5, 0, 255)).astype(np.uint8)
    codes[~np.isfinite(unit).all(axis=-1)] = MISSING
    return encode_picture(codes)


def hillshade(height: np.ndarray, *, step: float) -> np.ndarray:
    """Shade the relief (rows, columns) under a lamp from the upper left at 35 degrees, linear 0..1; NaN stays NaN.

    step : distance of the pixels in the unit of the height. Slopes are scaled so that their 95th percentile is 0.7: a
    relief is to be seen, not measured, here.
    """
    if min(height.shape) < 2:
        return np.where(np.isfinite(height), 0.5, np.nan)
    down, right = np.gradient(height, step)
    steep = np.hypot(down, right)
    typical = np.nanpercentile(steep, 95) if np.isfinite(steep).any() else 0.0
    gain = 0.7 / typical if typical > 0 else 0.0
    p, q = right * gain, -down * gain
    lamp = np.array([-0.58, 0.58, 0.57])
    shade = (-p * lamp[0] - q * lamp[1] + lamp[2]) / np.sqrt(1 + p * p + q * q)
    return np.clip(shade, 0, 1) ** 1.4


JPEG_QUALITY = 90


def encode_picture(codes: np.ndarray, *, lossless: bool = False, scale: Scale | None = None, key=()) -> PagePicture:
    """Encode a picture (rows, columns, 3) uint8 sRGB as data URI: JPEG, or PNG."""
    mime = "image/png" if lossless else "image/jpeg"
    coded = png_bytes(codes, level=9) if lossless else jpeg_bytes(codes, JPEG_QUALITY, halved=True)
    data = base64.b64encode(coded).decode("ascii")
    source = f"data:{mime};base64,{data}"
    return PagePicture(source, codes.shape[1], codes.shape[0], scale, key)


def file_picture(data: bytes, widest: int) -> PagePicture:
    """Reduce a PNG to at most `widest` pixels across, averaged in linear light. Raises ValueError for other files."""
    return encode_picture(_shrunk(data, widest))


def bright_picture(data: bytes, widest: int) -> tuple[PagePicture, str]:
    """Reduce a PNG as `file_picture` does, brightened if it is dark; also return a caption on that."""
    linear = decode(_shrunk(data, widest) / np.float32(255), "srgb")
    factor = brightening(linear)
    return colour_picture(linear * factor), describe_brightening(factor).strip()


def file_jpeg(data: bytes, widest: int) -> bytes:
    """Return a PNG as the bytes of a JPEG at most `widest` pixels wide, averaged in linear light."""
    return jpeg_bytes(_shrunk(data, widest), JPEG_QUALITY, halved=True)


def _shrunk(data: bytes, widest: int) -> np.ndarray:
    """Decode a PNG as (rows, columns, 3) uint8 sRGB, at most `widest` columns. Raises ValueError for other files."""
    import cv2

    codes = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    if codes is None:
        raise ValueError("not a picture")
    block = block_of(codes.shape[1], widest)
    if block == 1:
        return codes[..., ::-1]
    linear = decode(codes[..., ::-1] / np.float32(255), "srgb")
    small = shrink(lambda rows: linear[rows], codes.shape[:2], block)
    return np.round(255 * srgb_encode(small)).astype(np.uint8)
