"""Artifacts: what a stage leaves behind, and the contract that lets a reader trust it.

An artifact is a folder `results/<scene>/<stage>/<key>/`. Its `artifact.json` lists every file with its size and SHA-256
beside the settings, the upstream artifacts with their digests, the code digest and the library versions; it is
deterministic, so two runs can be compared byte for byte. Facts of one run (times, memory, host) are in `run.json`.
The folder is written beside its final place and renamed whole, so a reader sees all of it or nothing.
"""

import json
import os
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from nishiki.errors import UserError
from nishiki.provenance import file_digest

FORMAT = 1
MANIFEST = "artifact.json"
RUN = "run.json"


@dataclass(frozen=True)
class Damage:
    """One file of an artifact that is not what the manifest says."""

    path: Path
    kind: str  # damaged | missing | foreign
    detail: str

    def __str__(self) -> str:
        return f"{self.kind}: {self.path} ({self.detail})"


@dataclass(frozen=True)
class Artifact:
    """A finished artifact, opened for reading."""

    folder: Path
    manifest: dict[str, Any]

    @property
    def key(self) -> str:
        """The stage key: the name of the folder."""
        return self.manifest["key"]

    @property
    def stage(self) -> str:
        """Name of the stage that made it."""
        return self.manifest["stage"]

    @property
    def settings(self) -> dict[str, Any]:
        """Settings that the stage read, in canonical form."""
        return self.manifest["settings"]

    @property
    def diagnostics(self) -> dict[str, Any]:
        """What the stage reports of its own result: errors, conditions, counts of flagged pixels."""
        return self.manifest["diagnostics"]

    @property
    def digest(self) -> str:
        """SHA-256 of the manifest, hence of everything in the artifact."""
        return file_digest(self.folder / MANIFEST)

    @property
    def run(self) -> dict[str, Any]:
        """Facts of the run that made it (seconds, peak memory, host); empty where they are lost."""
        path = self.folder / RUN
        return json.loads(path.read_text()) if path.is_file() else {}

    def path(self, name: str) -> Path:
        """Full path of a file of the artifact."""
        return self.folder / name


def open_artifact(folder: Path, *, contents: bool = True) -> Artifact:
    """Open a finished artifact after a check: all listed files are there with their sizes.

    contents: check the SHA-256 of every file too, and of a chunk of a Zarr store its last four bytes: they are the
    checksum that reading it verifies, so that a stage never builds on a flipped bit or on a chunk of another place.
    Raises UserError naming each missing, truncated or damaged file, with the remedy.
    """
    folder = Path(folder)
    if folder.name == MANIFEST:
        folder = folder.parent
    manifest = _read_manifest(folder)
    wrong = [
        f"{name} ({'missing' if size is None else f'{size} bytes'}, expected {entry['bytes']})"
        for name, entry in manifest["files"].items()
        if (size := _size(folder / name)) != entry["bytes"]
    ]
    if contents and not wrong:
        wrong = [
            f"{name} (SHA-256 differs)"
            for name, entry in manifest["files"].items()
            if not _looks_sound(folder / name, entry)
        ]
    if wrong:
        shown = "; ".join(wrong[:5]) + (f"; and {len(wrong) - 5} more" if len(wrong) > 5 else "")
        raise UserError(f"{folder}: files differ from {MANIFEST}: {shown}. Remedy: delete this folder and run again.")
    return Artifact(folder, manifest)


def _read_manifest(folder: Path) -> dict[str, Any]:
    path = folder / MANIFEST
    if not path.is_file():
        raise UserError(f"{folder}: no finished artifact here ({MANIFEST} is missing). Remedy: run the stage again.")
    try:
        manifest = json.loads(path.read_bytes())
    except ValueError as error:
        raise UserError(f"{path}: not valid JSON ({error}). Remedy: delete this folder and run again.") from None
    missing = {"format", "scene", "stage", "key", "settings", "upstream", "files", "diagnostics"} - set(manifest)
    if missing or manifest["format"] != FORMAT:
        raise UserError(f"{path}: not an artifact manifest of format {FORMAT}. Remedy: delete this folder, run again.")
    return manifest


def _is_chunk(name: str) -> bool:
    """Whether a file is a chunk of a Zarr store: all that we write end with a checksum (CRC-32C, or that of zstd)."""
    parts = name.split("/")
    return any(part.endswith(".zarr") for part in parts[:-1]) and parts[-1] != "zarr.json"


def _looks_sound(path: Path, entry: dict[str, Any]) -> bool:
    return _tail(path) == entry["tail"] if "tail" in entry else file_digest(path) == entry["sha256"]


def _tail(path: Path) -> str:
    """The last four bytes of a file, hexadecimal."""
    with open(path, "rb") as handle:
        handle.seek(-4, os.SEEK_END)
        return handle.read(4).hex()


def _size(path: Path) -> int | None:
    return path.stat().st_size if path.is_file() else None


