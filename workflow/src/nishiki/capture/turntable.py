"""A capture of an object from many sides, or of one view under several polariser states, as one frozen value."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from nishiki.capture.frames import Frame, Photographed, inside
from nishiki.capture.lights import Lights, read_lights
from nishiki.capture.tables import arrange_cameras, read_cameras, read_points
from nishiki.capture.turntable_rules import Intrinsics, TurntableFile, read_intrinsics, turntable_problems
from nishiki.formats.mesh_heading import expect_mesh
from nishiki.formats.problems import Problem


@dataclass(frozen=True)
class TurntableCapture(Photographed):
    """An object from many sides.

    views, light_names, states: of the sample frames in the order in which they first appear, ('',) where the column is
    empty, but 'off' before 'on'; lights: the lamps of the lights file, or None; matrices: (3, 4) float64 by view, or
    None; distortions: k1, k2, p1, p2, k3 by view, empty where cameras.csv has none; points: (n, 5) float64 column, row,
    x, y, z by view, or None; scans, mesh, calibration: files; warnings: what was tolerated.
    """

    settings: TurntableFile
    views: tuple[str, ...]
    light_names: tuple[str, ...]
    states: tuple[str, ...]
    lights: Lights | None
    matrices: dict[str, np.ndarray] | None
    distortions: dict[str, tuple[float, ...]]
    points: dict[str, np.ndarray] | None
    intrinsics: Intrinsics | None
    mesh: Path | None
    scans: tuple[Path, ...]
    calibration: Path | None
    warnings: tuple[Problem, ...]

    @property
    def observed(self) -> tuple[Frame, ...]:
        """Frames of the object, ordered by light, then view, then polariser state: how observations are numbered."""
        by_state = {(f.light, f.view, f.polariser): f for f in self.frames_of("sample")}
        orders = [{name: i for i, name in enumerate(n)} for n in (self.light_names, self.views, self.states)]
        known = (key for key in by_state if all(name in order for name, order in zip(key, orders, strict=True)))
        return tuple(
            by_state[key] for key in sorted(known, key=lambda k: [o[n] for n, o in zip(k, orders, strict=True)])
        )

    def distortion_of(self, view: str) -> tuple[float, ...]:
        """Brown's k1, k2, p1, p2, k3 of a view's lens: those of its camera, else of the intrinsics, else zeros."""
        shared = self.intrinsics.distortion if self.intrinsics else (0.0,) * 5
        return self.distortions.get(view, shared)

    def silhouette_of(self, view: str) -> Frame | None:
        """Find the frame whose row names the silhouette of this view."""
        return next((f for f in self.frames if f.view == view and f.silhouette_path), None)


def examine_turntable(
    read: Photographed, complete: bool, attempt: Callable
) -> tuple[TurntableCapture | None, list[Problem]]:
    """Read the capture (None where its tables cannot be read) and list how its tables contradict each other.

    complete: whether frames.csv could be read; attempt: runs a reader, collecting the problems that it raises.
    """
    settings, payload, block = read.settings, read.payload, read.settings.turntable
    places = {(key, file): attempt(lambda f=file, k=key: inside(payload, f, f"capture.yaml {k}"))
              for key, file in block.files}  # fmt: skip

    def named(key: str) -> Path | None:
        return places.get((f"turntable.{key}", getattr(block, key)))

    def from_file(key: str, reader: Callable):
        return attempt(lambda: reader(named(key), getattr(block, key))) if named(key) else None

    for (key, file), path in places.items():
        if path is not None and key in ("turntable.mesh", "turntable.scans"):
            scan = key == "turntable.scans"
            attempt(lambda p=path, f=file, k=key, s=scan: expect_mesh(p, f, f"capture.yaml {k}", scan=s))
    file, kind = (settings.lights.file, settings.lights.kind) if settings.lights else (None, "direction")
    listed = attempt(lambda: inside(payload, file, "capture.yaml lights.file")) if file else None
    lights = attempt(lambda: read_lights(listed, kind=kind, frontal=False)) if listed else None
    table, intrinsics = from_file("cameras", read_cameras), from_file("intrinsics", read_intrinsics)
    if not complete:
        return None, []
    frames = _lamps_named(read.frames, lights)
    samples = [f for f in frames if f.role == "sample"]
    views = tuple(dict.fromkeys(f.view for f in samples))
    points = from_file("correspondences", lambda path, name: read_points(path, name, views))
    problems = turntable_problems(frames, views, lights, table.matrices if table else None, settings)
    if table is not None and (block.turn == "reverse" or block.camera_of):
        table = attempt(
            lambda: arrange_cameras(table, views, reverse=block.turn == "reverse", camera_of=block.camera_of)
        )
    states = tuple(dict.fromkeys(f.polariser for f in samples))
    if set(states) == {"off", "on"}:
        states = ("off", "on")  # the first state is the brighter one
    capture = TurntableCapture(
        **vars(read) | {"frames": frames},
        views=views,
        light_names=tuple(dict.fromkeys(f.light for f in samples)),
        states=states,
        lights=lights,
        matrices=table.matrices if table else None,
        distortions=table.distortions if table else {},
        points=points,
        intrinsics=intrinsics,
        mesh=named("mesh"),
        scans=tuple(path for (key, _), path in places.items() if key == "turntable.scans" and path),
        calibration=named("calibration"),
        warnings=tuple(p for p in (*problems, *(lights.warnings if lights else ())) if p.severity == "warning"),
    )
    return capture, problems + list(lights.warnings if lights else ())


def _lamps_named(frames: tuple[Frame, ...], lights: Lights | None) -> tuple[Frame, ...]:
    """Frames with their lamps called as in the lights file; a single lamp need not be named."""
    if lights is None:
        return frames
    alone = lights.names[0] if len(lights.names) == 1 else ""

    def called(frame: Frame) -> str:
        place = lights.find(frame.light) if frame.light else None
        return lights.names[place] if place is not None else frame.light or alone

    return tuple(replace(f, light=called(f)) if f.role in ("sample", "white") else f for f in frames)
