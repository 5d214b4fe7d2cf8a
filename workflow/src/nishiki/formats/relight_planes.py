"""Read planes of a relightable image in a folder.

They are `plane_N.jpg`, a deep zoom, its tiles in one file (OpenLIME's tarzoom), or the tiles of webRTIViewer.

A `.tzi` is JSON: size, side of the tiles, levels, and where each tile begins in the `.tzb` of the same name. Tiles
follow each other by level, the smallest first, and row by row; `planes.tzi` (itarzoom) has the tiles of all planes of
one place one after the other, `stride` of them.

Folders of webRTIViewer hold `info.xml` and tiles `NODE_LAYER.jpg` (or `.png`). `info.xml` has the kind (LRGB_PTM,
RGB_PTM, HSH_RTI), the size, a scale and a bias a term, and a quadtree over a square whose side is a power of two, the
picture in its middle. A node's tile has one row or column more at each side than `tile`. Nodes are listed with their
boxes (y upwards) in old folders; else node 4 i + 1 + k is the child of node i, k the quadrant from the top left one in
reading order, and files count nodes from 1. The layers of PTM are three terms each and a colour (LRGB), or a term's
red, green and blue; those of HSH are terms, whose scale stands as `Bias` and the reverse.
"""

import json
import re
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from nishiki.formats.coding import RGB
from nishiki.formats.files import Refused, expect_bound, expect_memory, leads_out, open_regular, read_bytes, read_text
from nishiki.formats.images import read_codes
from nishiki.formats.legacy_rti import HshFile, PtmFile, decode_stream

ALL_PLANES = "planes.tzi"
LEAST_TILE = 16  # pixels
REMEDY = "Fit it again with relight as ptm, hsh, rbf or bilinear, or convert the photographs"


def within(folder: Path, name: str) -> Path:
    """Return the path of a file of the folder. Refused where it is a link elsewhere."""
    if leads_out(folder / name, folder):
        raise Refused(f"{folder.name}/{name}", "a link that leads out of the folder", remedy="Copy the file into it")
    return folder / name


def read_plane(folder: Path, number: int, out: np.ndarray) -> list[str]:
    """Fill (rows, columns, 3) from a picture or its tiles of full resolution; return names of the files read.

    Refused; CaptureError where a picture cannot be decoded.
    """
    name = f"plane_{number}"
    if (folder / f"{name}.jpg").is_file():
        _fill(folder, f"{name}.jpg", out)
        return [f"{name}.jpg"]
    if (folder / f"{name}.tzi").is_file() and not (folder / f"{name}.dzi").is_file():
        return _read_joined_tiles(folder, f"{name}.tzi", 0, out)
    if (folder / ALL_PLANES).is_file() and not (folder / f"{name}.dzi").is_file():
        return _read_joined_tiles(folder, ALL_PLANES, number, out)
    return _read_deep_zoom(folder, name, out)


