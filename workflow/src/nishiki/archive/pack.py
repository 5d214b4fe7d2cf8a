"""Pack one scene, with everything that its results were made from, into one folder that can be verified by itself.

Every file is read once, while it is copied; one that is not what its manifest says stops the packing. The same
artifacts give the same bytes: names are sorted, and no time is written that the artifacts do not record. Files of a
folder, or inside a ZIP file, are listed and read without following any link.
"""

import hashlib
import os
import shutil
import stat
import struct
import zipfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from io import FileIO
from pathlib import Path
from typing import IO

from nishiki.archive.crate import LOCK, MANIFEST, manifest_text, metadata
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
    return f"""# {scene.about_value("title") or scene.name}

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


LARGEST_TEXT = 256 * 2**20
"""Bytes of the largest manifest that is read; one of a million files has about 150 MB."""


@dataclass
class FolderContents:
    """Contents of a folder: sizes of regular files, targets of links, other entries, unreadable entries."""

    files: dict[str, int] = field(default_factory=dict)
    links: dict[str, str] = field(default_factory=dict)
    others: dict[str, str] = field(default_factory=dict)
    unreadable: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class FolderTree:
    """Files below a folder. Links are listed, never followed; only the folder itself may be reached through one."""

    root: Path

    def listing(self, below: str = "") -> FolderContents:
        """List everything below a folder of the tree, names relative to that folder, in a fixed order."""
        listing = FolderContents()
        folders = [""]
        start = os.path.join(self.root, below) if below else str(self.root)
        while folders:
            folder = folders.pop()
            try:
                with os.scandir(os.path.join(start, folder) if folder else start) as entries:
                    inner = sorted(entries, key=lambda entry: entry.name)
            except OSError as error:
                listing.unreadable[folder or "."] = str(error.strerror)
                continue
            names = [(f"{folder}/{entry.name}" if folder else entry.name, entry) for entry in inner]
            folders += [name for name, entry in reversed(names) if _sort_in(listing, name, entry)]
        return listing

    def read(self, name: str) -> bytes:
        """Read a small file. Raises OSError; ValueError for one that is larger than LARGEST_TEXT."""
        with _open(os.path.join(self.root, name)) as handle:
            return _read(handle, os.fstat(handle.fileno()).st_size)

    def digest(self, name: str) -> str:
        """Compute the SHA-256 of a file, read in blocks. Raises OSError."""
        with _open(os.path.join(self.root, name)) as handle:
            return hashlib.file_digest(handle, "sha256").hexdigest()


def _sort_in(listing: FolderContents, name: str, entry: os.DirEntry) -> bool:
    """Note one entry of a folder; True where it is a folder to look into."""
    if entry.is_symlink():
        listing.links[name] = os.readlink(entry.path)
    elif entry.is_dir(follow_symlinks=False):
        return True
    elif entry.is_file(follow_symlinks=False):
        listing.files[name] = entry.stat(follow_symlinks=False).st_size
    else:
        listing.others[name] = stat.filemode(entry.stat(follow_symlinks=False).st_mode)
    return False


def _open(path: str) -> FileIO:
    """Open a regular file for reading; a link or a pipe in its place is an OSError."""
    descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise OSError(22, "not a regular file", path)
    return FileIO(descriptor)


def _read(handle: IO[bytes] | FileIO, size: int) -> bytes:
    if size > LARGEST_TEXT:
        raise ValueError(f"{size} bytes, larger than any manifest")
    data = bytearray()
    while block := handle.read(BLOCK):
        data += block
        if len(data) > LARGEST_TEXT:
            raise ValueError("larger than any manifest")
    return bytes(data)


@contextmanager
def _broken_as_oserror(name: str) -> Iterator[None]:
    """Turn the exceptions of a broken ZIP file into the OSError of an unreadable file."""
    try:
        yield
    except (zipfile.BadZipFile, EOFError, NotImplementedError, RuntimeError, struct.error) as error:
        raise OSError(5, str(error), name) from None


class ZipTree:
    """Files inside a ZIP file, read where they are: nothing is unpacked."""

    def __init__(self, root: Path):
        self.root = root
        self.archive = zipfile.ZipFile(root)
        self.members = {}
        self.repeated: list[str] = []
        for member in self.archive.infolist():
            if member.filename in self.members:
                self.repeated.append(member.filename)
            self.members[member.filename] = member

    def listing(self, below: str = "") -> FolderContents:
        """List everything below a folder of the tree, names relative to that folder, in a fixed order."""
        listing = FolderContents()
        prefix = f"{below}/" if below else ""
        for name, member in sorted(self.members.items()):
            if not name.startswith(prefix) or member.is_dir():
                continue
            mode = member.external_attr >> 16
            if stat.S_ISLNK(mode):
                listing.links[name[len(prefix) :]] = "(inside a ZIP file)"
            elif member.compress_type != zipfile.ZIP_STORED or member.flag_bits & 1:
                listing.others[name[len(prefix) :]] = "compressed or encrypted"
            else:
                listing.files[name[len(prefix) :]] = member.file_size
        return listing

    def read(self, name: str) -> bytes:
        """Read a small file. Raises OSError; ValueError for one that is larger than LARGEST_TEXT."""
        member = self._member(name)
        with _broken_as_oserror(name), self.archive.open(member) as handle:
            return _read(handle, member.file_size)

    def digest(self, name: str) -> str:
        """Compute the SHA-256 of a file, read in blocks. Raises OSError."""
        with _broken_as_oserror(name), self.archive.open(self._member(name)) as handle:
            return hashlib.file_digest(handle, "sha256").hexdigest()  # type: ignore[arg-type]  # a ZipExtFile can

    def _member(self, name: str) -> zipfile.ZipInfo:
        member = self.members.get(name)
        if member is None or member.compress_type != zipfile.ZIP_STORED or member.flag_bits & 1:
            raise OSError(2, "no such file stored in the ZIP file", name)
        return member


Tree = FolderTree | ZipTree
"""Files under relative names with `/`."""
