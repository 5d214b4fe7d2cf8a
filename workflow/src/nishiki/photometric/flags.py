"""Define the defects of a pixel's normal: one bit each in NormalField.flags."""

from enum import IntEnum


class NormalFlag(IntEnum):
    """Bits of the flags of a normal; their names in lower case stand in results."""

    TOO_FEW_LIGHTS = 1  # fewer than three usable lights: no estimate
    COPLANAR_LIGHTS = 2  # the usable lights lie in one plane with the origin: no estimate
    ILL_CONDITIONED = 4  # estimate kept, but the condition of the normal matrix exceeds the bound
    NO_SIGNAL = 8  # every usable sample is zero, or float32 cannot hold the albedo of the fit: no estimate
    FACES_AWAY = 16  # estimate kept, but it points away from the camera, which cannot be seen
    NO_REDUNDANCY = 32  # as many lights as unknowns: no residual, so sigma is unknown (set to pi / 2)
    FALLBACK = 128  # the solver's own model could not be fitted here: the Lambertian estimate stands


NO_ESTIMATE = NormalFlag.TOO_FEW_LIGHTS | NormalFlag.COPLANAR_LIGHTS | NormalFlag.NO_SIGNAL
"""Where a bit of it is set the normal is (0, 0, 1), albedo 0, sigma pi / 2."""
NOISE = 0.003  # of a photograph of eight bits, relative to the albedo: no smaller disagreement is taken seriously
COPLANAR = 1e12  # condition above which double precision cannot tell the normal matrix from a singular one
FEW_LIGHTS = 24
"""Number of lights up to which the joint fit with gloss and the relighting fit pay; above, selection suffices."""
