"""Place all fields of a mosaic together: one sparse robust least-squares problem over all overlaps.

A point x of field i (column, row), from the optical axis c in units of the reach L (half the largest diagonal), lies in
the mosaic at

    X = T_i + s_i R(r_i) L q (1 + k_1 |q|^2 + k_2 |q|^4 + t . q),    q = (x - c) / L

T, r and s are the position, turn and scale of the field. The lens (k_1, k_2; D. C. Brown, 1971) and the tilt t of the
camera against its stage, to first order, are common to all fields. They are used where they predict matches that were
left out of the adjustment better. The first field's position, the mean turn and the mean scale are fixed.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from nishiki.errors import UserError
from nishiki.mosaic.registration import Field, Overlap, fit_similarity

LENSES = {"none": (), "k1": (0,), "k1, k2": (0, 1), "k1, tilt": (0, 2, 3), "k1, k2, tilt": (0, 1, 2, 3)}
LEAST_GAIN = 0.05  # of the error of matches or overlaps left out, for a lens or levels with more terms
FOLDS = 4
# standard deviations expected of k_1, k_2 and t: where fields form a line, they are free
PRIOR = (0.05, 0.05, 0.01, 0.01)
SCALE_PRIOR = 0.01  # likewise of a field's scale and turn, against drift along a chain of fields
GAUGE = 1e5  # weight of the sum of all turns, and of all scales' logarithms
ROUNDS = 16
WRONG = 0.5, 2.0  # residual of a wrong overlap: pixels, and relative to that of a similarity of its own


@dataclass(frozen=True)
class FieldPlacement:
    """Positions of the fields in the mosaic.

    fields : fields, by number
    position : (fields, 2) float64
        Place of each field's centre, column and row.
    turn, scale : (fields,) float64
        Turn in radians, from columns to rows, and pixels of the mosaic to one of the field.
    lens : (4,) float64
        k_1, k_2 and t.
    sigma : (fields,) float64
        Standard error of the position against the first field, pixels.
    """

    fields: tuple[Field, ...]
    position: np.ndarray
    turn: np.ndarray
    scale: np.ndarray
    lens: np.ndarray
    sigma: np.ndarray

    @property
    def reach(self) -> float:
        """Half the diagonal of the largest field, pixels."""
        return max(float(np.hypot(*field.shape)) for field in self.fields) / 2

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the mosaic, whose first pixel is at (0, 0)."""
        columns, rows = np.max([self.box(i)[1] for i in range(len(self.fields))], axis=0)
        return int(rows), int(columns)

    def box(self, i: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the first (column, row) and the end of a field's bounding box in the mosaic, int64."""
        rows, columns = self.fields[i].shape
        x, y = np.linspace(0, columns - 1, 33), np.linspace(0, rows - 1, 33)
        rim = [np.stack([x, 0 * x + end], 1) for end in (0, rows - 1)]
        rim += [np.stack([0 * y + end, y], 1) for end in (0, columns - 1)]
        places = self.to_mosaic(i, np.concatenate(rim))
        return np.floor(places.min(axis=0) + 1e-3).astype(int), np.floor(places.max(axis=0) + 1e-3).astype(int) + 1

    def to_mosaic(self, i: int | np.ndarray, points: np.ndarray) -> np.ndarray:
        """Return the places (..., 2) in the mosaic of places in field i, or in fields i (...)."""
        q = self.scale_offset(i, points)
        turned = (q * _bend(q, self.lens)) @ (1, 1j) * (self.reach * self.scale[i] * np.exp(1j * self.turn[i]))
        return self.position[i] + np.stack([turned.real, turned.imag], axis=-1)

    def to_field(self, i: int, places: np.ndarray) -> np.ndarray:
        """Return the points (..., 2) of field i at places in the mosaic."""
        turned = (places - self.position[i]) @ (1, 1j) * np.exp(-1j * self.turn[i]) / (self.reach * self.scale[i])
        q = straight = np.stack([turned.real, turned.imag], axis=-1)
        for _ in range(8 if self.lens.any() else 0):  # a contraction, as the lens bends little
            q = straight / _bend(q, self.lens)
        return self.fields[i].centre + self.reach * q

    def scale_offset(self, i: int | np.ndarray, points: np.ndarray) -> np.ndarray:
        """Return q (..., 2) of places in field i, or in fields i (...)."""
        return (points - np.array([field.centre for field in self.fields])[i]) / self.reach


def _bend(q: np.ndarray, lens: np.ndarray) -> np.ndarray:
    square = np.square(q).sum(axis=-1, keepdims=True)
    return 1 + square * (lens[0] + lens[1] * square) + (q @ lens[2:])[..., None]


def adjust(fields: Sequence[Field], overlaps: Sequence[Overlap]) -> tuple[FieldPlacement, dict]:
    """Place the fields by their overlaps.

    Returns the placement, and plain numbers: `lens` with the error of matches left out of each choice, `rms_px` of all
    residuals, and `overlaps` with their fields, number of windows, residual, and why they are not used, else None.

    Raises
    ------
    UserError
        Where nothing connects some fields, or overlaps contradict each other and nothing shows which is wrong.
    """
    used = [overlap for overlap in overlaps if not overlap.problem]
    expect_connected(fields, used, overlaps)
    limits = {}
    for overlap in used:
        matrix, _ = fit_similarity(overlap.points, overlap.covariance)  # of this overlap alone
        apart = overlap.points[1] - overlap.points[0] @ matrix[:, :2].T - matrix[:, 2]
        limits[id(overlap)] = max(WRONG[0], WRONG[1] * np.median(np.linalg.norm(apart, axis=1)))
    for _ in range(len(used)):
        residuals = solve(fields, used, LENSES["k1, k2, tilt"])[1]
        excess = [np.median(each) - limits[id(overlap)] for each, overlap in zip(residuals, used, strict=True)]
        worst = int(np.argmax(excess))
        if excess[worst] <= 0:
            break
        wrong = used.pop(worst)
        overlaps = [replace(each, problem="contradicts others") if each is wrong else each for each in overlaps]
        expect_connected(fields, used, overlaps)
        expect_support(fields, used, wrong)
    errors = {name: left_out_error(fields, used, terms) for name, terms in LENSES.items()}
    chosen = "none"
    for name in LENSES:
        if errors[name] < (1 - LEAST_GAIN) * errors[chosen]:
            chosen = name
    placement, residuals = solve(fields, used, LENSES[chosen])
    first = np.min([placement.box(i)[0] for i in range(len(fields))], axis=0)
    placement = replace(placement, position=placement.position - first)
    rms = {id(o): float(np.sqrt(np.mean(np.square(each)))) for o, each in zip(used, residuals, strict=True)}
    return placement, {
        "lens": {"terms": chosen, "values": placement.lens.tolist(), "left_out_px": errors},
        "rms_px": float(np.sqrt(np.mean(np.square(np.concatenate(residuals))))) if residuals else 0.0,
        "overlaps": [
            {
                "fields": [fields[o.first].name, fields[o.second].name],
                "windows": o.points.shape[1],
                "used": not o.problem,
                "rms_px": rms.get(id(o)),
                "why": o.problem or None,
            }
            for o in overlaps
        ],
    }


def solve(fields: Sequence[Field], overlaps: Sequence[Overlap], lens: Sequence[int]) -> tuple[FieldPlacement, list]:
    """Adjust with the given terms of the lens; return the placement, and the residuals of each overlap in pixels.

    Gauss-Newton steps, with weights of least absolute deviations first, so that a wrong overlap does not pull, then
    with Cauchy's.
    """
    from scipy.sparse import csc_matrix
    from scipy.sparse.linalg import splu

    count, start = len(fields), np.zeros(len(fields))
    placement = FieldPlacement(tuple(fields), np.zeros((count, 2)), start, start + 1, np.zeros(4), start)
    if not overlaps:
        return placement, []
    sizes, size = [o.points.shape[1] for o in overlaps], 4 * count + 4
    owner = np.repeat(np.array([(o.first, o.second) for o in overlaps]).T, sizes, axis=1)
    points = np.concatenate([o.points for o in overlaps], axis=1)
    whiten = np.linalg.inv(np.linalg.cholesky(np.concatenate([o.covariance for o in overlaps])))
    prior = np.r_[np.full((count, 4), (0, 0, SCALE_PRIOR**-2, SCALE_PRIOR**-2)).ravel(), np.square(PRIOR) ** -1.0]
    prior[[0, 1] + [4 * count + k for k in range(4) if k not in lens]] = 1e12  # what is held
    sums = np.arange(2 * count)  # of turns and of scales
    row = np.r_[np.repeat(np.arange(owner.size), 8), np.repeat(np.arange(owner.size), 8), owner.size + sums % 2]
    common = np.tile(4 * count + np.arange(4), (owner.shape[1], 1))
    column = [np.concatenate([4 * each[:, None] + np.arange(4), common], axis=1).repeat(2, axis=0) for each in owner]
    place = row, np.r_[column[0].ravel(), column[1].ravel(), 4 * (sums // 2) + 2 + sums % 2]
    spread = 1.0
    for step in range(ROUNDS):
        residual = placement.to_mosaic(owner[0], points[0]) - placement.to_mosaic(owner[1], points[1])
        white = np.einsum("nij,nj->ni", whiten, residual)
        length = np.linalg.norm(white, axis=1)
        if step < ROUNDS // 2:
            weight = 1 / np.maximum(length, 1)
        else:
            spread = max(1.0, float(np.median(length)) / 1.18)  # of a Rayleigh distribution
            weight = 1 / (1 + np.square(length / (2.5 * spread)))
        root = np.sqrt(weight)[:, None]
        slopes = [whiten @ _slopes(placement, *each) * root[..., None] for each in zip(owner, points, strict=True)]
        entries = np.r_[slopes[0].ravel(), -slopes[1].ravel(), np.full(2 * count, GAUGE)]
        design = csc_matrix((entries, place), (owner.size + 2, size))
        factors = splu((design.T @ design + csc_matrix((prior, (range(size), range(size))))).tocsc())
        own = np.stack([*np.zeros((2, count)), placement.turn, np.log(placement.scale)], 1)
        state = np.r_[own.ravel(), placement.lens]
        means = GAUGE * own[:, 2:].sum(axis=0)
        change = -factors.solve(design.T @ np.r_[(white * root).ravel(), means] + prior * state)
        own = change[: 4 * count].reshape(count, 4)
        placement = replace(
            placement,
            position=placement.position + own[:, :2],
            turn=placement.turn + own[:, 2],
            scale=placement.scale * np.exp(own[:, 3]),
            lens=placement.lens + change[4 * count :],
        )
        if step == ROUNDS - 1:
            variance = factors.solve(np.eye(size)[:, : 4 * count])[: 4 * count].diagonal().reshape(count, 4)
            placement = replace(placement, sigma=spread * np.sqrt(np.maximum(variance[:, :2].mean(axis=1), 0)))
    return placement, np.split(np.linalg.norm(residual, axis=1), np.cumsum(sizes)[:-1])


def _slopes(placement: FieldPlacement, i: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return the derivatives (n, 2, 8) of places in the mosaic by T, r and log s of their field and by the lens."""
    q, around = placement.scale_offset(i, points), placement.to_mosaic(i, points) - placement.position[i]
    square = np.square(q).sum(axis=1, keepdims=True)
    lens = (around / _bend(q, placement.lens))[:, :, None] * np.concatenate([square, square**2, q], axis=1)[:, None]
    own = np.stack([around[:, ::-1] * (-1, 1), around], axis=2)
    return np.concatenate([np.broadcast_to(np.eye(2), (len(q), 2, 2)), own, lens], axis=2)


def left_out_error(fields: Sequence[Field], overlaps: Sequence[Overlap], lens: Sequence[int]) -> float:
    """Return the median error, pixels, of matches that were left out of the adjustment in turn."""
    errors = []
    for fold in range(FOLDS):
        kept, rest = [], []
        for overlap in overlaps:
            out = np.arange(overlap.points.shape[1]) % FOLDS == fold
            for part, chosen in ((kept, ~out), (rest, out)):
                part.append(replace(overlap, points=overlap.points[:, chosen], covariance=overlap.covariance[chosen]))
        placement, _ = solve(fields, kept, lens)
        apart = [placement.to_mosaic(o.first, o.points[0]) - placement.to_mosaic(o.second, o.points[1]) for o in rest]
        errors += [np.linalg.norm(each, axis=1) for each in apart]
    return float(np.median(np.concatenate(errors))) if errors else 0.0


def _groups(count: int, overlaps: Sequence[Overlap]) -> np.ndarray:
    """Return the number of the connected group of each field."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    pairs = np.array([(o.first, o.second) for o in overlaps], int).reshape(-1, 2)
    return connected_components(coo_matrix((np.ones(len(pairs)), pairs.T), (count, count)), directed=False)[1]


def expect_connected(fields: Sequence[Field], used: Sequence[Overlap], overlaps: Sequence[Overlap]) -> None:
    """Raise UserError, with the names, where overlaps do not connect all fields."""
    group = _groups(len(fields), used)
    if group.max(initial=0) == 0:
        return
    main = int(np.argmax(np.bincount(group)))
    lost = [field.name for field, number in zip(fields, group, strict=True) if number != main]
    doubts = [f"{fields[o.first].name} and {fields[o.second].name}: {o.problem}" for o in overlaps if o.problem]
    raise UserError(
        f"{len(lost)} of {len(fields)} fields are not connected to the others by an overlap that can be relied on: "
        f"{', '.join(lost[:12])}. {'Overlaps not used: ' + '; '.join(doubts[:6]) + '. ' if doubts else ''}Remedy: "
        "photograph fields that overlap them by 15 % or more where the surface has texture, turned by less than 4 "
        "degrees against them; where an ornament repeats, "
        "state the positions in fields.csv (and pixel_pitch_mm in each capture.yaml); or leave these fields out of it."
    )


def expect_support(fields: Sequence[Field], used: Sequence[Overlap], wrong: Overlap) -> None:
    """Raise UserError where any other overlap on the way between the fields of a wrong one could be wrong instead.

    Between its fields every overlap must lie in a loop that closes without it.
    """
    for overlap in used:
        group = _groups(len(fields), [other for other in used if other is not overlap])
        if group[wrong.first] != group[wrong.second]:
            names = [fields[k].name for k in (wrong.first, wrong.second, overlap.first, overlap.second)]
            raise UserError(
                f"the overlap of {names[0]} and {names[1]} contradicts the others, among them that of {names[2]} and "
                f"{names[3]}, and nothing shows which is wrong. Remedy: state the positions in fields.csv (and "
                "pixel_pitch_mm in each capture.yaml), or add a field that overlaps several of them."
            )
