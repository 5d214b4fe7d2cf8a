"""Moving lights and moving eyes: paths, and the pictures along them one after the other."""

import dataclasses
from collections.abc import Iterable, Iterator

import numpy as np

from nishiki.errors import UserError
from nishiki.render.plane.frame import Rendering, render
from nishiki.render.plane.scene import Ambient, Light, PlaneScene, View
from nishiki.render.plane.shade import cast_shadows


def circle_of_directions(count: int, *, elevation: float, start: float = 0.0) -> np.ndarray:
    """Return (count, 3) unit vectors at one elevation above the painting, evenly around; `start` azimuth; radians.

    The last one is a step before the first, so that a repeated film runs on without a stop.
    """
    if count < 1 or not 0 < elevation <= np.pi / 2:
        raise UserError(
            f"light circle: expected count >= 1 and an elevation above 0 up to 90 degrees, "
            f"found {count} and {np.degrees(elevation):g} degrees"
        )
    azimuth = start + 2 * np.pi * np.arange(count) / count
    radius = np.cos(elevation)
    return np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), np.full(count, np.sin(elevation))], axis=1)


def moved_lights(light: Light, directions: Iterable) -> Iterator[list[Light]]:
    """Yield light lists with the one lamp at each of the directions; a lamp with a position keeps its distance."""
    for direction in directions:
        unit = np.asarray(direction, np.float64) / np.linalg.norm(direction)
        if light.position_mm is None:
            yield [dataclasses.replace(light, direction=tuple(unit))]
        else:
            yield [dataclasses.replace(light, position_mm=tuple(unit * np.linalg.norm(light.position_mm)))]


def orbit(view: View, count: int, *, sweep: float) -> Iterator[View]:
    """Swing the eye about the vertical axis through its target, `sweep` radians to each side and back.

    The eye follows a cosine, so that it slows down where it turns; the first view is the one furthest to the right.
    """
    if view.eye_mm is None:
        raise UserError("orbit: expected a view with an eye, found the frontal view; give eye_mm and target_mm")
    eye, target = np.asarray(view.eye_mm, np.float64), np.asarray(view.target_mm, np.float64)
    dx, dy, dz = eye - target
    for k in range(count):
        a = sweep * np.cos(2 * np.pi * k / count)
        swung = (dx * np.cos(a) + dz * np.sin(a), dy, dz * np.cos(a) - dx * np.sin(a))
        yield dataclasses.replace(view, eye_mm=tuple(target + swung))


def light_sequence(
    scene: PlaneScene,
    lights: Iterable[list[Light]],
    view: View | None = None,
    *,
    ambient: Ambient | None = None,
    **settings,
) -> Iterator[Rendering]:
    """Yield a picture for each list of lights, from one view. `settings` as in `render`."""
    for current in lights:
        yield render(scene, current, view, ambient=ambient, **settings)


def view_sequence(
    scene: PlaneScene, lights: list[Light], views: Iterable[View], *, ambient: Ambient | None = None, **settings
) -> Iterator[Rendering]:
    """Yield a picture for each view under the same lights; shadows are cast once. `settings` as in `render`."""
    visibility = None
    if scene.height is not None and lights:
        visibility = cast_shadows(scene.height, lights, pitch=scene.pitch).visibility
    for view in views:
        yield render(scene, lights, view, ambient=ambient, visibility=visibility, shadows="none", **settings)
