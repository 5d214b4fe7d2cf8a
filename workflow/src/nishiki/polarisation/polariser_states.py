"""From polariser states to sums of photographs: which weighted sums give the components.

Every method here is linear in the photographs up to the last step, so that a view is separated by reading each of its
photographs once and adding it, weighted, to a few planes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from nishiki.errors import UserError
from nishiki.polarisation.mueller import Arm, design_matrix, equal_steps, solvable

MOST_CONDITION = 1e3
NEARLY = 1.0  # degrees: angles that count as parallel or crossed


@dataclass(frozen=True)
class StateSums:
    """method: none | circular | crossed | linear | pairs | mueller. states: names, in order; used: those that count.

    weights (planes, states) float64: plane p is sum_k weights[p, k] I_k. Planes: none: the photograph; circular: off,
    on; crossed and pairs: parallel, crossed; linear: mean a, then the cosine and sine parts of twice the angle;
    mueller: m00, m11, m22. elements (e,): indices of the Mueller matrix that are solved for; inverse (e, states): their
    weights; design (states, e): the way back; empty for plain sums. condition: of the least squares, 1 for plain sums.
    angles_deg: as taken (equal steps whose names are rounded count as equal).
    """

    method: str
    states: tuple[str, ...]
    weights: np.ndarray
    condition: float
    design: np.ndarray
    inverse: np.ndarray
    elements: tuple[int, ...] = ()
    angles_deg: tuple[tuple[float, ...], ...] = ()
    used: int = 0


def sums_of(
    states: Sequence[str], *, generator: Arm | None = None, analyser: Arm | None = None, method: str = "auto"
) -> StateSums:
    """The sums for these states: '' (none), off/on, analyser angles, or generator/analyser angles (degrees).

    generator, analyser: the instrument's arms where calibrated; without, angles are those of linear polarisers.
    method auto: generator/analyser series use the Mueller matrix where the arms are given or no parallel and crossed
    pair exists, else the pairs. Raises UserError where the states cannot be separated.
    """
    states = tuple(states)
    if method == "none" or len(states) == 1:
        first = states.index("off") if "off" in states else 0
        return _plain("none", states, np.eye(len(states))[first : first + 1])
    if set(states) == {"off", "on"}:
        order = np.array([[state == "off" for state in states], [state == "on" for state in states]], float)
        return _plain("circular", states, order)
    angles = _angles(states)
    if len(angles[0]) == 1:
        return _linear(states, angles[:, 0])
    return _series(states, angles, generator, analyser, method)


def _plain(method: str, states: tuple[str, ...], weights: np.ndarray, **rest) -> StateSums:
    nothing = np.zeros((len(states), 0))
    return StateSums(
        method, states, weights, 1.0, nothing, nothing.T, used=int((weights != 0).any(axis=0).sum()), **rest
    )


def _angles(states: tuple[str, ...]) -> np.ndarray:
    try:
        angles = [[float(part) for part in state.split("/")] for state in states]
        table = np.array(angles, np.float64).reshape(len(states), len(angles[0]))
        if not np.isfinite(table).all() or table.shape[1] > 2:
            raise ValueError("no angles")
        return table
    except ValueError:
        raise UserError(
            f"polariser states {', '.join(map(repr, states[:6]))}: expected off and on, analyser angles, or "
            "generator/analyser angles, all of one kind. Remedy: correct the column polariser of frames.csv"
        ) from None


def _linear(states: tuple[str, ...], angles: np.ndarray) -> StateSums:
    """a + b cos 2(psi - psi0) = a + c cos 2 psi + s sin 2 psi, linear in a, c, s."""
    reported_angles = tuple((float(angle),) for angle in angles)
    distinct = np.unique(np.round(np.remainder(angles, 180.0), 6))
    if len(distinct) == 2 and abs(abs(distinct[1] - distinct[0]) - 90) <= NEARLY:
        groups = np.isclose(np.remainder(angles, 180.0)[None], distinct[:, None], atol=1e-5)
        return _plain("crossed", states, groups / groups.sum(axis=1, keepdims=True), angles_deg=reported_angles)
    psi = np.radians(equal_steps(angles))
    design = np.column_stack([np.ones(len(psi)), np.cos(2 * psi), np.sin(2 * psi)])
    sizes = np.linalg.svd(design, compute_uv=False)
    if len(distinct) < 3 or sizes[-1] * MOST_CONDITION < sizes[0]:
        raise UserError(
            f"analyser angles {', '.join(states)}: expected three or more different ones, well spread (0, 60, 120; "
            "0, 45, 90, "
            "135), or two that are 90 degrees apart. Remedy: photograph more angles"
        )
    inverse = np.linalg.pinv(design)
    return StateSums(
        "linear",
        states,
        inverse,
        float(sizes[0] / sizes[-1]),
        design,
        inverse,
        angles_deg=reported_angles,
        used=len(states),
    )


def _series(states, angles, generator, analyser, method) -> StateSums:
    calibrated = generator is not None and analyser is not None
    steps = np.column_stack([equal_steps(angles[:, 0]), equal_steps(angles[:, 1])])
    reported_angles = tuple(map(tuple, steps.tolist()))
    parallel, crossed = _pairs(steps)
    if method == "pairs" or (method == "auto" and not calibrated and parallel.any()):
        if calibrated and (generator.retardance is not None or analyser.retardance is not None):
            raise UserError("method pairs needs linear polarisers; these states turn retarders. Remedy: method auto")
        if not parallel.any():
            raise UserError("polariser states: no generator angle has both its parallel and its crossed analyser")
        weights = np.stack([_each_generator(steps[:, 0], chosen) for chosen in (parallel, crossed)])
        return _plain("pairs", states, weights, angles_deg=reported_angles)
    design = design_matrix(generator or Arm(), analyser or Arm(), np.radians(steps))
    solution = solvable(design)
    if solution is None or solution[1] > MOST_CONDITION:
        raise UserError(
            f"{len(states)} generator/analyser states determine neither parallel and crossed images nor the Mueller "
            "matrix. "
            "Remedy: for some generator angles photograph the same analyser angle and the one 90 degrees from it"
        )
    elements, condition = solution
    part = design[:, elements]
    inverse = np.linalg.pinv(part)
    places = [elements.index(k) for k in (0, 5, 10)]
    return StateSums(
        "mueller", states, inverse[places], condition, part, inverse, elements, reported_angles, used=len(states)
    )


def _pairs(angles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(states,) bool twice: parallel and crossed states of the generator angles that have both."""
    apart = np.remainder(angles[:, 1] - angles[:, 0] + 90, 180) - 90
    parallel, crossed = np.abs(apart) <= NEARLY, 90 - np.abs(apart) <= NEARLY
    generators = np.remainder(angles[:, 0], 180)
    both = np.isin(generators, generators[parallel]) & np.isin(generators, generators[crossed])
    return parallel & both, crossed & both


def _each_generator(generators: np.ndarray, chosen: np.ndarray) -> np.ndarray:
    """(states,) weights of the mean over generator angles of the mean over the chosen states of each."""
    generators = np.round(np.remainder(generators, 180), 6)
    angles = np.unique(generators[chosen])
    counts = np.array([(chosen & (generators == angle)).sum() for angle in angles])
    places = np.searchsorted(angles, generators)
    return np.array([1 / (counts[k] * len(angles)) if c else 0.0 for k, c in zip(places, chosen, strict=True)])
