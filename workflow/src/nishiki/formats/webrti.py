"""Relightable images as folders of webRTIViewer: `info.xml` and tiles `NODE_LAYER.jpg` (or `.png`).

`info.xml` has the kind (LRGB_PTM, RGB_PTM, HSH_RTI), the size, a scale and a bias a term, and a quadtree over a square
whose side is a power of two, the picture in its middle. A node's tile has one row or column more at each side than
`tile`. Nodes are listed with their boxes (y upwards) in old folders; else node 4 i + 1 + k is the child of node i, k
the quadrant from the top left one in reading order, and files count nodes from 1. The layers of PTM are three terms
each and a colour (LRGB), or a term's red, green and blue; those of HSH are terms, whose scale stands as `Bias` and the
reverse.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from nishiki.formats.files import Refused, expect_bound, expect_memory, read_bytes
from nishiki.formats.hsh import HshFile
from nishiki.formats.images import read_codes
from nishiki.formats.ptm import PtmFile
from nishiki.formats.relight_planes import CHANNELS, LEAST_TILE, copy_plane, within

WEB_INFO = "info.xml"
TILE = re.compile(r"[0-9]{1,9}_[0-9]{1,2}")
PTM_TERMS, MOST_TERMS = 6, 16
REMEDY = "Convert the .ptm or .rti that it was made from, or the photographs"


@dataclass(frozen=True)
class WebRtiFolder:
    """The image that a folder's tiles make up; files: names that were read, relative to the folder."""

    image: PtmFile | HshFile
    files: tuple[str, ...]

    @property
    def layout(self) -> str:
        """What the folder is, for messages."""
        return f"webRTIViewer folder ({self.image.layout})"

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.image.shape

    def shown(self, light: np.ndarray) -> np.ndarray:
        """(rows, columns, 3) float32 from the top, for a unit vector to the lamp; full brightness is 1, not clipped."""
        return self.image.shown(light)


def is_web_rti(folder: Path) -> bool:
    """Whether a folder holds `info.xml` of a picture in tiles."""
    try:
        return b"<MultiRes" in read_bytes(folder / WEB_INFO, "table_bytes")
    except (FileNotFoundError, Refused):
        return False


def open_web_rti(folder: Path) -> WebRtiFolder:
    """Read info.xml and the tiles of the full resolution.

    Refused where the kind is not read, or info.xml contradicts itself; CaptureError where a tile cannot be decoded.
    """
    name = f"{folder.name}/{WEB_INFO}"
    try:
        content = read_bytes(within(folder, WEB_INFO), "table_bytes", name=name)
        if b"<!ENTITY" in content:
            raise ValueError("entities")
        root = ElementTree.fromstring(content)
        kind, size = str(root.find("Content").attrib.get("type")), root.find("Content/Size").attrib  # type: ignore[union-attr]
        rows, columns, terms = (int(size[key]) for key in ("height", "width", "coefficients"))
        layers = {"LRGB_PTM": 3, "RGB_PTM": PTM_TERMS, "HSH_RTI": terms}.get(kind, 0)
        if not layers or (terms != PTM_TERMS if "PTM" in kind else terms not in (1, 4, 9, MOST_TERMS)):
            expected, found = "LRGB_PTM or RGB_PTM of 6 terms, HSH_RTI of 1, 4, 9 or 16", f"{kind} of {terms}"
            raise Refused(name, "a kind of picture that is not read", expected=expected, found=found, remedy=REMEDY)
        scale, bias = (_numbers(root.findtext(f"Content/{key}"), terms) for key in ("Scale", "Bias"))
        expect_bound(max(rows, columns), "image_side", name)
        expect_bound(rows * columns, "image_pixels", name)
        tile, places = _places(root.findtext("Tree") or "", rows, columns)
    except (ValueError, KeyError, AttributeError, IndexError, ElementTree.ParseError) as e:
        raise Refused(name, "not a picture of webRTIViewer", found=str(e)[:80], remedy=REMEDY) from None
    expect_memory(3 * rows * columns * layers, name)
    codes = np.empty((rows, columns, 3 * layers), np.uint8)
    suffix, files = "png" if root.get("format") == "1" else "jpg", [WEB_INFO]
    for node, top, left in places:
        for layer in range(layers):
            part = f"{node}_{layer + 1}.{suffix}"
            stored = read_codes(within(folder, part), CHANNELS, name=f"{folder.name}/{part}")
            margin = max(stored.shape[0] - tile, 0) // 2
            window = codes[max(top, 0) : max(top + tile, 0), max(left, 0) : max(left + tile, 0)]
            before = (margin + max(-top, 0), margin + max(-left, 0))
            copy_plane(stored, window[..., 3 * layer : 3 * layer + 3], before, f"{folder.name}/{part}")
            files.append(part)
    return WebRtiFolder(_image(kind, codes, scale, bias), tuple(files))


