"""Define paints: invented pigments, the ramps of their mixtures, and the XYZ of each.

No measured pigment is behind the numbers: they are shapes (edges and bands) that give colours of the kind their names
suggest. Mixing: Duncan's rule, K and S add by concentration; reflectance of a thick layer: Kubelka & Munk (1931);
reflection at the inner side of the surface: Saunderson (J. Opt. Soc. Am. 32, 1942). Every region of the painting is a
short ramp of mixtures, every step of a ramp is one label.
"""

import math
from dataclasses import dataclass, field

import numpy as np

from nishiki.errors import UserError
from nishiki.simulate.capture import CameraSettings, check_choice, check_ranges, declare_range
from nishiki.simulate.randomness import subkey

INNER_REFLECTION = 0.5  # share of diffuse light that the surface sends back into the paint layer (Saunderson's k2)
OUTER_REFLECTION = 0.04  # share lost on the way in (k1)


@dataclass(frozen=True)
class Colourant:
    """Absorption: floor + edges + bands, each (strength, nm, width), an edge absorbs below; scattering: power law."""

    scattering: float
    floor: float
    edges: tuple[tuple[float, float, float], ...] = ()
    bands: tuple[tuple[float, float, float], ...] = ()
    exponent: float = 0.5

    def absorption(self, wavelengths_nm: np.ndarray) -> np.ndarray:
        """Compute K at the wavelengths, relative to the scattering of white."""
        total = np.full(wavelengths_nm.shape, self.floor)
        for strength, centre, width in self.edges:
            total += strength / (1.0 + np.exp((wavelengths_nm - centre) / width))
        for strength, centre, width in self.bands:
            total += strength * np.exp(-0.5 * ((wavelengths_nm - centre) / width) ** 2)
        return total

    def scatter(self, wavelengths_nm: np.ndarray) -> np.ndarray:
        """Compute S at the wavelengths; the white has 1 at 550 nm."""
        return self.scattering * (wavelengths_nm / 550.0) ** -self.exponent


PIGMENTS = {
    "white": Colourant(1.0, 0.0009, edges=((1.2, 396.0, 6.0),)),
    "black": Colourant(0.08, 3.0, exponent=0.1),
    "ultramarine": Colourant(0.13, 0.03, edges=((0.5, 384.0, 12.0),), bands=((2.4, 592.0, 52.0), (0.5, 535.0, 30.0))),
    "cobalt": Colourant(0.20, 0.025, bands=((0.8, 545.0, 24.0), (1.3, 588.0, 21.0), (1.4, 634.0, 25.0))),
    "cerulean": Colourant(0.25, 0.035, edges=((0.4, 402.0, 14.0),), bands=((1.1, 612.0, 44.0), (0.6, 682.0, 40.0))),
    "viridian": Colourant(0.12, 0.05, bands=((1.9, 622.0, 60.0), (1.3, 412.0, 36.0))),
    "lemon": Colourant(0.55, 0.006, edges=((5.0, 468.0, 8.0),)),
    "yellow": Colourant(0.60, 0.010, edges=((6.0, 497.0, 9.0),)),
    "orange": Colourant(0.55, 0.012, edges=((6.0, 560.0, 11.0),)),
    "vermilion": Colourant(0.50, 0.015, edges=((6.0, 587.0, 10.0),)),
    "madder": Colourant(0.06, 0.015, bands=((1.6, 514.0, 31.0), (1.2, 556.0, 21.0), (0.5, 440.0, 45.0))),
    "violet": Colourant(0.12, 0.06, bands=((1.6, 562.0, 48.0), (0.25, 630.0, 40.0))),
    "ochre": Colourant(0.40, 0.05, edges=((1.3, 536.0, 27.0),), bands=((0.30, 478.0, 26.0), (0.10, 655.0, 42.0))),
    "sienna": Colourant(0.25, 0.10, edges=((2.0, 580.0, 29.0),), bands=((0.2, 690.0, 60.0),)),
    "umber": Colourant(0.20, 0.42, edges=((1.4, 560.0, 80.0),)),
}


