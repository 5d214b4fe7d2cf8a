"""One way to fit every parametric model of a cloth: variable projection with prior knowledge of the shape.

A model is, in each channel, fixed(x) + columns(x) c with shape parameters x shared by the channels and c >= 0.  For
any x the c are a small non-negative least-squares problem, so only x is searched (Golub and Pereyra, Separable
nonlinear least squares, 2003), by a trust-region Levenberg-Marquardt on the projected residual.  Priors are Gaussian
in x: they decide what the measurements leave open, and shift what these tell by less than its uncertainty.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

STEP = 1e-4  # of the finite differences, in units of a parameter's scale: parameters are logarithms
REACH = 6.0  # prior standard deviations to either side within which a parameter is searched

Parts = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]  # x -> fixed (n,), columns (n, k)


@dataclass(frozen=True)
class ShapeFit:
    """The most probable shape and its linear coefficients."""

    x: np.ndarray  # (parameters,)
    coefficients: np.ndarray  # (channels, k), >= 0
    information: np.ndarray  # (parameters, parameters) of the measurements and the prior
    cost: float  # sum of squares of residuals and priors
    misfit: float  # of the residuals alone
    evaluations: int
    at_bounds: tuple[int, ...] = ()  # parameters that ended `REACH` prior standard deviations away


def solve_linear(fixed, columns, values, weight, limits) -> np.ndarray:
    """Coefficients (channels, k) >= 0 of columns (n, k) in values (n, channels) less fixed (n,).

    weight (n,): inverse standard deviations; limits (k,): prior standard deviation of each coefficient about 0,
    infinite where none.
    """
    from scipy.optimize import nnls

    ridge = np.diag(1 / np.asarray(limits, float))
    design = np.vstack([columns * weight[:, None], ridge])
    zeros = np.zeros(len(ridge))
    return np.array([nnls(design, np.concatenate([(y - fixed) * weight, zeros]))[0] for y in values.T])


def fit_shape(
    parts: Parts,
    values: np.ndarray,
    weight: np.ndarray,
    *,
    centre: np.ndarray,
    spread: np.ndarray,
    limits: np.ndarray,
    start: np.ndarray | None = None,
    free: np.ndarray | None = None,
    evaluations: int = 20,
) -> ShapeFit:
    """Fit x and c to values (n, channels) with inverse standard deviations weight (n,); channels count as one together.

    centre, spread (parameters,): prior mean and standard deviation; limits (k,) as in `solve_linear`; start: first x
    (default: the centre); free: indices of the parameters to be searched, the rest stays as in start (default: all);
    evaluations: most steps of the search.
    """
    from scipy.optimize import least_squares

    initial = np.array(centre if start is None else start, float)
    free = np.arange(initial.size) if free is None else np.asarray(free)
    channels = values.shape[1]
    low, high = (centre - REACH * spread)[free], (centre + REACH * spread)[free]

    def place(x):
        out = initial.copy()
        out[free] = x
        return out

    def solved(x):
        fixed, columns = parts(place(x))
        c = solve_linear(fixed, columns, values, weight, limits)
        return (fixed[:, None] + columns @ c.T - values) * weight[:, None] / np.sqrt(channels), c

    def residual(x):
        rest, c = solved(x)
        return np.concatenate([rest.ravel(), ((place(x) - centre) / spread)[free], (c / limits).ravel()])

    first = np.clip(initial[free], low, high)
    solution = least_squares(
        residual, first, x_scale=spread[free], bounds=(low, high), diff_step=STEP, max_nfev=evaluations
    )
    rest, c = solved(solution.x)
    return ShapeFit(
        x=place(solution.x),
        coefficients=c,
        information=solution.jac.T @ solution.jac,
        cost=float(2 * solution.cost),
        misfit=float(np.sum(rest * rest)),
        evaluations=int(solution.nfev),
        at_bounds=tuple(int(k) for k in free[np.abs(solution.x - centre[free]) >= 0.999 * REACH * spread[free]]),
    )
