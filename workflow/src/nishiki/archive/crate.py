"""Describe one packed stage and its digitisation in the words that all parts of a crate share."""

import re
from collections.abc import Iterable
from dataclasses import dataclass, field
from datetime import date as Date
from datetime import datetime, timedelta
from pathlib import Path, PurePosixPath
from typing import Any
from urllib.parse import quote

from nishiki.artifacts.artifact import Artifact, is_inside
from nishiki.artifacts.provenance import canonical, stage_program
from nishiki.capture.schema import Session
from nishiki.errors import UserError
from nishiki.formats.files import name_fault

METADATA = "ro-crate-metadata.json"
BIOSCHEMAS = "https://bioschemas.org/profiles/"
PROJECT_LICENCE = "https://spdx.org/licenses/BSD-3-Clause"
FORMATS = {
    ".json": "application/json",
    ".jsonld": "application/ld+json",
    ".xml": "application/xml",
    ".csv": "text/csv",
    ".html": "text/html",
    ".png": "image/png",
    ".jpg": "image/jpeg",
    ".svg": "image/svg+xml",
    ".exr": "image/x-exr",
    ".mp4": "video/mp4",
    ".webp": "image/webp",
    ".npz": "application/zip",
    ".ply": "model/ply",
    ".glb": "model/gltf-binary",
    ".usdz": "model/vnd.usdz+zip",
    ".md": "text/markdown",
    ".txt": "text/plain",
}
Entity = dict[str, Any]


def ids(names: Iterable[str]) -> list[Entity] | Entity:
    """Return references to entities; a single one stands without a list, as in the compact form."""
    references = [{"@id": name} for name in names]
    return references[0] if len(references) == 1 else references


def is_address(text: str | None) -> bool:
    """Test if a text, such as the rights in capture.yaml, is an address on the web and can identify what it says."""
    return bool(text and re.fullmatch(r"https?://[^\s<>\"]+", text))


def quoted(name: str) -> str:
    """Encode a file's name as a valid identifier."""
    return quote(name, safe="/:@!$&'()*+,;=-._~")


def media_type(name: str) -> str:
    """Return the media type for the suffix of a name."""
    return FORMATS.get(PurePosixPath(name).suffix, "application/octet-stream")


MANIFEST = "manifest-sha256.txt"
LINE = re.compile(r"([0-9a-f]{64})  (.+)")


def manifest_text(digests: dict[str, str]) -> str:
    """Write lines 'digest  name', sorted by name. Raises UserError for a name that not every system can have."""
    for name in digests:
        if fault := name_fault(name):
            raise UserError(f"{name!r}: cannot be packed: {fault}. Remedy: give the file another name")
    return "".join(f"{digests[name]}  {name}\n" for name in sorted(digests))


def parse_manifest_text(data: bytes) -> dict[str, str]:
    """Parse digests by name. Raises ValueError for bytes not written by `manifest_text` and names that lead outside."""
    try:
        text = data.decode("utf-8")
    except UnicodeDecodeError as error:
        raise ValueError(f"not UTF-8 ({error.reason})") from None
    digests = {}
    for number, line in enumerate(text.split("\n")[:-1], start=1):
        match = LINE.fullmatch(line)
        if match is None or not is_inside(match[2]) or name_fault(match[2]):
            raise ValueError(f"line {number}: expected 64 hexadecimal digits and a name inside the crate")
        digests[match[2]] = match[1]
    if manifest_text(digests).encode("utf-8") != data:
        raise ValueError("not as it was written: lines are sorted, each name stands once")
    return digests


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


