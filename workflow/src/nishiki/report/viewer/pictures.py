"""Maps of 8 bits as files that browsers decode without loss."""

import struct

import numpy as np


def png(values: np.ndarray) -> bytes:
    """A grey picture (rows, columns) uint8 as PNG."""
    import cv2

    return cv2.imencode(".png", values, [cv2.IMWRITE_PNG_COMPRESSION, 9])[1].tobytes()


def webp_stack(planes: list[np.ndarray]) -> bytes:
    """Planes (rows, columns) uint8, three to a lossless WebP; before each its length, four bytes, the lowest first.

    The last picture is filled up with zeros.
    """
    import cv2

    parts = []
    for first in range(0, len(planes), 3):
        three = planes[first : first + 3]
        colours = three + [np.zeros_like(three[0])] * (3 - len(three))
        picture = np.stack(colours[::-1], axis=-1)  # OpenCV keeps blue first
        data = cv2.imencode(".webp", picture, [cv2.IMWRITE_WEBP_QUALITY, 101])[1].tobytes()
        parts += [struct.pack("<I", len(data)), data]
    return b"".join(parts)
