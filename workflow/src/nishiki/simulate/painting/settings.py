"""What a simulated capture of a painting looks like: one frozen set of settings, checked when it is made."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from nishiki.errors import UserError
from nishiki.simulate.settings import CameraSettings, check_choice, check_ranges

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

    rings: int = 1
    ring_lights: int = 8
    top: bool = True
    checks_deg: tuple[float, ...] = (20.0, 30.0, 50.0, 60.0)
    distance_mm: float | None = None
    angular_diameter_deg: float = 1.5
    colour_temperature_k: float = 3200.0


@dataclass(frozen=True)
class SimulationSettings:
    """Everything that decides the bytes of a simulated capture.

    rows, columns : camera pixels. pitch_mm : size of one on the object. supersampling : points a pixel in each
    direction. scene, relief, gloss, body : see docs/simulator.md. roughness : GGX width, None = that of `gloss`.
    bounce : whether light that reaches a point by way of its surroundings is added. `relief_gain` scales all heights.
    """

    rows: int = 384
    columns: int = 512
    seed: int = 1
    scene: str = "painting"
    relief: str = "impasto"
    gloss: str = "varnish"
    body: str = "rough"
    roughness: float | None = None
    refractive_index: float = 1.5
    relief_gain: float = 1.0
    pitch_mm: float = 0.2
    supersampling: int = 2
    bounce: bool = True
    camera: CameraSettings = field(default_factory=CameraSettings)
    lights: LightSettings = field(default_factory=LightSettings)

    def __post_init__(self):
        lights = self.lights
        check_choice("scene", self.scene, SCENES)
        check_choice("relief", self.relief, RELIEFS)
        check_choice("gloss", self.gloss, ROUGHNESS)
        check_choice("body", self.body, BODIES)
        check_ranges(
            [
                ("rows", self.rows, 16, 20000),
                ("columns", self.columns, 16, 20000),
                ("seed", self.seed, 0, 2**53),
                ("pitch_mm", self.pitch_mm, 1e-3, 10.0),
                ("supersampling", self.supersampling, 1, 4),
                ("refractive_index", self.refractive_index, 1.05, 3.0),
                ("relief_gain", self.relief_gain, 0.0, 10.0),
                ("roughness", self.alpha, 0.0 if self.gloss == "none" else 0.02, 1.0),
                *self.camera.ranges(channels=(3, 8)),
                ("rings", lights.rings, 0, 8),
                ("ring_lights", lights.ring_lights, 3, 64),
                ("distance_mm", self.distance_mm, 2.0 * self.half_diagonal_mm, 1e9),
                ("angular_diameter_deg", lights.angular_diameter_deg, 0.0, 20.0),
                ("colour_temperature_k", lights.colour_temperature_k, 1500.0, 25000.0),
                *(("checks_deg", angle, 0.0, 85.0) for angle in lights.checks_deg),
            ]
        )
        if lights.rings * lights.ring_lights + lights.top < 3:
            raise UserError(
                "simulation: expected at least 3 sample lights, found fewer; use at least one ring of lights"
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
