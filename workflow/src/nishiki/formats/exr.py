"""OpenEXR frames: any channel names, any number of channels, half or float."""

from __future__ import annotations

from pathlib import Path
from typing import BinaryIO

import numpy as np

from nishiki.formats.exr_header import read_parts
from nishiki.formats.image_header import ImageHeader

_COLOURS = {"red": ("R", "red"), "green": ("G", "green"), "blue": ("B", "blue"), "grey": ("Y", "L"), "gray": ("Y", "L")}


def exr_header(file: BinaryIO) -> ImageHeader:
    """Header of the first part; ValueError, EOFError or struct.error where the file is damaged.

    The library decodes all parts: those after the first may not be larger than it (views, layers).
    """
    first, *others = read_parts(file)
    if sum(part.stored_bytes for part in others) > 8 * max(first.stored_bytes, 1):
        raise ValueError("the file's further parts are much larger than its first")
    names = tuple(sorted(name for name, _, _ in first.channels))
    alpha = "A" in names and len(names) > 1
    return ImageHeader(
        "exr", first.rows, first.columns, len(names), "float32", alpha, names=names,
        stored_bytes=sum(part.stored_bytes for part in (first, *others)), ratio=first.ratio,
    )  # fmt: skip


def read_exr(path: Path, wanted: tuple[str, ...]) -> np.ndarray:
    """Pixels (rows, columns, channels) float32 in the order of the wanted channel names.

    A wanted name matches a channel of the same name (case apart), or R, G, B for red, green, blue; if none of the
    names match, the file's channels but for alpha are taken in the file's (alphabetical) order, R, G, B first.
    ValueError where the counts differ or a channel is subsampled.
    """
    import OpenEXR

    with OpenEXR.File(str(path), separate_channels=True) as file:
        channels = {name: channel.pixels for name, channel in file.channels().items()}
    order = match_channels(tuple(channels), wanted)
    shapes = {channels[name].shape for name in order}
    if len(shapes) != 1:
        raise ValueError(f"channels of different size {sorted(shapes)}")
    return np.stack([channels[name].astype(np.float32) for name in order], axis=2)


def match_channels(present: tuple[str, ...], wanted: tuple[str, ...]) -> list[str]:
    """Which of the file's channels stand for the wanted ones, in their order."""
    folded = {name.casefold(): name for name in present}
    found = []
    for name in wanted:
        aliases = (name, *_COLOURS.get(name.casefold(), ()))
        found += [folded[alias.casefold()] for alias in aliases if alias.casefold() in folded][:1]
    if len(found) == len(wanted):
        return found
    colour = [name for name in ("R", "G", "B") if name in present]
    rest = sorted(set(present) - set(colour) - {"A"})
    order = colour + rest if len(colour) == 3 else sorted(set(present) - {"A"})
    if len(order) != len(wanted):
        raise ValueError(f"channels {', '.join(present)} do not give {len(wanted)} ({', '.join(wanted)})")
    return order
