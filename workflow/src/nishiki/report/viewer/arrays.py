"""Arrays for the page in one deflated block: a header in JSON, then the bytes of each array by significance."""

from __future__ import annotations

import json
import struct
import zlib
from collections.abc import Mapping

import numpy as np


def pack_arrays(arrays: Mapping[str, np.ndarray]) -> bytes:
    """Named arrays as bytes that `unpackArrays` of the page reads.

    Parameters
    ----------
    arrays : mapping of str to numpy.ndarray
        Of type int8 to int32, uint8 to uint32 or float32.

    Returns
    -------
    bytes
        Deflated (zlib): length of the header (4 bytes, little endian), header, bytes of the arrays. All first bytes of
        an array's numbers come before all second ones: numbers that are small or near each other deflate further so.
    """
    head, bodies = [], []
    for name, values in arrays.items():
        plain = np.ascontiguousarray(values).reshape(-1)
        little = plain.astype(plain.dtype.newbyteorder("<"), copy=False)
        head.append({"name": name, "type": plain.dtype.name, "shape": list(values.shape)})
        bodies.append(np.ascontiguousarray(little.view(np.uint8).reshape(-1, plain.dtype.itemsize).T).tobytes())
    text = json.dumps(head, separators=(",", ":")).encode()
    return zlib.compress(struct.pack("<I", len(text)) + text + b"".join(bodies), 9)
