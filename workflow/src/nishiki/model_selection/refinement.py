"""Whether normals are fitted together with the gloss: a first look at few pixels, then the whole sample."""

from nishiki.model_selection.decision import Decision
from nishiki.photometric.gloss_scene import WORTHWHILE, SceneGloss

CLEAR = 1 / 3  # of the limit: a gain nearer to 0 in the first look is not looked at again
OVERRIDE = "normals.refine: gloss"


def clearly_matt(first: SceneGloss, *, limit: float = WORTHWHILE) -> bool:
    """Whether the first look settles it: the gain in robust cost is within a third of what counts of nothing.

    A loss of more than that is a profile that has gone wrong, and says nothing.
    """
    return abs(first.gain) < CLEAR * limit


def decided(gloss: SceneGloss, setting: str, *, limit: float = WORTHWHILE) -> Decision:
    """What was decided, for the log and the diagnostics."""
    joint = gloss.significant or setting == "gloss"
    words = "normals fitted together with gloss" if joint else "no joint fit: gloss does not count"
    if setting == "gloss":
        words += " (set)"
    loss = "nothing" if joint else f"robust cost {max(gloss.gain, 0.0):.2g} a value higher than with a gloss profile"
    criterion = "robust cost a value (light and channel) that gloss takes off, on a sample"
    return Decision("refine", words, criterion, float(gloss.gain), limit, loss, OVERRIDE)
