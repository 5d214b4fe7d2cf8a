"""Declare the settings of a simulated capture of a painting, and the lamp that they place."""

import math
from dataclasses import dataclass, field

import numpy as np

from nishiki.errors import UserError
from nishiki.simulate.capture import CameraSettings, check_choice, check_ranges, ranged
from nishiki.simulate.randomness import subkey

ROUGHNESS = {"none": 0.0, "matte": 0.42, "satin": 0.22, "varnish": 0.11}
RELIEFS = ("flat", "canvas", "impasto")
SCENES = ("painting", "spheres")
BODIES = ("rough", "lambert")
PRESETS = {"painting": (384, 512), "tiny": (64, 96), "large": (1536, 2048), "full": (3000, 4000)}


@dataclass(frozen=True)
class LightSettings:
    """The lamp and where it stands.

    rings, ring_lights : number of rings and of lights in each. top : whether there is a light beside the camera.
    checks_deg : incidence of the check lights. distance_mm : from the centre of the object; None = 80 half diagonals.
    angular_diameter_deg : of the lamp seen from the object. colour_temperature_k : of its Planckian spectrum.
    """

    rings: int = ranged(0, 8, 1)
    ring_lights: int = ranged(3, 64, 8)
    top: bool = True
    checks_deg: tuple[float, ...] = (20.0, 30.0, 50.0, 60.0)
    distance_mm: float | None = None
    angular_diameter_deg: float = ranged(0.0, 20.0, 1.5)
    colour_temperature_k: float = ranged(1500.0, 25000.0, 3200.0)

    def __post_init__(self):
        check_ranges(self, *(("checks_deg", angle, 0.0, 85.0) for angle in self.checks_deg))
        if self.rings * self.ring_lights + self.top < 3:
            raise UserError(
                "simulation: expected at least 3 sample lights, found fewer; use at least one ring of lights"
            )


@dataclass(frozen=True)
class SimulationSettings:
    """Everything that decides the bytes of a simulated capture.

    rows, columns : camera pixels. pitch_mm : size of one on the object. supersampling : points a pixel in each
    direction. scene, relief, gloss, body : see docs/simulator.md. roughness : GGX width, None = that of `gloss`.
    bounce : whether light that reaches a point by way of its surroundings is added. `relief_gain` scales all heights.
    """

    rows: int = ranged(16, 20000, 384)
    columns: int = ranged(16, 20000, 512)
    seed: int = ranged(0, 2**53, 1)
    scene: str = "painting"
    relief: str = "impasto"
    gloss: str = "varnish"
    body: str = "rough"
    roughness: float | None = None
    refractive_index: float = ranged(1.05, 3.0, 1.5)
    relief_gain: float = ranged(0.0, 10.0, 1.0)
    pitch_mm: float = ranged(1e-3, 10.0, 0.2)
    supersampling: int = ranged(1, 4, 2)
    bounce: bool = True
    camera: CameraSettings = field(default_factory=CameraSettings)
    lights: LightSettings = field(default_factory=LightSettings)

    def __post_init__(self):
        check_choice("scene", self.scene, SCENES)
        check_choice("relief", self.relief, RELIEFS)
        check_choice("gloss", self.gloss, ROUGHNESS)
        check_choice("body", self.body, BODIES)
        check_ranges(
            self,
            ("roughness", self.alpha, 0.0 if self.gloss == "none" else 0.02, 1.0),
            ("distance_mm", self.distance_mm, 2.0 * self.half_diagonal_mm, 1e9),
        )

    @property
    def half_diagonal_mm(self) -> float:
        """Distance of a corner from the centre, mm."""
        return 0.5 * self.pitch_mm * math.hypot(self.rows, self.columns)

    @property
    def distance_mm(self) -> float:
        """Distance of the lamp from the centre of the object, mm."""
        return self.lights.distance_mm or 80.0 * self.half_diagonal_mm

    @property
    def alpha(self) -> float:
        """GGX roughness before it varies from region to region; 0 = no gloss at all."""
        return ROUGHNESS[self.gloss] if self.roughness is None else self.roughness


TOP_INCIDENCE_DEG = 4.0  # a lamp cannot stand where the camera is
_SECOND_RADIATION_CONSTANT_NM_K = 1.438776877e7


@dataclass(frozen=True)
class LampPose:
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


def place_lamps(settings: SimulationSettings) -> tuple[LampPose, ...]:
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


def _lamp(settings, rng, name, role, incidence, azimuth):
    miss = rng.uniform(-1.5, 1.5, 2) if name != "top" else np.zeros(2)
    theta = math.radians(min(max(incidence + miss[0], 0.0), 88.0))
    phi = math.radians(azimuth + miss[1])
    direction = np.array([math.sin(theta) * math.cos(phi), math.sin(theta) * math.sin(phi), math.cos(theta)])
    position = settings.distance_mm * direction
    tilt = tuple(rng.uniform(-0.03, 0.03, 2))
    return LampPose(name, role, direction, position, float(rng.uniform(0.93, 1.07)), tilt, rng.uniform(0.03, 0.07))


def plane_coordinates(settings: SimulationSettings, rows: slice) -> tuple[np.ndarray, np.ndarray]:
    """Positions x (columns,) and y (rows in the slice,) of pixel centres in mm from the centre, y upwards."""
    x = (np.arange(settings.columns) + 0.5 - 0.5 * settings.columns) * settings.pitch_mm
    y = (0.5 * settings.rows - 0.5 - np.arange(settings.rows)[rows]) * settings.pitch_mm
    return x, y


def beam_strength(lamp: LampPose, settings: SimulationSettings, rows: slice) -> np.ndarray:
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


def board_cosine(lamp: LampPose, settings: SimulationSettings, rows: slice) -> np.ndarray:
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
