"""Write and read artifacts, the folders that stages leave behind, and publish links to the present ones.

An artifact is a folder `results/<scene>/<stage>/<key>/`. Its `artifact.json` lists every file with its size and SHA-256
beside the settings, the upstream artifacts with their digests, the code digest and the library versions; it is
deterministic, so two runs can be compared byte for byte. Facts of one run (times, memory, host) are in `run.json`,
which vouches for the manifest and for itself by their digests. The folder is written beside its final place and renamed
whole, so a reader sees all of it or nothing. `nishiki.archive` looks after many artifacts: verifies, prunes, packs.
"""

import hashlib
import json
import os
import shutil
import stat
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from nishiki.artifacts.provenance import canonical, file_digest
from nishiki.errors import UserError
from nishiki.formats.files import flush
from nishiki.processes import host, identity, is_alive, owner, owner_of
from nishiki.threads import in_threads

FORMAT = 1  # of the file; readers refuse others
MANIFEST = "artifact.json"
RUN = "run.json"
FLUSHES = 8  # at once: 1,900 files and folders took 6.3 s one by one, 1.0 s by two, 0.5 s by eight
BESIDE = frozenset(("", ".", ".."))
"""Parts of a name that lead out of a folder, or make two names of one file."""
ENTRIES = {
    "format": int,
    "scene": str,
    "stage": str,
    "key": str,
    "settings": dict,
    "upstream": dict,
    "files": dict,
    "diagnostics": dict,
}
"""Entries of every manifest, with their types."""


@dataclass(frozen=True)
class Artifact:
    """A finished artifact, opened for reading. sha256: of the manifest when it was opened."""

    folder: Path
    manifest: dict[str, Any]
    sha256: str = ""

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
        return self.sha256 or file_digest(self.folder / MANIFEST)

    @property
    def run(self) -> dict[str, Any]:
        """Facts of the run that made it (seconds, peak memory, host); empty where they are lost."""
        path = self.folder / RUN
        return json.loads(path.read_text()) if path.is_file() else {}

    def path(self, name: str) -> Path:
        """Return the full path of a file of the artifact. UserError where the name leads out of it."""
        return self.folder / _expect_inside(name)


def open_artifact(folder: Path, *, contents: bool = True) -> Artifact:
    """Open a finished artifact after a check: all listed files are there with their sizes.

    contents: check the SHA-256 of every file too, and of a chunk of a Zarr store its last four bytes: they are the
    checksum that reading it verifies, so that a stage never builds on a flipped bit or on a chunk of another place.
    Raises UserError naming each missing, truncated or damaged file, with the remedy.
    """
    folder = Path(folder)
    if folder.name == MANIFEST:
        folder = folder.parent
    manifest, digest = _read_manifest(folder)
    place = f"{folder}/"
    wrong = [
        f"{name} ({'missing' if size is None else f'{size} bytes'}, expected {entry['bytes']})"
        for name, entry in manifest["files"].items()
        if (size := _size(place + name)) != entry["bytes"]
    ]
    if contents and not wrong:
        wrong = [
            f"{name} (SHA-256 differs)"
            for name, entry in manifest["files"].items()
            if (
                _tail(folder / name) != entry["tail"]
                if "tail" in entry
                else file_digest(folder / name) != entry["sha256"]
            )
        ]
    if wrong:
        shown = "; ".join(wrong[:5]) + (f"; and {len(wrong) - 5} more" if len(wrong) > 5 else "")
        remedy = "Remedy: ./nishiki verify --set-aside, then run again."
        raise UserError(f"{folder}: files differ from {MANIFEST}: {shown}. {remedy}")
    return Artifact(folder, manifest, digest)


def _read_manifest(folder: Path) -> tuple[dict[str, Any], str]:
    """Read a manifest and its SHA-256. A campaign reads a hundred thousand at its start: paths are texts."""
    path = f"{folder}/{MANIFEST}"
    if not os.path.isfile(path):
        raise UserError(f"{folder}: no finished artifact here ({MANIFEST} is missing). Remedy: run the stage again.")
    data = _bytes_of(path)
    try:
        manifest = parse_manifest(data)
    except ValueError as error:
        raise UserError(f"{path}: {error}. Remedy: delete this folder and run again.") from None
    digest = hashlib.sha256(data).hexdigest()
    run = f"{folder}/{RUN}"
    if os.path.isfile(run) and digest.encode() not in _bytes_of(run):  # looked for, not parsed; see `run_problem`
        problem = f"{MANIFEST} is not the manifest that was written with {RUN}"
        raise UserError(f"{folder}: {problem}. Remedy: delete this folder and run again.")
    return manifest, digest


def _bytes_of(path: str) -> bytes:
    with open(path, "rb", buffering=0) as handle:
        return handle.readall()


