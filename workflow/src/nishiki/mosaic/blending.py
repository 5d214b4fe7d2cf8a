"""Resample the maps of placed fields onto the mosaic and blend them: reflectance, normals, errors, never brightness.

Every field counts by the inverse of its normals' variance times the distance to its rim, so that it fades out there.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from nishiki.mosaic.adjustment import Placement
from nishiki.mosaic.levelling import Levels, Samples, to_quantities
from nishiki.photometric.flags import NO_ESTIMATE, TOO_FEW_LIGHTS

STEEPEST = 1e-3  # z of a normal at least
Reader = Callable[[str, slice], np.ndarray]
"""From the name of a map and a slice of its rows to values."""
CELL, SQUARE = 32, 8  # pixels: distance between the areas at which fields are compared, and the areas' side
NODES = 16  # pixels between places that are computed
CELLS = 8  # rows of these areas that are compared at a time
LEAST_SIGMA = 1e-3  # radians: a field that claims less counts no more
NORMALS = ("normals", "shading_normals")
COLOURS = ("reflectance", "albedo")


@dataclass(frozen=True)
class Piece:
    """What one field shows of a part of the mosaic.

    columns : slice of the part's columns
    maps : by name (rows, columns, ...)
    inside, known : (rows, columns) bool, in the field, and with an estimate
    place : (rows, columns, 2) float64, in the field, from its centre in units of the reach
    depth : (rows, columns) float32, distance to the field's rim, relative to half its shorter side
    """

    columns: slice
    maps: dict[str, np.ndarray]
    inside: np.ndarray
    known: np.ndarray
    place: np.ndarray
    depth: np.ndarray


def take_piece(
    placement: Placement, i: int, read: Reader, names: Mapping[str, bool], rows: np.ndarray, columns: np.ndarray
) -> Piece | None:
    """Resample maps of field i at some rows and columns of the mosaic; None where it shows none of them.

    names : maps, and whether they hold numbers of kinds, of which the nearest is taken; others are interpolated by a
    cubic where all pixels around are known.
    """
    import cv2

    low, high = placement.box(i)
    shown = (columns >= low[0]) & (columns < high[0])
    if not shown.any() or rows[-1] < low[1] or rows[0] >= high[1]:
        return None
    first, end = np.flatnonzero(shown)[[0, -1]]
    part = slice(int(first), int(end) + 1)
    points = _field_places(placement, i, rows, columns[part])
    x, y, size = points[..., 0], points[..., 1], np.array(placement.fields[i].shape[::-1])
    inside = (x >= 0) & (y >= 0) & (x <= size[0] - 1) & (y <= size[1] - 1)
    if not inside.any():
        return None
    strip = slice(max(int(y[inside].min()) - 2, 0), min(int(y[inside].max()) + 4, int(size[1])))
    where = (points - (0, strip.start)).astype(np.float32)

    def warp(values: np.ndarray, method: int) -> np.ndarray:
        return cv2.remap(values, where, None, method, borderMode=cv2.BORDER_REPLICATE)

    usable = ((read("flags", strip) & NO_ESTIMATE) == 0).astype(np.uint8)
    known = inside & (warp(usable, cv2.INTER_NEAREST) > 0)
    solid = warp(cv2.erode(usable, np.ones((5, 5), np.uint8)), cv2.INTER_NEAREST) > 0
    maps = {}
    for name, kinds in names.items():
        values = read(name, strip)
        flat = values.reshape(*values.shape[:2], -1)
        layers = []
        for k in range(flat.shape[2]):
            layer = np.ascontiguousarray(flat[..., k])
            nearest = warp(layer, cv2.INTER_NEAREST)
            layers.append(
                nearest if kinds else np.where(solid, warp(layer.astype(np.float32), cv2.INTER_CUBIC), nearest)
            )
        maps[name] = np.stack(layers, axis=-1).reshape(*where.shape[:2], *values.shape[2:])
    depth = np.minimum(np.minimum(x, size[0] - 1 - x), np.minimum(y, size[1] - 1 - y))
    place = (points - placement.fields[i].centre) / placement.reach
    return Piece(part, maps, inside, known, place, np.maximum((depth + 1) / (size.min() / 2), 0).astype(np.float32))


def _field_places(placement: Placement, i: int, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Return places in field i (rows, columns, 2), linear between nodes: a lens bends by 1e-3 pixels between them."""
    nodes = [np.arange(each[0], each[-1] + NODES, NODES, dtype=float) for each in (columns, rows)]
    lattice = placement.to_field(i, np.stack(np.meshgrid(*nodes), axis=-1))
    across, down = (
        np.maximum(0, 1 - np.abs(each[:, None] - node) / NODES)
        for each, node in zip((columns, rows), nodes, strict=True)
    )
    return np.stack([down @ lattice[..., k] @ across.T for k in (0, 1)], axis=-1)


def turn_normals(normals: np.ndarray, turn: float, tilt: np.ndarray | float = 0.0) -> np.ndarray:
    """Turn normals (..., 3) of a field into the mosaic's frame, then tilt them by the angles -tilt (..., 2).

    turn : of the field, from columns to rows, so that it is clockwise for x right and y up.
    """
    cosine, sine = np.cos(turn), np.sin(turn)
    x, y = cosine * normals[..., 0] + sine * normals[..., 1], cosine * normals[..., 1] - sine * normals[..., 0]
    depth = np.maximum(normals[..., 2:], STEEPEST)
    slopes = np.tan(np.arctan2(np.stack([x, y], axis=-1), depth) - tilt)
    turned = np.concatenate([slopes, np.ones_like(depth)], axis=-1)
    return turned / np.linalg.norm(turned, axis=-1, keepdims=True)


