"""A rig that photographs an existing capture: what each lamp shows is a photograph of it. Faults come on request."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import yaml

from nishiki.capture.folder import load_capture
from nishiki.rig.device import DeviceLost, Exposure, Rig


class Bench:
    """What stands before the camera and which lamp shines; `disturb(device)` is called before each step of a device."""

    def __init__(self, capture: Path, disturb: Callable[[str], None] = lambda device: None) -> None:
        source = load_capture(capture)
        self.photographs = {
            (f.role if f.role in ("white", "dark") else "object", f.light): f.path for f in source.frames
        }
        self.lamps = source.lights.names
        self.subject, self.lamp, self.disturb = "object", None, disturb
        self.exposures, self.asked = 0, []
        self.configured: list[Exposure] = []

    def open(self, description: Path) -> Rig:
        """The devices of the rig."""
        self.disturb("open")
        return Rig(BenchCamera(self), BenchLamps(self))

    def ask(self, device: str, request: str) -> None:
        """The person at the rig does what is asked."""
        self.asked.append(request)
        words = {"white board": "white", "lens cap on": "dark", "object": "object"}
        self.subject = next(subject for text, subject in words.items() if text in request)

    def see(self) -> Path:
        """The photograph that the camera would take now."""
        if self.subject == "dark" or self.lamp is None:
            return self.photographs["dark", ""]
        return self.photographs[self.subject, self.lamps[self.lamp - 1]]


class BenchLamps:
    """One lamp shines."""

    def __init__(self, bench: Bench) -> None:
        self.bench, self.count = bench, len(bench.lamps)

    def light(self, lamp: int | None) -> None:
        """Light a lamp."""
        self.bench.disturb("lamps")
        self.bench.lamp = lamp

    def close(self) -> None:
        """Switch off."""
        self.bench.lamp = None


class BenchCamera:
    """Copies the photograph that the bench shows."""

    def __init__(self, bench: Bench) -> None:
        self.bench = bench

    def configure(self, exposure: Exposure) -> Exposure:
        """Take any exposure."""
        self.bench.disturb("configure")
        self.bench.configured.append(exposure)
        return exposure

    def photograph(self, folder: Path) -> tuple[Path, ...]:
        """Expose and download; a cable that is unplugged leaves half a file."""
        self.bench.exposures += 1
        source, target = self.bench.see(), folder / f"DSC{self.bench.exposures:04d}.PNG"
        try:
            self.bench.disturb("photograph")
        except DeviceLost:
            target.write_bytes(source.read_bytes()[:300])
            raise
        shutil.copyfile(source, target)
        return (target,)

    def close(self) -> None:
        """Nothing is held."""


def write_plan(folder: Path, photographed: Path, **changes) -> Path:
    """A plan that photographs a capture of a plane again: lamps and camera are the same."""
    source = load_capture(photographed)
    shutil.copyfile(source.payload / "lights.lp", folder / "dome.lp")
    camera = source.settings.camera
    block = {"title": "Test plane", "camera": {"bits": camera.bits, "saturation": camera.saturation}}
    plan = {
        "kind": "dome",
        "suffix": "png",
        "lights": "dome.lp",
        "checks_for": [f.light for f in source.frames_of("check")],
        "white": {"when": "before"},
        "dark": {"when": "after", "frames": 1},
        "estimate": {"frame_mb": 0.01},
        "capture": block,
    }
    path = folder / "plan.yaml"
    path.write_text(yaml.safe_dump(plan | changes))
    return path
