"""Numbers from MATLAB files of level 5, by variable; everything else in them is passed over unread.

Layout from MathWorks' "MAT-File Format" (level 5). What a file claims is compared with the bytes that are there before
anything is allocated; compressed variables are unpacked up to the bound matlab_bytes, all together.
"""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import numpy as np

from nishiki.formats.bounds import bound
from nishiki.formats.files import read_bytes

_NUMBERS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
_MATRIX, _PACKED = 14, 15
_CELL, _NUMERIC = 1, frozenset(range(6, 16))  # double ... uint64
_HEADING = 128
MOST_CELLS = 1 << 16


def read_matlab(path: Path, names: tuple[str, ...]) -> dict[str, np.ndarray]:
    """Those of the named variables that the file has: arrays of numbers, cell arrays as object arrays of these.

    Shapes are MATLAB's (two axes at least). ValueError where it is no such file, is damaged, or holds one of the
    variables as something else (text, complex numbers, sparse matrices, cells in cells); FileNotFoundError;
    nishiki.formats.files.Refused where it is larger than is read.
    """
    data = read_bytes(path, "matlab_bytes", name=path.name)
    if len(data) < _HEADING or data[126:128] not in (b"IM", b"MI"):
        raise ValueError("not a MATLAB file of level 5 (-v6, -v7)")
    order = "<" if data[126:128] == b"IM" else ">"
    if struct.unpack(order + "H", data[124:126])[0] >> 8 != 1:
        raise ValueError("a MATLAB file of another level than 5 (-v7.3 is HDF5)")
    place, variables, left = _HEADING, {}, bound("matlab_bytes")
    while place < len(data):
        kind, content, place = _element(data, place, order)
        if kind == _PACKED:
            unpacked = _unpacked(content, left)
            left -= len(unpacked)
            kind, content, _ = _element(unpacked, 0, order)
        if kind == _MATRIX:
            name, values = _variable(content, order, names)
            if values is not None:
                variables[name] = values
    return variables


def _element(data: bytes | memoryview, place: int, order: str) -> tuple[int, memoryview, int]:
    """Kind and content of one element, and where the next one begins."""
    view = memoryview(data)
    if place + 8 > len(view):
        raise ValueError("the file is cut off")
    kind, size = struct.unpack(order + "II", view[place : place + 8])
    if kind >> 16:  # at most four bytes, held in the tag itself
        kind, size = kind & 0xFFFF, kind >> 16
        if size > 4:
            raise ValueError(f"a small element of {size} bytes")
        return kind, view[place + 4 : place + 4 + size], place + 8
    start = place + 8
    if start + size > len(view):
        raise ValueError(f"an element of {size} bytes where {len(view) - start} are left")
    padding = 0 if kind == _PACKED else -size % 8
    return kind, view[start : start + size], start + size + padding


def _unpacked(content: memoryview, most: int) -> bytes:
    """zlib data, unpacked whole. ValueError where they are damaged or larger than `most` bytes."""
    stream = zlib.decompressobj()
    try:
        data = stream.decompress(content, max(most, 1))
    except zlib.error as error:
        raise ValueError(f"packed data are damaged ({error})") from None
    if stream.unconsumed_tail or not stream.eof:
        raise ValueError(f"packed data are cut off, or unpack to more than {bound('matlab_bytes')} bytes")
    return data


def _variable(content: memoryview, order: str, names: tuple[str, ...] | None) -> tuple[str, np.ndarray | None]:
    """Name and values of a matrix; None for the values of one that is not among the names (None: all are wanted)."""
    if not len(content):
        return "", np.zeros((0, 0))
    _, flags, place = _element(content, 0, order)
    _, dimensions, place = _element(content, place, order)
    _, letters, place = _element(content, place, order)
    name = bytes(letters).decode("latin-1")
    if names is not None and name not in names:
        return name, None
    if len(flags) < 4 or len(dimensions) % 4 or not 8 <= len(dimensions) <= 128:
        raise ValueError(f"heading of the variable {name[:40]!r} is damaged")
    word = struct.unpack(order + "I", flags[:4])[0]
    shape = tuple(int(n) for n in np.frombuffer(dimensions, order + "i4"))
    if word & 0x800:
        raise ValueError(f"{name[:40]!r} holds complex numbers")
    if word & 0xFF == _CELL and names is not None:
        return name, _cells(content, place, order, shape, name)
    if word & 0xFF not in _NUMERIC:
        raise ValueError(f"{name[:40]!r} holds no numbers")
    return name, _numbers(content, place, order, shape, name)


def _numbers(content: memoryview, place: int, order: str, shape: tuple[int, ...], name: str) -> np.ndarray:
    kind, values, _ = _element(content, place, order)
    if kind not in _NUMBERS:
        raise ValueError(f"{name[:40]!r} holds values of kind {kind}")
    stored = np.dtype(order + _NUMBERS[kind])
    if min(shape) < 0 or _product(shape) * stored.itemsize != len(values):
        size = " x ".join(map(str, shape))
        raise ValueError(f"{name[:40]!r} of {size} has {len(values)} bytes of values")
    return np.frombuffer(values, stored).reshape(shape, order="F").astype(np.float64)


def _cells(content: memoryview, place: int, order: str, shape: tuple[int, ...], name: str) -> np.ndarray:
    count = _product(shape)
    if min(shape) < 0 or count > min(MOST_CELLS, (len(content) - place) // 8):
        raise ValueError(f"{name[:40]!r} claims {count} cells in {len(content) - place} bytes")
    cells = np.empty(count, object)
    for i in range(count):
        kind, cell, place = _element(content, place, order)
        if kind != _MATRIX:
            raise ValueError(f"cell {i + 1} of {name[:40]!r} is damaged")
        cells[i] = _variable(cell, order, None)[1]
    return cells.reshape(shape, order="F")


def _product(shape: tuple[int, ...]) -> int:
    product = 1
    for n in shape:
        product *= n
    return product
