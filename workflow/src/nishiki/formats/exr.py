"""OpenEXR frames: the light channels of one layer, placed in the display window; half or float.

A channel is called LAYER.NAME (OpenEXR Technical Introduction); alpha, depth and identifiers are no light.
"""

import struct
from dataclasses import dataclass
from typing import Any, BinaryIO

import numpy as np

from nishiki.formats.coding import D65, LINEAR, Coding, Matrix, primaries_xyz
from nishiki.formats.exif import Exif, positive_number
from nishiki.formats.picture_files import ImageHeader, Output, Picture, Wanted, unsupported

_COLOURS = {"red": ("R", "red"), "green": ("G", "green"), "blue": ("B", "blue"), "grey": ("Y", "L"), "gray": ("Y", "L")}
_NO_LIGHT = frozenset("a alpha z zback zf depth depth.z id mask ar ag ab ra ga ba".split())
_BEAUTY = ("", "combined", "beauty", "rgba", "rgb", "composite", "default", "main")
"""Last word of the layer that holds the whole light, in order of preference; '' has no layer."""
_RATIO = {"NO_COMPRESSION": 1, "RLE_COMPRESSION": 130, "ZIPS_COMPRESSION": 1040, "ZIP_COMPRESSION": 1040}
"""How many times smaller than its pixels a coded part can be; other compressions have no bound."""


@dataclass(frozen=True)
class _Channel:
    """A channel of light: number of its part, name in it, name of its layer, and its own name without that."""

    part: int
    stored: str
    layer: str
    base: str


def open_exr(file: BinaryIO, name: str) -> Picture:
    """Open the picture of an EXR: of the layer that holds all light, else of the only one, else every layer's channels.

    Channels of several layers, none of them the whole light, have the names of their layers; `match_channels` takes
    those that are wanted. ValueError or RuntimeError where the file is damaged.
    """
    import OpenEXR

    path = f"/dev/fd/{file.fileno()}"
    with OpenEXR.File(path, header_only=True) as opened:
        headers = [dict(part.header) for part in opened.parts]
    if any(header["type"] in (OpenEXR.deepscanline, OpenEXR.deeptile) for header in headers):
        raise ValueError("deep images (several samples a pixel) are not read")
    windows = [_window(header["dataWindow"]) for header in headers]
    present = [channel for part, header in enumerate(headers) for channel in _channels(header, part)]
    light = [channel for channel in present if channel.base.casefold() not in _NO_LIGHT]
    channels = _light(light or [channel for channel in present if channel.base == "A"])  # a mask may be alpha alone
    layers = {(channel.part, channel.layer) for channel in channels}
    alpha = [
        channel for channel in present if light and channel.base == "A" and layers == {(channel.part, channel.layer)}
    ]
    if not channels:
        raise unsupported(name, "chroma sub-sampled or no channels of light", "Save it with channels R, G and B")
    window = _window(headers[0]["displayWindow"] if "displayWindow" in headers[0] else headers[0]["dataWindow"])
    stored = [window[2] * window[3] * len(each["channels"]) for window, each in zip(windows, headers, strict=True)]
    if sum(stored[1:]) > 8 * max(stored[0], 1):
        raise ValueError("the file's further parts are much larger than its first")
    coding = Coding("linear, OpenEXR", LINEAR, _primaries(headers[0].get("chromaticities")))
    exposure, aperture, speed = (positive_number(headers[0].get(key)) for key in ("expTime", "aperture", "isoSpeed"))
    names = tuple(channel.base for channel in channels)
    if names not in (("R", "G", "B"), ("Y",)):
        names = tuple(".".join(filter(None, (channel.layer, channel.base))) for channel in channels)
    # half floats at least: a header tells no types of its channels
    header = ImageHeader(
        "exr", window[2], window[3], len(channels) + len(alpha), "float32", bool(alpha), names=names,
        stored_bytes=2 * sum(stored), ratio=_RATIO.get(headers[0]["compression"].name, 0), coding=coding,
        exif=Exif(exposure, aperture, speed),
    )  # fmt: skip

    def decode(wanted: Wanted, output: Output) -> np.ndarray:
        stored = {channel.stored.casefold(): channel for channel in channels}
        order = [stored[name.casefold()] for name in wanted.channels if name.casefold() in stored]
        if len(order) != len(wanted.channels):
            order = [channels[header.names.index(name)] for name in match_channels(header.names, wanted.channels)]
        out = output((header.rows, header.columns, len(order) + len(alpha)), "float32")
        out[...] = 0
        with OpenEXR.File(path, separate_channels=True) as opened:
            for place, channel in enumerate([*order, *alpha]):
                values = opened.channels(channel.part)[channel.stored].pixels
                data = windows[channel.part]
                top, left = data[0] - window[0], data[1] - window[1]
                rows = slice(max(top, 0), max(min(top + data[2], header.rows), 0))
                columns = slice(max(left, 0), max(min(left + data[3], header.columns), 0))
                part = values[rows.start - top : rows.stop - top, columns.start - left : columns.stop - left]
                out[rows, columns, place] = part  # what lies in the display window
        return out

    return Picture(header, decode)


