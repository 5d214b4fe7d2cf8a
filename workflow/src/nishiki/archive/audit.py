"""Compare artifacts with their contract by names, sizes, manifests and contents, and name each kind of damage.

An audit covers the files of many artifacts, the references between them, and the links that publish them.
"""

import hashlib
import json
import os
import re
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from nishiki.archive.pack import FolderContents, FolderTree, Tree
from nishiki.artifacts.artifact import INDEX, MANIFEST, RUN, index_text, is_digest, parse_manifest, run_problem
from nishiki.artifacts.packed import METADATA
from nishiki.artifacts.provenance import UPSTREAM, file_digest, place_above, stage_key
from nishiki.engine.project import SWEEPS
from nishiki.errors import printable
from nishiki.threads import in_threads

KINDS = {
    "damaged": "the content is not what was written",
    "missing": "a file, or an artifact that another was made from, is not there",
    "foreign": "a file that nobody listed, or that is no regular file",
    "link": "a symbolic link where there may be none, or one that leads out of its scene",
    "unreadable": "the system does not let it be read",
    "wrong-key": "the name is not what settings and upstream artifacts give",
    "misplaced": "an artifact in the folder of another stage or scene",
    "stale": "made from another version of an upstream artifact than the present one",
    "incomplete": "a packed scene lacks a part of the way from the photographs to the result",
}


@dataclass(frozen=True)
class Damage:
    """One damage that an audit found. artifact: folder of the artifact that is no longer sound, if any is."""

    path: Path
    kind: str
    detail: str
    artifact: Path | None = None

    def __str__(self) -> str:
        return printable(f"{self.kind}: {self.path} ({self.detail})")


CAPTURE = "capture"
KEY = re.compile(r"[0-9a-f]{12}")


@dataclass
class Survey:
    """Facts of one artifact from its names, sizes and manifest, before its files are read."""

    tree: Tree
    below: str
    damages: list[Damage] = field(default_factory=list)
    digest: str = ""  # SHA-256 of its manifest
    scene: str = ""
    stage: str = ""
    key: str = ""
    # stage -> (key, digest of the manifest), for the first stage "capture" -> ("", digest)
    upstream: dict[str, tuple[str, str]] = field(default_factory=dict)
    # files in the right number of bytes, with the digests that they should have
    to_read: list[tuple[str, str]] = field(default_factory=list)
    files: int = 0
    bytes: int = 0

    @property
    def folder(self) -> Path:
        """Where the artifact lies."""
        return self.tree.root / self.below if self.below else self.tree.root

    def add(self, name: str, kind: str, detail: str) -> None:
        """Note one damage."""
        self.damages.append(Damage(self.folder / name, kind, detail, self.folder))

    def member_name(self, name: str) -> str:
        """Name of a file of the artifact inside the tree."""
        return f"{self.below}/{name}" if self.below else name


def survey_artifact(tree: Tree, below: str = "", *, name: str | None = None) -> Survey:
    """Survey of the artifact in a folder of a tree; `name`: of that folder, where the tree does not know it."""
    survey = Survey(tree, below)
    listing = tree.listing(below)
    for kind, things in (("unreadable", listing.unreadable), ("foreign", listing.others)):
        for file, detail in things.items():
            survey.add(file, kind, detail)
    for link, target in listing.links.items():
        survey.add(link, "link", f"an artifact holds files, not links; to {target}")
    manifest = _manifest(survey, listing)
    if manifest is None:
        return survey
    _check_names(survey, manifest, name or survey.folder.name)
    _check_files(survey, manifest, listing)
    # names of upstream artifacts are checked, as they become paths
    for stage, entry in manifest["upstream"].items():
        key, digest = entry.get("key", ""), entry.get("digest")
        named = key == "" if stage == CAPTURE else UPSTREAM.fullmatch(stage) and KEY.fullmatch(str(key))
        if named and is_digest(digest):
            survey.upstream[stage] = (key, digest)
        else:
            survey.add(MANIFEST, "damaged", f"does not name an upstream artifact: {stage} {key}")
    if not manifest["upstream"]:
        survey.add(MANIFEST, "damaged", "names neither a capture nor an upstream artifact")
    return survey


