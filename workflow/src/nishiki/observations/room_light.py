"""Light of the room in the stored photographs of a plane, estimated from the albedo and subtracted.

    v_j = rho (s_j max(n . l_j, 0) + a)

v_j: value relative to the white board; s_j: strength of lamp j; a: light of the room relative to a lamp that faces the
object, one number a channel. rho and n follow pixel by pixel from the lit photographs, and rho a is subtracted from the
codes of all, which stay codes.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from nishiki.formats.zarr_store import chunk_path, write_chunk
from nishiki.observations.blocks import field_rows
from nishiki.observations.plane import Observations
from nishiki.observations.resampling import subtract_light
from nishiki.photometric.consistency import solve_normals

ROUNDS = 4  # of choosing the photographs in which a pixel is lit
LIT = 0.1  # cosine from which it is
VALUES = 1 << 21  # computed at a time


def subtract_room(store: Path, ambient: np.ndarray, strengths: np.ndarray) -> None:
    """Rewrite the codes of `frames.zarr` without the light of the room.

    ambient: (channels,) a of the equation above; strengths: (lights,) s, by which the stored gains are divided.
    """
    observations = Observations(store)
    lamps = strengths[:, None] * observations.directions
    scale = strengths.astype(np.float32)[:, None, None, None]
    compression, (saturated, _) = observations.attributes["compression"], observations.limits
    for number, band in enumerate(observations.bands()):
        if not observations.mask[band].any():
            continue
        codes, start = observations.codes(band)
        values, valid = observations.read(band)
        room = albedo_under_room(values * scale, valid, lamps, ambient) * ambient.astype(np.float32)
        for light, photograph in enumerate(codes):
            gain = field_rows(observations.gain[light] * scale[light], observations.edges, start, start + len(room))
            share = np.divide(room, gain, out=np.zeros_like(room), where=gain > 0)
            part = subtract_light(photograph, share, observations.table, saturated)
            rest = np.zeros((observations.band_rows - len(part), *part.shape[1:]), part.dtype)
            place = chunk_path(store / "codes", light, number)
            write_chunk(place, np.concatenate([part, rest]), compression=compression)


def albedo_under_room(values: np.ndarray, valid: np.ndarray, lamps: np.ndarray, ambient: np.ndarray) -> np.ndarray:
    """Estimate rho of the module's equation.

    Parameters
    ----------
    values : (lights, rows, columns, channels) float32
    valid : (lights, rows, columns) bool
    lamps : (lights, 3) float64
        Directions times strengths.
    ambient : (channels,) float64

    Returns
    -------
    (rows, columns, channels) float32
        0 where it is not known.
    """
    lights, rows, columns, channels = values.shape
    flat, known = values.reshape(lights, -1, channels), valid.reshape(lights, -1).astype(np.float32)
    albedo, step = np.zeros((rows * columns, channels), np.float32), max(VALUES // lights, 1)
    level = float(ambient.mean())
    for first in range(0, rows * columns, step):
        part = slice(first, first + step)
        used, seen = known[:, part], flat[:, part]
        grey = seen.mean(axis=2)
        weights, room = used, np.zeros(grey.shape[1])
        for _ in range(ROUNDS):
            normal, _ = solve_normals(weights, grey - room, lamps[:, None])
            length = np.linalg.norm(normal, axis=1) + 1e-12
            cosines = lamps @ (normal / length[:, None]).T
            room = level * length
            lit = used * (cosines > LIT)
            weights = np.where(lit.sum(axis=0) >= 3, lit, used)
        shares = np.maximum(cosines, 0)[:, :, None] + ambient
        lit = weights[:, :, None] * shares
        albedo[part] = (lit * seen).sum(axis=0) / np.maximum((lit * shares).sum(axis=0), 1e-12)
    return np.where(np.isfinite(albedo), np.maximum(albedo, 0), 0).astype(np.float32).reshape(rows, columns, channels)
