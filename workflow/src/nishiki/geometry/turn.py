"""The circle of the camera centres: do they lie on one, as those of a turntable must, and do they go once round?"""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np

LARGEST_STEP = 1.6  # of a full turn, relative to the median step
ON_CIRCLE = 0.1  # relative distance from the circle up to which a camera belongs to one ring
EQUAL_STEPS_DEG = 0.05
"""Largest difference between steps that are called equal: a pixel on a radius of a thousand."""


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

    @property
    def full(self) -> bool:
        """Whether the views go once round: steps in one sense, together one turn, none above 1.6 times the median."""
        steps = np.array(self.steps_deg)
        once = abs(steps.sum() - 360) < 1e-4 and (steps > 0).all()
        return bool(once and steps.max() <= LARGEST_STEP * np.median(steps))

    def as_dict(self) -> dict:
        """Plain data, for JSON."""
        return asdict(self)


def order_round(centres: np.ndarray) -> list[int]:
    """Indices that bring camera centres (n, 3) into the order of the turn, the first one first.

    Those of cameras that go once round a circle in another order than they are given in: names like cam1/0000, or
    exports sorted by another key. All others keep their order.
    """
    given = list(range(len(centres)))
    turn = turn_of(centres)
    if turn is None or turn.full or turn.off_plane > ON_CIRCLE or turn.radius_min < 1 - ON_CIRCLE:
        return given
    angles = np.cumsum([0.0, *turn.steps_deg[:-1]]) % 360
    ahead = angles if angles[1] <= 180 else -angles % 360  # in the sense in which the second follows the first
    order = np.argsort(ahead, kind="stable").tolist()
    again = turn_of(centres[order])
    return order if again is not None and again.full else given


def circle_centre(points: np.ndarray) -> np.ndarray:
    """Centre (2,) of the circle nearest to points (n, 2), n >= 3, in the sense of squared radii.

    |p|^2 = 2 p.c + (r^2 - |c|^2) is linear in the centre c and in the last term (Kåsa, 1976).
    """
    design = np.column_stack([2 * points, np.ones(len(points))])
    return np.linalg.lstsq(design, (points**2).sum(axis=1), rcond=None)[0][:2]


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
    centre = circle_centre(plane)
    around = plane - centre
    radii = np.linalg.norm(around, axis=1)
    angles = np.arctan2(around[:, 1], around[:, 0])
    steps = np.remainder(np.diff(angles, append=angles[0]) + np.pi, 2 * np.pi) - np.pi
    sign = -1.0 if np.median(steps) < 0 else 1.0
    axis = sign * np.cross(directions[0], directions[1])
    return CircleCheck(
        axis=tuple(axis.tolist()),
        centre=tuple((middle + centre @ directions[:2]).tolist()),
        radius=float(radii.mean()),
        radius_min=float(radii.min() / radii.mean()),
        radius_max=float(radii.max() / radii.mean()),
        off_plane=float(np.abs((centres - middle) @ directions[2]).max() / radii.mean()),
        steps_deg=tuple(np.degrees(sign * steps).tolist()),
    )


def scale_turn(matrices: np.ndarray, centres: np.ndarray, factor: float) -> np.ndarray | None:
    """Projections (n, 3, 4) of cameras at `factor` times their angles from the first about the axis of their circle.

    matrices (n, 3, 4) and centres (n, 3), world's unit, in the order of the turn. -1 is an object that turns the other
    way: once round in equal steps, these are the given matrices in reverse order. None where the centres lie on no
    circle.
    """
    circle = turn_of(centres)
    if circle is None:
        return None
    if factor == -1 and circle.full and np.ptp(circle.steps_deg) < EQUAL_STEPS_DEG:
        return np.roll(matrices[::-1], 1, axis=0)
    angles = np.radians((1 - factor) * np.concatenate([[0.0], np.cumsum(circle.steps_deg[:-1])]))
    x, y, z = circle.axis
    across = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    sines, cosines = np.sin(angles)[:, None, None], np.cos(angles)[:, None, None]
    motions = np.tile(np.eye(4), (len(matrices), 1, 1))
    motions[:, :3, :3] += sines * across + (1 - cosines) * (across @ across)  # Rodrigues
    motions[:, :3, 3] = circle.centre - motions[:, :3, :3] @ np.array(circle.centre)
    return matrices @ motions
