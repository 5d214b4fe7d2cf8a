"""One packed stage in the description of a crate: its script, its step, its settings, its run, what it made."""

import re
from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import Any

from nishiki.archive.crate_entities import PROJECT_LICENCE, Entity, ids, media_type, quoted
from nishiki.artifacts.provenance import canonical, stage_program


@dataclass(frozen=True)
class PackedStage:
    """One artifact as it is packed. manifest: artifact.json; run: facts of its run; same_code: whether the packed code
    made it; does: what the stage does, in words; files: of artifact.json and run.json, bytes and SHA-256."""

    manifest: dict[str, Any]
    run: dict[str, Any]
    same_code: bool
    does: str
    files: dict[str, tuple[int, str]]

    @property
    def stage(self) -> str:
        """Name of the stage."""
        return self.manifest["stage"]

    @property
    def folder(self) -> str:
        """Folder of the artifact inside the crate, with a slash at its end."""
        return f"artifacts/{self.stage}/{self.manifest['key']}/"


def stage_entities(stage: PackedStage, number: int, stages: list[PackedStage]) -> list[Entity]:
    """Everything about one stage. number: its place in the flow; stages: all that are packed, for what it read."""
    name, manifest = stage.stage, stage.manifest
    folders = {other.stage: other.folder for other in stages}
    reads = ["capture/" if above == "capture" else folders[above] for above in manifest["upstream"]]
    code = "Made by the packed code" if stage.same_code else "Made by other code than the packed"
    return [
        {
            "@id": f"code/{stage_program(name)}",
            "@type": ["File", "SoftwareSourceCode"],
            "name": name,
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
            "workExample": {"@id": f"code/{stage_program(name)}"},
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
            "instrument": {"@id": f"code/{stage_program(name)}"},
            "object": ids([*reads, f"#settings-{name}"]),
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
    """When a stage began, ISO 8601."""
    end = datetime.fromisoformat(stage.run["finished"])
    return (end - timedelta(seconds=float(stage.run["seconds"]))).isoformat(timespec="seconds")


def ended(stage: PackedStage) -> str:
    """When a stage ended, ISO 8601."""
    return datetime.fromisoformat(stage.run["finished"]).isoformat(timespec="seconds")


def _artifact(stage: PackedStage) -> list[Entity]:
    """The folder, its files, and its Zarr stores as folders: their chunks are in the manifests."""
    files = {name: (entry["bytes"], entry["sha256"]) for name, entry in stage.manifest["files"].items()} | stage.files
    stores = sorted({match[0] for name in files if (match := re.match(r".*?\.zarr/", name))})
    single = {name: facts for name, facts in files.items() if not name.startswith(tuple(stores))}
    folder: Entity = {
        "@id": stage.folder,
        "@type": "Dataset",
        "name": f"{stage.stage} {stage.manifest['key']}",
        "description": stage.does,
        "identifier": f"sha256:{stage.files['artifact.json'][1]}",
        "exampleOfWork": {"@id": f"#parameter-{stage.stage}"},
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
    """The libraries that the stages say they used, each once."""
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
