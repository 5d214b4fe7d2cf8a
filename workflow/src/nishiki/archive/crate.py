"""Describe a packed scene in JSON-LD after the profile Provenance Run Crate 0.5 of RO-Crate 1.1, and its manifest.

A function of what is packed: the same artifacts give the same bytes. https://www.researchobject.org/workflow-run-crate
"""

import re
from pathlib import PurePosixPath
from typing import Any
from urllib.parse import quote

from nishiki.artifacts.artifact import is_inside
from nishiki.artifacts.packed import METADATA, Entity, PackedScene, PackedStage, end_time, ids, is_address, start_time
from nishiki.artifacts.provenance import canonical, stage_program
from nishiki.capture.schema import OBJECT_FACTS, Session
from nishiki.errors import UserError
from nishiki.formats.files import name_fault
from nishiki.optional_formats.museums import RECORDS

BIOSCHEMAS = "https://bioschemas.org/profiles/"
PROJECT_LICENCE = "https://spdx.org/licenses/BSD-3-Clause"
FORMATS = {
    ".json": "application/json", ".jsonld": "application/ld+json", ".xml": "application/xml", ".csv": "text/csv",
    ".html": "text/html", ".png": "image/png", ".jpg": "image/jpeg", ".svg": "image/svg+xml", ".exr": "image/x-exr",
    ".mp4": "video/mp4", ".webp": "image/webp", ".npz": "application/zip", ".ply": "model/ply",
    ".glb": "model/gltf-binary", ".usdz": "model/vnd.usdz+zip", ".md": "text/markdown", ".txt": "text/plain",
}  # fmt: skip
CONTEXT = ["https://w3id.org/ro/crate/1.1/context", "https://w3id.org/ro/terms/workflow-run/context"]
RO_CRATE = "https://w3id.org/ro/crate/1.1"
WORKFLOW = "https://w3id.org/workflowhub/workflow-ro-crate/1.0"
PROFILES = {
    "https://w3id.org/ro/wfrun/process/0.5": ("Process Run Crate", "0.5"),
    "https://w3id.org/ro/wfrun/workflow/0.5": ("Workflow Run Crate", "0.5"),
    "https://w3id.org/ro/wfrun/provenance/0.5": ("Provenance Run Crate", "0.5"),
    WORKFLOW: ("Workflow RO-Crate", "1.0"),
}
MAIN, LOCK = "code/Snakefile", "code/uv.lock"


def quote_name(name: str) -> str:
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


def capture_method(described: Session) -> dict[str, Any]:
    """Return how a capture was made, from its capture.yaml: `geometry`, `camera`, `pixel_pitch_mm`."""
    scaled = getattr(described, "goniometer", described)
    return {
        "geometry": getattr(described, "geometry", None),
        "camera": described.camera.model,
        "pixel_pitch_mm": getattr(scaled, "pixel_pitch_mm", None),
    }


def metadata(scene: PackedScene, others: list[str]) -> Entity:
    """Build the whole description; others: names of further files of the crate."""
    stages = scene.stages
    profiles = ids([RO_CRATE, WORKFLOW])
    graph = [
        {"@id": METADATA, "@type": "CreativeWork", "about": {"@id": "./"}, "conformsTo": profiles},
        _root(scene, others),
        *(
            {"@id": name, "@type": "CreativeWork", "name": title, "version": number}
            for name, (title, number) in PROFILES.items()
        ),
        *_people_and_rights(scene),
        *_workflow(scene, locked=LOCK in others),
        _capture(scene),
        *(entity for number, stage in enumerate(stages) for entity in stage_entities(stage, number)),
        *_workflow_run(scene, locked=LOCK in others),
        *library_entities(stages),
        *(_other(name) for name in others),
    ]
    return {"@context": CONTEXT, "@graph": list({entity["@id"]: entity for entity in graph}.values())}


def _other(name: str) -> Entity:
    entity: Entity = {"@id": name, "@type": "File", "name": name, "encodingFormat": media_type(name)}
    if name in RECORDS:
        entity["description"] = f"Object and digitisation in the words of museums: {RECORDS[name].standard}"
    if name in ("README.md", *RECORDS):
        entity["about"] = {"@id": "./"}
    return entity


def last_end(stages: list[PackedStage]) -> str:
    """Return when the last stage ended, ISO 8601."""
    return max(end_time(stage) for stage in stages)


def _root(scene: PackedScene, others: list[str]) -> Entity:
    stages = scene.stages
    root = {
        "@id": "./",
        "@type": "Dataset",
        "name": scene.about_value("title") or scene.name,
        "description": f"Scene {scene.name}: from photographs under controlled light to the appearance of an object. "
        f"{len(stages)} results with everything that they were made from, each under a key that follows from its "
        "settings and from the keys of what it was made from.",
        "datePublished": last_end(stages),
        "license": {"@id": _rights_id(scene.about_value("rights"))},
        "conformsTo": ids(PROFILES),
        "mainEntity": {"@id": MAIN},
        "hasPart": ids(["capture/", MAIN, "code/", *_scripts(stages), *(stage.folder for stage in stages), *others]),
        "mentions": ids(["#run", "#engine-run", *(f"#run-{stage.name}" for stage in stages)]),
    }
    if scene.about_value("creator"):
        root["author"] = {"@id": "#creator"}
    if _says_of_object(scene):
        root["about"] = {"@id": "#object"}
    return root


