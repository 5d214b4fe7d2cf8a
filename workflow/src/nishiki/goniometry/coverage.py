"""Check measured reflectances: coverage of the hemisphere, reciprocity, energy, and the side that shines.

A surface has the same BRDF with light and view exchanged (Helmholtz; von Helmholtz, Handbuch der physiologischen Optik,
1867), and sends back no more light than it gets. Values that are weighted by a cosine, angles that are counted from
another direction, and values in per cent violate one or the other.
"""

from collections.abc import Iterable
from dataclasses import asdict, dataclass

import numpy as np

from nishiki.goniometry.directions import Symmetry, angles, images, unit
from nishiki.goniometry.table import ReflectanceSet

PROBES = 4000  # even directions
REACH = np.radians(7.5)  # a view stands for directions this near


@dataclass(frozen=True)
class IncidenceCoverage:
    """Hold the coverage of one direction of light."""

    theta_deg: float  # theta_deg, phi_deg: of the light (phi 0 along the normal)
    phi_deg: float
    rows: np.ndarray  # indices of its measurements
    views: int  # how many
    unusable: int  # of these, in the region where most are
    covered: float  # share of the hemisphere's solid angle within 7.5 degrees of a usable view or its mirror image
    gap_deg: float  # from the worst direction of the hemisphere to the nearest view
    steepest_deg: float  # greatest theta_r

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


def cover(views: np.ndarray, same: Iterable[np.ndarray]) -> tuple[float, float]:
    """Return the share of the hemisphere within REACH of a view (n, 3) or its images, and the widest gap in radians."""
    from scipy.spatial import cKDTree

    tree = cKDTree(np.concatenate([views @ image.T for image in same]))
    distance = 2 * np.arcsin(np.minimum(tree.query(spread(PROBES))[0] / 2, 1.0))
    return float((distance < REACH).mean()), float(distance.max())


def _of(measured: ReflectanceSet, light: np.ndarray, rows: np.ndarray) -> IncidenceCoverage:
    good = rows[measured.valid[rows].all(axis=1)]
    lit = unit(*np.radians(light))
    # only images that leave the light where it is show the same measurement again
    same = [m for m in images(measured.symmetry) if np.allclose(m @ lit, lit, atol=1e-6)]
    covered, gap = cover(measured.outgoing[good], same) if len(good) else (0.0, np.pi / 2)
    steepest = angles(measured.outgoing[rows])[0].max()
    unusable = int((~measured.valid[rows]).sum(axis=0).max())
    numbers = (float(light[0]), float(light[1]))
    return IncidenceCoverage(
        *numbers, rows, len(rows), unusable, covered, float(np.degrees(gap)), float(np.degrees(steepest))
    )


def spread(count: int) -> np.ndarray:
    """Spread unit vectors (count, 3) over the upper hemisphere, each for the same solid angle (Fibonacci lattice)."""
    i = np.arange(count) + 0.5
    return unit(np.arccos(1 - i / count), np.pi * (1 + np.sqrt(5)) * i)


SAME = 0.02  # distance of unit vectors up to which two directions are one, about a degree
APART = 0.1  # by which a pair differs from itself exchanged, else it tells nothing
FEWEST_PAIRS = 4  # from which their disagreement tells something
GRAZING = np.cos(np.radians(80.5))  # beyond it instruments disagree with themselves
NODES = 2000  # directions over which the light that is sent back is summed
PAIR_REACH = np.radians(15.0)  # a view stands for directions this near
FEWEST_VIEWS, LEAST_COVERED = 12, 0.7  # of one direction of light whose reflected light is summed
STEEPEST = np.cos(np.radians(72.0))  # grazing light is not: few views hold most of what it sends back
OBLIQUE = np.cos(np.radians(20.0))