def parse_manifest(data: bytes) -> dict[str, Any]:
    """Parse the manifest of an artifact. Raises ValueError with the reason where it is none.

    Every file has a size, a digest and a name inside the folder: whoever follows the names stays in it.
    """
    try:
        manifest = json.loads(data)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"not valid JSON ({error})") from None
    if not isinstance(manifest, dict) or manifest.get("format") != FORMAT:
        raise ValueError(f"not an artifact manifest of format {FORMAT}")
    wrong = [name for name, kind in ENTRIES.items() if not isinstance(manifest.get(name), kind)]
    if wrong:
        raise ValueError(f"not an artifact manifest: {wrong[0]} is missing or of a wrong kind")
    for name, entry in manifest["files"].items():
        if not is_inside(name):
            raise ValueError(f"names a file outside of the artifact: {name!r}")
        if not (isinstance(entry, dict) and isinstance(entry.get("bytes"), int) and is_digest(entry.get("sha256"))):
            raise ValueError(f"no size or no SHA-256 of {name!r}")
    if any(not isinstance(entry, dict) for entry in manifest["upstream"].values()):
        raise ValueError("upstream is not a block of artifacts")
    return manifest


def is_inside(name: str) -> bool:
    """Return whether a relative name with `/` stays inside its folder: no empty part, no `.` or `..`, not absolute."""
    return "\0" not in name and BESIDE.isdisjoint(name.split("/"))


def _expect_inside(name: str) -> str:
    if not is_inside(name):
        raise UserError(
            f"file name {name!r} would leave its artifact. Remedy: rename the light, view or region it comes from"
        )
    return name


def is_digest(text: Any) -> bool:
    """Return whether this is a SHA-256 as 64 lower-case hexadecimal digits."""
    return isinstance(text, str) and len(text) == 64 and not text.strip("0123456789abcdef")


def run_text(run: dict[str, Any], manifest: bytes) -> str:
    """Return the text of run.json: the facts of the run, the manifest's digest, and a digest of both."""
    facts = {**run, "manifest_sha256": hashlib.sha256(manifest).hexdigest()}
    facts["sha256"] = hashlib.sha256(canonical(facts).encode()).hexdigest()
    return json.dumps(facts, indent=1, sort_keys=True) + "\n"


def run_problem(data: bytes, manifest: bytes) -> str | None:
    """Compare run.json with the bytes of a manifest; return the problem, or None where both are intact."""
    try:
        facts = json.loads(data)
        recorded = facts["manifest_sha256"]
        again = run_text({name: value for name, value in facts.items() if name != "sha256"}, manifest).encode()
    except (ValueError, RecursionError, TypeError, KeyError):
        return "damaged: it holds no digest of the manifest"
    if data == again:
        return None
    if recorded != hashlib.sha256(manifest).hexdigest():
        return f"{MANIFEST} or {RUN} is damaged: this is not the manifest that was written with it"
    return "damaged: its own digest is wrong"


def _tail(path: Path) -> str:
    """Return the last four bytes of a file as hexadecimal digits."""
    with open(path, "rb") as handle:
        handle.seek(-4, os.SEEK_END)
        return handle.read(4).hex()


def _size(path: str) -> int | None:
    """Return the bytes of a regular file; None where there is none, or a link in its place."""
    try:
        status = os.lstat(path)
    except OSError:
        return None
    return status.st_size if stat.S_ISREG(status.st_mode) else None


def _files(folder: Path) -> Iterator[tuple[str, Path]]:
    """Yield each file below `folder` with its name relative to it, in a fixed order; links count as files."""
    start = len(str(folder)) + 1
    for root, folders, names in os.walk(folder):
        folders.sort()
        below = Path(root[start:]).as_posix() + "/" if root[start:] else ""
        for name in sorted(names):
            yield below + name, Path(root, name)


