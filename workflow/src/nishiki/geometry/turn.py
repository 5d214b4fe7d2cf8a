"""Do camera centres lie on a circle, as those of a turntable must? A check that needs no board."""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np


@dataclass(frozen=True)
class CircleCheck:
    """The circle nearest to the camera centres.

    axis: (3,) unit, the way the cameras go round (counter-clockwise seen from its tip); centre: (3,) of the circle;
    radius: mean; radius_min, radius_max: over the views, relative to the mean; off_plane: largest distance from the
    plane of the circle, relative to the radius; steps_deg: from view to view, the last one back to the first view.
    """

    axis: tuple[float, ...]
    centre: tuple[float, ...]
    radius: float
    radius_min: float
    radius_max: float
    off_plane: float
    steps_deg: tuple[float, ...]

    def as_dict(self) -> dict:
        """Plain data, for JSON."""
        return asdict(self)


def turn_of(centres: np.ndarray) -> CircleCheck | None:
    """Circle through camera centres (n, 3) in the order of the turn, by plane and algebraic circle fit.

    None where fewer than 3 distinct centres, or centres on a line, determine no circle.
    """
    centres = np.asarray(centres, np.float64)
    if len(centres) < 3:
        return None
    middle = centres.mean(axis=0)
    _, sizes, directions = np.linalg.svd(centres - middle)
    if sizes[1] <= 1e-9 * max(sizes[0], np.abs(centres).max()):
        return None
    plane = (centres - middle) @ directions[:2].T
    # |p|^2 = 2 p.c + (r^2 - |c|^2) is linear in the centre c and in the last term (I. Kasa, A circle fitting procedure
    # and its error analysis, IEEE Trans. Instrumentation and Measurement 25, 1976).
    design = np.column_stack([2 * plane, np.ones(len(plane))])
    solution = np.linalg.lstsq(design, (plane**2).sum(axis=1), rcond=None)[0]
    around = plane - solution[:2]
    radii = np.linalg.norm(around, axis=1)
    angles = np.arctan2(around[:, 1], around[:, 0])
    steps = np.remainder(np.diff(angles, append=angles[0]) + np.pi, 2 * np.pi) - np.pi
    sign = -1.0 if np.median(steps) < 0 else 1.0
    axis = sign * np.cross(directions[0], directions[1])
    return CircleCheck(
        axis=tuple(axis.tolist()),
        centre=tuple((middle + solution[:2] @ directions[:2]).tolist()),
        radius=float(radii.mean()),
        radius_min=float(radii.min() / radii.mean()),
        radius_max=float(radii.max() / radii.mean()),
        off_plane=float(np.abs((centres - middle) @ directions[2]).max() / radii.mean()),
        steps_deg=tuple(np.degrees(sign * steps).tolist()),
    )