def compare_fields(placement: Placement, readers: Sequence[Reader]) -> Samples:
    """Compare all fields where they overlap, at areas of SQUARE pixels every CELL pixels. One band is in memory."""
    rows, columns = placement.shape
    down, across = (np.arange(n // CELL * CELL).reshape(-1, CELL)[:, :SQUARE] for n in (rows, columns))
    pairs, places, values = [], [], []
    for top in range(0, len(down), CELLS):
        pieces, here = {}, down[top : top + CELLS]
        for i, read in enumerate(readers):
            names = {"reflectance": False, "normals": False}
            piece = take_piece(placement, i, read, names, here.ravel(), across.ravel())
            if piece is not None:
                normals = turn_normals(piece.maps["normals"], placement.turn[i])
                found = to_quantities(piece.maps["reflectance"], normals)
                whole = np.zeros((here.size, across.size, found.shape[2] + 3))
                whole[:, piece.columns] = np.concatenate([found, piece.place, piece.known[..., None]], axis=-1)
                squares = whole.reshape(len(here), SQUARE, len(across), SQUARE, -1).mean(axis=(1, 3))
                pieces[i] = squares.reshape(-1, squares.shape[2])
        for i in pieces:
            for j in pieces:
                both = (pieces[i][:, -1] == 1) & (pieces[j][:, -1] == 1)
                if i < j and both.any():
                    ends = np.stack([pieces[i][both], pieces[j][both]], axis=1)
                    pairs.append(np.tile((i, j), (len(ends), 1)))
                    places.append(ends[..., -3:-1])
                    values.append(ends[..., :-3])
    if not pairs:
        count = readers[0]("reflectance", slice(0, 1)).shape[2] + 2
        return Samples(np.zeros((0, 2), np.int64), np.zeros((0, 2, 2)), np.zeros((0, 2, count)))
    return Samples(np.concatenate(pairs), np.concatenate(places), np.concatenate(values))


def blend_band(
    placement: Placement, readers: Sequence[Reader], levels: Levels, names: Mapping[str, bool], rows: slice
) -> dict[str, np.ndarray]:
    """Blend some rows of the mosaic.

    Parameters
    ----------
    names : mapping
        Maps that all fields have, and whether they hold numbers of kinds; with `flags`, `sigma`, `normals` and
        `reflectance`.

    Returns
    -------
    dict
        Maps (rows, columns, ...) by name. Numbers of kinds are those of the field that counts most; `flags` and `mask`
        of all fields are joined, flags of those that have an estimate where one has. `sigma` is the rms of the fields'
        own, with the scatter of the normals between them.
    """
    width = placement.shape[1]
    size, across = (rows.stop - rows.start, width), np.arange(width)
    total, best = np.zeros(size, np.float32), np.zeros(size, np.float32)
    out: dict[str, np.ndarray] = {}
    square, without = np.zeros(size, np.float32), np.zeros(size, np.uint8)
    for i, read in enumerate(readers):
        piece = take_piece(placement, i, read, names, np.arange(rows.start, rows.stop), across)
        if piece is None:
            continue
        maps, level = piece.maps, levels.at(i, piece.place)
        for name in COLOURS:
            if name in maps:
                gain = np.exp(-level[..., :-2])
                maps[name] = maps[name] * (gain if maps[name].ndim == 3 else gain.mean(axis=-1))
        for name in NORMALS:
            if name in maps:
                maps[name] = turn_normals(maps[name], placement.turn[i], level[..., -2:])
        weight = np.where(piece.known, piece.depth / np.square(np.maximum(maps["sigma"], LEAST_SIGMA)), 0)
        weight = weight.astype(np.float32)
        here = np.s_[:, piece.columns]
        square[here] += weight * np.square(maps["sigma"])
        for name, kinds in names.items():
            values = maps[name]
            if name not in out:
                out[name] = np.zeros((*size, *values.shape[2:]), values.dtype if kinds else np.float32)
            if name == "flags":
                out[name][here] |= np.where(piece.known, values, 0)
                without[here] |= np.where(piece.inside, values, 0)
            elif name == "mask":
                out[name][here] |= np.where(piece.inside, values, 0)
            elif kinds:
                out[name][here] = np.where(weight > best[here], values, out[name][here])
            else:
                out[name][here] += weight.reshape(weight.shape + (1,) * (values.ndim - 2)) * values
        best[here] = np.maximum(best[here], weight)
        total[here] += weight
    known, divisor = total > 0, np.where(total > 0, total, 1)
    for name, kinds in names.items():
        if not kinds and name in out:
            out[name] /= divisor.reshape(divisor.shape + (1,) * (out[name].ndim - 2))
    length = np.linalg.norm(out["normals"], axis=-1)
    scatter = np.where(known, np.maximum(1 - np.square(length), 0), 0)
    out["sigma"] = np.where(known, np.sqrt(square / divisor + scatter), np.pi / 2).astype(np.float32)
    for name in NORMALS:
        if name in out:
            unit = np.linalg.norm(out[name], axis=-1, keepdims=True)
            out[name] = np.where(known[..., None], out[name] / np.maximum(unit, 1e-12), (0, 0, 1)).astype(np.float32)
    out["flags"] = np.where(known, out["flags"], np.where(without > 0, without, TOO_FEW_LIGHTS))
    return out
