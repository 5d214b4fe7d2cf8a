"""Whether normals are fitted together with the gloss: a first look at few pixels, the whole sample, lamps left out."""

import numpy as np

from nishiki.model_selection.decision import Decision
from nishiki.photometric.gloss_scene import WORTHWHILE, SceneGloss

LEAST_GAIN = 0.02  # part of the error of left-out lamps that the joint fit takes off where it counts
CLEAR = 1 / 3  # of the limit: a gain nearer to 0 in the first look is not looked at again
OVERRIDE = "normals.refine: gloss"


def clearly_matt(first: SceneGloss) -> bool:
    """Whether the first look settles it: the gain in robust cost is within a third of what counts of nothing.

    A loss of more than that is a profile that has gone wrong, and says nothing.
    """
    return abs(first.gain) < CLEAR * WORTHWHILE


def decided(
    gloss: SceneGloss, setting: str, errors: dict[str, np.ndarray] | None = None, *, limit: float = WORTHWHILE
) -> tuple[bool, Decision]:
    """Whether the joint fit is used, and what was decided.

    errors : CIEDE2000 of captured lamps left out, with "plain" and "joint"
    (`nishiki.model_selection.relighting.left_out_errors`), or None. Where gloss counts, the joint fit must predict them
    better by LEAST_GAIN: on surfaces whose gloss it takes for another, and on matt ones with interreflections, it does
    not, and its normals are worse.
    """
    joint, words = gloss.significant, "no joint fit: gloss does not count"
    if joint and errors is not None:
        gain, least = float(errors["plain"].mean() - errors["joint"].mean()), LEAST_GAIN * float(errors["plain"].mean())
        joint = gain > least
        words = "normals fitted together with gloss" if joint else "no joint fit: it predicts lamps less well"
        criterion = "CIEDE2000 of captured lamps left out that the joint fit takes off"
        return joint, Decision("refine", words, criterion, gain, least, "nothing", OVERRIDE)
    joint = joint or setting == "gloss"
    if joint:
        words = "normals fitted together with gloss"
    if setting == "gloss":
        words += " (set)"
    loss = "nothing" if joint else f"robust cost {max(gloss.gain, 0.0):.2g} a value higher than with a gloss profile"
    criterion = "robust cost a value (light and channel) that gloss takes off, on a sample"
    return joint, Decision("refine", words, criterion, float(gloss.gain), limit, loss, OVERRIDE)
