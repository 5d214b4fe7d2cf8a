"""Pack one scene, with everything that its results were made from, into one folder that can be verified by itself.

Every file is read once, while it is copied; one that is not what its manifest says stops the packing. The same
artifacts give the same bytes: names are sorted, and no time is written that the artifacts do not record.
"""

import hashlib
import os
import shutil
import zipfile
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

from nishiki.archive.crate import LOCK, MANIFEST, manifest_text, metadata
from nishiki.archive.tree import FolderTree
from nishiki.artifacts.artifact import MANIFEST as ARTIFACT
from nishiki.artifacts.artifact import RUN, Artifact
from nishiki.artifacts.packed import METADATA, PackedScene, PackedStage, json_text
from nishiki.errors import UserError
from nishiki.installation import CARRIED, PACKAGES, SOURCE
from nishiki.optional_formats.museums import IN_WORDS, RECORDS

CODE = ("Snakefile", "LICENSE", "pyproject.toml", "uv.lock", "workflow", "scripts", "envs")
"""Files of the project that are packed: the program, and the lock of its libraries."""
CODE_SUFFIXES = {"", *".py .smk .yaml .txt .toml .lock .csv .npz .json .j2 .css .sh .md".split()}
BLOCK = 2**20
ZIP_DATE = (1980, 1, 1, 0, 0, 0)
Tell = Callable[[int, int, str], None]


@dataclass
class Crate:
    """A folder that is being filled: digest and size of every file written, by its name."""

    root: Path
    files: dict[str, tuple[int, str]] = field(default_factory=dict)

    def copy(self, source: Path, name: str, sha256: str = "") -> None:
        """Copy a file; UserError where its content has not the digest that it should have."""
        target = self._place(name)
        digest, size = hashlib.sha256(), 0
        descriptor = os.open(source, os.O_RDONLY | os.O_NOFOLLOW | os.O_CLOEXEC)
        with os.fdopen(descriptor, "rb") as reader, open(target, "wb") as writer:
            while block := reader.read(BLOCK):
                digest.update(block)
                writer.write(block)
                size += len(block)
        if sha256 and digest.hexdigest() != sha256:
            raise UserError(f"{source}: content differs from its record. Remedy: ./nishiki verify lists all damage")
        self.files[name] = (size, digest.hexdigest())

    def write(self, name: str, text: str) -> None:
        """Write a file of text."""
        data = text.encode("utf-8")
        self._place(name).write_bytes(data)
        self.files[name] = (len(data), hashlib.sha256(data).hexdigest())

    def _place(self, name: str) -> Path:
        target = self.root / name
        target.parent.mkdir(parents=True, exist_ok=True)
        return target


def pack(scene: PackedScene, project: Path, target: Path, *, tell: Tell) -> str:
    """Write the crate of a scene to a new folder and return the digest that names all of it.

    project: folder of the workflow's code. Raises UserError where the target exists, or an artifact or the capture is
    damaged. Built beside its place and renamed whole.
    """
    if os.path.lexists(target):
        raise UserError(f"{target} exists already. Remedy: give another --output, or remove it")
    partial = target.with_name(f".{target.name}.{os.getpid()}.partial")
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True)
    try:
        crate = Crate(partial)
        stages = []
        for number, item in enumerate(scene.artifacts):
            tell(number, len(scene.artifacts), f"copying {item.stage}")
            stages.append(_copy_artifact(crate, scene, item, project))
        scene = replace(scene, stages=stages)
        _copy_capture(crate, scene, tell)
        _copy_code(crate, project)
        crate.write("scene.json", json_text({"scene": scene.name, **scene.facts}))
        crate.write("README.md", _readme(scene))
        try:
            for name, record in RECORDS.items():
                crate.write(name, record.text(scene))
        except ValueError as error:
            raise UserError(f"{scene.capture}: {error}. Remedy: remove control characters from capture.yaml") from None
        others = ["README.md", "scene.json", *RECORDS, MANIFEST]
        others += [name for name in ("code/LICENSE", LOCK) if name in crate.files]
        crate.write(METADATA, json_text(metadata(scene, others)))
        text = manifest_text({name: sha256 for name, (_, sha256) in crate.files.items()})
        crate.write(MANIFEST, text)
        os.rename(partial, target)
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    return crate.files[MANIFEST][1]