def match_channels(present: tuple[str, ...], names: tuple[str, ...]) -> list[str]:
    """Which of a file's channels of light stand for the wanted ones, in their order.

    A wanted name matches a channel of the same name (capitals apart), or R, G, B for red, green, blue; where they do
    not match, all channels are taken in the file's order. ValueError where the counts differ.
    """
    folded = {name.casefold(): name for name in present}
    matched = []
    for name in names:
        aliases = (name, *_COLOURS.get(name.casefold(), ()))
        matched += [folded[alias.casefold()] for alias in aliases if alias.casefold() in folded][:1]
    if len(matched) == len(names):
        return matched
    if len(present) != len(names) or several_layers(present):
        raise ValueError(f"channels {', '.join(present)} do not give {len(names)} ({', '.join(names)})")
    return list(present)


def several_layers(names: tuple[str, ...]) -> bool:
    """Whether channels belong to different layers, so that somebody has to choose."""
    return len({name.rpartition(".")[0] for name in names}) > 1


def _channels(header: dict[str, Any], part: int) -> list[_Channel]:
    """List a part's channels of full resolution, its own name before those of its layers where it has one."""
    found, name = [], str(header.get("name", ""))
    name = "" if name.casefold() in _BEAUTY else name
    for channel in header["channels"]:
        layer, _, base = channel.name.rpartition(".")
        full = channel.xSampling == channel.ySampling == 1
        if full and base.casefold() not in ("ry", "by"):
            found.append(_Channel(part, channel.name, ".".join(filter(None, (name, layer))), base))
    return found


def _light(found: list[_Channel]) -> list[_Channel]:
    """Channels of the layer that is taken, red, green and blue first; of all layers where none stands out."""
    layers: dict[str, list[_Channel]] = {}
    for channel in found:
        layers.setdefault(channel.layer, []).append(channel)

    def rank(layer: str) -> int:
        last = layer.rpartition(".")[2].casefold()
        return _BEAUTY.index(last) if last in _BEAUTY else len(_BEAUTY)

    best = sorted(layers, key=rank)[:1]
    first = [layer for layer in layers if rank(layer) == rank(best[0])] if best else []
    chosen = layers[best[0]] if len(first) == 1 else [channel for layer in first for channel in layers[layer]]
    order = {"R": 0, "G": 1, "B": 2}
    return sorted(chosen, key=lambda c: (c.layer, order.get(c.base, 3), c.base))


def _window(corners: tuple[np.ndarray, np.ndarray]) -> tuple[int, int, int, int]:
    """Row, column, rows, columns of a window between two corners (x, y), both inclusive."""
    (left, top), (right, bottom) = (tuple(int(n) for n in corner) for corner in corners)
    return top, left, bottom - top + 1, right - left + 1


def _primaries(corners: Any) -> Matrix | None:
    """(3, 3) to XYZ of the attribute `chromaticities`: red, green, blue, white, x and y each."""
    if corners is None:
        return None
    try:
        xy = np.asarray(corners, float).reshape(4, 2)
    except (TypeError, ValueError, struct.error):
        return None
    pairs = tuple((float(x), float(y)) for x, y in xy)
    return primaries_xyz(pairs[:3], pairs[3] if pairs[3][1] > 0 else D65) if (xy[:, 1] != 0).all() else None
