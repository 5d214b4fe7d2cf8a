"""Selections that are not to be followed: they leave the normal undetermined, or leave out what no gloss explains.

Half of the samples can agree with a Lambertian surface by accident where few lamps light a pixel: above all samples of
lamps that lie in one plane, which fit any normal along a line of directions, and neighbouring lamps of a narrow cone.
Two signs tell, and both need a selection that determines the normal badly (condition of its normal matrix above
SUSPECT):

* It determines the normal far worse than all valid samples would: condition more than WORSE times theirs.
* It is worse than theirs at all (SOMEWHAT), and what it leaves out as too bright is not nearer to the mirror direction
  than what it keeps (mean n . h): gloss only adds light there.
"""

import numpy as np

from nishiki.photometric import flags as bits
from nishiki.photometric.light_selection import distinct_sets, half_vectors

SUSPECT = 40.0  # condition of the light matrix
WORSE, SOMEWHAT = 16.0, 1.3
PIXELS = 1 << 14  # at a time


def distrusted(stack, directions, usable, known, outputs):
    """Find the pixels whose selected samples are not to be followed.

    Parameters
    ----------
    stack : (lights, pixels) float32 observations.
    directions : (lights, 3) float64, unit vectors to the lights.
    usable, known : (lights, pixels) uint8, 1 for the selected and for the valid samples.
    outputs : normals, scalars, lights used and flags of Lambert's law on the selected samples
        (`nishiki.photometric.solve.lambertian`).

    Returns
    -------
    (n,) int64, numbers of the pixels.
    """
    normals, scalars, _, flags = outputs
    fitted = (flags & (bits.TOO_FEW_LIGHTS | bits.NO_SIGNAL)) == 0
    suspects = np.flatnonzero((scalars[2] > SUSPECT) & fitted)
    halves, found = half_vectors(directions), []
    for start in range(0, len(suspects), PIXELS):
        here = suspects[start : start + PIXELS]
        valid, condition = known[:, here] > 0, scalars[2, here].astype(np.float64)
        first, member = distinct_sets(valid)
        least = condition_of(valid[:, first], directions)[member]
        distrust = condition > WORSE * least
        between = np.flatnonzero((condition > SOMEWHAT * least) & ~distrust)
        p = here[between]
        distrust[between] = ~gloss_explains(
            stack[:, p], directions, halves, usable[:, p] > 0, valid[:, between], normals[p], scalars[0, p]
        )
        found.append(here[distrust])
    return np.concatenate(found) if found else suspects


def condition_of(chosen, directions):
    """Condition (n,) of the normal matrix of the chosen (lights, n) lights; infinite where it is singular."""
    outer = (directions[:, :, None] * directions[:, None, :]).reshape(len(directions), -1)
    values = np.linalg.eigvalsh((chosen.T.astype(np.float64) @ outer).reshape(-1, 3, 3))
    least, largest = values[:, 0], values[:, 2]
    sound = (chosen.sum(axis=0) >= 3) & (least > largest / bits.COPLANAR)
    return np.where(sound, largest / np.where(sound, least, 1.0), np.inf)


def gloss_explains(samples, directions, halves, usable, known, normals, albedo):
    """Whether samples left out as too bright lie nearer to the mirror direction, on average, than those kept; (n,)."""
    mirror = np.maximum(halves @ normals.T, 0.0)
    bright = known & ~usable & (samples > albedo * np.maximum(directions @ normals.T, 0.0))
    kept = known & usable
    brights, keeps = bright.sum(axis=0), kept.sum(axis=0)
    nearer = (mirror * bright).sum(axis=0) * keeps >= (mirror * kept).sum(axis=0) * brights
    return (brights == 0) | (keeps == 0) | nearer
