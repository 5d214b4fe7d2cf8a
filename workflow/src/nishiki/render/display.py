"""Convert linear light for display, for all renderers, and write files: OpenEXR, PNG and moving pictures.

Every file carries the stamp that the caller gives (scene, stage, key, project version) and is written under another
name first, then renamed. EXR and PNG bytes depend on the values alone: no date, no host.
"""

import os
import struct
import zlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import reduce
from pathlib import Path

import numpy as np

from nishiki.colour.colour import decode, srgb_encode, xyz_to_srgb_linear
from nishiki.errors import UserError
from nishiki.formats.banded_pictures import ExrWriter, png_bytes
from nishiki.installation import install_command

_LUMINANCE = np.array([0.2126, 0.7152, 0.0722], np.float32)  # of linear sRGB, IEC 61966-2-1
ADAPTED_PERCENTILE, ADAPTED_LEVEL, ADAPTED_BOUNDS = 98, 0.8, (0.5, 8.0)


@dataclass(frozen=True)
class DisplayImage:
    """A picture for display, and the losses of its 8 bits."""

    pixels: np.ndarray  # (rows, columns, 3) uint8 sRGB
    clipped_high: float  # share of pixels with a channel above 1 before coding
    clipped_low: float  # share of pixels with a channel below 0


def display_image(xyz: np.ndarray, *, white: np.ndarray | None = None, exposure: float = 1.0) -> DisplayImage:
    """Convert linear XYZ (rows, columns, 3) to 8-bit sRGB.

    A perfect white of Y = 1 gets 255 at exposure 1.  white: XYZ (3,) of the scene's white, which Bradford adaptation
    turns into the display's (as the eye adapts to lamp light); None shows the colours as a D65 display measures them.
    """
    if not (np.isfinite(exposure) and exposure > 0):
        raise UserError(f"exposure: expected a finite factor above 0, found {exposure!r}")
    return encode_display(xyz_to_srgb_linear(np.asarray(xyz, np.float32) * np.float32(exposure), white=white))


def encode_display(linear: np.ndarray) -> DisplayImage:
    """Encode linear sRGB (rows, columns, 3) in 8 bits."""
    # half a step of the coding is not clipping: a perfect white is 1 to within rounding; `any` is ten times slower
    high, low = (np.count_nonzero(reduce(np.logical_or, each.T)) for each in (linear > 1.0 + 1e-3, linear < -1e-3))
    size = max(1, linear[..., 0].size)
    return DisplayImage(np.floor(srgb_encode(linear) * 255 + 0.5).astype(np.uint8), high / size, low / size)


def three_channels(linear: np.ndarray) -> np.ndarray:
    """Convert to (..., 3): three channels are taken as linear sRGB, a guess about the camera; other numbers as grey."""
    if linear.shape[-1] == 3:
        return linear
    return np.repeat(linear.mean(axis=-1, keepdims=True), 3, axis=-1)