def mixture(parts: dict[str, float], wavelengths_nm: np.ndarray) -> np.ndarray:
    """Compute the reflectance (wavelengths,) of a mixture of pigment name → concentration (any positive scale)."""
    wavelengths_nm = np.asarray(wavelengths_nm, float)
    total = sum(parts.values())
    absorption, scattering = np.zeros((2, *wavelengths_nm.shape))
    for name, share in parts.items():
        absorption += share / total * PIGMENTS[name].absorption(wavelengths_nm)
        scattering += share / total * PIGMENTS[name].scatter(wavelengths_nm)
    ratio = absorption / scattering
    # Kubelka and Munk's 1 + q - sqrt(q^2 + 2q), of an opaque layer, as its reciprocal: no cancellation where q is large
    inside = 1.0 / (1.0 + ratio + np.sqrt(ratio * ratio + 2.0 * ratio))
    # Saunderson: seen from outside, without the mirror reflection of the surface
    return (1.0 - OUTER_REFLECTION) * (1.0 - INNER_REFLECTION) * inside / (1.0 - INNER_REFLECTION * inside)


def grey(reflectance: float) -> dict[str, float]:
    """Mix white and black to reflect `reflectance` at 550 nm (bisection in log concentration)."""
    low, high = -14.0, 14.0
    at = np.array([550.0])
    for _ in range(80):
        middle = 0.5 * (low + high)
        if mixture({"white": 1.0, "black": float(np.exp(middle))}, at)[0] > reflectance:
            low = middle
        else:
            high = middle
    return {"white": 1.0, "black": float(np.exp(0.5 * (low + high)))}


GREYS = (0.85, 0.55, 0.36, 0.20, 0.09, 0.012)  # 0.85 and 0.012 lie close to the pure white and black paints

_RAMPS: dict[str, tuple[dict, dict, int]] = {
    "ground": ({"sienna": 1.0, "white": 0.5}, {"sienna": 1.0, "white": 0.9}, 3),
    "sky high": ({"ultramarine": 1.0, "cobalt": 0.8, "white": 0.35}, {"cobalt": 1.0, "white": 0.9}, 7),
    "sky middle": ({"cerulean": 1.0, "cobalt": 0.4, "white": 0.6}, {"cerulean": 1.0, "white": 2.2}, 7),
    "sky low": ({"white": 1.0, "orange": 0.02, "madder": 0.25}, {"white": 1.0, "yellow": 0.10}, 7),
    "halo": ({"yellow": 1.0, "white": 0.7}, {"orange": 0.7, "yellow": 1.0, "white": 0.3}, 6),
    "sun": ({"lemon": 1.0, "white": 2.0}, {"yellow": 1.0, "white": 0.3}, 4),
    "cloud": ({"white": 1.0, "madder": 0.10}, {"white": 1.0, "ochre": 0.02}, 5),
    "gold cloud": ({"ochre": 1.0, "yellow": 0.25}, {"ochre": 0.6, "yellow": 0.5, "white": 0.5}, 4),
    "mountain lit": ({"violet": 1.0, "white": 0.7, "madder": 0.5}, {"violet": 1.0, "white": 1.6, "ochre": 0.3}, 5),
    "mountain shade": ({"ultramarine": 1.0, "violet": 0.6, "white": 0.12}, {"ultramarine": 1.0, "white": 0.45}, 5),
    "snow lit": ({"white": 1.0, "ochre": 0.01}, {"white": 1.0}, 3),
    "snow shade": ({"white": 1.0, "ultramarine": 0.5}, {"white": 1.0, "ultramarine": 0.2}, 4),
    "far hills": ({"cobalt": 1.0, "viridian": 0.5, "white": 0.8}, {"viridian": 0.8, "cerulean": 1.0, "white": 1.6}, 5),
    "middle hills": (
        {"viridian": 1.0, "cerulean": 0.6, "lemon": 0.4, "white": 0.2},
        {"viridian": 1.0, "lemon": 0.9, "white": 0.5},
        5,
    ),
    "near hills": ({"viridian": 1.0, "umber": 0.3, "lemon": 0.2}, {"viridian": 0.7, "lemon": 1.0}, 5),
    "lake": ({"cobalt": 1.0, "ultramarine": 0.5, "white": 0.12}, {"cerulean": 1.0, "white": 1.0}, 8),
    "glitter": ({"orange": 0.5, "yellow": 0.5, "white": 0.7}, {"yellow": 1.0, "white": 1.6}, 5),
    "meadow": ({"viridian": 1.0, "umber": 0.2, "lemon": 0.3}, {"viridian": 0.35, "lemon": 1.0, "white": 0.1}, 6),
    "rape field": ({"yellow": 1.0, "ochre": 0.5}, {"lemon": 1.0, "yellow": 0.4}, 5),
    "poppies": ({"vermilion": 1.0, "madder": 0.15}, {"vermilion": 0.4, "orange": 1.0, "white": 0.05}, 4),
    "blossom": ({"white": 1.0, "madder": 1.3}, {"white": 1.0, "madder": 0.06}, 6),
    "branch": ({"umber": 1.0, "black": 0.4}, {"umber": 1.0, "sienna": 0.6}, 4),
    "torii": ({"vermilion": 1.0, "sienna": 0.15}, {"vermilion": 0.6, "orange": 1.0}, 4),
    "black line": ({"black": 1.0}, {"black": 1.0, "umber": 0.3}, 2),
    "brocade red": ({"madder": 0.5, "vermilion": 1.0}, {"vermilion": 1.0, "madder": 0.08}, 4),
    "brocade indigo": ({"ultramarine": 1.0, "black": 0.03}, {"ultramarine": 1.0, "cobalt": 0.8}, 4),
    "brocade green": ({"viridian": 1.0, "white": 0.1}, {"viridian": 1.0, "white": 0.3, "lemon": 0.3}, 4),
    "brocade violet": ({"violet": 1.0, "madder": 0.3}, {"violet": 1.0, "white": 0.25}, 4),
    "brocade gold": ({"ochre": 1.0, "yellow": 0.2}, {"ochre": 1.0, "yellow": 0.7, "white": 0.2}, 5),
    "brocade cream": ({"white": 1.0, "ochre": 0.06}, {"white": 1.0, "ochre": 0.02}, 3),
    **{f"grey {index + 1}": (grey(value), grey(value), 1) for index, value in enumerate(GREYS)},
    "patch red": ({"vermilion": 1.0}, {"vermilion": 1.0}, 1),
    "patch orange": ({"orange": 1.0}, {"orange": 1.0}, 1),
    "patch yellow": ({"yellow": 1.0, "lemon": 0.3}, {"yellow": 1.0, "lemon": 0.3}, 1),
    "patch green": ({"viridian": 1.0, "lemon": 1.2}, {"viridian": 1.0, "lemon": 1.2}, 1),
    "patch blue": ({"cobalt": 1.0, "white": 0.3}, {"cobalt": 1.0, "white": 0.3}, 1),
    "patch violet": ({"violet": 1.0, "white": 0.3}, {"violet": 1.0, "white": 0.3}, 1),
}

