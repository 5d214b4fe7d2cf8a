"""Level the fields of a mosaic: a gain of reflectance and a tilt of the normals, solved over all overlaps together.

Of field i, the logarithm of reflectance in each channel, and the two angles of the normal, differ from the mosaic's by

    e_i(q) = c_i + w . (q_x, q_y, q_x^2, q_x q_y, q_y^2)

with c_i its own and w, a slow change across the field, common to all, as the same lamps light every field. Overlaps
give only differences: a slope across each field and a growth of c over the mosaic explain them alike. A prior about 0,
as wide as the differences of whole overlaps, decides, so that the mean of c is 0 and an error that repeats in each
field does not bend the whole. Overlaps left out in turn decide whether fields are levelled, and whether with squares.
"""

from dataclasses import dataclass

import numpy as np

from nishiki.model_selection.decision import Decision

CHOICES = {"none": None, "constant and slope": 2, "with squares": 5}  # terms of w; None: no levels at all
LEAST_GAIN = 0.05  # of the error of overlaps left out, for more terms
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
        """Return the chosen ones."""
        return Samples(self.pair[chosen], self.place[chosen], self.values[chosen])


@dataclass(frozen=True)
class Levels:
    """own : (fields, quantities), c; slow : (terms, quantities), w."""

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


def to_quantities(reflectance: np.ndarray, normals: np.ndarray, floor: float = 1e-3) -> np.ndarray:
    """Combine reflectance (..., channels) and normals (..., 3) into logarithms and angles (..., channels + 2)."""
    angles = np.arctan2(normals[..., :2], np.maximum(normals[..., 2:], 1e-3))
    return np.concatenate([np.log(np.maximum(reflectance, floor)), angles], axis=-1)


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
