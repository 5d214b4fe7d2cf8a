"""The description of a packed scene: JSON-LD after the profile Provenance Run Crate 0.5 of RO-Crate 1.1.

A function of what is packed: the same artifacts give the same bytes. https://www.researchobject.org/workflow-run-crate
"""

import re
from collections.abc import Iterable
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import PurePosixPath
from typing import Any
from urllib.parse import quote

from nishiki.contract.provenance import canonical

METADATA = "ro-crate-metadata.json"
CONTEXT = ["https://w3id.org/ro/crate/1.1/context", "https://w3id.org/ro/terms/workflow-run/context"]
RO_CRATE = "https://w3id.org/ro/crate/1.1"
WORKFLOW = "https://w3id.org/workflowhub/workflow-ro-crate/1.0"
PROFILES = {
    "https://w3id.org/ro/wfrun/process/0.5": ("Process Run Crate", "0.5"),
    "https://w3id.org/ro/wfrun/workflow/0.5": ("Workflow Run Crate", "0.5"),
    "https://w3id.org/ro/wfrun/provenance/0.5": ("Provenance Run Crate", "0.5"),
    WORKFLOW: ("Workflow RO-Crate", "1.0"),
}
BIOSCHEMAS = "https://bioschemas.org/profiles/"
PROJECT_LICENCE = "https://spdx.org/licenses/BSD-3-Clause"
MAIN = "code/Snakefile"
FORMATS = {
    ".json": "application/json",
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
    ".md": "text/markdown",
    ".txt": "text/plain",
}
Entity = dict[str, Any]


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


@dataclass(frozen=True)
class PackedCapture:
    """The capture as it is packed. about: title, creator, date, object_id, rights, notes of capture.yaml."""

    digest: str
    about: dict[str, str | None]
    included: bool
    files: int
    bytes: int


def metadata(scene: str, version: str, capture: PackedCapture, stages: list[PackedStage], others: list[str]) -> Entity:
    """The whole description. stages: in the order of the flow; others: further files of the crate, by name."""
    graph = [
        _descriptor(),
        _root(scene, capture, stages, others),
        *(
            {"@id": name, "@type": "CreativeWork", "name": title, "version": number}
            for name, (title, number) in PROFILES.items()
        ),
        *_people_and_rights(capture),
        *_workflow(version, stages),
        *_capture(capture, stages),
        *(entity for number, stage in enumerate(stages) for entity in _stage(stage, number, stages)),
        *_whole_run(scene, stages),
        *_libraries(stages),
        *(_other(name) for name in others),
    ]
    return {"@context": CONTEXT, "@graph": graph}


def _other(name: str) -> Entity:
    found: Entity = {"@id": name, "@type": "File", "name": name, "encodingFormat": _format(name)}
    if name == "README.md":
        found["about"] = {"@id": "./"}
    return found


def ended(stages: list[PackedStage]) -> str:
    """When the last stage ended, ISO 8601."""
    return max(_ended(stage) for stage in stages)


def _descriptor() -> Entity:
    return {
        "@id": METADATA,
        "@type": "CreativeWork",
        "about": {"@id": "./"},
        "conformsTo": _ids([RO_CRATE, WORKFLOW]),
    }


def _root(scene: str, capture: PackedCapture, stages: list[PackedStage], others: list[str]) -> Entity:
    about = capture.about
    root = {
        "@id": "./",
        "@type": "Dataset",
        "name": about.get("title") or scene,
        "description": f"Scene {scene}: from photographs under controlled light to the appearance of an object. "
        f"{len(stages)} results with everything that they were made from, each under a key that follows from its "
        "settings and from the keys of what it was made from.",
        "datePublished": ended(stages),
        "license": {"@id": _rights_id(about.get("rights"))},
        "conformsTo": _ids(PROFILES),
        "mainEntity": {"@id": MAIN},
        "hasPart": _ids(["capture/", MAIN, "code/", *_scripts(stages), *(stage.folder for stage in stages), *others]),
        "mentions": _ids(["#run", "#engine-run", *(f"#run-{stage.stage}" for stage in stages)]),
    }
    if about.get("creator"):
        root["author"] = {"@id": "#creator"}
    if about.get("object_id"):
        root["about"] = {"@id": "#object"}
    return root


