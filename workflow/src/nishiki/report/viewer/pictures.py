"""Maps of 8 bits as files that browsers decode without loss."""

import struct

import numpy as np


def webp(planes: list[np.ndarray]) -> bytes:
    """A lossless WebP of three planes (rows, columns) uint8."""
    import cv2

    picture = np.stack(planes[::-1], axis=-1)  # OpenCV keeps blue first
    return cv2.imencode(".webp", picture, [cv2.IMWRITE_WEBP_QUALITY, 101])[1].tobytes()


def webp_stack(planes: list[np.ndarray]) -> bytes:
    """Planes (rows, columns) uint8, three to a lossless WebP; before each its length, four bytes, the lowest first.

    The last picture is filled up with zeros.
    """
    parts = []
    for first in range(0, len(planes), 3):
        three = planes[first : first + 3]
        colours = three + [np.zeros_like(three[0])] * (3 - len(three))
        data = webp(colours)
        parts += [struct.pack("<I", len(data)), data]
    return b"".join(parts)
