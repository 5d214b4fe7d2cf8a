"""The tables of a capture that a rig has taken: capture.yaml, frames.csv, lamps, and the files that the plan names."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from nishiki.capture.folder import examine
from nishiki.capture.schema_base import FORMAT
from nishiki.capture.taking import channel_names, choose_encoding, lights_text, settings_text, table_text
from nishiki.errors import UserError
from nishiki.formats.files import name_fault, put_file
from nishiki.formats.image_header import ImageHeader
from nishiki.formats.problems import CaptureError
from nishiki.rig.frames_table import ANGLES, PlannedFrame
from nishiki.rig.plan import GEOMETRIES, DomePlan, ReadPlan, TurntablePlan

FULL_TURN_DEG = 360.0


def capture_settings(plan: ReadPlan, header: ImageHeader | None = None) -> dict[str, Any]:
    """Keys of capture.yaml: those of the plan, and what follows from it and from a photograph, once there is one."""
    settings = plan.settings
    camera = dict(settings.capture.get("camera") or {})
    if header is not None:
        camera.setdefault("channels", list(channel_names(header)))
        camera.setdefault("encoding", choose_encoding(header, None, "")[0])
    values = {"format": FORMAT, "geometry": GEOMETRIES[settings.kind], **settings.capture, "camera": camera}
    if isinstance(settings, DomePlan):
        values["lights"] = {**(values.get("lights") or {}), "file": "lights.lp", "kind": settings.lights_kind}
    if isinstance(settings, TurntablePlan) and settings.turn_deg == FULL_TURN_DEG and settings.steps > 1:
        values["turntable"] = {"full_turn": True, **(values.get("turntable") or {})}
    return values


def write_tables(
    folder: Path,
    plan: ReadPlan,
    frames: tuple[PlannedFrame, ...],
    exposures: Mapping[str, float],
    header: ImageHeader | None = None,
) -> None:
    """Write capture.yaml, frames.csv and lights.lp into `folder`, and copy the files that the plan's `capture` names.

    exposures : mapping of str to float
        Seconds of each frame by its file. The column `exposure_s` is written where all lit frames have one.
    """
    values = capture_settings(plan, header)
    put_file(folder / "capture.yaml", settings_text(values))
    put_file(folder / "frames.csv", _frames_csv(plan, frames, exposures))
    if plan.lights is not None:
        put_file(folder / "lights.lp", lights_text(plan.lights))
    for name in _texts(plan.settings.capture):
        source = plan.folder / name
        if not name_fault(name) and source.is_file():
            target = folder / name
            target.parent.mkdir(parents=True, exist_ok=True)
            partial = target.with_name(f".{target.name}.part")
            shutil.copyfile(source, partial)
            os.replace(partial, target)


def refuse_unusable_settings(folder: Path) -> None:
    """UserError with every mistake of the tables in `folder`, which hold frames that are not taken yet."""
    _, problems = examine(folder)
    later = [p for p in problems if p.kind == "image-missing" and p.file.startswith("frames.csv row")]
    errors = [p for p in problems if p.severity == "error" and p not in later]
    if errors:
        raise UserError(f"plan: {CaptureError(errors)}\nRemedy: correct the plan's block 'capture', or its lights")


def _frames_csv(plan: ReadPlan, frames: tuple[PlannedFrame, ...], exposures: Mapping[str, float]) -> str:
    columns = {
        "dome": ["file", "role", "light"],
        "turntable": ["file", "role", "view", "light", "polariser"],
        "goniometer": ["file", "role", *ANGLES],
    }[plan.settings.kind]
    if all(frame.file in exposures for frame in frames if frame.group != "dark"):
        columns.append("exposure_s")
    rows = [columns]
    for frame in frames:
        cells = {key: getattr(frame, key, "") for key in columns} | dict(zip(ANGLES, frame.angles_deg, strict=False))
        cells["exposure_s"] = exposures.get(frame.file, "")
        rows.append([f"{cells[key]:.10g}" if isinstance(cells[key], float) else cells[key] for key in columns])
    return table_text(rows)


def _texts(value: Any) -> Iterator[str]:
    """Every text in a block of settings."""
    if isinstance(value, str):
        yield value
    elif isinstance(value, Mapping | list | tuple):
        for item in value.values() if isinstance(value, Mapping) else value:
            yield from _texts(item)
