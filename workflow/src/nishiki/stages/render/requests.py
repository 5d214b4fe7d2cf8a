"""What the settings ask for, as lamps, views and films of the renderer."""

import dataclasses
from collections.abc import Iterable

import numpy as np

from nishiki.render.plane.scene import Light, PlaneScene, View
from nishiki.stages.render.declaration import LightSettings, SequenceSettings, ViewSettings

LAMP_RADIUS_RAD = np.radians(0.75)
"""Radius of a lamp as the object sees it: the soft edge of cast shadows."""
FIELD_OF_VIEW_MARGIN = 1.05
CENTRING_STEPS = 8  # of the camera's target; the middle of the object converges in a few
NEAREST = 1e-3  # depth of points beside or behind the eye, in lengths of the object
LONGER_SIDE, SHORTEST_SIDE = 1024, 16  # pixels of a picture whose size the settings leave open


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
    """The frontal view pixel by pixel, or a pinhole camera whose picture the object fills.

    The object is where the maps have normals: a small one in a large frame is framed as if it were alone. Where the
    settings leave a side of the picture open, the picture has the proportions of the object as the eye sees it.
    """
    if settings.kind == "frontal":
        return View()
    edge = outline(scene)
    low, high = edge.min(axis=0), edge.max(axis=0)
    towards = direction(settings.elevation_deg, settings.azimuth_deg)
    up = (0.0, 1.0, 0.0) if abs(towards[1]) < 0.999 else (0.0, 0.0, 1.0)
    forward = -towards
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    above = np.cross(right, forward)
    target, length = (low + high) / 2, float((high - low).max())
    for _ in range(CENTRING_STEPS):
        eye = target + settings.distance * length * towards
        rays = edge - eye
        depth = np.maximum(rays @ forward, NEAREST * length)
        x, y = rays @ right / depth, rays @ above / depth
        middle = forward + right * (x.min() + x.max()) / 2 + above * (y.min() + y.max()) / 2
        if not middle[2] < 0:  # the horizon is in the picture
            break
        target = eye - middle * eye[2] / middle[2]
    eye = target + settings.distance * length * towards
    rays = edge - eye
    depth = np.maximum(rays @ forward, NEAREST * length)
    wide, tall = (float(np.abs(rays @ axis / depth).max()) for axis in (right, above))
    rows, columns = _picture_size(settings, tall / wide)
    field = 2 * np.arctan(FIELD_OF_VIEW_MARGIN * max(tall, wide * rows / columns))
    return View(
        eye_mm=tuple(eye), target_mm=tuple(target), up=up, field_of_view=float(field), rows=rows, columns=columns
    )


def outline(scene: PlaneScene) -> np.ndarray:
    """(N, 3) outer corners of the first and last pixel with a normal in each row; z = 0, in the unit of the pitch.

    All four corners of the maps where no pixel has one.
    """
    known = np.einsum("rci,rci->rc", scene.normals, scene.normals) > 0.5
    if not known.any():
        known = np.ones(scene.shape, bool)
    rows = np.flatnonzero(known.any(axis=1))
    first = known[rows].argmax(axis=1)
    last = known.shape[1] - 1 - known[rows, ::-1].argmax(axis=1)
    across = np.concatenate([first - 0.5, last + 0.5, first - 0.5, last + 0.5])
    down = np.concatenate([rows - 0.5, rows - 0.5, rows + 0.5, rows + 0.5])
    x = (across - (scene.shape[1] - 1) / 2) * scene.pitch
    y = ((scene.shape[0] - 1) / 2 - down) * scene.pitch
    return np.stack([x, y, np.zeros_like(x)], axis=1)


def _picture_size(settings: ViewSettings, proportion: float) -> tuple[int, int]:
    """(rows, columns): as given; a side left open by the proportion (height over width) of the object."""
    rows, columns = settings.rows, settings.columns
    if rows is None and columns is None:
        rows, columns = (None, LONGER_SIDE) if proportion <= 1 else (LONGER_SIDE, None)
    if rows is None:
        rows = min(max(round(columns * proportion), SHORTEST_SIDE), 16 * columns)
    elif columns is None:
        columns = min(max(round(rows / proportion), SHORTEST_SIDE), 16 * rows)
    return rows, columns


def white_sheet(lights: Iterable[LightSettings], ambient: float) -> float:
    """Luminance of a perfect white sheet that lies in the plane of the object, 1: one that faces a lamp."""
    return ambient + sum(light.intensity * float(np.sin(np.radians(light.elevation_deg))) for light in lights)


def film_view(settings: SequenceSettings, scene: PlaneScene) -> View:
    """View of a film: frontal at its width, or a pinhole camera at its elevation; even sides, as H.264 wants them."""
    rows, columns = scene.shape
    width = min(settings.columns, columns) if settings.moves == "light" else settings.columns
    width += width % 2
    height = max(2, round(width * rows / columns / 2) * 2)
    if settings.moves == "light":
        return View(rows=height, columns=width)
    view = view_of(ViewSettings(kind="pinhole", elevation_deg=settings.elevation_deg, columns=width), scene)
    return dataclasses.replace(view, rows=view.rows + view.rows % 2)