def _people_and_rights(scene: PackedScene) -> list[Entity]:
    rights = scene.about_value("rights")
    entities: list[Entity] = [
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
    if scene.about_value("creator"):
        entities.append({"@id": "#creator", "@type": "Person", "name": scene.about_value("creator")})
    if _says_of_object(scene):
        entities.append(_object(scene))
    return entities


def _says_of_object(scene: PackedScene) -> bool:
    return any(scene.about_value(key) for key in ("object_id", *OBJECT_FACTS))


def _object(scene: PackedScene) -> Entity:
    """Describe the object; properties that schema.org has for works of art alone are given in words."""
    entity: Entity = {"@id": "#object", "@type": "Thing"}
    entity["name"] = scene.about_value("title") or scene.about_value("object_id") or "Object"
    if scene.about_value("object_id"):
        entity["identifier"] = scene.about_value("object_id")
    facts = [f"{label}: {scene.about_value(key)}" for key, label in OBJECT_FACTS.items() if scene.about_value(key)]
    if facts:
        entity["description"] = ". ".join(facts)
    return entity


def _rights_id(rights: str) -> str:
    return rights if is_address(rights) else "#rights"


def _capture(scene: PackedScene) -> Entity:
    what = "The sealed capture: a BagIt bag (RFC 8493) with the photographs, lights, cameras and tables."
    without = "The manifest of the sealed capture (BagIt, RFC 8493): names and SHA-256; the files are kept elsewhere."
    entity: Entity = {
        "@id": "capture/",
        "@type": "Dataset",
        "name": "Capture",
        "description": what if scene.with_capture else without,
        "identifier": f"sha256:{scene.digest}",
        "license": {"@id": _rights_id(scene.about_value("rights"))},
        "exampleOfWork": {"@id": "#parameter-capture"},
    }
    if scene.about_value("date"):
        entity["dateCreated"] = scene.about_value("date")
    if scene.about_value("creator"):
        entity["creator"] = {"@id": "#creator"}
    if scene.about_value("notes"):
        entity["disambiguatingDescription"] = scene.about_value("notes")
    return entity


def _workflow(scene: PackedScene, *, locked: bool) -> list[Entity]:
    stages = scene.stages
    code = "The workflow's code" + (", and the lock of all libraries" if locked else "")
    return [
        {
            "@id": MAIN,
            "@type": ["File", "SoftwareSourceCode", "ComputationalWorkflow", "HowTo"],
            "name": "Nishiki",
            "description": "From photographs under controlled light to the appearance of an object",
            "version": scene.version,
            "license": {"@id": PROJECT_LICENCE},
            "conformsTo": {"@id": f"{BIOSCHEMAS}ComputationalWorkflow/1.0-RELEASE"},
            "encodingFormat": "text/plain",
            "programmingLanguage": {"@id": "#snakemake"},
            "hasPart": ids(_scripts(stages)),
            "step": ids(f"#step-{stage.name}" for stage in stages),
            "input": {"@id": "#parameter-capture"},
            "output": ids(f"#parameter-{stage.name}" for stage in stages),
        },
        {
            "@id": "#snakemake",
            "@type": "ComputerLanguage",
            "name": "Snakemake",
            "identifier": {"@id": "https://doi.org/10.1093/bioinformatics/bts480"},
            "url": {"@id": "https://snakemake.readthedocs.io"},
        },
        {"@id": "code/", "@type": "Dataset", "name": code},
        _parameter("capture", "capture/"),
        *(_parameter(stage.name, stage.folder) for stage in stages),
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


def _workflow_run(scene: PackedScene, *, locked: bool) -> list[Entity]:
    stages = scene.stages
    engine = {"softwareVersion": f"the version in {LOCK}"} if locked else {}  # an installation has no lock
    return [
        {
            "@id": "#run",
            "@type": "CreateAction",
            "name": f"Digitisation of {scene.name}",
            "description": "All stages of the scene. They may have run in several sessions.",
            "instrument": {"@id": MAIN},
            "object": {"@id": "capture/"},
            "result": ids(stage.folder for stage in stages),
            "startTime": min(start_time(stage) for stage in stages),
            "endTime": last_end(stages),
            "actionStatus": "http://schema.org/CompletedActionStatus",
        },
        {
            "@id": "#engine-run",
            "@type": "OrganizeAction",
            "name": "Run of Snakemake",
            "instrument": {"@id": "https://snakemake.github.io"},
            "object": ids(f"#control-{stage.name}" for stage in stages),
            "result": {"@id": "#run"},
        },
        {
            "@id": "https://snakemake.github.io",
            "@type": "SoftwareApplication",
            "name": "Snakemake",
            "url": "https://snakemake.github.io",
            **engine,
        },
    ]


def _scripts(stages: list[PackedStage]) -> list[str]:
    return list(dict.fromkeys(f"code/{stage_program(stage.stage)}" for stage in stages))


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
            "startTime": start_time(stage),
            "endTime": end_time(stage),
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
        "hasPart": ids(stage.folder + quote_name(name) for name in sorted([*single, *stores])),
    }
    return [
        folder,
        *(_store(stage.folder + quote_name(store), store) for store in stores),
        *(
            {
                "@id": stage.folder + quote_name(name),
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
