"""Compare one artifact with its contract by names, sizes and manifests, and name each kind of damage."""

import hashlib
import re
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from nishiki.archive.tree import Listing, Tree
from nishiki.artifacts.artifact import MANIFEST, RUN, is_digest, parse_manifest, run_problem
from nishiki.artifacts.provenance import UPSTREAM, stage_key
from nishiki.errors import printable

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
    """One thing that is not as it should be. artifact: folder of the artifact that is no longer sound, if any is."""

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
    """What is known of one artifact before its files are read."""

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

    def named(self, name: str) -> str:
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
    _note_upstream(survey, manifest)
    return survey


def _manifest(survey: Survey, listing: Listing) -> dict[str, Any] | None:
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


def _read(survey: Survey, listing: Listing, name: str, missing: str, parse: Callable[[bytes], Any]) -> Any:
    """Parse a file of an artifact; None, with the damage noted, where that cannot be done."""
    try:
        if name in listing.files:
            return parse(survey.tree.read(survey.named(name)))
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


def _note_upstream(survey: Survey, manifest: dict[str, Any]) -> None:
    """Record the upstream artifacts after a check of their names, which become paths."""
    for stage, entry in manifest["upstream"].items():
        key, digest = entry.get("key", ""), entry.get("digest")
        named = key == "" if stage == CAPTURE else UPSTREAM.fullmatch(stage) and KEY.fullmatch(str(key))
        if named and is_digest(digest):
            survey.upstream[stage] = (key, digest)
        else:
            survey.add(MANIFEST, "damaged", f"does not name an upstream artifact: {stage} {key}")
    if not manifest["upstream"]:
        survey.add(MANIFEST, "damaged", "names neither a capture nor an upstream artifact")


def _check_files(survey: Survey, manifest: dict[str, Any], listing: Listing) -> None:
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
    """Digest a file of an artifact; what is not as listed."""
    try:
        digest = survey.tree.digest(survey.named(name))
    except OSError as error:
        return [Damage(survey.folder / name, "unreadable", str(error.strerror), survey.folder)]
    if digest == sha256:
        return []
    detail = f"sha256 {digest[:12]}…, expected {sha256[:12]}…"
    return [Damage(survey.folder / name, "damaged", detail, survey.folder)]
