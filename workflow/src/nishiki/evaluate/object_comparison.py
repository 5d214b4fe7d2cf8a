"""A photograph beside its rendering, and what lies between them."""

from __future__ import annotations

import numpy as np

from nishiki.colour.encoding import decode
from nishiki.render.display import developed, three_channels
from nishiki.render.object.film import block_mean

AMPLIFIED = 10


def comparison(
    photograph: np.ndarray,
    rendered: np.ndarray,
    model: np.ndarray,
    inside: np.ndarray,
    encoding: str,
    columns: int,
) -> dict[str, np.ndarray]:
    """Pictures (rows, columns, 3) uint8 cut to the object and reduced to at most `columns`: photograph, rendered and
    model as seen on a screen, black outside of the silhouette; error: grey plus AMPLIFIED times the difference of
    rendered and photograph.  Inputs in the capture's encoding, inside (rows, columns) bool."""
    rows, across = np.flatnonzero(inside.any(axis=1)), np.flatnonzero(inside.any(axis=0))
    if not len(rows):
        rows, across = np.arange(inside.shape[0]), np.arange(inside.shape[1])
    box = slice(rows[0], rows[-1] + 1), slice(across[0], across[-1] + 1)
    size = max(1, -(-(box[1].stop - box[1].start) // columns))
    mask = inside[box]
    out = {}
    for name, values in (("photograph", photograph), ("rendered", rendered), ("model", model)):
        linear = np.where(mask[..., None], decode(np.ascontiguousarray(values[box]), encoding), np.float32(0))
        shown = block_mean(linear.astype(np.float32), size)
        out[name] = developed(shown, np.ones(shown.shape[:2], np.float32)).pixels
    delta = three_channels(np.where(mask[..., None], rendered[box] - photograph[box], 0).astype(np.float32))
    grey = 0.5 + AMPLIFIED * block_mean(delta, size)
    out["error"] = np.floor(np.clip(grey, 0, 1) * 255 + 0.5).astype(np.uint8)
    return out
