"""Audit many artifacts: their files, the references between them, and the links that publish them."""

import json
import os
import re
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from nishiki.archive.crate import METADATA
from nishiki.archive.survey import CAPTURE, Damage, Survey, read_file, survey_artifact
from nishiki.archive.tree import FolderTree
from nishiki.artifacts.artifact import INDEX, MANIFEST, index_text
from nishiki.artifacts.provenance import file_digest, place_above
from nishiki.engine.project import SWEEPS
from nishiki.threads import in_threads


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
        """Digest of the manifest of an artifact, audited or not; None where there is none."""
        if folder not in self.digests:
            path = folder / MANIFEST
            if folder.is_symlink() or path.is_symlink() or not path.is_file():
                return None
            return file_digest(path)
        return self.digests[folder]

    def problems(self) -> Iterator[Damage]:
        """Artifacts in a wrong place; upstream artifacts that are lost, or stand there with another content."""
        for folder, (scene, stage) in self._stamps.items():
            yield from self._misplaced(folder, scene, stage)
            if "." not in folder.name:
                yield from self._lost(folder)

    def _misplaced(self, folder: Path, scene: str, stage: str) -> Iterator[Damage]:
        from nishiki.stages.table import CHAIN

        if stage != folder.parent.name and folder.parent.name in CHAIN:
            yield Damage(folder, "misplaced", f"made by stage {stage}, lies in {folder.parent.name}", folder)
        elif (folder.parents[1] / "current").is_dir() and scene != folder.parents[1].name:
            yield Damage(folder, "misplaced", f"of scene {scene}, lies in {folder.parents[1].name}", folder)

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
    """Every damage of a folder of published links. References: digests of the artifacts that it may link to."""
    damages = [damage for name in sorted(os.listdir(folder)) if (damage := _of_link(folder / name))]
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
        damages += _of_stage(folder, stage, key, artifacts[stage].get("digest"), references)
    return damages


def _of_link(path: Path) -> Damage | None:
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


def _of_stage(folder: Path, stage: str, key: str, digest: Any, references: "References") -> list[Damage]:
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
    """What stands below some folders: artifacts, published links, stray links, unfinished and set-aside folders."""

    artifacts: list[Path] = field(default_factory=list)
    crates: list[Path] = field(default_factory=list)
    publications: list[Path] = field(default_factory=list)
    damages: list[Damage] = field(default_factory=list)
    unfinished: list[Path] = field(default_factory=list)
    aside: list[Path] = field(default_factory=list)

    @property
    def empty(self) -> bool:
        """Whether nothing is there that a run or pack has made; published links alone are nothing."""
        return not (self.artifacts or self.crates or self.damages or self.unfinished or self.aside)


@dataclass
class Counts:
    """What was audited so far."""

    artifacts: int = 0
    files: int = 0
    bytes: int = 0
    problems: int = 0


def find_artifacts(folders: Iterable[Path]) -> AuditTargets:
    """Everything to audit at or below folders: results, a scene, a stage or an artifact. No link is followed."""
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
    """Every damage of what was found, while it is found, always in the same order.

    tell: called with artifacts done, their number, and what was done last. Held in memory: of every artifact its
    place, digest and upstream artifacts.
    """
    references = References()
    yield from _counted(targets.damages, counts)
    ahead = 4 * threads
    surveys = in_threads(lambda folder: survey_artifact(FolderTree(folder)), targets.artifacts, threads, ahead)
    files = _files(surveys, references, counts, len(targets.artifacts), tell)
    for damages in in_threads(lambda look: look(), files, threads, ahead):
        yield from _counted(damages, counts)
    yield from _counted(references.problems(), counts)
    for damages in in_threads(lambda folder: check_publication(folder, references), targets.publications, threads):
        yield from _counted(damages, counts)


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


def _counted(damages: Iterable[Damage], counts: Counts) -> Iterator[Damage]:
    for damage in damages:
        counts.problems += 1
        yield damage