def _image(kind: str, codes: np.ndarray, scale: np.ndarray, bias: np.ndarray) -> PtmFile | HshFile:
    """The image of its layers (rows, columns, 3 a layer)."""
    if kind == "LRGB_PTM":
        return PtmFile(kind, codes[None, ::-1, :, :PTM_TERMS], codes[::-1, :, PTM_TERMS:], scale, bias)
    terms = np.moveaxis(codes.reshape(*codes.shape[:2], len(scale), 3), 3, 2)
    if kind == "HSH_RTI":
        return HshFile(terms, bias, scale)
    return PtmFile(kind, np.moveaxis(terms, 2, 0)[:, ::-1], None, scale, bias)


def _numbers(text: str | None, count: int) -> np.ndarray:
    values = np.array([float(word) for word in (text or "").split()])
    if len(values) != count or not (np.abs(values) < 1e6).all():
        raise ValueError(f"{len(values)} scales or biases")
    return values


def _places(tree: str, rows: int, columns: int) -> tuple[int, list[tuple[int, int, int]]]:
    """Side of the tiles; node, row and column in the picture of each tile of the full resolution that shows some."""
    lines = [line.split() for line in tree.strip().splitlines()]
    tile, side = int(lines[1][0]), int(lines[2][0])
    if (
        not LEAST_TILE <= tile <= side < 2 * max(rows, columns, tile)
        or side % tile
        or (side // tile) & (side // tile - 1)
    ):
        raise ValueError(f"tiles of {tile} in {side}")
    above, before = (side - rows) // 2, (side - columns) // 2

    def showing(nodes: list[tuple[int, int, int]], size: int) -> list[tuple[int, int, int]]:
        return [(n, y, x) for n, y, x in nodes if -size < y - above < rows and -size < x - before < columns]

    if len(lines) > 4:  # number, parent, children, side, shown, lowest and highest corner of the box
        leaves = [cells for cells in lines[4:] if set(cells[2:6]) == {"-1"}]
        boxes = [(int(cells[0]), 1 - float(cells[12]), float(cells[8])) for cells in leaves]
        nodes = [(node, round(top * side), round(left * side)) for node, top, left in boxes]
    else:
        nodes = [(0, 0, 0)]
        for half in (side >> level for level in range(1, (side // tile).bit_length())):
            quadrants = [(k, half * (k >> 1), half * (k & 1)) for k in range(4)]
            nodes = [(4 * node + 1 + k, y + down, x + right) for node, y, x in nodes for k, down, right in quadrants]
            nodes = showing(nodes, half)
        nodes = [(node + 1, top, left) for node, top, left in nodes]
    places = [(node, top - above, left - before) for node, top, left in showing(nodes, tile)]
    shown = [(min(y + tile, rows) - max(y, 0)) * (min(x + tile, columns) - max(x, 0)) for _, y, x in places]
    if sum(shown) != rows * columns:
        raise ValueError("tiles that do not cover the picture")
    return tile, places