def _manifest(survey: Survey, listing: FolderContents) -> dict[str, Any] | None:
    missing = "no finished artifact here; run the stage again"
    read = _read(survey, listing, MANIFEST, missing, lambda data: (data, parse_manifest(data)))
    if read is None:
        return None
    data, manifest = read
    survey.digest = hashlib.sha256(data).hexdigest()
    missing = "facts of the run, and the digest of the manifest"
    if wrong := _read(survey, listing, RUN, missing, lambda run: run_problem(run, data)):
        survey.add(RUN, "damaged", wrong)
    return manifest


def _read(survey: Survey, listing: FolderContents, name: str, missing: str, parse: Callable[[bytes], Any]) -> Any:
    """Parse a file of an artifact; None, with the damage noted, where that cannot be done."""
    try:
        if name in listing.files:
            return parse(survey.tree.read(survey.member_name(name)))
        if name not in listing.links:
            survey.add(name, "missing", missing)
    except OSError as error:
        survey.add(name, "unreadable", str(error.strerror))
    except ValueError as error:
        survey.add(name, "damaged", str(error))
    return None


def _check_names(survey: Survey, manifest: dict[str, Any], name: str) -> None:
    """Check the folder's name, and the key against stage, format version, settings and upstream keys."""
    survey.scene, survey.stage, survey.key = manifest["scene"], manifest["stage"], manifest["key"]
    if survey.key != name.split(".")[0]:
        survey.add(MANIFEST, "wrong-key", f"says key {survey.key}, folder is {name}")
    expected = name.partition(".superseded-")[2]
    if expected and not survey.digest.startswith(expected):
        survey.add(MANIFEST, "wrong-key", f"folder is {name}, digest is {survey.digest[:8]}")
    try:
        reads = {stage: entry["digest" if stage == CAPTURE else "key"] for stage, entry in manifest["upstream"].items()}
        key = stage_key(survey.stage, manifest["format_version"], manifest["settings"], reads)
    except (KeyError, TypeError, ValueError, RecursionError) as error:
        survey.add(MANIFEST, "wrong-key", f"no key follows from it ({type(error).__name__}: {error})")
        return
    if key != survey.key:
        survey.add(MANIFEST, "wrong-key", f"says key {survey.key}; its settings and upstream artifacts give {key}")


def _check_files(survey: Survey, manifest: dict[str, Any], listing: FolderContents) -> None:
    files = manifest["files"]
    for name, entry in files.items():
        size = listing.files.get(name)
        if size is None:
            if name not in listing.links:
                survey.add(name, "missing", f"expected {entry['bytes']} bytes")
            continue
        if size != entry["bytes"]:
            survey.add(name, "damaged", f"{size} bytes, expected {entry['bytes']} bytes")
            continue
        survey.to_read.append((name, entry["sha256"]))
    for name in listing.files:
        if name not in files and name not in (MANIFEST, RUN):
            survey.add(name, "foreign", "not in the manifest")
    survey.files, survey.bytes = len(files), sum(entry["bytes"] for entry in files.values())


def read_file(survey: Survey, name: str, sha256: str) -> list[Damage]:
    """Digest a file of an artifact, and return what is not as listed."""
    try:
        digest = survey.tree.digest(survey.member_name(name))
    except OSError as error:
        return [Damage(survey.folder / name, "unreadable", str(error.strerror), survey.folder)]
    if digest == sha256:
        return []
    detail = f"sha256 {digest[:12]}…, expected {sha256[:12]}…"
    return [Damage(survey.folder / name, "damaged", detail, survey.folder)]