def develop(
    linear: np.ndarray, coverage: np.ndarray, *, exposure: float = 1.0, soft: bool = False, background: float = 0.0
) -> DisplayImage:
    """Compose an 8-bit picture over an even background.

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
    beyond = reduce(np.logical_or, (values > (1.0 + 1e-3) * coverage[..., None]).T).T & seen
    high = np.count_nonzero(beyond) / max(1, np.count_nonzero(seen))
    behind = np.float32(decode(np.asarray(background, np.float64), "srgb"))
    image = encode_display((shoulder(values) if soft else values) + behind * (1 - coverage[..., None]))
    return DisplayImage(image.pixels, high, image.clipped_low)


def exposure_for(parts: list[tuple[np.ndarray, float]]) -> float:
    """Choose one factor at which no part (linear sRGB (n, 3), level of its 98th percentile) is too bright."""
    tops = [np.percentile(linear @ _LUMINANCE, ADAPTED_PERCENTILE) / level for linear, level in parts if len(linear)]
    top = float(max(tops, default=0.0))
    return 1 / top if top > 0 else 1.0


def shoulder(linear: np.ndarray, *, start: float = 0.6) -> np.ndarray:
    """Compress linear sRGB (..., 3) with luminances above `start` so that they reach 1 only at infinity.

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
    """Compute the exposure at which an eye adapted to the light would see a picture.

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
    """Encode unit normals as (rows, columns, 3) uint16, OpenGL convention: (n + 1) / 2, x right, y up, z outwards.

    A missing normal (zero or not finite) is (0, 0, 0), which no unit normal maps to.
    """
    values = np.asarray(normals, np.float64)
    with np.errstate(invalid="ignore", over="ignore"):
        known = np.abs(np.sum(values * values, axis=2) - 1) < 0.02
        coded = np.floor((np.clip(values, -1, 1) + 1) / 2 * 65535 + 0.5)
    return np.where(known[..., None], coded, 0).astype(np.uint16)


# red, green, blue, white: x, y of each.  XYZ itself is an RGB space whose primaries are the corners of the diagram.
_CHROMATICITIES = {
    "xyz": (1.0, 0.0, 0.0, 1.0, 0.0, 0.0, 1 / 3, 1 / 3),
    "srgb": (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290),
}
_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"


def write_exr(
    path: Path,
    linear: np.ndarray,
    *,
    stamp: Mapping[str, str],
    colours: str = "xyz",
    coverage: np.ndarray | None = None,
) -> None:
    """Write a linear picture (rows, columns, 3), XYZ or linear sRGB (= Rec. 709), as R, G, B with chromaticities.

    The value 1 is the white reference, stated as 100 cd/m^2, which is no measurement. coverage becomes alpha.
    """
    if colours not in _CHROMATICITIES:
        raise UserError(f"EXR colours: expected xyz or srgb, found {colours!r}; choose one of the two")
    values = linear if coverage is None else np.concatenate([linear, coverage[..., None]], axis=-1)
    header = {"chromaticities": _CHROMATICITIES[colours], "whiteLuminance": 100.0}
    _write_exr(path, values, "RGBA"[: values.shape[-1]], stamp, header)


def write_normals_exr(path: Path, normals: np.ndarray, *, stamp: Mapping[str, str]) -> None:
    """Write unit normals (rows, columns, 3) as float32 channels N.X, N.Y, N.Z: x right, y up, z out of the surface."""
    _write_exr(path, normals, ("N.X", "N.Y", "N.Z"), stamp, {})


def _write_exr(path: Path, values: np.ndarray, names: Sequence[str], stamp: Mapping[str, str], header: dict) -> None:
    unfinished = _temporary_path(path)
    attributes = header | {f"nishiki.{name}": str(text) for name, text in stamp.items()}
    with ExrWriter(unfinished, names, values.shape[0], values.shape[1], attributes) as exr:
        exr.write(values)
    os.replace(unfinished, path)


def write_png(path: Path, pixels: np.ndarray, *, stamp: Mapping[str, str], srgb: bool = True) -> None:
    """Write (rows, columns, 3) uint8 or uint16 as PNG; `srgb` marks sRGB-coded colours."""
    if pixels.dtype not in (np.uint8, np.uint16) or pixels.ndim != 3 or pixels.shape[2] != 3:
        raise UserError(f"PNG: expected (rows, columns, 3) uint8 or uint16, found {pixels.shape} {pixels.dtype}")
    _write_bytes(path, _stamped_png(png_bytes(pixels, level=6), stamp, srgb))


def write_normals_png(path: Path, normals: np.ndarray, *, stamp: Mapping[str, str]) -> None:
    """Write normals (rows, columns, 3) as 16-bit PNG, OpenGL convention (y up); missing ones are black."""
    write_png(path, normals_as_colours(normals), stamp=stamp, srgb=False)


def _stamped_png(content: bytes, stamp: Mapping[str, str], srgb: bool) -> bytes:
    """Insert the stamp as text, and a mark of sRGB colours, into a PNG before the image data."""
    end = len(_PNG_SIGNATURE) + 25  # of IHDR, which comes first
    notes = [_chunk(b"sRGB", b"\x00")] if srgb else []  # perceptual intent
    for name, text in stamp.items():
        kind, between = (b"tEXt", b"\x00") if str(text).isascii() else (b"iTXt", b"\x00\x00\x00\x00\x00")
        notes.append(_chunk(kind, f"nishiki.{name}".encode("ascii") + between + str(text).encode("utf-8")))
    return b"".join([content[:end], *notes, content[end:]])


def _chunk(kind: bytes, body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))


@dataclass(frozen=True)
class VideoWritten:
    """Result of writing a sequence."""

    path: Path  # the file that was written: MP4, or an animated PNG where MP4 cannot be encoded
    frames: int
    note: str  # why it is not what was asked for; empty if it is


def write_video(
    path: Path,
    frames: Iterable[np.ndarray],
    *,
    frames_per_second: int = 25,
    stamp: Mapping[str, str],
    quality: int = 18,
) -> VideoWritten:
    """Write frames (rows, columns, 3) uint8 sRGB, all of one size, as MP4 (H.264, 4:2:0) by PyAV.

    One encoding thread and no date: the same frames give the same bytes with the same PyAV.  quality: constant rate
    factor, 0 lossless .. 51.  Without PyAV an animated PNG with the name of `path` and .png is written instead.
    """
    try:
        import av
    except ImportError:
        other = path.with_suffix(".png")
        count = write_animated_png(other, frames, frames_per_second=frames_per_second, stamp=stamp)
        how = install_command(("av",))
        note = f"PyAV is not installed, so an animated PNG was written in place of an MP4. Remedy: {how}"
        return VideoWritten(other, count, note)
    unfinished, count, shape = _temporary_path(path), 0, None
    options = {"fflags": "+bitexact", "movflags": "+faststart"}
    with av.open(str(unfinished), "w", format="mp4", options=options) as container:
        container.metadata["comment"] = "; ".join(f"nishiki.{name}={text}" for name, text in stamp.items())
        for pixels in frames:
            if shape is None:
                shape = pixels.shape
                stream = _h264_stream(container, shape, frames_per_second, quality)
            _check_frame(pixels, shape, count)
            picture = av.VideoFrame.from_ndarray(_yuv420(pixels), format="yuv420p")
            picture.pts = count
            container.mux(stream.encode(picture))
            count += 1
        if shape is None:
            raise UserError(f"{path}: expected at least one frame, found none; give a light or view path with a step")
        container.mux(stream.encode(None))
    os.replace(unfinished, path)
    return VideoWritten(path, count, "")


def write_animated_png(
    path: Path, frames: Iterable[np.ndarray], *, frames_per_second: int = 25, stamp: Mapping[str, str]
) -> int:
    """Write frames (rows, columns, 3) uint8 sRGB, all held at once, as an endless animated PNG; return their number."""
    import cv2

    pictures: list[np.ndarray] = []
    for pixels in frames:
        _check_frame(pixels, pictures[0].shape if pictures else pixels.shape, len(pictures))
        pictures.append(np.ascontiguousarray(pixels[..., ::-1]))
    if not pictures:
        raise UserError(f"{path}: expected at least one frame, found none; give a light or view path with a step")
    animation = cv2.Animation()
    animation.frames, animation.loop_count = pictures, 0
    animation.durations = np.full(len(pictures), round(1000 / frames_per_second))  # ms
    _write_bytes(path, _stamped_png(cv2.imencodeanimation(".png", animation)[1].tobytes(), stamp, srgb=True))
    return len(pictures)


def _check_frame(pixels: np.ndarray, shape: tuple, number: int) -> None:
    if pixels.shape != shape or pixels.dtype != np.uint8:
        raise UserError(f"frame {number}: expected {shape} uint8 like frame 0, found {pixels.shape} {pixels.dtype}")


def _h264_stream(container, shape: tuple, frames_per_second: int, quality: int):
    stream = container.add_stream("libx264", rate=frames_per_second)
    # 4:2:0 needs even sides: odd ones are extended by repeating the last row or column
    stream.height, stream.width = shape[0] + shape[0] % 2, shape[1] + shape[1] % 2
    stream.pix_fmt = "yuv420p"
    # macroblock-tree rate control makes the bytes depend on where in memory the frames lie, for sizes that are no
    # multiple of 16 (measured: two outcomes in eight runs)
    stream.options = {"crf": str(quality), "preset": "medium", "x264-params": "mbtree=0", "flags": "+bitexact"}
    context = stream.codec_context
    context.thread_count = 1
    # ITU-T H.273: primaries and matrix of BT.709, transfer of sRGB, limited range
    context.color_primaries, context.color_trc, context.colorspace, context.color_range = 1, 13, 1, 1
    return stream


def _yuv420(pixels: np.ndarray) -> np.ndarray:
    """Convert to planes Y, U, V of BT.709, limited range, 8 bits, stacked (1.5 rows, columns): yuv420p of PyAV."""
    rows, columns = pixels.shape[:2]
    rgb = np.pad(pixels, ((0, rows % 2), (0, columns % 2), (0, 0)), mode="edge").astype(np.float32) / 255
    luma = rgb @ np.array([0.2126, 0.7152, 0.0722], np.float32)
    blue = (rgb[..., 2] - luma) / 1.8556
    red = (rgb[..., 0] - luma) / 1.5748
    halves = [(c[::2, ::2] + c[1::2, ::2] + c[::2, 1::2] + c[1::2, 1::2]) / 4 for c in (blue, red)]
    planes = [luma * 219 + 16, *(half * 224 + 128 for half in halves)]
    flat = np.concatenate([np.floor(plane + 0.5).clip(0, 255).astype(np.uint8).ravel() for plane in planes])
    return flat.reshape(luma.shape[0] * 3 // 2, luma.shape[1])


def _temporary_path(path: Path) -> Path:
    return path.with_name(f".{path.name}.unfinished{path.suffix}")


def _write_bytes(path: Path, content: bytes) -> None:
    unfinished = _temporary_path(path)
    unfinished.write_bytes(content)
    os.replace(unfinished, path)
