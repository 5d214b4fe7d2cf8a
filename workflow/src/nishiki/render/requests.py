"""What the settings ask for, as lamps, views and films of the renderer."""

import numpy as np

from nishiki.render.scene import Light, PlaneScene, View
from nishiki.settings.render import LightSettings, SequenceSettings, ViewSettings

LAMP_RADIUS_RAD = np.radians(0.75)
"""Radius of a lamp as the object sees it: the soft edge of cast shadows."""
FIELD_OF_VIEW_MARGIN = 1.05


def direction(elevation_deg: float, azimuth_deg: float) -> np.ndarray:
    """Unit vector (3,) at an elevation above the object's plane, azimuth from x (right) towards y (up)."""
    elevation, azimuth = np.radians([elevation_deg, azimuth_deg])
    return np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])


def lamp(settings: LightSettings, spectrum: np.ndarray) -> Light:
    """A distant lamp; spectrum (61,)."""
    towards = direction(settings.elevation_deg, settings.azimuth_deg)
    return Light(
        direction=tuple(towards), spectrum=spectrum, intensity=settings.intensity, angular_radius=LAMP_RADIUS_RAD
    )


def view_of(settings: ViewSettings, scene: PlaneScene) -> View:
    """The frontal view pixel by pixel, or a pinhole camera that holds the whole object in its picture."""
    if settings.kind == "frontal":
        return View()
    rows, columns = scene.shape
    length = max(rows, columns) * scene.pitch
    eye = settings.distance * length * direction(settings.elevation_deg, settings.azimuth_deg)
    up = (0.0, 1.0, 0.0) if abs(eye[1]) < 0.999 * np.linalg.norm(eye) else (0.0, 0.0, 1.0)
    field = _field_of_view(eye, up, scene, settings)
    return View(eye_mm=tuple(eye), up=up, field_of_view=field, rows=settings.rows, columns=settings.columns)


def _field_of_view(eye: np.ndarray, up: tuple, scene: PlaneScene, settings: ViewSettings) -> float:
    """Vertical field of view that just holds the four corners."""
    forward = -eye / np.linalg.norm(eye)
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    above = np.cross(right, forward)
    half_rows, half_columns = (0.5 * side * scene.pitch for side in scene.shape)
    corners = np.array([[x, y, 0.0] for x in (-half_columns, half_columns) for y in (-half_rows, half_rows)]) - eye
    depth = corners @ forward
    high = np.abs(corners @ above / depth).max()
    wide = np.abs(corners @ right / depth).max() * settings.rows / settings.columns
    return float(2 * np.arctan(FIELD_OF_VIEW_MARGIN * max(high, wide)))


def film_view(settings: SequenceSettings, scene: PlaneScene) -> View:
    """View of a film: frontal at its width, or a pinhole camera at its elevation; even sides, as H.264 wants them."""
    rows, columns = scene.shape
    width = min(settings.columns, columns) if settings.moves == "light" else settings.columns
    width += width % 2
    height = max(2, round(width * rows / columns / 2) * 2)
    if settings.moves == "light":
        return View(rows=height, columns=width)
    oblique = ViewSettings(kind="pinhole", elevation_deg=settings.elevation_deg, rows=max(16, height), columns=width)
    return view_of(oblique, scene)
