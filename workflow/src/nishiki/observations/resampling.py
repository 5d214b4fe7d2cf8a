"""Change stored codes of photographs: undo movements of the camera, and subtract light of the room.

Light of the room is an image of the albedo:

    v_j = rho (s_j max(n . l_j, 0) + a)

v_j: value relative to the white board; s_j: strength of lamp j; a: light of the room relative to a lamp that faces the
object, one number a channel. rho and n follow pixel by pixel from the lit photographs, and rho a is subtracted from the
codes of all.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from nishiki.formats.images import Region
from nishiki.formats.stored import chunk_path, write_chunk
from nishiki.observations.linearise import field_rows
from nishiki.observations.plane import Observations
from nishiki.photometric.lambert_fit import solve_normals
from nishiki.threads import strips

FINE_CODES = 1 << 16  # steps of linear light in a table from light to 8-bit codes: 20 of the smallest sRGB step
MOST_CHANNELS = 4  # that OpenCV resamples at a time
REACH = 4  # pixels, of the kernel of Lanczos


def region_behind(matrix: np.ndarray, region: Region, rows: int, columns: int) -> Region:
    """Find the part of a photograph of these rows and columns that a region needs once moved by matrix (2, 3)."""
    row, column, height, width = region
    corners = matrix[:, :2] @ np.array([[0, width, 0, width], [0, 0, height, height]]) + matrix[:, 2:]
    reach = REACH + 1  # and of the mark around saturated pixels, which is interpolated
    low = np.floor(corners.min(axis=1)).astype(int) - reach + (column, row)
    high = np.ceil(corners.max(axis=1)).astype(int) + reach + (column, row)
    left, top = np.clip(low, 0, (columns - 1, rows - 1))
    right, bottom = np.clip(high, (left + 1, top + 1), (columns, rows))
    return int(top), int(left), int(bottom - top), int(right - left)


def move_codes(
    codes: np.ndarray, matrix: np.ndarray, shape: Sequence[int], saturated: np.number, clip: np.number
) -> np.ndarray:
    """Resample codes (rows, columns, channels) to the place that they have in the first photograph, by Lanczos' kernel.

    Parameters
    ----------
    codes : (rows, columns, channels) uint8, uint16 or float32
    matrix : (2, 3) float64
        Column and row in `codes` of a column and row of the result.
    shape : sequence of int
        Rows and columns of the result.
    saturated, clip : numpy.number
        Codes from which, and up to which, a sample is unusable.

    Returns
    -------
    (*shape, channels) of the same type
        A pixel is saturated in all channels where one within the reach of the kernel is so in any, and at `clip` in all
        where the nearest one is, or none: what must not be used before may not be used after.
    """
    import cv2

    size = (int(shape[1]), int(shape[0]))

    def warp(picture: np.ndarray, method: int, border: int = cv2.BORDER_REPLICATE) -> np.ndarray:
        flags = method | cv2.WARP_INVERSE_MAP
        return cv2.warpAffine(picture, matrix, size, flags=flags, borderMode=border, borderValue=1)

    hot = np.any(codes >= saturated, axis=2).astype(np.uint8)
    cold = np.all(codes <= clip, axis=2).astype(np.uint8)
    parts = [codes[:, :, k : k + MOST_CHANNELS] for k in range(0, codes.shape[2], MOST_CHANNELS)]
    warped = (warp(np.ascontiguousarray(part), cv2.INTER_LANCZOS4) for part in parts)
    moved = np.concatenate([part.reshape(*size[::-1], -1) for part in warped], axis=2)
    if hot.any():
        reach = warp(cv2.dilate(hot, np.ones((2 * REACH - 1,) * 2, np.uint8)) * np.uint8(255), cv2.INTER_LINEAR)
        moved[reach > 0] = saturated
    moved[warp(cold, cv2.INTER_NEAREST, cv2.BORDER_CONSTANT) > 0] = clip
    return moved


def subtract_light(codes: np.ndarray, light: np.ndarray, table: np.ndarray, saturated: np.number) -> np.ndarray:
    """Subtract linear light (rows, columns, channels), a fraction of full scale, from codes of the same shape.

    table: linear value by code, rising; two zeros for float codes. Saturated codes stay as they are. What would be
    negative becomes code 0, which tells only that there was no more light than that.
    """
    if codes.dtype.kind == "f":
        return np.where(codes >= saturated, codes, np.maximum(codes - light, 0)).astype(codes.dtype)
    out, middles = np.empty_like(codes), (table[1:] + table[:-1]) / 2
    coded = np.searchsorted(middles, np.linspace(0, table[-1], FINE_CODES)) if len(table) < FINE_CODES else None
    straight = np.linspace(0, table[-1], len(table))  # much faster than a search
    scale = np.float32(straight[1]) if np.allclose(table, straight, rtol=1e-6, atol=0) else np.float32(0)
    for band in strips(len(codes)):
        part = codes[band]
        linear = np.clip(table[part] - light[band], 0, table[-1])
        if coded is not None:
            fresh = coded[np.rint(linear * ((FINE_CODES - 1) / table[-1])).astype(np.int64)]
        else:
            fresh = np.rint(linear / scale) if scale > 0 else np.searchsorted(middles, linear)
        out[band] = np.where(part >= saturated, part, fresh.astype(codes.dtype))
    return out


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
            part = subtract_light(photograph, share, observations.lut, saturated)
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