class References:
    """Place, digest and upstream artifacts of every audited artifact; about a kilobyte each."""

    def __init__(self) -> None:
        self.digests: dict[Path, str] = {}
        self._upstream: dict[Path, dict[str, tuple[str, str]]] = {}
        self._stamps: dict[Path, tuple[str, str]] = {}

    def add(self, survey: Survey) -> None:
        """Note an artifact; one without a readable manifest is no reference."""
        if survey.digest and survey.stage:
            self.digests[survey.folder] = survey.digest
            self._upstream[survey.folder] = survey.upstream
            self._stamps[survey.folder] = (survey.scene, survey.stage)

    def digest(self, folder: Path) -> str | None:
        """Return the digest of an artifact's manifest, audited or not; None where there is none."""
        if folder not in self.digests:
            path = folder / MANIFEST
            if folder.is_symlink() or path.is_symlink() or not path.is_file():
                return None
            return file_digest(path)
        return self.digests[folder]

    def problems(self) -> Iterator[Damage]:
        """Yield artifacts in a wrong place, and upstream artifacts that are lost or have another content."""
        from nishiki.stages.table import CHAIN

        for folder, (scene, stage) in self._stamps.items():
            if stage != folder.parent.name and folder.parent.name in CHAIN:
                yield Damage(folder, "misplaced", f"made by stage {stage}, lies in {folder.parent.name}", folder)
            elif (folder.parents[1] / "current").is_dir() and scene != folder.parents[1].name:
                yield Damage(folder, "misplaced", f"of scene {scene}, lies in {folder.parents[1].name}", folder)
            if "." not in folder.name:
                yield from self._lost(folder)

    def _lost(self, folder: Path) -> Iterator[Damage]:
        for stage, (key, digest) in self._upstream[folder].items():
            if stage == CAPTURE:
                continue
            upstream = folder.parents[2].joinpath(*place_above(folder.parents[1].name, stage), key)
            present = self.digest(upstream)
            if present is None:
                yield Damage(upstream, "missing", f"{folder} was made from it; run again")
            elif present != digest:
                yield Damage(folder, "stale", f"made from another version of {upstream}; run again", folder)


def check_publication(folder: Path, references: "References") -> list[Damage]:
    """List every damage of a folder of published links. references: digests of the artifacts that it may link to."""
    damages = [damage for name in sorted(os.listdir(folder)) if (damage := _check_link(folder / name))]
    index = folder / INDEX
    try:
        data = index.read_bytes() if not index.is_symlink() else b""
        described = json.loads(data)
        artifacts: dict[str, Any] = dict(described["artifacts"])
        keys = {str(stage): str(entry["key"]) for stage, entry in artifacts.items()}
        again = index_text(described["scene"], artifacts, described.get("code", ""))
        sound = again.encode() == data and described["scene"] == folder.parent.name
    except FileNotFoundError:
        return [*damages, Damage(index, "missing", "the folder is incomplete; delete it and run again")]
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
        sound, artifacts, keys = False, {}, {}
    if not sound:
        damages.append(Damage(index, "damaged", "not as it was written; delete the folder and run again"))
    for stage, key in keys.items():
        damages += _check_stage(folder, stage, key, artifacts[stage].get("digest"), references)
    return damages


def _check_link(path: Path) -> Damage | None:
    """Check that a link has the form `../<stage>/<key>` or `../<stage>/<key>/<file>` and leads somewhere."""
    if not path.is_symlink():
        return None
    target = os.readlink(path)
    parts = target.split("/")
    if parts[0] != ".." or len(parts) not in (3, 4) or {"", ".", ".."} & set(parts[1:]):
        return Damage(path, "link", f"leads out of the scene, to {target}")
    if not path.exists():
        return Damage(path, "missing", f"what it links to: {target}")
    return None


def _check_stage(folder: Path, stage: str, key: str, digest: Any, references: "References") -> list[Damage]:
    damages = []
    if not stage.isidentifier() or not key.isalnum():
        return [Damage(folder / INDEX, "damaged", f"names no artifact: {stage} {key}")]
    if not (folder / stage).is_symlink() or os.readlink(folder / stage) != f"../{stage}/{key}":
        damages.append(Damage(folder / stage, "missing", f"link to ../{stage}/{key}; delete the folder and run again"))
    standing = references.digest(folder.parent / stage / key)
    if standing is None:
        damages.append(Damage(folder.parent / stage / key, "missing", f"published in {folder}; run again"))
    elif standing != digest:
        damages.append(Damage(folder / INDEX, "stale", f"{stage} is not the one that was published; run again"))
    return damages


ARTIFACT_NAME = re.compile(r"[0-9a-f]{12}(\.superseded-[0-9a-f]{8})?")
UNFINISHED = (".partial", ".pruned")
CURRENT = "current"


