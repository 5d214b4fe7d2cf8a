"""The lamp: where it is put, how unevenly it shines, its spectrum."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from nishiki.simulate.painting.settings import SimulationSettings
from nishiki.simulate.randomness import subkey

TOP_INCIDENCE_DEG = 4.0  # a lamp cannot stand where the camera is
_SECOND_RADIATION_CONSTANT_NM_K = 1.438776877e7


@dataclass(frozen=True)
class Lamp:
    """One lamp position.

    name, role ("sample" or "check"). direction : (3,) unit, from the centre of the object. position_mm : (3,), origin
    at the centre of the object, x right, y up, z to the camera. power : relative. tilt : (2,) and falloff : unevenness
    of the beam, per half diagonal.
    """

    name: str
    role: str
    direction: np.ndarray
    position_mm: np.ndarray
    power: float
    tilt: tuple[float, float]
    falloff: float


def place_lamps(settings: SimulationSettings) -> tuple[Lamp, ...]:
    """All lamp positions: the top one, the rings, then the check lights between their azimuths.

    One ring stands at 45° incidence, several are spread evenly from 30° to 60°; like hand-placed lamps each misses its
    place by up to 1.5°. The capture records where it really stood.
    """
    random = np.random.default_rng(subkey(settings.seed, "lamps"))
    lights = settings.lights
    places = []
    if lights.top:
        places.append(("top", "sample", TOP_INCIDENCE_DEG, 90.0))
    incidences = [45.0] if lights.rings == 1 else np.linspace(30.0, 60.0, lights.rings)
    for ring in range(lights.rings):
        for index in range(lights.ring_lights):
            azimuth = 360.0 / lights.ring_lights * (index + 0.5 * (ring % 2))
            name = f"ring{index + 1}" if lights.rings == 1 else f"ring{ring + 1}-{index + 1}"
            places.append((name, "sample", float(incidences[ring]), azimuth))
    for index, incidence in enumerate(lights.checks_deg):
        places.append((f"check{index + 1}-{incidence:g}", "check", incidence, 67.5 + 137.5 * index))
    return tuple(_lamp(settings, random, *place) for place in places)


def _lamp(settings, random, name, role, incidence, azimuth):
    miss = random.uniform(-1.5, 1.5, 2) if name != "top" else np.zeros(2)
    theta = math.radians(min(max(incidence + miss[0], 0.0), 88.0))
    phi = math.radians(azimuth + miss[1])
    direction = np.array([math.sin(theta) * math.cos(phi), math.sin(theta) * math.sin(phi), math.cos(theta)])
    position = settings.distance_mm * direction
    tilt = tuple(random.uniform(-0.03, 0.03, 2))
    return Lamp(name, role, direction, position, float(random.uniform(0.93, 1.07)), tilt, random.uniform(0.03, 0.07))


def plane_coordinates(settings: SimulationSettings, rows: slice) -> tuple[np.ndarray, np.ndarray]:
    """Positions x (columns,) and y (rows in the slice,) of pixel centres in mm from the centre, y upwards."""
    x = (np.arange(settings.columns) + 0.5 - 0.5 * settings.columns) * settings.pitch_mm
    y = (0.5 * settings.rows - 0.5 - np.arange(settings.rows)[rows]) * settings.pitch_mm
    return x, y


def beam_strength(lamp: Lamp, settings: SimulationSettings, rows: slice) -> np.ndarray:
    """Irradiance (rows, columns) on a surface facing the lamp (1/r², beam); power 1 gives 1 at the centre."""
    x, y = plane_coordinates(settings, rows)
    dx, dy = lamp.position_mm[0] - x[None, :], lamp.position_mm[1] - y[:, None]
    square = dx * dx + dy * dy + lamp.position_mm[2] ** 2
    u, v = x[None, :] / settings.half_diagonal_mm, y[:, None] / settings.half_diagonal_mm
    beam = 1.0 + lamp.tilt[0] * u + lamp.tilt[1] * v - lamp.falloff * (u * u + v * v)
    return lamp.power * beam * settings.distance_mm**2 / square


def vignette(settings: SimulationSettings, rows: slice) -> np.ndarray:
    """Light fall-off of the lens (rows, columns): 4 % in the corners."""
    u, v = (axis / settings.half_diagonal_mm for axis in plane_coordinates(settings, rows))
    return 1.0 - 0.04 * (u[None, :] ** 2 + v[:, None] ** 2)


def board_cosine(lamp: Lamp, settings: SimulationSettings, rows: slice) -> np.ndarray:
    """Cosine of incidence (rows, columns) on a flat board in the plane of the object, for the lamp's true position."""
    x, y = plane_coordinates(settings, rows)
    dx, dy = lamp.position_mm[0] - x[None, :], lamp.position_mm[1] - y[:, None]
    return lamp.position_mm[2] / np.sqrt(dx * dx + dy * dy + lamp.position_mm[2] ** 2)


def direction_error_deg(settings: SimulationSettings) -> tuple[float, float]:
    """Mean and largest angle (degrees, over pixels and lamps) between true directions and those from the centre."""
    x = np.linspace(-0.5, 0.5, 41) * settings.columns * settings.pitch_mm
    y = np.linspace(-0.5, 0.5, 41) * settings.rows * settings.pitch_mm
    plane = np.stack([*np.meshgrid(x, y), np.zeros((41, 41))], axis=-1)
    angles = []
    for lamp in place_lamps(settings):
        to_lamp = lamp.position_mm - plane
        sine = np.linalg.norm(np.cross(to_lamp, lamp.direction), axis=-1) / np.linalg.norm(to_lamp, axis=-1)
        angles.append(np.degrees(np.arcsin(np.clip(sine, 0, 1))))
    return float(np.mean(angles)), float(np.max(angles))


def planck_spectrum(wavelengths_nm: np.ndarray, temperature_k: float) -> np.ndarray:
    """Relative power of a Planckian radiator, 1 at 560 nm (constants: CODATA 2018)."""
    wavelengths_nm = np.asarray(wavelengths_nm, float)

    def power(nm):
        return nm**-5.0 / np.expm1(_SECOND_RADIATION_CONSTANT_NM_K / (nm * temperature_k))

    return power(wavelengths_nm) / power(np.float64(560.0))
