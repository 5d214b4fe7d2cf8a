"""Auditing many artifacts: files are read by several threads, memory does not grow with the bytes that are read."""

import os
import re
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

from nishiki.archive.crate_entities import METADATA
from nishiki.archive.damage import Damage
from nishiki.archive.publication import check_publication
from nishiki.archive.references import References
from nishiki.archive.survey import Survey, read_portion, survey_artifact
from nishiki.archive.tree import FolderTree
from nishiki.artifacts.artifact import MANIFEST
from nishiki.threads import in_order

ARTIFACT_NAME = re.compile(r"[0-9a-f]{12}(\.superseded-[0-9a-f]{8})?")
UNFINISHED = (".partial", ".pruned")
CURRENT = "current"
SWEEPS = "sweeps"
"""Pages and timings of sweeps: no artifacts, though some folders there are named by keys."""


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
    if folder.name == CURRENT and (folder / "index.json").exists():
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
        elif entry.name != SWEEPS:
            todo.append(path)


def audit(
    targets: AuditTargets, counts: Counts, *, threads: int, tell: Callable[[int, int, str], None]
) -> Iterator[Damage]:
    """Every damage of what was found, while it is found, always in the same order.

    tell: called with artifacts done, their number, and what was done last. Held in memory: a few portions of files at
    a time, and of every artifact its place, digest and upstream artifacts.
    """
    references = References()
    yield from _counted(targets.damages, counts)
    with ThreadPoolExecutor(threads) as pool:
        surveys = in_order(pool, lambda folder: survey_artifact(FolderTree(folder)), targets.artifacts, 4 * threads)
        portions = _portions(surveys, references, counts, len(targets.artifacts), tell)
        for damages in in_order(pool, _of_portion, portions, 4 * threads):
            yield from _counted(damages, counts)
        yield from _counted(references.problems(), counts)
        publications = in_order(
            pool, lambda folder: check_publication(folder, references), targets.publications, threads
        )
        for damages in publications:
            yield from _counted(damages, counts)


def _of_portion(work: tuple[Survey, list]) -> list[Damage]:
    survey, portion = work
    return read_portion(survey, portion) if portion else survey.damages


def _portions(
    surveys: Iterable[Survey], references: References, counts: Counts, total: int, tell: Callable[[int, int, str], None]
) -> Iterator[tuple[Survey, list]]:
    """Work for the threads: of every artifact what its survey found (an empty portion), then its files."""
    for survey in surveys:
        counts.artifacts += 1
        counts.files += survey.files
        counts.bytes += survey.bytes
        references.add(survey)
        if survey.damages:
            yield survey, []
        for portion in survey.batches():
            yield survey, portion
        tell(counts.artifacts, total, f"{counts.bytes / 1e9:.2f} GB, {counts.problems} problems")


def _counted(damages: Iterable[Damage], counts: Counts) -> Iterator[Damage]:
    for damage in damages:
        counts.problems += 1
        yield damage
