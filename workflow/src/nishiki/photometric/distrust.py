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
from numba import njit, prange

from nishiki.photometric import flags as bits
from nishiki.photometric.least_squares import conditioned

SUSPECT = 40.0
WORSE, SOMEWHAT = 16.0, 1.3
CHUNK = 256


def distrusted(stack, directions, usable, known, outputs):
    """Pixels (pixels,) bool whose selected samples are not to be followed.

    Parameters
    ----------
    stack : (lights, pixels) float32 observations.
    directions : (lights, 3) float64, unit vectors to the lights.
    usable, known : (lights, pixels) uint8, 1 for the selected and for the valid samples.
    outputs : normals, scalars, lights used and flags of Lambert's law on the selected samples
        (`nishiki.photometric.solve.lambertian`).
    """
    halves = directions + np.array([0.0, 0.0, 1.0])
    halves /= np.maximum(np.linalg.norm(halves, axis=1, keepdims=True), 1e-12)
    distrust = np.zeros(stack.shape[1], np.bool_)
    normals, scalars, _, flags = outputs
    _distrusted(stack, np.ascontiguousarray(directions), halves, usable, known, normals, scalars, flags, distrust)
    return distrust


@njit(cache=True, error_model="numpy")
def condition_of(known, directions, p, sums):
    """Condition of the normal matrix of a pixel's valid samples; infinite where it is singular."""
    sums[:] = 0.0
    count = 0
    for j in range(len(directions)):
        if known[j, p]:
            x, y, z = directions[j, 0], directions[j, 1], directions[j, 2]
            sums[0] += x * x
            sums[1] += x * y
            sums[2] += x * z
            sums[3] += y * y
            sums[4] += y * z
            sums[5] += z * z
            count += 1
    return conditioned(sums, count)[0]


@njit(cache=True, error_model="numpy")
def gloss_explains(stack, directions, halves, usable, known, normal, albedo, p):
    """Whether the samples left out as too bright lie nearer to the mirror direction, on average, than those kept."""
    bright, kept, brights, keeps = 0.0, 0.0, 0, 0
    for j in range(len(directions)):
        if not known[j, p]:
            continue
        x = normal[0] * halves[j, 0] + normal[1] * halves[j, 1] + normal[2] * halves[j, 2]
        x = max(x, 0.0)
        if usable[j, p]:
            kept, keeps = kept + x, keeps + 1
            continue
        c = normal[0] * directions[j, 0] + normal[1] * directions[j, 1] + normal[2] * directions[j, 2]
        if stack[j, p] > albedo * max(c, 0.0):
            bright, brights = bright + x, brights + 1
    return brights == 0 or keeps == 0 or bright * keeps >= kept * brights


@njit(cache=True, parallel=True, error_model="numpy")
def _distrusted(stack, directions, halves, usable, known, normals, scalars, flags, distrust):
    pixels = stack.shape[1]
    for chunk in prange((pixels + CHUNK - 1) // CHUNK):
        sums = np.empty(6)
        for p in range(chunk * CHUNK, min((chunk + 1) * CHUNK, pixels)):
            condition = np.float64(scalars[2, p])
            if not condition > SUSPECT or flags[p] & (bits.TOO_FEW_LIGHTS | bits.NO_SIGNAL):
                continue
            least = condition_of(known, directions, p, sums)
            if condition > WORSE * least:
                distrust[p] = True
            elif condition > SOMEWHAT * least:
                distrust[p] = not gloss_explains(
                    stack, directions, halves, usable, known, normals[p], np.float64(scalars[0, p]), p
                )