REGIONS = tuple(_RAMPS)
REGION = {name: index for index, name in enumerate(REGIONS)}


@dataclass(frozen=True)
class Palette:
    """The paints of a picture.

    first, steps : (regions,) first label of a region and how many it has; region : (labels,) region of a label; names :
    (labels,) text; spectra : (labels, wavelengths) reflectance; roughness : (labels,) GGX alpha.
    """

    first: np.ndarray
    steps: np.ndarray
    region: np.ndarray
    names: tuple[str, ...]
    spectra: np.ndarray
    roughness: np.ndarray


def make_palette(wavelengths_nm: np.ndarray, *, alpha: float, seed: int) -> Palette:
    """Make all paints at the given wavelengths; roughness varies by ±20 % between regions and ±5 % within one."""
    steps = np.array([ramp[2] for ramp in _RAMPS.values()])
    first = np.concatenate([[0], np.cumsum(steps)[:-1]])
    region = np.repeat(np.arange(steps.size), steps)
    names, spectra = [], []
    for name, (start, end, count) in _RAMPS.items():
        for step in range(count):
            share = step / max(count - 1, 1)
            parts = {
                pigment: (1.0 - share) * start.get(pigment, 0.0) + share * end.get(pigment, 0.0)
                for pigment in {**start, **end}
            }
            spectra.append(mixture(parts, wavelengths_nm))
            names.append(f"{name} {step + 1}/{count}" if count > 1 else name)
    random = np.random.default_rng(subkey(seed, "roughness"))
    between = random.uniform(0.8, 1.2, steps.size)[region]
    roughness = alpha * between * random.uniform(0.95, 1.05, region.size)
    return Palette(first, steps, region, tuple(names), np.array(spectra), np.clip(roughness, 0.0, 1.0))


ROUGHNESS = {"none": 0.0, "matte": 0.42, "satin": 0.22, "varnish": 0.11}
RELIEFS = ("flat", "canvas", "impasto")
SCENES = ("painting", "spheres")
BODIES = ("rough", "lambert")
PRESETS = {"painting": (384, 512), "tiny": (64, 96), "large": (1536, 2048), "full": (3000, 4000)}


