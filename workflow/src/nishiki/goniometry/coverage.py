"""Which views were measured for each direction of light, and how much of the hemisphere they leave open."""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np

from nishiki.goniometry.directions import angles, unit
from nishiki.goniometry.symmetry import images
from nishiki.goniometry.table import ReflectanceSet

PROBES = 4000
REACH = np.radians(7.5)  # a view stands for directions this near


@dataclass(frozen=True)
class IncidenceCoverage:
    """theta_deg, phi_deg: of the light (phi 0 along the normal); rows: indices of its measurements; views: how many;
    unusable: of these, in the region where most are; covered: share of the hemisphere's solid angle within 7.5 degrees
    of a usable view or its mirror image; gap_deg: from the worst direction of the hemisphere to the nearest view;
    steepest_deg: greatest theta_r."""

    theta_deg: float
    phi_deg: float
    rows: np.ndarray
    views: int
    unusable: int
    covered: float
    gap_deg: float
    steepest_deg: float

    def as_dict(self) -> dict:
        """Plain values for JSON, without the rows."""
        values = asdict(self)
        del values["rows"]
        return values


def coverage(measured: ReflectanceSet) -> tuple[IncidenceCoverage, ...]:
    """Coverage of each direction of light, by theta and then phi, in degrees rounded to 0.1."""
    theta, phi = np.degrees(angles(measured.incident))
    along = measured.normal_incidence
    key = np.column_stack([np.where(along, 0.0, np.round(theta, 1)), np.where(along, 0.0, np.round(phi, 1) % 360)])
    lights, group = np.unique(key, axis=0, return_inverse=True)
    group = group.ravel()
    return tuple(_of(measured, light, np.flatnonzero(group == i)) for i, light in enumerate(lights))


def _of(measured: ReflectanceSet, light: np.ndarray, rows: np.ndarray) -> IncidenceCoverage:
    from scipy.spatial import cKDTree

    good = rows[measured.valid[rows].all(axis=1)]
    lit = unit(*np.radians(light))
    # only images that leave the light where it is show the same measurement again
    same = [m for m in images(measured.symmetry) if np.allclose(m @ lit, lit, atol=1e-6)]
    covered, gap = 0.0, np.pi / 2
    if len(good):
        tree = cKDTree(np.concatenate([measured.outgoing[good] @ m.T for m in same]))
        distance = 2 * np.arcsin(np.minimum(tree.query(spread(PROBES))[0] / 2, 1.0))
        covered, gap = float((distance < REACH).mean()), float(distance.max())
    steepest = angles(measured.outgoing[rows])[0].max()
    unusable = int((~measured.valid[rows]).sum(axis=0).max())
    numbers = (float(light[0]), float(light[1]))
    return IncidenceCoverage(
        *numbers, rows, len(rows), unusable, covered, float(np.degrees(gap)), float(np.degrees(steepest))
    )


def spread(count: int) -> np.ndarray:
    """Unit vectors (count, 3) over the upper hemisphere, each for the same solid angle (a Fibonacci lattice)."""
    i = np.arange(count) + 0.5
    return unit(np.arccos(1 - i / count), np.pi * (1 + np.sqrt(5)) * i)
