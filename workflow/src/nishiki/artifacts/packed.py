"""Describe a packed scene and its stages: the facts that every description of a crate states."""

import json
import re
from collections.abc import Iterable
from dataclasses import dataclass, field
from datetime import date as Date
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

from nishiki.artifacts.artifact import Artifact

METADATA = "ro-crate-metadata.json"
Entity = dict[str, Any]


def json_text(value: Any) -> str:
    """Format a value as indented JSON with sorted keys."""
    return json.dumps(value, indent=1, sort_keys=True, ensure_ascii=False, allow_nan=False) + "\n"


def ids(names: Iterable[str]) -> list[Entity] | Entity:
    """Return references to entities; a single one stands without a list, as in the compact form."""
    references = [{"@id": name} for name in names]
    return references[0] if len(references) == 1 else references


def is_address(text: str | None) -> bool:
    """Test if a text, such as the rights in capture.yaml, is an address on the web and can identify what it says."""
    return bool(text and re.fullmatch(r"https?://[^\s<>\"]+", text))


@dataclass(frozen=True)
class PackedStage:
    """Describe one packed artifact."""

    manifest: dict[str, Any]  # artifact.json
    run: dict[str, Any]  # facts of its run
    same_code: bool  # whether the packed code made it
    does: str  # purpose of the stage
    files: dict[str, tuple[int, str]]  # bytes and SHA-256 of artifact.json and run.json
    name: str  # that of the stage, after its field where it is one of a mosaic's: FIELD/STAGE

    @property
    def stage(self) -> str:
        """Name of the stage."""
        return self.manifest["stage"]

    @property
    def folder(self) -> str:
        """Folder of the artifact inside the crate, with a slash at its end."""
        return f"artifacts/{self.name}/{self.manifest['key']}/"

    @property
    def sources(self) -> list[str]:
        """Folders of what it was made from, inside the crate."""
        above, own = self.manifest["upstream"], self.name.removesuffix(self.stage)
        return ["capture/" if name == "capture" else f"artifacts/{own}{name}/{above[name]['key']}/" for name in above]


def start_time(stage: PackedStage) -> str:
    """Return when a stage began, ISO 8601."""
    end = datetime.fromisoformat(stage.run["finished"])
    return (end - timedelta(seconds=float(stage.run["seconds"]))).isoformat(timespec="seconds")


def end_time(stage: PackedStage) -> str:
    """Return when a stage ended, ISO 8601."""
    return datetime.fromisoformat(stage.run["finished"]).isoformat(timespec="seconds")


TECHNIQUES = {
    "plane": "photographs of one view under several lamps in turn",
    "turntable": "photographs from several sides, or under several states of a polariser",
    "goniometer": "measurement of reflectance under many directions of light and view",
}
"""How a capture of each geometry is made, in words."""


@dataclass(frozen=True)
class PackedScene:
    """Collect the contents of a crate: one digitised scene."""

    name: str
    version: str  # of this program
    artifacts: list[Artifact]  # in the order of the flow
    capture: Path  # the sealed folder
    digest: str  # of the capture
    # what capture.yaml says under the keys of `ABOUT`; None or empty where nothing is said
    about: dict[str, str | None]
    facts: dict[str, Any]  # further facts of the plan as plain data
    does: dict[str, str]  # purposes of the stages
    method: dict[str, Any] = field(default_factory=dict)  # how the capture was made (`capture_method`)
    stages: list[PackedStage] = field(default_factory=list)  # the artifacts as they are packed
    with_capture: bool = True

    def about_value(self, key: str) -> str:
        """Return the value of capture.yaml under a key of `about`; empty where it is missing."""
        return self.about.get(key) or ""

    @property
    def technique(self) -> str:
        """How the photographs were taken, in words; empty where the geometry is unknown."""
        return TECHNIQUES.get(self.method.get("geometry", ""), "")

    @property
    def camera(self) -> str:
        """Model of the camera; empty where nothing is said."""
        return self.method.get("camera") or ""

    @property
    def scale(self) -> str:
        """Distance of two pixels on the object, in words; empty where nothing is said."""
        pitch = self.method.get("pixel_pitch_mm")
        return f"a pixel is {pitch:g} mm on the object" if pitch else ""


def days_of(text: str) -> tuple[str, str] | None:
    """Return first and last moment of an ISO 8601 date, or of a date with time; None for any other text.

    Examples
    --------
    >>> days_of("2026-01-31")
    ('2026-01-31T00:00:00', '2026-01-31T23:59:59')
    >>> days_of("2026-01-31, in two sessions") is None
    True
    """
    try:
        day = Date.fromisoformat(text)
    except ValueError:
        pass
    else:
        return f"{day.isoformat()}T00:00:00", f"{day.isoformat()}T23:59:59"
    try:
        moment = datetime.fromisoformat(text).isoformat()
    except ValueError:
        return None
    return moment, moment
