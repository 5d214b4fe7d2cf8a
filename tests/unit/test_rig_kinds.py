"""Whole captures of an object on a turntable and of a cloth on a goniometer, through simple devices."""

from pathlib import Path

import numpy as np
import pytest
import yaml
from captures import write_frame

from nishiki.capture.folder import load_capture
from nishiki.rig.device import Exposure, Rig
from nishiki.rig.run import run_capture


class Scene:
    """An object, a board or darkness before a camera, with axes, polarisers and one lamp."""

    def __init__(self, axes=(), polarisers=None):
        self.subject, self.exposure, self.lit = "object", Exposure(), False
        self.count, self.taken = 1, 0
        self.angles = {}
        self.states = {}
        axes = {name: SceneAxis(self, name) for name in axes}
        polarisers = {name: ScenePolariser(self, name, states) for name, states in (polarisers or {}).items()}
        self.rig = Rig(self, self, axes, polarisers)

    def configure(self, exposure):
        self.exposure = exposure
        return exposure

    def light(self, lamp):
        self.lit = lamp is not None

    def close(self):
        self.lit = False

    def photograph(self, folder):
        self.taken += 1
        rng = np.random.default_rng(5)
        texture = 0.5 + 0.2 * rng.random((80, 90, 3))
        texture[:10] = 0.02
        tilt = np.cos(np.radians(self.angles.get("lamp_arm", 0.0)))
        values = {"object": 0.8 * texture, "white": np.full_like(texture, 0.9), "dark": 0.0 * texture}[self.subject]
        dimmed = 0.7 if self.states.get("polariser") == "on" else 1.0
        codes = 100 + 3000 * values * tilt * dimmed * (self.exposure.seconds or 0.5) / 0.5
        write_frame(folder / f"{self.taken:04d}.png", np.minimum(codes + self.taken % 7, 4095))
        return (folder / f"{self.taken:04d}.png",)

    def ask(self, device, request):
        words = {"white board": "white", "lens cap on": "dark", "object": "object"}
        self.subject = next(subject for text, subject in words.items() if text in request)


class SceneAxis:
    range_deg = (-180.0, 180.0)

    def __init__(self, scene, name):
        self.scene, self.name = scene, name

    def home(self):
        self.scene.angles[self.name] = 0.0

    def move_to(self, degrees):
        assert self.name in self.scene.angles, "not homed"
        assert -180 <= degrees <= 180
        self.scene.angles[self.name] = degrees

    def close(self):
        pass


class ScenePolariser:
    def __init__(self, scene, name, states):
        self.scene, self.name, self.states = scene, name, states

    def set(self, state):
        self.scene.states[self.name] = state

    def close(self):
        pass


def take(folder, scene, plan):
    (folder / "plan.yaml").write_text(yaml.safe_dump(plan))
    run_capture(
        Path("rig.yaml"), folder / "plan.yaml", folder / "capture", open_devices=lambda path: scene.rig, ask=scene.ask
    )
    return load_capture(folder / "capture")


def test_an_object_on_a_turntable_in_two_polariser_states(tmp_path):
    scene = Scene(axes=["turntable"], polarisers={"polariser": ("off", "on")})
    plan = {
        "kind": "turntable",
        "suffix": "png",
        "steps": 4,
        "states": ["off", "on"],
        "exposure_s": 0.5,
        "lamps": [1],
        "white": {"when": "before"},
        "dark": {"frames": 1},
        "estimate": {"frame_mb": 0.1},
        "capture": {"camera": {"bits": 12}, "lights": {"kind": "camera"}},
    }
    capture = take(tmp_path, scene, plan)
    assert capture.sealed
    assert capture.settings.turntable.full_turn
    assert [(f.view, f.polariser) for f in capture.frames_of("sample")][:3] == [
        ("000", "off"),
        ("000", "on"),
        ("001", "off"),
    ]
    assert {f.exposure_s for f in capture.frames} == {0.5}
    assert scene.angles["turntable"] == pytest.approx(-90)  # 270 degrees, the other way round


def test_a_cloth_on_a_goniometer_with_two_exposures(tmp_path):
    scene = Scene(axes=["lamp_arm", "camera_arm", "table"])
    plan = {
        "kind": "goniometer",
        "suffix": "png",
        "theta_step_deg": 27,
        "phi_step_deg": 30,
        "oblique": 3,
        "exposure_s": [0.5, 0.1],
        "lamp": 1,
        "axes": {"lamp_arm": {"theta_i": 1}, "camera_arm": {"theta_r": 1}, "table": {"phi_r": -1}},
        "white": {"when": "before"},
        "dark": {"frames": 1},
        "estimate": {"frame_mb": 0.1},
        "capture": {"camera": {"bits": 12}, "goniometer": {"weave": "satin", "white_reflectance": 0.99}},
    }
    capture = take(tmp_path, scene, plan)
    samples = capture.frames_of("sample")
    assert len(samples) == 2 * (1 + 3 * 4 + 3)
    assert {f.exposure_s for f in samples} == {0.5, 0.1}
    assert {f.exposure_s for f in capture.frames_of("dark")} == {0.5, 0.1}
    assert {f.angles_deg[:2] for f in samples} == {f.angles_deg[:2] for f in capture.frames_of("white")}
    assert capture.settings.goniometer.weave == "satin"
