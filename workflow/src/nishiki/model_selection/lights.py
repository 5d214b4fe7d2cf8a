"""Choose the lights of a fit: evenly spread, as few as give nearly the normals of all lights."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from nishiki.errors import UserError
from nishiki.model_selection.decision import Decision
from nishiki.observations.plane import Observations, sample
from nishiki.photometric.flags import NO_ESTIMATE
from nishiki.photometric.light_selection import select_diffuse
from nishiki.photometric.solve import NormalField, estimate_normals


def spread_order(directions: np.ndarray) -> np.ndarray:
    """Sort all directions so that every beginning of the order is evenly spread, (n,) int64.

    directions (n, 3), unit or positions of any length. The first is the one nearest to their mean; each further one is
    the farthest from those before it, the earlier of equals (T. F. Gonzalez, Clustering to minimize the maximum
    intercluster distance, Theor. Comput. Sci. 38, 1985: no set of as many covers the others within half the distance).
    So a choice of more contains every choice of fewer.
    """
    directions = np.asarray(directions, np.float64)
    if directions.ndim != 2 or not np.isfinite(directions).all():
        raise UserError(f"directions: expected finite (n, 3), found an array {directions.shape}")
    count = len(directions)
    order = np.empty(count, np.int64)
    if not count:
        return order
    order[0] = np.argmin(_squares(directions, directions.mean(axis=0)))
    nearest = _squares(directions, directions[order[0]])
    ordered = np.zeros(count, bool)
    ordered[order[0]] = True
    for k in range(1, count):
        order[k] = np.argmax(np.where(ordered, -1.0, nearest))
        ordered[order[k]] = True
        nearest = np.minimum(nearest, _squares(directions, directions[order[k]]))
    return order


def _squares(directions: np.ndarray, point: np.ndarray) -> np.ndarray:
    """Compute squared distances to a point, rounded: sums in another order must not change the farthest point."""
    return np.round(np.sum((directions - point) ** 2, axis=1), 12)


LIMIT_DEG = 0.2  # by which half of the normals may move
WORTH = 30_000_000  # samples (lights x pixels) from which the choice costs less than the lights that it saves
FEWEST = 32
"""Least number of lights: up to 24 the joint fit begins, and selection needs samples beside gloss and shadow."""
OVERRIDE = "normals.lights: all, auto or a number"


@dataclass(frozen=True)
class LightSample:
    """Sampled pixels under one set of directions: observations, valid (lights, 1, pixels), directions (lights, 3)."""

    observations: np.ndarray
    valid: np.ndarray
    directions: np.ndarray


Solve = Callable[[np.ndarray, np.ndarray, np.ndarray], tuple[np.ndarray, NormalField]]
"""Solver from (observations, directions, valid) to (usable samples, normals), as in the stages."""


def static_choice(directions: np.ndarray, setting: int) -> tuple[np.ndarray, Decision | None]:
    """Choose a number of lights (all if there are no more); return (their rows, in rising order; the decision)."""
    count = len(directions)
    if setting >= count:
        return np.arange(count), None
    chosen = np.sort(spread_order(directions)[:setting])
    lost = 100 * (np.sqrt(count / len(chosen)) - 1)
    decision = Decision(
        "lights",
        f"{len(chosen)} of {count} lights, evenly spread",
        "number set",
        None,
        None,
        f"standard error of the normals about {lost:.0f} % larger (noise alone), fewer samples to detect highlights",
        OVERRIDE,
    )
    return chosen, decision


def not_worth(lights: int, pixels: int) -> Decision | None:
    """Return the decision to take all lights at once where the fit costs no more than the choice; else None."""
    if lights <= FEWEST or lights * pixels >= WORTH:
        return None
    criterion = "samples (lights x pixels), below which the choice costs more than it saves"
    return Decision(
        "lights", f"all {lights} lights", criterion, float(lights * pixels), float(WORTH), "nothing", OVERRIDE
    )


def measured_choice(
    directions: np.ndarray, samples: Sequence[LightSample], solve: Solve
) -> tuple[np.ndarray, Decision | None]:
    """Choose as `static_choice`, but the fewest lights by which half of the sample's normals stay in place.

    First predicted, then checked by solving the sample with the lights chosen; a quarter more of them
    until the check is passed. None decided where there are no more than FEWEST lights, or no pixel to judge by.
    """
    count = len(directions)
    if count <= FEWEST or not samples:
        return np.arange(count), None
    order = spread_order(directions)
    full = [solve(sample.observations, sample.directions, sample.valid) for sample in samples]
    number, most = FEWEST, count
    while number < most:  # the fewest whose predicted addition is within the limit
        middle = (number + most) // 2
        within = added_deg(order[:middle], samples, full) <= LIMIT_DEG
        number, most = (number, middle) if within else (middle + 1, most)
    predicted = added_deg(order[:number], samples, full)
    moved = np.inf
    while number < count:
        moved = moved_deg(np.sort(order[:number]), samples, full, solve)
        if moved <= LIMIT_DEG:
            break
        number = min(count, number + -(-number // 4))
    saved = number < count
    if not np.isfinite(moved):  # none fewer was worth checking: what a quarter fewer would cost
        moved = added_deg(order[: max(FEWEST, 3 * count // 4)], samples, full)
    if saved:
        loss = f"half of the normals move by less than {moved:.2g} degrees (noise alone predicts {predicted:.2g})"
    else:
        loss = "nothing: fewer lights move the normals by more than the limit"
    decision = Decision(
        "lights",
        f"{number} of {count} lights" + ", evenly spread" * saved,
        "median angle to the normals of all lights on a sample, degrees",
        float(moved),
        LIMIT_DEG,
        loss,
        OVERRIDE,
    )
    return np.sort(order[:number]), decision


def added_deg(rows: np.ndarray, samples: Sequence[LightSample], full) -> float:
    """Predict the angle that fewer lights add to the error of a normal, degrees: median over the pixels.

    Lambert's law with noise of standard deviation s gives the scaled normal the covariance s^2 M^-1, M the sum of l l^T
    over the usable lights; across the normal its trace is the variance of the direction. With s from the fit to all
    lights, what fewer lights add is the difference of the two variances (their matrices are nested). A pixel that is
    left with fewer than three lights counts as lost (90 degrees).
    """
    added = [np.empty(0)]
    for piece, (usable, field) in zip(samples, full, strict=True):
        known = (field.flags.ravel() & NO_ESTIMATE) == 0
        normals, sigma = field.normals.reshape(-1, 3)[known].astype(np.float64), field.sigma.ravel()[known]
        masks = usable.reshape(len(usable), -1)[:, known].astype(np.float64)
        all_of, of_rows = (_across(piece.directions[k], masks[k], normals) for k in (slice(None), rows))
        share = np.where(np.isfinite(of_rows), of_rows / all_of - 1, np.inf)
        added.append(np.minimum(sigma * np.sqrt(np.maximum(share, 0)), 0.5 * np.pi))
    values = np.concatenate(added)
    return float(np.degrees(np.median(values))) if values.size else 0.0


def _across(directions: np.ndarray, masks: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Compute (pixels,) trace of the inverse of sum of l l^T across the normal; infinite where it is singular."""
    matrix = np.einsum("lp,la,lb->pab", masks, directions, directions)
    regular = np.linalg.cond(matrix) < 1e10
    inverse = np.linalg.inv(np.where(regular[:, None, None], matrix, np.eye(3)))
    trace = np.trace(inverse, axis1=1, axis2=2) - np.einsum("pa,pab,pb->p", normals, inverse, normals)
    return np.where(regular, trace, np.inf)


