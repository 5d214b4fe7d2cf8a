"""Filling of pixels without an estimate from their neighbours, where a picture without holes is asked for."""

from dataclasses import replace

import numpy as np

from nishiki.errors import UserError
from nishiki.photometric import flags as bits


def fill_flagged(field, *, inside=None, reach=8):
    """Give pixels without an estimate the mean normal and albedo of neighbours that have one.

    Works inwards from the edge of a hole, a pixel a round, `reach` rounds at most; inside (rows, columns) bool limits
    where. Filled pixels keep their flags and get FILLED; their sigma stays pi / 2: nothing was measured there.
    Raises UserError if reach is not positive. Returns a new NormalField.
    """
    from scipy import ndimage

    if reach < 1:
        raise UserError(f"filling normals: expected a reach of at least 1 pixel, found {reach}")
    missing = (field.flags & bits.NO_ESTIMATE) != 0
    if inside is not None:
        missing &= np.asarray(inside, dtype=bool)
    have = (field.flags & bits.NO_ESTIMATE) == 0
    values = np.dstack([field.normals, field.albedo]) * have[..., None]
    flags = field.flags.copy()
    window = np.ones((3, 3), dtype=np.float32)
    for _ in range(reach):
        near = ndimage.convolve(have.astype(np.float32), window, mode="constant")
        edge = missing & ~have & (near > 0.5)
        if not edge.any():
            break
        for k in range(4):
            values[..., k][edge] = (ndimage.convolve(values[..., k], window, mode="constant") / np.maximum(near, 1))[
                edge
            ]
        length = np.linalg.norm(values[..., :3][edge], axis=-1, keepdims=True)
        flat = np.array([0, 0, 1], dtype=np.float32)  # opposite neighbours can cancel
        values[..., :3][edge] = np.where(length > 1e-6, values[..., :3][edge] / np.maximum(length, 1e-6), flat)
        flags[edge] |= bits.FILLED
        have = have | edge
    filled = (flags & bits.FILLED) != 0
    normals, albedo = field.normals.copy(), field.albedo.copy()
    normals[filled], albedo[filled] = values[..., :3][filled], values[..., 3][filled]
    return replace(field, normals=normals, albedo=albedo, flags=flags)
