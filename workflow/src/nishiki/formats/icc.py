"""An ICC profile of an RGB space: primaries relative to D50 and one power law (ICC.1:2022, a matrix profile)."""

from __future__ import annotations

import struct
from dataclasses import dataclass

import numpy as np

D50 = (0.9642, 1.0, 0.8249)
"""White of the profile connection space, ICC.1:2022, 6.3.4.3."""


@dataclass(frozen=True)
class RgbSpace:
    """An RGB space whose white is D50: name, x and y of red, green and blue, exponent of its power law."""

    name: str
    primaries: tuple[tuple[float, float], ...]
    gamma: float

    def to_xyz(self) -> np.ndarray:
        """(3, 3) from linear RGB to XYZ relative to D50, white Y = 1."""
        columns = np.array([[x / y, 1.0, (1.0 - x - y) / y] for x, y in self.primaries]).T
        return columns * np.linalg.solve(columns, np.array(D50))


ROMM = RgbSpace("ROMM RGB (ProPhoto)", ((0.7347, 0.2653), (0.1596, 0.8404), (0.0366, 0.0001)), 1.8)
"""ISO 22028-2, with a pure power law. It holds every colour that a surface can have."""


def icc_profile(space: RgbSpace) -> bytes:
    """The profile's bytes; the same space gives the same bytes."""
    curve = b"para" + bytes(4) + struct.pack(">HH", 0, 0) + _fixed(space.gamma)
    matrix = space.to_xyz()
    texts = {b"desc": space.name, b"cprt": "No copyright, use freely"}
    tags = {tag: _text(text) for tag, text in texts.items()}
    tags[b"wtpt"] = _xyz(D50)
    for column, letter in enumerate(b"rgb"):
        tags[bytes([letter]) + b"XYZ"] = _xyz(matrix[:, column])
        tags[bytes([letter]) + b"TRC"] = curve
    start = 128 + 4 + 12 * len(tags)
    table, data = [struct.pack(">I", len(tags))], b""
    for tag, content in tags.items():
        table.append(tag + struct.pack(">II", start + len(data), len(content)))
        data += content + bytes(-len(content) % 4)
    size = start + len(data)
    header = struct.pack(">I4sI4s4s4s", size, bytes(4), 0x04300000, b"mntr", b"RGB ", b"XYZ ")
    header += struct.pack(">6H", 2026, 1, 1, 0, 0, 0) + b"acsp" + bytes(28) + _numbers(D50) + bytes(48)
    return header + b"".join(table) + data


def _fixed(value: float) -> bytes:
    """s15Fixed16Number."""
    return struct.pack(">i", round(value * 65536))


def _numbers(values: tuple[float, ...] | np.ndarray) -> bytes:
    return b"".join(_fixed(float(value)) for value in values)


def _xyz(values: tuple[float, ...] | np.ndarray) -> bytes:
    return b"XYZ " + bytes(4) + _numbers(values)


def _text(text: str) -> bytes:
    """multiLocalizedUnicodeType, one record in English."""
    coded = text.encode("utf-16-be")
    return b"mluc" + bytes(4) + struct.pack(">II2s2sII", 1, 12, b"en", b"US", len(coded), 28) + coded
