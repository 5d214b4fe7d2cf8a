"""Lights of the fit, as the setting `lights` says; shared by separate and normals."""

import numpy as np

from nishiki.model_selection.decision import Decision
from nishiki.model_selection.lights import FEWEST, LightSample, measured_choice, not_worth, static_choice
from nishiki.observations.plane import Observations
from nishiki.observations.sample import sample
from nishiki.photometric.light_selection import select_diffuse
from nishiki.photometric.solve import NormalField, estimate_normals

PIXELS = 1200


def choose_lights(frames: Observations, lights: np.ndarray, settings) -> tuple[np.ndarray, Decision | None]:
    """(rows of `lights` that the fit uses, what was decided); settings: of separate, or of normals without it."""
    directions = frames.directions[lights]
    if settings.lights == "all" or (settings.lights == "auto" and len(lights) <= FEWEST):
        return np.arange(len(lights)), None
    if settings.lights != "auto":
        return static_choice(directions, settings.lights)
    pixels = int(np.count_nonzero(frames.mask))
    if skipped := not_worth(len(lights), pixels):
        return np.arange(len(lights)), skipped
    pieces = sample(frames, lights, PIXELS)
    samples = [LightSample(piece.observations, piece.valid, piece.parcel.directions) for piece in pieces]
    return measured_choice(directions, samples, solver_of(settings))


def solver_of(settings):
    """Selection as separate does it (none where normals runs without it), and the default solution."""

    def solve(observations: np.ndarray, directions: np.ndarray, valid: np.ndarray) -> tuple[np.ndarray, NormalField]:
        usable = valid
        if hasattr(settings, "method"):
            selection = {"method": settings.method, "w1": settings.w1, "w2": settings.w2, "keep": settings.keep}
            usable = select_diffuse(observations, directions, valid=valid, **selection).usable
        return usable, estimate_normals(observations, directions, usable=usable, valid=valid)

    return solve