def verify_artifact(folder: Path) -> list[Damage]:
    """Recompute every digest of an artifact; each damaged, missing or foreign file, an empty list if it is sound."""
    folder = Path(folder)
    try:
        manifest = _read_manifest(folder)
    except UserError as error:
        return [Damage(folder / MANIFEST, "missing" if not (folder / MANIFEST).exists() else "damaged", str(error))]
    found = []
    if manifest["key"] != folder.name.split(".")[0]:
        found.append(Damage(folder / MANIFEST, "damaged", f"says key {manifest['key']}, folder is {folder.name}"))
    for name, entry in manifest["files"].items():
        path = folder / name
        size = _size(path)
        if size is None:
            found.append(Damage(path, "missing", f"expected {entry['bytes']} bytes"))
        elif size != entry["bytes"]:
            found.append(Damage(path, "damaged", f"{size} bytes, expected {entry['bytes']}"))
        elif (digest := file_digest(path)) != entry["sha256"]:
            found.append(Damage(path, "damaged", f"sha256 {digest[:12]}…, expected {entry['sha256'][:12]}…"))
    listed = set(manifest["files"]) | {MANIFEST, RUN}
    found += [Damage(path, "foreign", "not in the manifest") for name, path in _files(folder) if name not in listed]
    return found


def _files(folder: Path) -> Iterator[tuple[str, Path]]:
    """Each file below `folder` with its name relative to it, in a fixed order; links count as files."""
    for root, folders, names in os.walk(folder):
        folders.sort()
        for name in sorted(names):
            path = Path(root, name)
            yield path.relative_to(folder).as_posix(), path


class ArtifactWriter:
    """Writes one artifact in a temporary folder beside its final place; `finish` makes it appear whole.

    Left without `finish` (an exception, a kill), nothing appears and an earlier artifact in its place is untouched.
    """

    def __init__(self, target: Path):
        self.target = Path(target)
        self.target.parent.mkdir(parents=True, exist_ok=True)
        self.folder = self.target.parent / f".{self.target.name}.{os.getpid()}.partial"
        _remove_dead_partials(self.target)
        self.folder.mkdir()

    def __enter__(self) -> "ArtifactWriter":
        return self

    def __exit__(self, *_: object) -> None:
        shutil.rmtree(self.folder, ignore_errors=True)

    def path(self, name: str) -> Path:
        """Where to write a file of the artifact."""
        path = self.folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        return path

    def finish(self, manifest: dict[str, Any], run: dict[str, Any]) -> Artifact:
        """List and digest the files, write the manifest last, flush to disk and rename into place.

        An artifact that stands there already (made by older code under the same settings) is kept beside the new one
        as `<key>.superseded-<its digest>`.
        """
        files = {}
        for name, path in _files(self.folder):
            files[name] = {"bytes": path.stat().st_size, "sha256": file_digest(path)}
            if _is_chunk(name) and files[name]["bytes"] >= 4:
                files[name]["tail"] = _tail(path)
        manifest = {"format": FORMAT, **manifest, "files": files}
        (self.folder / RUN).write_text(json.dumps(run, indent=1, sort_keys=True) + "\n")
        text = json.dumps(manifest, indent=1, sort_keys=True, ensure_ascii=False, allow_nan=False) + "\n"
        (self.folder / MANIFEST).write_text(text, encoding="utf-8")
        _flush(self.folder)
        old = _retire(self.target, self.folder)
        os.rename(self.folder, self.target)
        _flush_folder(self.target.parent)
        if old:
            shutil.rmtree(old, ignore_errors=True)
        return Artifact(self.target, manifest)


def _remove_dead_partials(target: Path) -> None:
    """Remove what killed runs of this very artifact left behind; those of living processes stay."""
    for path in target.parent.glob(f".{target.name}.*.partial"):
        owner = path.name.split(".")[-2]
        if not Path("/proc", owner).exists() or owner == str(os.getpid()):
            shutil.rmtree(path, ignore_errors=True)


def _retire(target: Path, successor: Path) -> Path | None:
    """Move what stands at the artifact's place out of the way, whole; its new path where it can go afterwards.

    A finished artifact with another content is kept, under a name that tells its digest; a torn one or an equal can go.
    """
    if not target.exists():
        return None
    manifest = target / MANIFEST
    if manifest.is_file() and file_digest(manifest) != file_digest(successor / MANIFEST):
        aside = target.with_name(f"{target.name}.superseded-{file_digest(manifest)[:8]}")
        if not aside.exists():
            os.rename(target, aside)
            return None
    old = target.with_name(f".{target.name}.old.{os.getpid()}.partial")
    os.rename(target, old)
    return old


def _flush(folder: Path) -> None:
    for _, path in _files(folder):
        with open(path, "rb") as handle:
            os.fsync(handle.fileno())
    for root, _, _ in os.walk(folder):
        _flush_folder(Path(root))


def _flush_folder(folder: Path) -> None:
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
