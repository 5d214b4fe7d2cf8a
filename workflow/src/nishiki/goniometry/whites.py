"""Which white board belongs to which photograph of the cloth."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from nishiki.errors import UserError
from nishiki.goniometry.directions import between, unit

SAME = np.radians(0.1)
GRAZING = 0.05  # cosine between lamp and board below which a board tells nothing of other incidences
Rule = Literal["own", "incidence", "cosine"]


@dataclass(frozen=True)
class Boards:
    """rule: own (the sample's pair of directions), incidence (its light), or cosine (all boards, by the cosine law);
    which: indices of the boards; factors: their light times these is that of the board under the sample's light."""

    rule: Rule
    which: np.ndarray
    factors: np.ndarray


def assign_boards(sample_deg: np.ndarray, white_deg: np.ndarray) -> list[Boards]:
    """The boards of each sample: those of its own directions, else those of its incidence (a diffuse board looks the
    same from everywhere), else all of them that are not grazed, times cos(theta_i) / cos(theta_W).

    sample_deg (n, 4): theta_i, phi_i, theta_r, phi_r; white_deg (m, 4): likewise, NaN for a view that is not given.
    """
    white = np.radians(np.asarray(white_deg, np.float64))
    lights, views = unit(white[:, 0], white[:, 1]), unit(white[:, 2], white[:, 3])
    cosines = lights[:, 2]
    known: dict[tuple, Boards] = {}
    boards = []
    for row in np.radians(np.asarray(sample_deg, np.float64)):
        key = tuple(np.round(row, 9))
        if key not in known:
            known[key] = _of(unit(row[0], row[1]), unit(row[2], row[3]), lights, views, cosines)
        boards.append(known[key])
    return boards


def _of(light: np.ndarray, view: np.ndarray, lights: np.ndarray, views: np.ndarray, cosines: np.ndarray) -> Boards:
    same_light = between(lights, light) < SAME
    with np.errstate(invalid="ignore"):
        same_pair = same_light & (between(views, view) < SAME)
    for rule, chosen in (("own", same_pair), ("incidence", same_light)):
        which = np.flatnonzero(chosen)
        if len(which):
            return Boards(rule, which, np.ones(len(which)))
    which = np.flatnonzero(cosines > GRAZING)
    if not len(which):
        raise UserError(
            f"white boards: expected one lit less steeply than {np.degrees(np.arccos(GRAZING)):.0f} degrees, for a "
            f"sample at another incidence, found none of {len(lights)}. Remedy: photograph the board at the sample's "
            "incidences"
        )
    return Boards("cosine", which, light[2] / cosines[which])