def _copy_artifact(crate: Crate, scene: PackedScene, item: Artifact, project: Path) -> PackedStage:
    from nishiki.artifacts.provenance import code_digest, name_above, program_of, stage_program

    name_of_stage = name_above(scene.name, item.manifest)
    folder = f"artifacts/{name_of_stage}/{item.key}"
    for name, entry in sorted(item.manifest["files"].items()):
        crate.copy(item.path(name), f"{folder}/{name}", entry["sha256"])
    for name in (ARTIFACT, RUN):
        crate.copy(item.path(name), f"{folder}/{name}")
    run = item.run
    if not {"finished", "seconds"} <= set(run):
        raise UserError(f"{item.path(RUN)}: has no time of the run. Remedy: ./nishiki verify --set-aside, run again")
    script = project / stage_program(item.stage)
    script = script if script.is_file() else program_of(item.stage)  # of an installed package
    same = script.is_file() and code_digest(script) == item.manifest.get("code")
    files = {name: crate.files[f"{folder}/{name}"] for name in (ARTIFACT, RUN)}
    return PackedStage(item.manifest, run, same, scene.does.get(item.stage, item.stage), files, name_of_stage)


def _copy_capture(crate: Crate, scene: PackedScene, tell: Tell) -> None:
    from nishiki.capture.mosaic import TABLE, is_mosaic, read_fields
    from nishiki.capture.seal import MANIFEST as SEAL
    from nishiki.capture.seal import TAG_MANIFEST, TAGS, read_manifest

    bags = {scene.capture: "capture"}
    if is_mosaic(scene.capture):
        crate.copy(scene.capture / TABLE, f"capture/{TABLE}")
        bags = {field.path: f"capture/{field.place}" for field in read_fields(scene.capture)}
    listed = {}
    for bag, place in bags.items():
        for name in (*TAGS, TAG_MANIFEST):
            if (bag / name).is_file():
                crate.copy(bag / name, f"{place}/{name}")
        listed |= {f"{place}/{name}": (bag / name, sha256) for name, sha256 in read_manifest(bag / SEAL).items()}
    total = 0
    for number, (name, (path, sha256)) in enumerate(sorted(listed.items()) if scene.with_capture else ()):
        tell(number, len(listed), f"copying the capture, {total / 1e9:.2f} GB")
        crate.copy(path, name, sha256)
        total += crate.files[name][0]


def _copy_code(crate: Crate, project: Path) -> None:
    places = {name: project / name for name in CODE}
    if project == CARRIED:  # an installation has its packages elsewhere
        places |= {f"workflow/src/{name}": SOURCE / name for name in PACKAGES}
    for name, path in places.items():
        if not path.exists():  # a copy of the project need not have its lock or its licence
            continue
        inner = FolderTree(path).listing().files if path.is_dir() else {"": 0}
        for file in sorted(inner):
            parts = file.split("/")
            carried = path / parts[0] == CARRIED
            if carried or any(part.startswith((".", "__pycache__")) for part in parts if part):
                continue
            if os.path.splitext(file)[1] in CODE_SUFFIXES:
                crate.copy(path / file if file else path, f"code/{name}/{file}" if file else f"code/{name}")


def _readme(scene: PackedScene) -> str:
    """Write the page for people who find the folder and have no tool of this project."""
    photographs = (
        "`capture/` holds the photographs, sealed as a BagIt bag."
        if scene.with_capture
        else "`capture/` holds the manifest of the photographs, which are kept elsewhere: their names and SHA-256."
    )
    rows = "\n".join(f"| `{stage.folder}` | {stage.does} |" for stage in scene.stages)
    return f"""# {scene.said("title") or scene.name}

One digitised scene with everything that it was made from, as a Workflow Run RO-Crate (`{METADATA}` describes it).

{photographs} `code/` holds the workflow, `scene.json` what was asked for. Every folder below `artifacts/` is one
result; its `artifact.json` names its files with their SHA-256, its settings, and the results that it was made from.

| folder | what |
|---|---|
{rows}

Is everything still what it was? `sha256sum --check {MANIFEST}` compares the files; `./nishiki verify FOLDER` of the
workflow also follows the way from the photographs to every result, and computes every key again.

{IN_WORDS}"""


def write_zip(folder: Path, target: Path) -> None:
    """Write a folder as a ZIP file: stored, in the order of the names, all with one date, atomically."""
    if os.path.lexists(target):
        raise UserError(f"{target} exists already. Remedy: give another --output, or remove it")
    partial = target.with_name(f".{target.name}.{os.getpid()}.partial")
    try:
        with zipfile.ZipFile(partial, "w", zipfile.ZIP_STORED) as archive:
            for name in sorted(FolderTree(folder).listing().files):
                entry = zipfile.ZipInfo(name, ZIP_DATE)
                entry.create_system, entry.external_attr = 3, 0o100644 << 16
                with open(folder / name, "rb") as reader, archive.open(entry, "w", force_zip64=True) as writer:
                    shutil.copyfileobj(reader, writer, BLOCK)
        os.rename(partial, target)
    finally:
        partial.unlink(missing_ok=True)