class ArtifactWriter(AbstractContextManager["ArtifactWriter"]):
    """Write one artifact in a temporary folder beside its final place; `finish` makes it appear whole.

    Left without `finish` (an exception, a kill), nothing appears and an earlier artifact in its place is untouched.
    """

    def __init__(self, target: Path):
        self.target = Path(target)
        self.target.parent.mkdir(parents=True, exist_ok=True)
        self.folder = self.target.parent / f".{self.target.name}.{owner()}.partial"
        # What killed runs of this very artifact left behind on this machine; those of living processes stay.
        for path in self.target.parent.glob(f".{self.target.name}.*.partial"):
            at, process = owner_of(path.name)
            if at in ("", host()) and (not is_alive(process) or process == identity()):
                shutil.rmtree(path, ignore_errors=True)
        self.folder.mkdir()

    def __exit__(self, *_: object) -> None:
        shutil.rmtree(self.folder, ignore_errors=True)

    def path(self, name: str) -> Path:
        """Return the path to write a file of the artifact to. UserError where its name, maybe from data, leads out."""
        path = self.folder / _expect_inside(name)
        path.parent.mkdir(parents=True, exist_ok=True)
        return path

    def finish(self, manifest: dict[str, Any], run: dict[str, Any], *, inputs: Iterable[Path] = ()) -> Artifact:
        """List and digest the files, write the manifest last, flush to disk and rename into place.

        An artifact that stands there already (made by older code under the same settings) is kept beside the new one
        as `<key>.superseded-<its digest>`.
        """
        files: dict[str, dict[str, Any]] = {}
        listed = list(_files(self.folder))
        digests = in_threads(file_digest, [path for _, path in listed])
        for (name, path), digest in zip(listed, digests, strict=True):
            files[name] = {"bytes": path.stat().st_size, "sha256": digest}
            # all chunks of a Zarr store that we write end with a checksum (CRC-32C, or that of zstd)
            if ".zarr/" in name and not name.endswith("/zarr.json") and files[name]["bytes"] >= 4:
                files[name]["tail"] = _tail(path)
        manifest = {"format": FORMAT, **manifest, "files": files}
        text = json.dumps(manifest, indent=1, sort_keys=True, ensure_ascii=False, allow_nan=False) + "\n"
        data = text.encode("utf-8")
        (self.folder / RUN).write_text(run_text(run, data))
        (self.folder / MANIFEST).write_bytes(data)
        date_not_before(self.folder / MANIFEST, inputs)
        with ThreadPoolExecutor(FLUSHES) as pool:  # many at once: the disk commits together those that wait
            for _ in pool.map(flush, (self.folder, *self.folder.rglob("*"))):
                pass
        old = _retire(self.target, self.folder)
        os.rename(self.folder, self.target)
        flush(self.target.parent)
        if old:
            shutil.rmtree(old, ignore_errors=True)
        return Artifact(self.target, manifest)


def date_not_before(path: Path, inputs: Iterable[Path]) -> None:
    """Date a file no earlier than its inputs.

    Snakemake takes an earlier file for that of a failed job, which happens where the clock was set back.
    """
    newest = max((item.stat().st_mtime_ns for item in inputs), default=0)
    if path.stat().st_mtime_ns < newest:
        os.utime(path, ns=(newest, newest))


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
    old = target.with_name(f".{target.name}.old.{owner()}.partial")
    os.rename(target, old)
    return old


INDEX = "index.json"


def publish(
    current: Path, *, scene: str, stages: dict[str, str], deliverables: Mapping[str, Sequence[str]], code: str = ""
) -> Path:
    """Make `current` hold a link a stage and a link a deliverable, and an index with the artifacts' digests.

    current: results/<scene>/current; stages: names and keys; deliverables: patterns of the files
    to link, by stage; code: digest of the code that publishes. The folder is
    built beside its place and swapped in.
    """
    folder = current.parent
    partial, old = (folder / f".current{what}.{owner()}.partial" for what in ("", ".old"))
    for path in (partial, old):
        shutil.rmtree(path, ignore_errors=True)
    partial.mkdir(parents=True)
    artifacts = {}
    for stage, key in stages.items():
        os.symlink(os.path.join("..", stage, key), partial / stage)
        artifacts[stage] = {"key": key, "digest": file_digest(folder / stage / key / MANIFEST)}
        for pattern in deliverables.get(stage, ()):
            for path in sorted((folder / stage / key).glob(pattern)):
                os.symlink(os.path.join("..", stage, key, path.name), partial / path.name)
    (partial / INDEX).write_text(index_text(scene, artifacts, code))
    date_not_before(partial / INDEX, [folder / stage / key / MANIFEST for stage, key in stages.items()])
    # Moved away whole: killed here, there is no folder, and the next run publishes; never one that lacks links.
    if current.exists() or current.is_symlink():
        os.rename(current, old)
    os.rename(partial, current)
    shutil.rmtree(old, ignore_errors=True)
    return current


def expect_links(results: Path) -> None:
    """Raise UserError where the file system of the results has no symbolic links, which `publish` makes."""
    link = results / f".link.{owner()}.partial"
    try:
        os.symlink(INDEX, link)
    except OSError as error:
        raise UserError(
            f"{results}: the file system has no symbolic links ({error.strerror}), which `current` needs. Remedy: name "
            "a folder on another disk with the key results, or mount the share with links (CIFS: option mfsymlinks)"
        ) from None
    link.unlink()


def index_text(scene: str, artifacts: dict[str, dict[str, str]], code: str = "") -> str:
    """Return the text of the index: key and digest of every stage's artifact, and the digest of the code."""
    values = {"scene": scene, "artifacts": artifacts} | ({"code": code} if code else {})
    return json.dumps(values, indent=1, sort_keys=True) + "\n"
