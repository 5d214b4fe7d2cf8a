"""Which combinations of the weave model's parameters the data determine, from the null space of its Jacobian."""

from dataclasses import dataclass

import numpy as np

NULL = 1e-7  # singular value over the largest below which no measurement, however exact, would tell
WEAK = 0.1
LEAST = 0.05  # share of a direction's largest part from which a parameter is named


@dataclass(frozen=True)
class Identifiability:
    """free: products of powers that change nothing. weak: those that the data see, but determine to no better than
    WEAK, the worst first, and weak_error the relative change that is one standard deviation. singular: values of the
    Jacobian over the largest, falling."""

    free: list[str]
    weak: list[str]
    weak_error: list[float]
    singular: list[float]


def identify(predict, parameters: dict[str, float], weight: np.ndarray, *, variance: float) -> Identifiability:
    """From the Jacobian of the weighted prediction in the logarithms of the parameters.

    predict(dict) -> (n,) reflectances; parameters: by name, those that are 0 cannot be changed by a factor and are left
    out; weight (n,) = 1 / sigma; variance: of the weighted residuals, used where above 1.
    """
    names = [name for name, value in parameters.items() if value > 0]
    slopes = np.stack([_slope(predict, parameters, name) for name in names], axis=1) * weight[:, None]
    _, singular, rows = np.linalg.svd(slopes, full_matrices=True)
    singular = np.concatenate([singular, np.zeros(len(names) - len(singular))])
    largest = max(float(singular[0]), 1e-300)
    seen = singular > NULL * largest
    spread = np.sqrt(max(variance, 1.0))
    weak = [k for k in np.flatnonzero(seen)[::-1] if spread / singular[k] > WEAK]
    return Identifiability(
        free=[_product(row, names) for row in _reduced(rows[~seen])],
        weak=[_product(rows[k], names) for k in weak],
        weak_error=[float(f"{spread / singular[k]:.3g}") for k in weak],
        singular=[float(f"{value / largest:.3g}") if value > NULL * largest else 0.0 for value in singular],
    )


def _slope(predict, parameters: dict[str, float], name: str, step: float = 1e-5) -> np.ndarray:
    """Derivative by the logarithm of one parameter, central differences."""
    up, down = ({**parameters, name: parameters[name] * np.exp(sign * step)} for sign in (1, -1))
    return (predict(up) - predict(down)) / (2 * step)


def _reduced(rows: np.ndarray) -> np.ndarray:
    """Reduced row echelon form, pivots by size: the simplest vectors that span the same space."""
    rows, done = rows.copy(), 0
    for column in np.argsort(-np.abs(rows).sum(axis=0), kind="stable") if len(rows) else []:
        if done == len(rows):
            break
        pivot = done + int(np.argmax(np.abs(rows[done:, column])))
        if abs(rows[pivot, column]) < 1e-3:
            continue
        rows[[done, pivot]] = rows[[pivot, done]]
        rows[done] /= rows[done, column]
        for other in range(len(rows)):
            if other != done:
                rows[other] -= rows[other, column] * rows[done]
        done += 1
    return rows


def _product(row: np.ndarray, names: list[str]) -> str:
    """A direction in logarithms as a product of powers, its largest power 1."""
    row = row / row[np.argmax(np.abs(row))]
    return " · ".join(
        name if abs(power - 1) < 1e-3 else f"{name}^{power:.2g}"
        for name, power in zip(names, row, strict=True)
        if abs(power) > LEAST
    )