def _read_deep_zoom(folder: Path, name: str, out: np.ndarray) -> list[str]:
    (rows, columns), with_tiles = out.shape[:2], f"{name}.dzi"
    about = f"{folder.name}/{with_tiles}"
    try:
        text = read_text(within(folder, with_tiles), "settings_bytes", name=about)
    except FileNotFoundError:
        raise Refused(about, "neither this nor a .jpg is there", remedy=REMEDY) from None
    except UnicodeDecodeError:
        raise Refused(about, "not UTF-8 text", remedy=REMEDY) from None
    found = dict(re.findall(r'\b(TileSize|Overlap|Format)="(\w{1,9})"', text, re.ASCII))
    sides = dict(re.findall(r'\b(Width|Height)="(\d{1,9})"', "".join(re.findall(r"<Size\b[^>]*>", text)), re.ASCII))
    levels = [path.name for path in (folder / f"{name}_files").glob("*") if re.fullmatch("[0-9]+", path.name)]
    if len(found) < 3 or len(sides) < 2 or not levels:
        raise Refused(about, "no deep zoom with tiles", remedy=REMEDY)
    if (int(sides["Height"]), int(sides["Width"])) != (rows, columns):
        raise _other_size(about, (rows, columns), f"{int(sides['Width'])} x {int(sides['Height'])}")
    size, overlap = (int(found[key]) if found[key].isdecimal() else 0 for key in ("TileSize", "Overlap"))
    _expect_tiles(size, about)
    files, level = [with_tiles], max(levels, key=int)
    for row in range(-(-rows // size)):
        for column in range(-(-columns // size)):
            tile = f"{name}_files/{level}/{column}_{row}.{found['Format']}"
            margin = (min(row, 1) * overlap, min(column, 1) * overlap)
            _fill(folder, tile, out[row * size : (row + 1) * size, column * size : (column + 1) * size], margin)
            files.append(tile)
    return files


def _read_joined_tiles(folder: Path, name: str, number: int, out: np.ndarray) -> list[str]:
    """Fill a plane from the tiles in one file. number : of the plane among those that alternate in it."""
    about, (rows, columns) = f"{folder.name}/{name}", out.shape[:2]
    try:
        index = json.loads(read_text(within(folder, name), "table_bytes", name=about))
        size, overlap, width, height, levels = (
            index[key] for key in ("tilesize", "overlap", "width", "height", "nlevels")
        )
        stride, offsets = (index["stride"] if name == ALL_PLANES else 1), index["offsets"]
        sound = all(type(n) is int for n in (size, overlap, width, height, levels, stride, *offsets))
    except (ValueError, RecursionError, KeyError, TypeError):
        sound = False
    if not sound or not 0 < levels <= max(width, height).bit_length() + 1 or number >= stride or overlap < 0:
        raise Refused(
            about, "no list of tiles", expected="tilesize, overlap, width, height, nlevels, offsets", remedy=REMEDY
        )
    if (height, width) != (rows, columns):
        raise _other_size(about, (rows, columns), f"{width} x {height}")
    _expect_tiles(size, about)
    below = range(1, levels)  # halvings of the levels that come first
    start = sum(-(-(width >> halved) // size) * -(-(height >> halved) // size) for halved in below)
    joined = f"{name[:-4]}.tzb"
    place, across = f"{folder.name}/{joined}", -(-columns // size)
    path = within(folder, joined)
    try:
        handle = open_regular(path, place)
    except FileNotFoundError:
        raise Refused(place, "the file of the tiles is missing", remedy=REMEDY) from None
    with open(handle, "rb") as file:
        stored = file.seek(0, 2)
        for tile in range(-(-rows // size) * across):
            row, column = divmod(tile, across)
            first = (start + tile) * stride + number
            begin, end = offsets[first : first + 2] if first + 1 < len(offsets) else (0, 0)
            if not 0 <= begin < end <= stored:
                expected, found = f"tile {first} within {stored} bytes", f"bytes {begin} to {end}"
                raise Refused(about, "no list of these tiles", expected=expected, found=found, remedy=REMEDY)
            file.seek(begin)
            named, most = f"{place}, tile {first}", size + 2 * overlap
            codes = decode_stream(np.frombuffer(file.read(end - begin), np.uint8), named)
            if max(codes.shape[:2]) > most:
                raise _other_size(named, (most, most), f"{codes.shape[1]} x {codes.shape[0]}")
            margin = (min(row, 1) * overlap, min(column, 1) * overlap)
            part = out[row * size : (row + 1) * size, column * size : (column + 1) * size]
            copy_plane(np.broadcast_to(codes, (*codes.shape[:2], 3)), part, margin, named)
    return [name, joined] if number == 0 or name != ALL_PLANES else []


def _fill(folder: Path, name: str, out: np.ndarray, margin: tuple[int, int] | None = None) -> None:
    """Copy a picture into a window. margin : rows and columns before those of a tile; more may follow after them."""
    about = f"{folder.name}/{name}"
    copy_plane(read_codes(within(folder, name), RGB, name=about), out, margin, about)


def copy_plane(codes: np.ndarray, out: np.ndarray, margin: tuple[int, int] | None, about: str) -> None:
    """Copy decoded codes into a window; margin as in `_fill`. Refused where they have another size or type."""
    if margin is not None:
        codes = codes[margin[0] :, margin[1] :][: out.shape[0], : out.shape[1]]
    if codes.shape != out.shape or codes.dtype != np.uint8:
        raise _other_size(about, out.shape, f"{codes.shape[1]} x {codes.shape[0]} of {codes.dtype}")
    out[:] = codes


def _expect_tiles(size: int, about: str) -> None:
    if size < LEAST_TILE:
        raise Refused(about, "tiles too small", found=f"{size} pixels", remedy=REMEDY)


def _other_size(about: str, shape: tuple[int, ...], found: str) -> Refused:
    expected = f"{shape[1]} x {shape[0]} of 8 bits"
    return Refused(about, "a plane of another size than info.json says", expected=expected, found=found, remedy=REMEDY)


WEB_INFO = "info.xml"
TILE = re.compile(r"[0-9]{1,9}_[0-9]{1,2}")
PTM_TERMS, MOST_TERMS = 6, 16
WEBRTI_REMEDY = "Convert the .ptm or .rti that it was made from, or the photographs"


def is_web_rti(folder: Path) -> bool:
    """Check whether a folder holds `info.xml` of a picture in tiles."""
    try:
        return b"<MultiRes" in read_bytes(folder / WEB_INFO, "table_bytes")
    except (FileNotFoundError, Refused):
        return False


def open_web_rti(folder: Path) -> PtmFile | HshFile:
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
            raise Refused(
                name, "a kind of picture that is not read", expected=expected, found=found, remedy=WEBRTI_REMEDY
            )
        scale, bias = (_numbers(root.findtext(f"Content/{key}"), terms) for key in ("Scale", "Bias"))
        expect_bound(max(rows, columns), "image_side", name)
        expect_bound(rows * columns, "image_pixels", name)
        tile, places = _places(root.findtext("Tree") or "", rows, columns)
    except (ValueError, KeyError, AttributeError, IndexError, ElementTree.ParseError) as e:
        raise Refused(name, "not a picture of webRTIViewer", found=str(e)[:80], remedy=WEBRTI_REMEDY) from None
    expect_memory(3 * rows * columns * layers, name)
    codes = np.empty((rows, columns, 3 * layers), np.uint8)
    suffix, files = "png" if root.get("format") == "1" else "jpg", [WEB_INFO]
    for node, top, left in places:
        for layer in range(layers):
            part = f"{node}_{layer + 1}.{suffix}"
            stored = read_codes(within(folder, part), RGB, name=f"{folder.name}/{part}")
            margin = max(stored.shape[0] - tile, 0) // 2
            window = codes[max(top, 0) : max(top + tile, 0), max(left, 0) : max(left + tile, 0)]
            before = (margin + max(-top, 0), margin + max(-left, 0))
            copy_plane(stored, window[..., 3 * layer : 3 * layer + 3], before, f"{folder.name}/{part}")
            files.append(part)
    layout = f"webRTIViewer folder ({f'HSH of {terms} terms' if kind == 'HSH_RTI' else kind})"
    if kind == "LRGB_PTM":
        brightness, colours = codes[None, ::-1, :, :PTM_TERMS], codes[::-1, :, PTM_TERMS:]
        return PtmFile(layout, brightness, colours, scale, bias, tuple(files))
    values = np.moveaxis(codes.reshape(rows, columns, len(scale), 3), 3, 2)
    if kind == "HSH_RTI":
        return HshFile(layout, values, bias, scale, tuple(files))
    return PtmFile(layout, np.moveaxis(values, 2, 0)[:, ::-1], None, scale, bias, tuple(files))


def _numbers(text: str | None, count: int) -> np.ndarray:
    values = np.array([float(word) for word in (text or "").split()])
    if len(values) != count or not (np.abs(values) < 1e6).all():
        raise ValueError(f"{len(values)} scales or biases")
    return values


def _places(tree: str, rows: int, columns: int) -> tuple[int, list[tuple[int, int, int]]]:
    """Return the side of the tiles; node, row and column of each visible tile of the full resolution."""
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