def _people_and_rights(capture: PackedCapture) -> list[Entity]:
    about = capture.about
    rights = about.get("rights")
    found: list[Entity] = [
        {
            "@id": _rights_id(rights),
            "@type": "CreativeWork",
            "name": rights or "No rights are stated",
            "description": "Rights in the photographs and in what was made from them, as capture.yaml states them."
            if rights
            else "capture.yaml states no rights in the photographs; ask their owner.",
        },
        {"@id": PROJECT_LICENCE, "@type": "CreativeWork", "name": "BSD 3-Clause License"},
    ]
    if about.get("creator"):
        found.append({"@id": "#creator", "@type": "Person", "name": about["creator"]})
    if about.get("object_id"):
        title = about.get("title") or about["object_id"]
        found.append({"@id": "#object", "@type": "Thing", "name": title, "identifier": about["object_id"]})
    return found


def _rights_id(rights: str | None) -> str:
    return rights if rights and re.fullmatch(r"https?://[^\s<>\"]+", rights) else "#rights"


def _capture(capture: PackedCapture, stages: list[PackedStage]) -> list[Entity]:
    what = "The sealed capture: a BagIt bag (RFC 8493) with the photographs, lights, cameras and tables."
    without = "The manifest of the sealed capture (BagIt, RFC 8493): names and SHA-256; the files are kept elsewhere."
    about = capture.about
    found: Entity = {
        "@id": "capture/",
        "@type": "Dataset",
        "name": "Capture",
        "description": what if capture.included else without,
        "identifier": f"sha256:{capture.digest}",
        "license": {"@id": _rights_id(about.get("rights"))},
        "exampleOfWork": {"@id": "#parameter-capture"},
    }
    if about.get("date"):
        found["dateCreated"] = about["date"]
    if about.get("creator"):
        found["creator"] = {"@id": "#creator"}
    if about.get("notes"):
        found["disambiguatingDescription"] = about["notes"]
    return [found]


def _workflow(version: str, stages: list[PackedStage]) -> list[Entity]:
    return [
        {
            "@id": MAIN,
            "@type": ["File", "SoftwareSourceCode", "ComputationalWorkflow", "HowTo"],
            "name": "Nishiki",
            "description": "From photographs under controlled light to the appearance of an object",
            "version": version,
            "license": {"@id": PROJECT_LICENCE},
            "conformsTo": {"@id": f"{BIOSCHEMAS}ComputationalWorkflow/1.0-RELEASE"},
            "encodingFormat": "text/plain",
            "programmingLanguage": {"@id": "#snakemake"},
            "hasPart": _ids(_scripts(stages)),
            "step": _ids(f"#step-{stage.stage}" for stage in stages),
            "input": {"@id": "#parameter-capture"},
            "output": _ids(f"#parameter-{stage.stage}" for stage in stages),
        },
        {
            "@id": "#snakemake",
            "@type": "ComputerLanguage",
            "name": "Snakemake",
            "identifier": {"@id": "https://doi.org/10.1093/bioinformatics/bts480"},
            "url": {"@id": "https://snakemake.readthedocs.io"},
        },
        {"@id": "code/", "@type": "Dataset", "name": "The workflow's code, and the lock of all libraries"},
        _parameter("capture", "capture/"),
        *(_parameter(stage.stage, stage.folder) for stage in stages),
    ]


def _parameter(name: str, example: str) -> Entity:
    return {
        "@id": f"#parameter-{name}",
        "@type": "FormalParameter",
        "name": name,
        "additionalType": "Dataset",
        "conformsTo": {"@id": f"{BIOSCHEMAS}FormalParameter/1.0-RELEASE"},
        "workExample": {"@id": example},
    }


