"""Level the fields of a mosaic, resample their maps onto it and blend them: reflectance, normals, never brightness.

Levels are a gain of reflectance and a tilt of the normals, solved over all overlaps together. Of field i, the logarithm
of reflectance in each channel, and the two angles of the normal, differ from the mosaic's by

    e_i(q) = c_i + w . (q_x, q_y, q_x^2, q_x q_y, q_y^2)

with c_i its own and w, a slow change across the field, common to all, as the same lamps light every field. Overlaps
give only differences: a slope across each field and a growth of c over the mosaic explain them alike. A prior about 0,
as wide as the differences of whole overlaps, decides, so that the mean of c is 0 and an error that repeats in each
field does not bend the whole. Overlaps left out in turn decide whether fields are levelled, and whether with squares.

Every field counts by the inverse of its normals' variance times the distance to its rim, so that it fades out there.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from nishiki.model_selection.decision import Decision
from nishiki.mosaic.adjustment import LEAST_GAIN, FieldPlacement
from nishiki.photometric.flags import NO_ESTIMATE, NormalFlag

LEAST_NZ = 1e-3  # of a normal that is tilted
LEAST_REFLECTANCE = 1e-3  # in logarithms: darker places count as this bright
Reader = Callable[[str, slice], np.ndarray]
"""Reader of values from the name of a map and a slice of its rows."""
CELL, SQUARE = 32, 8  # pixels: distance between the areas at which fields are compared, and the areas' side
NODES = 16  # pixels between places that are computed
CELLS = 8  # rows of these areas that are compared at a time
LEAST_SIGMA = 1e-3  # radians: a field that claims less counts no more
NORMALS = ("normals", "shading_normals")
COLOURS = ("reflectance", "albedo")
CHOICES = {"none": None, "constant and slope": 2, "with squares": 5}  # terms of w; None: no levels at all
ROUNDS = 8
MOST_LEFT_OUT = 12  # overlaps
GROUP = 25  # neighbouring samples whose median is judged where an overlap was left out


@dataclass(frozen=True)
class Samples:
    """Pairs of small areas that two fields show.

    pair : (n, 2) int64
        Numbers of the fields.
    place : (n, 2, 2) float64
        Places in both fields, from the centre in units of the reach.
    values : (n, 2, quantities) float64
        Of both fields: logarithms of reflectance, then the angles of the normal in radians.
    """

    pair: np.ndarray
    place: np.ndarray
    values: np.ndarray

    def only(self, chosen: np.ndarray) -> "Samples":
        """Return the chosen samples."""
        return Samples(self.pair[chosen], self.place[chosen], self.values[chosen])


@dataclass(frozen=True)
class Levels:
    """Levels of the fields. own : (fields, quantities), c; slow : (terms, quantities), w."""

    own: np.ndarray
    slow: np.ndarray

    def at(self, fields: np.ndarray | int, place: np.ndarray) -> np.ndarray:
        """Return e (..., quantities) of fields at places (..., 2) in units of the reach."""
        return self.own[fields] + slow_terms(place, len(self.slow)) @ self.slow

    def taken_off(self, samples: Samples) -> np.ndarray:
        """Return the values (n, 2, quantities) of samples without their levels."""
        return samples.values - self.at(samples.pair, samples.place)


def slow_terms(place: np.ndarray, count: int) -> np.ndarray:
    """Return the first terms (..., count) of the slow change at places (..., 2)."""
    x, y = place[..., 0], place[..., 1]
    return np.stack([x, y, x * x, x * y, y * y], axis=-1)[..., :count]


def solve_levels(samples: Samples, fields: int, terms: int | None) -> Levels:
    """Solve c and w by robust least squares (Cauchy's weights), each quantity by itself; no terms: all are 0."""
    from scipy.sparse import coo_matrix, hstack

    count, quantities = len(samples.pair), samples.values.shape[2]
    if terms is None:
        return Levels(np.zeros((fields, quantities)), np.zeros((0, quantities)))
    slow = slow_terms(samples.place[:, 0], terms) - slow_terms(samples.place[:, 1], terms)
    own = coo_matrix((np.tile((1.0, -1.0), count), (np.arange(count).repeat(2), samples.pair.ravel())), (count, fields))
    design = hstack([own, slow]).tocsr()
    apart, found = samples.values[:, 0] - samples.values[:, 1], np.zeros((fields + terms, quantities))
    number = samples.pair @ (fields, 1)
    wide = [np.square(np.median(apart[number == each], axis=0)) for each in np.unique(number)]
    prior = np.mean(wide, axis=0) + 1e-12 if wide else np.ones(quantities)
    for k in range(quantities if count else 0):
        rest = apart[:, k]
        for _ in range(ROUNDS):
            spread = 1.4826 * float(np.median(np.abs(rest))) + 1e-6
            weight = 1 / (1 + np.square(rest / (2 * spread)))
            matrix = (design.T @ design.multiply(weight[:, None])).toarray() + spread**2 / prior[k] * np.eye(
                fields + terms
            )
            found[:, k] = np.linalg.solve(matrix, design.T @ (weight * apart[:, k]))
            rest = apart[:, k] - design @ found[:, k]
    return Levels(found[:fields], found[fields:])


def level_fields(samples: Samples, fields: int) -> tuple[Levels, Decision]:
    """Solve the levels of all fields, with as many terms as predict overlaps left out in turn."""
    errors, chosen = {name: left_out_error(samples, fields, terms) for name, terms in CHOICES.items()}, "none"
    for name in CHOICES:
        chosen = name if errors[name] < (1 - LEAST_GAIN) * errors[chosen] else chosen
    best = min(errors.values()) / errors["none"] if errors["none"] > 0 else 1.0
    decision = Decision(
        "levels",
        chosen,
        "part of the difference of overlaps left out that levels take off",
        1 - best,
        LEAST_GAIN,
        "seams stay as wide as they are measured",
        "no setting",
    )
    return solve_levels(samples, fields, CHOICES[chosen]), decision


def left_out_error(samples: Samples, fields: int, terms: int | None) -> float:
    """Return the rms difference that is left in overlaps left out in turn, in units of the median difference.

    Of overlaps without which some fields would not be connected, the second half is left out instead.
    """
    number = samples.pair @ (fields, 1)
    unit = np.median(np.abs(samples.values[:, 0] - samples.values[:, 1]), axis=0) + 1e-9 if len(number) else 1.0
    errors = []
    every = np.unique(number)
    for each in every[:: -(-len(every) // MOST_LEFT_OUT) or 1]:
        out = number == each
        edges = np.unique(samples.pair[~out], axis=0)
        if np.linalg.matrix_rank(np.eye(fields)[edges[:, 0]] - np.eye(fields)[edges[:, 1]]) < fields - 1:
            out &= np.cumsum(out) > out.sum() / 2
        ends = solve_levels(samples.only(~out), fields, terms).taken_off(samples.only(out))
        left = (ends[:, 0] - ends[:, 1]) / unit
        groups = np.array_split(left, max(1, len(left) // GROUP))
        errors += [np.square(np.median(group, axis=0)).mean() for group in groups if len(group)]
    return float(np.sqrt(np.mean(errors))) if errors else 0.0


@dataclass(frozen=True)
class FieldPiece:
    """One field's values in a part of the mosaic.

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
    placement: FieldPlacement, i: int, read: Reader, names: Mapping[str, bool], rows: np.ndarray, columns: np.ndarray
) -> FieldPiece | None:
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
    return FieldPiece(
        part, maps, inside, known, place, np.maximum((depth + 1) / (size.min() / 2), 0).astype(np.float32)
    )


def _field_places(placement: FieldPlacement, i: int, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
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
    depth = np.maximum(normals[..., 2:], LEAST_NZ)
    slopes = np.tan(np.arctan2(np.stack([x, y], axis=-1), depth) - tilt)
    turned = np.concatenate([slopes, np.ones_like(depth)], axis=-1)
    return turned / np.linalg.norm(turned, axis=-1, keepdims=True)


def compare_fields(placement: FieldPlacement, readers: Sequence[Reader]) -> Samples:
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
                level = np.log(np.maximum(piece.maps["reflectance"], LEAST_REFLECTANCE))
                angles = np.arctan2(normals[..., :2], normals[..., 2:])
                whole = np.zeros((here.size, across.size, level.shape[2] + 5))
                whole[:, piece.columns] = np.concatenate([level, angles, piece.place, piece.known[..., None]], axis=-1)
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
    placement: FieldPlacement, readers: Sequence[Reader], levels: Levels, names: Mapping[str, bool], rows: slice
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
    out["flags"] = np.where(known, out["flags"], np.where(without > 0, without, NormalFlag.TOO_FEW_LIGHTS))
    return out