@dataclass(frozen=True)
class LampSettings:
    """The lamp and its positions.

    rings, ring_lights : number of rings and of lights in each. top : whether there is a light beside the camera.
    checks_deg : incidence of the check lights. distance_mm : from the centre of the object; None = 80 half diagonals.
    angular_diameter_deg : of the lamp seen from the object. colour_temperature_k : of its Planckian spectrum.
    """

    rings: int = declare_range(0, 8, 1)
    ring_lights: int = declare_range(3, 64, 8)
    top: bool = True
    checks_deg: tuple[float, ...] = (20.0, 30.0, 50.0, 60.0)
    distance_mm: float | None = None
    angular_diameter_deg: float = declare_range(0.0, 20.0, 1.5)
    colour_temperature_k: float = declare_range(1500.0, 25000.0, 3200.0)

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

    rows: int = declare_range(16, 20000, 384)
    columns: int = declare_range(16, 20000, 512)
    seed: int = declare_range(0, 2**53, 1)
    scene: str = "painting"
    relief: str = "impasto"
    gloss: str = "varnish"
    body: str = "rough"
    roughness: float | None = None
    refractive_index: float = declare_range(1.05, 3.0, 1.5)
    relief_gain: float = declare_range(0.0, 10.0, 1.0)
    pitch_mm: float = declare_range(1e-3, 10.0, 0.2)
    supersampling: int = declare_range(1, 4, 2)
    bounce: bool = True
    camera: CameraSettings = field(default_factory=CameraSettings)
    lights: LampSettings = field(default_factory=LampSettings)

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
    """Place all lamps: the top one, the rings, then the check lights between their azimuths.

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
    """Compute positions x (columns,) and y (rows in the slice,) of pixel centres in mm from the centre, y upwards."""
    x = (np.arange(settings.columns) + 0.5 - 0.5 * settings.columns) * settings.pitch_mm
    y = (0.5 * settings.rows - 0.5 - np.arange(settings.rows)[rows]) * settings.pitch_mm
    return x, y


def beam_strength(lamp: LampPose, settings: SimulationSettings, rows: slice) -> np.ndarray:
    """Compute irradiance (rows, columns) on a surface facing the lamp (1/r², beam); power 1 gives 1 at the centre."""
    x, y = plane_coordinates(settings, rows)
    dx, dy = lamp.position_mm[0] - x[None, :], lamp.position_mm[1] - y[:, None]
    square = dx * dx + dy * dy + lamp.position_mm[2] ** 2
    u, v = x[None, :] / settings.half_diagonal_mm, y[:, None] / settings.half_diagonal_mm
    beam = 1.0 + lamp.tilt[0] * u + lamp.tilt[1] * v - lamp.falloff * (u * u + v * v)
    return lamp.power * beam * settings.distance_mm**2 / square


def vignette(settings: SimulationSettings, rows: slice) -> np.ndarray:
    """Compute the light fall-off of the lens (rows, columns): 4 % in the corners."""
    u, v = (axis / settings.half_diagonal_mm for axis in plane_coordinates(settings, rows))
    return 1.0 - 0.04 * (u[None, :] ** 2 + v[:, None] ** 2)


def board_cosine(lamp: LampPose, settings: SimulationSettings, rows: slice) -> np.ndarray:
    """Compute the cosine (rows, columns) of incidence on a flat board in the object's plane, from the true lamp."""
    x, y = plane_coordinates(settings, rows)
    dx, dy = lamp.position_mm[0] - x[None, :], lamp.position_mm[1] - y[:, None]
    return lamp.position_mm[2] / np.sqrt(dx * dx + dy * dy + lamp.position_mm[2] ** 2)


def direction_error_deg(settings: SimulationSettings) -> tuple[float, float]:
    """Compute mean and largest angle (degrees; pixels, lamps) between true directions and those from the centre."""
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
    """Compute the relative power of a Planckian radiator, 1 at 560 nm (constants: CODATA 2018)."""
    wavelengths_nm = np.asarray(wavelengths_nm, float)

    def power(nm):
        return nm**-5.0 / np.expm1(_SECOND_RADIATION_CONSTANT_NM_K / (nm * temperature_k))

    return power(wavelengths_nm) / power(np.float64(560.0))
