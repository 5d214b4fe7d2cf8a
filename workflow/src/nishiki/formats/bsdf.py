"""Files of tables of reflection, `.bsdf`: named arrays in the container of the database of Dupuy and Jakob (2018).

`tensor_file`, a zero byte, version 1 0, number of arrays (uint32); of each array the length of its name (uint16), its
name, number of axes (uint16), kind (uint8), place in the file (uint64) and sizes (uint64); then the arrays, lowest
byte first.
"""

from __future__ import annotations

import struct

import numpy as np

KINDS = {np.dtype("u1"): 1, np.dtype("<f4"): 10}
HEADING = b"tensor_file\0" + bytes([1, 0])


def bsdf_bytes(arrays: dict[str, np.ndarray]) -> bytes:
    """A file of arrays of uint8 or float32."""
    headings = [
        (
            name.encode(),
            struct.pack("<HB", array.ndim, KINDS[array.dtype]),
            struct.pack(f"<{array.ndim}Q", *array.shape),
        )
        for name, array in arrays.items()
    ]
    place = len(HEADING) + 4 + sum(2 + len(name) + len(kind) + 8 + len(shape) for name, kind, shape in headings)
    top, contents = [HEADING, struct.pack("<I", len(arrays))], []
    for (name, kind, shape), array in zip(headings, arrays.values(), strict=True):
        place += (gap := -place % 8)
        top += [struct.pack("<H", len(name)), name, kind, struct.pack("<Q", place), shape]
        contents += [bytes(gap), array.tobytes()]
        place += array.nbytes
    return b"".join(top + contents)
