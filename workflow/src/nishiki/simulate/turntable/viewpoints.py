"""Where the camera stands, seen from the object: it goes round as the object turns."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from nishiki.simulate.turntable.settings import DISTANCE_MM, ELEVATION_DEG, LAMP_MM, TurntableSettings

AIM_MM = (0.0, 86.0, 0.0)  # the point of the axis that the camera looks at
_WIDTH_MM, _HEIGHT_MM = 204.0, 200.0  # what the picture must hold, at the axis


@dataclass(frozen=True)
class Viewpoint:
    """One view. rotation (3, 3): object to camera (x right, y down, z into the scene); centre (3,): the camera, mm;
    lamp (3,): the lamp's centre, mm, object's frame; focal: pixels; principal: column, row of the optical axis."""

    name: str
    rotation: np.ndarray
    centre: np.ndarray
    lamp: np.ndarray
    focal: float
    principal: tuple[float, float]

    @property
    def matrix(self) -> np.ndarray:
        """(3, 4) projection: homogeneous (column, row) of object points; the top left pixel's centre is (0, 0)."""
        k = np.array([[self.focal, 0.0, self.principal[0]], [0.0, self.focal, self.principal[1]], [0.0, 0.0, 1.0]])
        return k @ np.column_stack([self.rotation, -self.rotation @ self.centre])


def place_views(settings: TurntableSettings) -> tuple[Viewpoint, ...]:
    """Views in the order of the turn: each has turned the object on by 360°/views, anticlockwise seen from above."""
    focal = DISTANCE_MM * min(settings.columns / _WIDTH_MM, settings.rows / _HEIGHT_MM)
    principal = (0.5 * settings.columns - 0.5 + 1.7, 0.5 * settings.rows - 0.5 - 0.9)
    elevation = np.radians(ELEVATION_DEG)
    views = []
    for index in range(settings.views):
        turn = -2.0 * np.pi * index / settings.views
        back = np.array(
            [np.cos(elevation) * np.sin(turn), np.sin(elevation), np.cos(elevation) * np.cos(turn)]
        )  # from the object to the camera
        right = np.array([np.cos(turn), 0.0, -np.sin(turn)])
        up = np.cross(back, right)
        centre = np.array(AIM_MM) + DISTANCE_MM * back
        lamp = centre + LAMP_MM[0] * right + LAMP_MM[1] * up + LAMP_MM[2] * back
        views.append(Viewpoint(f"{index:03d}", np.stack([right, -up, -back]), centre, lamp, focal, principal))
    return tuple(views)
