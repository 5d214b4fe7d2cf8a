"""Photographs on the turntable: blur, fall-off, polarisers, sensor; of the object, the white board, the closed lens."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from nishiki.simulate.randomness import subkey
from nishiki.simulate.sensor import expose
from nishiki.simulate.turntable.render import Light
from nishiki.simulate.turntable.settings import (
    AIM_MM,
    BETA,
    BLUR_PIXELS,
    BOARD_REFLECTANCE,
    CLOTH,
    LEAK,
    STRAY,
    WHITE_RATIO,
    TurntableSettings,
    Viewpoint,
)

STATES = ("off", "on")


@dataclass(frozen=True)
class Optics:
    """What stands between the light and the converter, without noise.

    sensitivity : (rows, columns, 3), share of full scale that a perfect white at the axis gives, first polariser in
    place; beta : (rows, columns, 3), factor of the second polariser; board : (rows, columns), light from the white
    board, relative to a perfect white at the axis. All float64.
    """

    sensitivity: np.ndarray
    beta: np.ndarray
    board: np.ndarray


def _plane(settings: TurntableSettings) -> tuple[np.ndarray, np.ndarray]:
    """u (1, columns) to the right and v (rows, 1) upwards, -1..1 along the longer side."""
    longer = 0.5 * max(settings.rows, settings.columns)
    u = (np.arange(settings.columns) + 0.5 - 0.5 * settings.columns) / longer
    v = (0.5 * settings.rows - 0.5 - np.arange(settings.rows)) / longer
    return u[None, :], v[:, None]


def make_optics(view: Viewpoint, settings: TurntableSettings) -> Optics:
    """Fall-off of the lens (4 % in the corners), unevenness of the polarisers (±3 %) and of the light on the board.

    The board stands in the place of the object, facing the camera; the same for every view, as camera and lamp are.
    """
    u, v = _plane(settings)
    falloff = 1.0 - 0.02 * (u * u + v * v)
    sensitivity = settings.camera.white_level * falloff[..., None] * np.array(WHITE_RATIO)
    random = np.random.default_rng(subkey(settings.seed, "turntable polariser"))
    waves = random.uniform(-1.0, 1.0, (3, 5)) * 0.012
    shape = np.stack([u + 0 * v, v + 0 * u, u * v, u * u - 0.3 + 0 * v, v * v - 0.3 + 0 * u], axis=-1)
    beta = np.array(BETA) * (1.0 + np.einsum("ijk,ck->ijc", shape, waves))
    # Points of the board: along the rays through the pixels, in the plane through the axis across the optical axis.
    right, down, into = view.rotation
    reach = float(into @ (np.array(AIM_MM) - view.centre))
    x = (np.arange(settings.columns) - view.principal[0])[None, :, None] / view.focal
    y = (np.arange(settings.rows) - view.principal[1])[:, None, None] / view.focal
    points = view.centre + reach * (into + x * right + y * down)
    to_lamp = view.lamp - points
    square = np.sum(to_lamp**2, axis=-1)
    board = BOARD_REFLECTANCE * np.sum((view.lamp - np.array(AIM_MM)) ** 2) / square
    return Optics(sensitivity, beta, board * -np.sum(to_lamp * into, axis=-1) / np.sqrt(square))


def blurred(image: np.ndarray) -> np.ndarray:
    """A (rows, columns, channels) picture behind the lens: normal point spread of BLUR_PIXELS."""
    from scipy.ndimage import correlate1d

    offsets = np.arange(-3, 4)
    kernel = np.exp(-0.5 * (offsets / BLUR_PIXELS) ** 2)
    kernel /= kernel.sum()
    for axis in range(2):
        image = correlate1d(image, kernel, axis=axis, mode="nearest")
    return image


def backdrop(settings: TurntableSettings) -> np.ndarray:
    """(rows, columns, 1) light from the black cloth: a faint glow that is stronger below."""
    u, v = _plane(settings)
    return (CLOTH * (1.0 - 0.4 * v + 0.1 * u))[..., None]


def components(light: Light, settings: TurntableSettings) -> tuple[np.ndarray, np.ndarray]:
    """Depolarised and mirror-reflected light (rows, columns, 3) float64 at the sensor: blurred, stray light added."""
    bare = (1.0 - light.coverage)[..., None].astype(np.float64)
    diffuse = blurred(light.diffuse + bare * backdrop(settings))
    return diffuse + STRAY, blurred(light.specular.astype(np.float64))


def signal(light: Light, optics: Optics, settings: TurntableSettings, state: str) -> np.ndarray:
    """Share of full scale (rows, columns, 3) in one state of the polarisers ("off", "on", or "" without any)."""
    diffuse, specular = components(light, settings)
    if state == "on":
        return optics.sensitivity * optics.beta * (diffuse + np.array(LEAK) * specular)
    return optics.sensitivity * (diffuse + specular)


def photograph(light: Light, optics: Optics, settings: TurntableSettings, *, view: str, state: str) -> np.ndarray:
    """Codes (rows, columns, 3) uint16 of the object."""
    key = subkey(settings.seed, f"turntable noise {view} {state}")
    return expose(signal(light, optics, settings, state).astype(np.float32), settings.camera, key=key)


def white_board(index: int, optics: Optics, settings: TurntableSettings, *, state: str) -> np.ndarray:
    """Codes of one of several pictures of the matt white board, which depolarises all that it reflects."""
    level = optics.sensitivity * (optics.board + STRAY)[..., None]
    if state == "on":
        level = level * optics.beta
    key = subkey(settings.seed, f"turntable noise white {index} {state}")
    return expose(level.astype(np.float32), settings.camera, key=key)
