"""Whether the frames of a goniometer capture belong together: directions, white boards, exposure times."""

from __future__ import annotations

import numpy as np

from nishiki.capture.frames import Frame, exposure_problems
from nishiki.formats.problems import Problem, error, warning
from nishiki.goniometry.directions import unit

TABLE = "frames.csv"
SAME_DEG = 0.1  # directions nearer than this are one
NORMAL_DEG = 1.0
STEEPEST_WHITE_DEG = 85.0
FEWEST_NORMAL = 12
FEWEST_ANGLES = 6  # measurements whose angles together tell their unit
LEAST_SPREAD = 0.1  # greatest theta, in whatever unit, below which angles tell nothing


def goniometer_problems(frames: tuple[Frame, ...]) -> list[Problem]:
    """Everything wrong with how the table's frames fit together."""
    samples, whites = ([f for f in frames if f.role == role] for role in ("sample", "white"))
    problems = [p for frame in frames for p in _angle_problems(frame)]
    if not samples:
        remedy = "Photographs of the cloth have the role sample"
        problems.append(error("samples-none", TABLE, "no photograph of the cloth", remedy=remedy))
    if not whites:
        what = "no white frame: a reflectance is the cloth's light over that of a white board"
        remedy = "Photograph a diffuse white board in the cloth's place, at least once"
        problems.append(error("white-missing", TABLE, what, remedy=remedy))
    problems += exposure_problems(frames)
    angles = [f.angles_deg for f in samples if None not in f.angles_deg]
    if angles and in_radians(np.array(angles, np.float64)):
        problems.append(radians_problem(TABLE, "Name the columns theta_i_rad, phi_i_rad, theta_r_rad, phi_r_rad"))
    if not any(p.severity == "error" for p in problems):
        problems += _spread_problems(samples, whites)
    return problems


def _angle_problems(frame: Frame) -> list[Problem]:
    """Angles that a frame of this role needs or cannot have."""
    where, (theta_i, phi_i, theta_r, phi_r) = f"{TABLE} row {frame.row}", frame.angles_deg
    if frame.role == "dark":
        return []
    if frame.role == "sample" and None in frame.angles_deg:
        remedy = "Give theta_i_deg, phi_i_deg, theta_r_deg and phi_r_deg in degrees; phi is 0 where theta is 0"
        return [error("angle-missing", where, "a sample frame needs its four angles", remedy=remedy)]
    if theta_i is None or phi_i is None:
        remedy = "Give theta_i_deg and phi_i_deg; the view may be left out, a board does not depend on it"
        return [error("angle-missing", where, "a white frame needs the direction of its light", remedy=remedy)]
    if (theta_r is None) != (phi_r is None):
        remedy = "Give both theta_r_deg and phi_r_deg, or neither"
        return [error("angle-missing", where, "half a direction of view", remedy=remedy)]
    if frame.role == "white" and theta_i > STEEPEST_WHITE_DEG:
        expected, found = f"at most {STEEPEST_WHITE_DEG:g} degrees", f"{theta_i:g}"
        what = "the board is grazed by its light"
        remedy = "Photograph it at a smaller theta_i_deg: the cosine of the angles brings it to the others"
        return [error("white-grazing", where, what, expected=expected, found=found, remedy=remedy)]
    return []


def _spread_problems(samples: list[Frame], whites: list[Frame]) -> list[Problem]:
    """What the later stages will miss, although the capture can be read."""
    problems = []
    normal = [f for f in samples if f.angles_deg[0] < NORMAL_DEG]
    if len(normal) < FEWEST_NORMAL:
        expected, found = f"{FEWEST_NORMAL} views or more with theta_i below {NORMAL_DEG:g} degree", f"{len(normal)}"
        what = "few views of the cloth lit along its normal; the weave and the BRDF are found from them"
        problems.append(warning("normal-few", TABLE, what, expected=expected, found=found))
    lights = sorted({f.angles_deg[:2] for f in samples})
    apart_deg = nearest(lights, sorted({w.angles_deg[:2] for w in whites}))
    alone = {light for light, angle in zip(lights, apart_deg, strict=True) if angle >= SAME_DEG}
    apart = [f for f in samples if f.angles_deg[:2] in alone]
    if apart:
        what = "no white frame under the same light: another board's light is used, by the cosine of the angles"
        found = f"{len(apart)} of {len(samples)} sample frames, the first in row {apart[0].row}"
        remedy = "Photograph the board once for every direction of light where the lamp's distance or strength changes"
        problems.append(warning("white-cosine", TABLE, what, found=found, remedy=remedy))
    return problems


def in_radians(angles: np.ndarray) -> bool:
    """Whether angles (n, 4) theta_i, phi_i, theta_r, phi_r of some measurements are radians: none is above pi / 2 for
    theta and 2 pi for phi, which in degrees would all be views along the normal."""
    theta, phi = np.abs(angles[:, [0, 2]]), np.abs(angles[:, [1, 3]])
    within = (theta <= np.pi / 2 + 1e-3).all() and (phi <= 2 * np.pi + 1e-3).all()
    return bool(within and len(angles) >= FEWEST_ANGLES and theta.max() > LEAST_SPREAD)


def radians_problem(file: str, remedy: str) -> Problem:
    """angles-radians, for angles named in degrees of which none is above a turn in radians."""
    what, expected = "the angles are radians: no theta is above pi / 2, no phi above 2 pi", "degrees"
    return error("angles-radians", file, what, expected=expected, remedy=remedy)


def nearest(directions: list[tuple[float, float]], others: list[tuple[float, float]]) -> np.ndarray:
    """Angle in degrees from each direction (theta, phi in degrees) to the nearest of the others, infinite for none."""
    from scipy.spatial import cKDTree

    if not others:
        return np.full(len(directions), np.inf)
    towards, known = (unit(*np.radians(each).T) for each in (directions, others))
    chords, _ = cKDTree(known).query(towards)
    return np.degrees(2 * np.arcsin(np.minimum(chords / 2, 1.0)))  # from the chord: exact for small angles
