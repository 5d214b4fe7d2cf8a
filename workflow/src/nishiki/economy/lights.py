"""Which lights a fit needs: an evenly spread choice, and how uncertain normals become with fewer."""

import numpy as np

from nishiki.economy.decision import Decision
from nishiki.economy.spread import spread_order

OVERRIDE = "normals.lights: all, auto or a number"


def static_choice(directions: np.ndarray, setting: str | int) -> tuple[np.ndarray, Decision | None]:
    """(rows of the lights used, in rising order; what was decided) where `setting` is 'all' or a number.

    directions (n, 3): of the lights that a fit may use. A number of at least n means all.
    """
    count = len(directions)
    if setting == "all" or int(setting) >= count:
        return np.arange(count), None
    chosen = np.sort(spread_order(directions)[: int(setting)])
    lost = 100 * (np.sqrt(count / len(chosen)) - 1)
    decision = Decision(
        "lights",
        f"{len(chosen)} of {count} lights, evenly spread",
        "number set",
        None,
        None,
        f"standard error of the normals about {lost:.0f} % larger (noise alone), fewer samples to tell highlights by",
        OVERRIDE,
    )
    return chosen, decision
