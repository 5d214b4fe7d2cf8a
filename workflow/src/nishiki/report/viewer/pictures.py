"""Grey pictures of 8 bits as files, as the viewer's page decodes them."""

import numpy as np


def jpeg(values: np.ndarray, quality: int) -> bytes:
    """A grey picture (rows, columns) uint8 as JPEG."""
    import cv2

    return cv2.imencode(".jpg", values, [cv2.IMWRITE_JPEG_QUALITY, quality, cv2.IMWRITE_JPEG_OPTIMIZE, 1])[1].tobytes()


def png(values: np.ndarray) -> bytes:
    """A grey picture (rows, columns) uint8 as PNG."""
    import cv2

    return cv2.imencode(".png", values, [cv2.IMWRITE_PNG_COMPRESSION, 9])[1].tobytes()
