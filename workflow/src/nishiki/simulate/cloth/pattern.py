"""Which yarn is on top at each crossing of a repeat."""

from __future__ import annotations

from math import gcd

import numpy as np

from nishiki.errors import UserError


def weave_pattern(weave: str, harness: int, step: int, *, face: str = "warp") -> np.ndarray:
    """(harness, harness) bool, row = weft yarn, column = warp yarn: True where the warp lies on top.

    plain : alternating. twill : the warp passes under one weft yarn a repeat, one place on with each yarn. satin : the
    same with a step that leaves no two bindings side by side; step and harness have no common factor. face : the yarns
    that are on top mostly.
    """
    if weave == "plain":
        return (np.add.outer(np.arange(2), np.arange(2)) % 2).astype(bool)
    step = 1 if weave == "twill" else step
    if weave == "satin" and (gcd(step, harness) != 1 or step % harness in (1, harness - 1)):
        raise UserError(
            f"simulation: step {step} of a {harness}-harness satin expected 2 to {harness - 2}, no common factor; "
            "choose another, such as 2 for 5 or 3 for 8"
        )
    warp_up = np.ones((harness, harness), bool)
    yarns = np.arange(harness)
    warp_up[(step * yarns) % harness, yarns] = False
    return warp_up if face == "warp" else ~warp_up.T