def moved_deg(rows: np.ndarray, samples: Sequence[LightSample], full, solve: Solve) -> float:
    """Compute the median angle between normals of the lights `rows` and of all, degrees; lost pixels count 90."""
    angles = []
    for chosen, (_, field) in zip(samples, full, strict=True):
        fewer = solve(chosen.observations[rows], chosen.directions[rows], chosen.valid[rows])[1]
        known = (field.flags & NO_ESTIMATE) == 0
        difference = np.linalg.norm(fewer.normals.astype(np.float64) - field.normals, axis=-1)
        angle = 2 * np.arcsin(np.minimum(0.5 * difference, 1))
        lost = (fewer.flags & NO_ESTIMATE) != 0
        angles.append(np.where(lost, 0.5 * np.pi, angle)[known])
    values = np.concatenate(angles) if angles else np.empty(0)
    return float(np.degrees(np.median(values))) if values.size else 0.0


PIXELS = 1200  # of the sample


def choose_lights(frames: Observations, lights: np.ndarray, settings) -> tuple[np.ndarray, Decision | None]:
    """Choose the rows of `lights` for the fit; return the decision too; settings: of separate, else of normals."""
    directions = frames.directions[lights]
    if settings.lights == "all" or (settings.lights == "auto" and len(lights) <= FEWEST):
        return np.arange(len(lights)), None
    if settings.lights != "auto":
        return static_choice(directions, settings.lights)
    pixels = int(np.count_nonzero(frames.mask))
    if skipped := not_worth(len(lights), pixels):
        return np.arange(len(lights)), skipped
    pieces = sample(frames, lights, PIXELS)
    samples = [LightSample(piece.observations, piece.valid, piece.parcel.directions) for piece in pieces]
    return measured_choice(directions, samples, solver_of(settings))


def solver_of(settings):
    """Build the solver of the trial: selection as in separate (if normals uses it), default solution."""

    def solve(observations: np.ndarray, directions: np.ndarray, valid: np.ndarray) -> tuple[np.ndarray, NormalField]:
        usable = valid
        if hasattr(settings, "method"):
            selection = {"method": settings.method, "w1": settings.w1, "w2": settings.w2, "keep": settings.keep}
            usable = select_diffuse(observations, directions, valid=valid, **selection).usable
        return usable, estimate_normals(observations, directions, usable=usable, valid=valid)

    return solve