def _stage(stage: PackedStage, number: int, stages: list[PackedStage]) -> list[Entity]:
    name, manifest = stage.stage, stage.manifest
    folders = {other.stage: other.folder for other in stages}
    reads = ["capture/" if above == "capture" else folders[above] for above in manifest["upstream"]]
    code = "Made by the packed code" if stage.same_code else "Made by other code than the packed"
    return [
        {
            "@id": f"code/scripts/{name}.py",
            "@type": ["File", "SoftwareSourceCode"],
            "name": name,
            "description": stage.does,
            "encodingFormat": "text/x-python",
            "version": manifest.get("version", ""),
            "license": {"@id": PROJECT_LICENCE},
            "softwareRequirements": _ids(_library_id(*item) for item in sorted(manifest["libraries"].items())),
        },
        {
            "@id": f"#step-{name}",
            "@type": "HowToStep",
            "name": name,
            "position": str(number),
            "workExample": {"@id": f"code/scripts/{name}.py"},
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
            "instrument": {"@id": f"code/scripts/{name}.py"},
            "object": _ids([*reads, f"#settings-{name}"]),
            "result": {"@id": stage.folder},
            "startTime": _started(stage),
            "endTime": _ended(stage),
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


def _started(stage: PackedStage) -> str:
    end = datetime.fromisoformat(stage.run["finished"])
    return (end - timedelta(seconds=float(stage.run["seconds"]))).isoformat(timespec="seconds")


def _ended(stage: PackedStage) -> str:
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
        "hasPart": _ids(stage.folder + _quoted(name) for name in sorted([*single, *stores])),
    }
    return [
        folder,
        *(_store(stage.folder + _quoted(store), store) for store in stores),
        *(
            {
                "@id": stage.folder + _quoted(name),
                "@type": "File",
                "name": name,
                "contentSize": str(size),
                "sha256": sha256,
                "encodingFormat": _format(name),
            }
            for name, (size, sha256) in sorted(single.items())
        ),
    ]


def _store(place: str, name: str) -> Entity:
    return {"@id": place, "@type": "Dataset", "name": name, "description": "Zarr store, version 3"}


def _whole_run(scene: str, stages: list[PackedStage]) -> list[Entity]:
    return [
        {
            "@id": "#run",
            "@type": "CreateAction",
            "name": f"Digitisation of {scene}",
            "description": "All stages of the scene. They may have run in several sessions.",
            "instrument": {"@id": MAIN},
            "object": {"@id": "capture/"},
            "result": _ids(stage.folder for stage in stages),
            "startTime": min(_started(stage) for stage in stages),
            "endTime": ended(stages),
            "actionStatus": "http://schema.org/CompletedActionStatus",
        },
        {
            "@id": "#engine-run",
            "@type": "OrganizeAction",
            "name": "Run of Snakemake",
            "instrument": {"@id": "https://snakemake.github.io"},
            "object": _ids(f"#control-{stage.stage}" for stage in stages),
            "result": {"@id": "#run"},
        },
        {
            "@id": "https://snakemake.github.io",
            "@type": "SoftwareApplication",
            "name": "Snakemake",
            "url": "https://snakemake.github.io",
            "softwareVersion": "the version in code/uv.lock",
        },
    ]


def _libraries(stages: list[PackedStage]) -> list[Entity]:
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


def _scripts(stages: list[PackedStage]) -> list[str]:
    return [f"code/scripts/{stage.stage}.py" for stage in stages]


def _ids(names: Iterable[str]) -> list[Entity] | Entity:
    """References to entities; to a single one without a list, as the compact form has it."""
    found = [{"@id": name} for name in names]
    return found[0] if len(found) == 1 else found


def _quoted(name: str) -> str:
    return quote(name, safe="/:@!$&'()*+,;=-._~")


def _format(name: str) -> str:
    return FORMATS.get(PurePosixPath(name).suffix, "application/octet-stream")
