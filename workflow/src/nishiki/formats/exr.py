"""OpenEXR frames: any channel names, any number of channels, half or float."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from nishiki.formats.image_header import ImageHeader

_COLOURS = {"red": ("R", "red"), "green": ("G", "green"), "blue": ("B", "blue"), "grey": ("Y", "L"), "gray": ("Y", "L")}


_RATIO = {"NO_COMPRESSION": 1, "RLE_COMPRESSION": 130, "ZIPS_COMPRESSION": 1040, "ZIP_COMPRESSION": 1040}
"""How many times smaller than its pixels a coded part can be; other compressions have no bound."""
_LEAST_SAMPLE = 2  # bytes; a header tells no types of its channels


def exr_header(path: Path) -> ImageHeader:
    """Header of the first part; ValueError or RuntimeError where the file is damaged or has several samples a pixel.

    The library decodes all parts: those after the first may not be larger than it (views, layers).
    """
    import OpenEXR

    with OpenEXR.File(str(path), header_only=True) as file:
        headers = [dict(part.header) for part in file.parts]
    if any(header["type"] in (OpenEXR.deepscanline, OpenEXR.deeptile) for header in headers):
        raise ValueError("deep images (several samples a pixel) are not read")
    shapes, samples = [], []
    for header in headers:
        first, last = header["dataWindow"]
        columns, rows = (int(n) for n in last.astype(np.int64) - first + 1)
        shapes.append((rows, columns))
        samples.append(rows * columns * sum(c.xSampling == c.ySampling == 1 for c in header["channels"]))
    if sum(samples[1:]) > 8 * max(samples[0], 1):
        raise ValueError("the file's further parts are much larger than its first")
    names = tuple(sorted(channel.name for channel in headers[0]["channels"]))
    return ImageHeader(
        "exr", *shapes[0], len(names), "float32", "A" in names and len(names) > 1, names=names,
        stored_bytes=_LEAST_SAMPLE * sum(samples), ratio=_RATIO.get(headers[0]["compression"].name, 0),
    )  # fmt: skip


def read_exr(path: Path, names: tuple[str, ...]) -> np.ndarray:
    """Pixels (rows, columns, channels) float32 in the order of the wanted channel names.

    A wanted name matches a channel of the same name (case apart), or R, G, B for red, green, blue; if none of the
    names match, the file's channels but for alpha are taken in the file's (alphabetical) order, R, G, B first.
    ValueError where the counts differ or a channel is subsampled.
    """
    import OpenEXR

    with OpenEXR.File(str(path), separate_channels=True) as file:
        channels = {name: channel.pixels for name, channel in file.channels().items()}
    order = match_channels(tuple(channels), names)
    shapes = {channels[name].shape for name in order}
    if len(shapes) != 1:
        raise ValueError(f"channels of different size {sorted(shapes)}")
    return np.stack([channels[name].astype(np.float32) for name in order], axis=2)


def match_channels(present: tuple[str, ...], names: tuple[str, ...]) -> list[str]:
    """Which of the file's channels stand for the wanted ones, in their order."""
    folded = {name.casefold(): name for name in present}
    matched = []
    for name in names:
        aliases = (name, *_COLOURS.get(name.casefold(), ()))
        matched += [folded[alias.casefold()] for alias in aliases if alias.casefold() in folded][:1]
    if len(matched) == len(names):
        return matched
    colour = [name for name in ("R", "G", "B") if name in present]
    rest = sorted(set(present) - set(colour) - {"A"})
    order = colour + rest if len(colour) == 3 else sorted(set(present) - {"A"})
    if len(order) != len(names):
        raise ValueError(f"channels {', '.join(present)} do not give {len(names)} ({', '.join(names)})")
    return order
