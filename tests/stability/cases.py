"""Cases of stability: each is a test, and a row of docs/notes/stability.md.

    from stability.cases import case, worst_over

    @case(
        "No light polarised",                        # name: unique, what a reader looks for
        hazard="0/0 where beta -> 0",
        treatment="flagged below beta_least, value 0",
        reference="mpmath, 50 digits",
        bound=1e-12,
        unit="relative",                             # of the error that the function returns
        outcome="flagged; no other pixel changes",
    )
    def test_no_light_polarised():
        return worst_error                           # a number; a count of wrong outcomes where there is no error

The decorated function passes where the returned error is a number of at most `bound`. It takes no arguments: use
`worst_over` for drawn cases. `python tests/stability/page.py` runs all cases and writes the page.
"""

import functools
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import hypothesis
import numpy as np
from hypothesis import strategies


@dataclass(frozen=True)
class Case:
    """One stated hazard, how it is treated, and the function that measures how well."""

    name: str
    area: str  # of the file's name: test_<area>.py
    hazard: str
    treatment: str
    reference: str
    bound: float
    unit: str
    outcome: str
    measure: Callable[[], float]
    source: str


REGISTRY: dict[str, Case] = {}


def case(
    name: str,
    *,
    hazard: str,
    treatment: str,
    outcome: str,
    bound: float,
    reference: str = "the definition",
    unit: str = "relative",
) -> Callable[[Callable[[], float]], Callable[[], None]]:
    """Register the decorated function as a case and make a test of it; raises ValueError for a name used twice."""

    def register(measure: Callable[[], float]) -> Callable[[], None]:
        path = Path(measure.__code__.co_filename)
        source = f"{path.name}::{measure.__name__}"
        if name in REGISTRY and REGISTRY[name].source != source:
            raise ValueError(f"two cases are called {name!r}: {REGISTRY[name].source} and {source}")
        area = path.stem.removeprefix("test_")
        REGISTRY[name] = Case(name, area, hazard, treatment, reference, bound, unit, outcome, measure, source)

        @functools.wraps(measure)
        def test() -> None:
            error = float(measure())
            assert error <= bound, f"{name}: {error:.3g} {unit}, bound {bound:.3g}"  # a NaN is no error below a bound

        return test

    return register


def worst_over(measure: Callable[..., float], *drawn: strategies.SearchStrategy, examples: int = 100) -> float:
    """The largest error that `measure(*values)` returns over drawn values; the search is led towards large errors.

    The values are the same at every run, unless HYPOTHESIS_PROFILE=search asks for new ones. A NaN counts as infinite.
    """
    found = [0.0]

    @hypothesis.settings(
        max_examples=examples,
        derandomize=os.environ.get("HYPOTHESIS_PROFILE", "same") == "same",
        database=None,
        deadline=None,
        suppress_health_check=list(hypothesis.HealthCheck),
    )
    @hypothesis.given(strategies.tuples(*drawn))
    def draw(values: tuple) -> None:
        error = float(measure(*values))
        found.append(np.inf if np.isnan(error) else error)
        hypothesis.target(float(np.clip(np.log10(max(found[-1], 1e-30)), -30, 30)))

    draw()
    return max(found)


def powers_of_ten(least: float, most: float) -> strategies.SearchStrategy[float]:
    """Numbers spread evenly over orders of magnitude: 10^least to 10^most."""
    return strategies.floats(least, most).map(lambda exponent: float(10.0**exponent))


def relative(found: np.ndarray, exact: np.ndarray) -> float:
    """Largest deviation over all values, divided by the largest magnitude of the exact ones; infinite for a NaN."""
    found, exact = np.asarray(found, float), np.asarray(exact, float)
    scale = np.abs(exact).max(initial=0.0)
    deviation = np.abs(found - exact).max(initial=0.0)
    if not np.isfinite(deviation):
        return np.inf
    return float(deviation / scale) if scale > 0 else float(deviation)