@dataclass
class AuditTargets:
    """Contents of some folders: artifacts, published links, stray links, unfinished and set-aside folders."""

    artifacts: list[Path] = field(default_factory=list)
    crates: list[Path] = field(default_factory=list)
    publications: list[Path] = field(default_factory=list)
    damages: list[Damage] = field(default_factory=list)
    unfinished: list[Path] = field(default_factory=list)
    aside: list[Path] = field(default_factory=list)

    @property
    def empty(self) -> bool:
        """Return whether nothing is there that a run or pack has made; published links alone are nothing."""
        return not (self.artifacts or self.crates or self.damages or self.unfinished or self.aside)


@dataclass
class Counts:
    """Running totals of an audit."""

    artifacts: int = 0
    files: int = 0
    bytes: int = 0
    problems: int = 0


def find_artifacts(folders: Iterable[Path]) -> AuditTargets:
    """Find everything to audit at or below folders: results, a scene, a stage or an artifact. No link is followed."""
    targets = AuditTargets()
    todo = [Path(folder) for folder in folders]
    while todo:
        _look(todo.pop(), targets, todo)
    for items in (targets.artifacts, targets.crates, targets.publications, targets.unfinished, targets.aside):
        items[:] = sorted(set(items))
    return targets


def _look(folder: Path, targets: AuditTargets, todo: list[Path]) -> None:
    if ARTIFACT_NAME.fullmatch(folder.name) or (folder / MANIFEST).is_file():
        # Snakemake makes the folder of an output before its stage starts: an empty one is not lost, but not begun.
        (targets.artifacts if any(folder.iterdir()) else targets.unfinished).append(folder)
        return
    if (folder / METADATA).is_file():
        targets.crates.append(folder)
        return
    if folder.name == CURRENT and (folder / INDEX).exists():
        targets.publications.append(folder)
        return
    try:
        with os.scandir(folder) as entries:
            inner = list(entries)
    except OSError as error:
        targets.damages.append(Damage(folder, "unreadable", str(error.strerror)))
        return
    for entry in inner:
        path = folder / entry.name
        if entry.is_symlink():
            detail = f"not followed, to {os.readlink(path)}; verify its target itself"
            targets.damages.append(Damage(path, "link", detail))
        elif not entry.is_dir(follow_symlinks=False):
            targets.crates += [path] if path.suffix.lower() == ".zip" else []
        elif ".set-aside-" in entry.name:
            targets.aside.append(path)
        elif entry.name.startswith("."):
            targets.unfinished += [path] if entry.name.endswith(UNFINISHED) else []
        elif entry.name == CURRENT:
            targets.publications.append(path)
        elif entry.name != SWEEPS:  # pages and timings are no artifacts, though some folders there are named by keys
            todo.append(path)


def audit(
    targets: AuditTargets, counts: Counts, *, threads: int, tell: Callable[[int, int, str], None]
) -> Iterator[Damage]:
    """Yield every damage of the targets while it is found, always in the same order.

    tell: called with artifacts done, their number, and what was done last. Held in memory: of every artifact its
    place, digest and upstream artifacts.
    """
    references = References()
    yield from _count(targets.damages, counts)
    ahead = 4 * threads
    surveys = in_threads(lambda folder: survey_artifact(FolderTree(folder)), targets.artifacts, threads, ahead)
    files = _files(surveys, references, counts, len(targets.artifacts), tell)
    for damages in in_threads(lambda look: look(), files, threads, ahead):
        yield from _count(damages, counts)
    yield from _count(references.problems(), counts)
    for damages in in_threads(lambda folder: check_publication(folder, references), targets.publications, threads):
        yield from _count(damages, counts)


def _files(
    surveys: Iterable[Survey], references: References, counts: Counts, total: int, tell: Callable[[int, int, str], None]
) -> Iterator[Callable[[], list[Damage]]]:
    """Work for the threads: of every artifact what its survey found, then each of its files."""
    for survey in surveys:
        counts.artifacts += 1
        counts.files += survey.files
        counts.bytes += survey.bytes
        references.add(survey)
        yield partial(getattr, survey, "damages")
        for name, sha256 in survey.to_read:
            yield partial(read_file, survey, name, sha256)
        tell(counts.artifacts, total, f"{counts.bytes / 1e9:.2f} GB, {counts.problems} problems")


def _count(damages: Iterable[Damage], counts: Counts) -> Iterator[Damage]:
    for damage in damages:
        counts.problems += 1
        yield damage