def reciprocity(
    incident: np.ndarray, outgoing: np.ndarray, values: np.ndarray, symmetry: Symmetry
) -> tuple[float | None, int]:
    """Disagreement of pairs that differ by the exchange of light and view: mean of |ln ratio|; and number of pairs.

    Parameters
    ----------
    incident, outgoing : ndarray
        Unit vectors (n, 3).
    values : ndarray
        Reflectances (n, channels), above 0.
    symmetry : str
        A key of `symmetry.IMAGES`.
    """
    from scipy.spatial import cKDTree

    steep = (incident[:, 2] > GRAZING) & (outgoing[:, 2] > GRAZING)
    incident, outgoing, values = incident[steep], outgoing[steep], values[steep]
    if not len(values):
        return None, 0
    tree, found = cKDTree(np.hstack([incident, outgoing])), []
    for image in images(symmetry):
        exchanged = np.hstack([outgoing @ image.T, incident @ image.T])
        distance, other = tree.query(exchanged, distance_upper_bound=SAME)
        place = np.flatnonzero(np.isfinite(distance))
        other = other[place]
        apart = np.linalg.norm(incident[place] - incident[other], axis=1)
        apart += np.linalg.norm(outgoing[place] - outgoing[other], axis=1)
        found.append(np.column_stack([place, other])[apart > APART])
    pairs = np.unique(np.sort(np.concatenate(found), axis=1), axis=0)
    if not len(pairs):
        return None, 0
    logs = np.log(values)
    return float(np.abs(logs[pairs[:, 0]] - logs[pairs[:, 1]]).mean()), len(pairs)


def typical_albedo(incident: np.ndarray, outgoing: np.ndarray, values: np.ndarray, symmetry: Symmetry) -> float | None:
    """Share of the light that is sent back, in the brightest channel, median over the directions of light.

    A direction of light counts where its views leave little of the hemisphere open; each part of the hemisphere has the
    value of the nearest view. None where no direction of light does. Arguments as of `reciprocity`.
    """
    from scipy.spatial import cKDTree

    nodes, shares = spread(NODES), []
    lights, group = np.unique(np.round(incident, 3), axis=0, return_inverse=True)
    for i, light in enumerate(lights):
        rows = np.flatnonzero(group.ravel() == i)
        if len(rows) < FEWEST_VIEWS or light[2] < STEEPEST:
            continue
        same = [image for image in images(symmetry) if np.allclose(image @ light, light, atol=2e-3)]
        distance, place = cKDTree(np.concatenate([outgoing[rows] @ image.T for image in same])).query(nodes)
        near = distance <= 2 * np.sin(PAIR_REACH / 2)
        if (near * nodes[:, 2]).sum() < LEAST_COVERED * nodes[:, 2].sum():
            continue
        light_back = values[rows][place % len(rows)] * (near * nodes[:, 2] * (2 * np.pi / NODES))[:, None]
        shares.append(light_back.sum(axis=0).max())
    return float(np.median(shares)) if shares else None


def forward_shine(incident: np.ndarray, outgoing: np.ndarray, values: np.ndarray) -> float | None:
    """Rank correlation of reflectance with the half vector's cosine under oblique light, -1 to 1; None without such.

    Surfaces shine where the half vector is near the normal. Arguments as of `reciprocity`.
    """
    rows = (incident[:, 2] < OBLIQUE) & (outgoing[:, 2] < OBLIQUE)
    if rows.sum() < FEWEST_VIEWS:
        return None
    half = incident[rows] + outgoing[rows]
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    ranks = [np.argsort(np.argsort(each)) for each in (np.round(half[:, 2], 6), np.log(values[rows]).mean(axis=1))]
    return float(np.corrcoef(*ranks)[0, 1])


def turned_views(incident: np.ndarray, outgoing: np.ndarray, turn: float) -> np.ndarray:
    """Return views (n, 3) whose azimuth was counted from that of the light, plus `turn` in radians."""
    theta, phi = angles(outgoing)
    return unit(theta, phi + np.where(incident[:, 2] < 1 - 1e-4, angles(incident)[1] + turn, 0.0))