def stage_entities(stage: PackedStage, number: int) -> list[Entity]:
    """List the entities of one stage. number: its place in the flow."""
    name, manifest, program = stage.name, stage.manifest, f"code/{stage_program(stage.stage)}"
    code = "Made by the packed code" if stage.same_code else "Made by other code than the packed"
    return [
        {
            "@id": program,
            "@type": ["File", "SoftwareSourceCode"],
            "name": stage.stage,
            "description": stage.does,
            "encodingFormat": "text/x-python",
            "version": manifest.get("version", ""),
            "license": {"@id": PROJECT_LICENCE},
            "softwareRequirements": ids(_library_id(*item) for item in sorted(manifest["libraries"].items())),
        },
        {
            "@id": f"#step-{name}",
            "@type": "HowToStep",
            "name": name,
            "position": str(number),
            "workExample": {"@id": program},
        },
        {
            "@id": f"#settings-{name}",
            "@type": "PropertyValue",
            "name": f"settings of {name}",
            "value": canonical(manifest["settings"]),
        },
        {
            "@id": f"#run-{name}",
            "@type": "CreateAction",
            "name": f"Run of {name}",
            "description": f"{code}; digest of its code: {manifest.get('code', '')}",
            "instrument": {"@id": program},
            "object": ids([*stage.sources, f"#settings-{name}"]),
            "result": {"@id": stage.folder},
            "startTime": started(stage),
            "endTime": ended(stage),
            "actionStatus": "http://schema.org/CompletedActionStatus",
        },
        {
            "@id": f"#control-{name}",
            "@type": "ControlAction",
            "name": f"Orchestration of {name}",
            "instrument": {"@id": f"#step-{name}"},
            "object": {"@id": f"#run-{name}"},
        },
        *_artifact(stage),
    ]


def started(stage: PackedStage) -> str:
    """Return when a stage began, ISO 8601."""
    end = datetime.fromisoformat(stage.run["finished"])
    return (end - timedelta(seconds=float(stage.run["seconds"]))).isoformat(timespec="seconds")


def ended(stage: PackedStage) -> str:
    """Return when a stage ended, ISO 8601."""
    return datetime.fromisoformat(stage.run["finished"]).isoformat(timespec="seconds")


def _artifact(stage: PackedStage) -> list[Entity]:
    """Describe the folder of an artifact, its files and its Zarr stores; chunks are listed in the manifests."""
    files = {name: (entry["bytes"], entry["sha256"]) for name, entry in stage.manifest["files"].items()} | stage.files
    stores = sorted({match[0] for name in files if (match := re.match(r".*?\.zarr/", name))})
    single = {name: facts for name, facts in files.items() if not name.startswith(tuple(stores))}
    folder: Entity = {
        "@id": stage.folder,
        "@type": "Dataset",
        "name": f"{stage.name} {stage.manifest['key']}",
        "description": stage.does,
        "identifier": f"sha256:{stage.files['artifact.json'][1]}",
        "exampleOfWork": {"@id": f"#parameter-{stage.name}"},
        "hasPart": ids(stage.folder + quoted(name) for name in sorted([*single, *stores])),
    }
    return [
        folder,
        *(_store(stage.folder + quoted(store), store) for store in stores),
        *(
            {
                "@id": stage.folder + quoted(name),
                "@type": "File",
                "name": name,
                "contentSize": str(size),
                "sha256": sha256,
                "encodingFormat": media_type(name),
            }
            for name, (size, sha256) in sorted(single.items())
        ),
    ]


def _store(place: str, name: str) -> Entity:
    return {"@id": place, "@type": "Dataset", "name": name, "description": "Zarr store, version 3"}


def library_entities(stages: list[PackedStage]) -> list[Entity]:
    """Return the libraries that the stages used, each once."""
    used = sorted({item for stage in stages for item in stage.manifest["libraries"].items()})
    return [
        {
            "@id": _library_id(name, version),
            "@type": "SoftwareApplication",
            "name": name,
            "softwareVersion": version,
            "url": f"https://pypi.org/project/{name}/",
        }
        for name, version in used
    ]


def _library_id(name: str, version: str) -> str:
    return f"https://pypi.org/project/{name}/{version}/"


TECHNIQUES = {
    "plane": "photographs of one view under several lamps in turn",
    "turntable": "photographs from several sides, or under several states of a polariser",
    "goniometer": "measurement of reflectance under many directions of light and view",
}
"""How a capture of each geometry is made, in words."""


def capture_method(described: Session) -> dict[str, Any]:
    """Return how a capture was made, from its capture.yaml: `geometry`, `camera`, `pixel_pitch_mm`."""
    scaled = getattr(described, "goniometer", described)
    return {
        "geometry": getattr(described, "geometry", None),
        "camera": described.camera.model,
        "pixel_pitch_mm": getattr(scaled, "pixel_pitch_mm", None),
    }


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

    def said(self, key: str) -> str:
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
