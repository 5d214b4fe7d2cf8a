"""Find what no configuration references in a results folder, and remove it.

Only folders that are artifacts by contract are ever listed for removal: `<scene>/<stage>/<name>` with the name of a key
(also superseded, set aside or unfinished) and, where it is finished, a manifest that says so and no file of others.
"""

import hashlib
import json
import os
import re
import shutil
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

from nishiki.archive.audit import ARTIFACT_NAME, CAPTURE, CURRENT
from nishiki.archive.pack import FolderTree
from nishiki.artifacts.artifact import INDEX, MANIFEST, RUN, parse_manifest
from nishiki.artifacts.provenance import place_above
from nishiki.engine.project import SWEEPS
from nishiki.engine.running_lock import RUNS
from nishiki.formats.files import flush
from nishiki.processes import host, is_alive, owner, owner_of
from nishiki.stages.table import CHAIN

ASIDE = re.compile(r"[0-9a-f]{12}\.set-aside-[0-9a-z-]+")
UNFINISHED = re.compile(r"\.([0-9a-f]{12}|current)\..*\.(partial|pruned)")
PRUNED = ".pruned"
"""Suffix of the name of a folder that is being removed."""
Place = tuple[str, str, str]


@dataclass(frozen=True)
class Item:
    """A folder, the reason for its treatment, and the bytes of its files."""

    folder: Path
    why: str
    bytes: int = 0


@dataclass
class Pruning:
    """Folders to remove, in this order, to keep though no configuration names them, and to leave as no artifacts."""

    remove: list[Item] = field(default_factory=list)
    keep: list[Item] = field(default_factory=list)
    left_alone: list[Item] = field(default_factory=list)


@dataclass(frozen=True)
class Finished:
    """A finished artifact: its place, digest and upstream artifacts (stage -> key, digest)."""

    folder: Path
    place: Place
    digest: str
    upstream: dict[str, tuple[str, str]]
    bytes: int


def folders_in(parent: Path, pruning: Pruning) -> Iterator[Path]:
    """Yield real folders inside a folder by name; note links, which stay, and the remains of a removal, which go."""
    with os.scandir(parent) as entries:
        inner = sorted(entries, key=lambda entry: entry.name)
    for entry in inner:
        if entry.is_symlink():
            pruning.left_alone.append(Item(parent / entry.name, f"a link, to {os.readlink(entry.path)}"))
        elif entry.name.endswith(PRUNED):
            folder = parent / entry.name
            pruning.remove.append(Item(folder, "left by an interrupted removal", size_of(folder)))
        elif entry.is_dir(follow_symlinks=False) and entry.name != RUNS:
            yield parent / entry.name


def judge(folder: Path, finished: list[Finished], pruning: Pruning, hosts: set[str]) -> None:
    """Sort a folder of a stage: into `finished` where it is a finished artifact, otherwise into `pruning`."""
    name = folder.name
    if UNFINISHED.fullmatch(name):
        judge_unfinished(folder, pruning, hosts)
    elif ASIDE.fullmatch(name):
        pruning.remove.append(Item(folder, "set aside", size_of(folder)))
    elif ARTIFACT_NAME.fullmatch(name) and not any(folder.iterdir()):
        pruning.remove.append(Item(folder, "empty: its stage was never finished"))
    elif not ARTIFACT_NAME.fullmatch(name):
        pruning.left_alone.append(Item(folder, "not the name of an artifact"))
    else:
        _judge_finished(folder, finished, pruning)


def _judge_finished(folder: Path, finished: list[Finished], pruning: Pruning) -> None:
    listing = FolderTree(folder).listing()
    try:
        data = FolderTree(folder).read(MANIFEST)
        manifest = parse_manifest(data)
    except (OSError, ValueError):
        reason = "no readable manifest; ./nishiki verify --set-aside renames it"
        pruning.left_alone.append(Item(folder, reason, sum(listing.files.values())))
        return
    expected = {*manifest["files"], MANIFEST, RUN}
    strange = [*listing.links, *listing.others, *listing.unreadable, *(set(listing.files) - expected)]
    total = sum(listing.files.values())
    if (manifest["stage"], manifest["key"]) != (folder.parent.name, folder.name[:12]):
        pruning.left_alone.append(Item(folder, "its manifest names another stage or key", total))
    elif strange:
        pruning.left_alone.append(Item(folder, f"holds files that its manifest does not list: {min(strange)}", total))
    else:
        upstream = {
            stage: (str(entry.get("key")), str(entry.get("digest")))
            for stage, entry in manifest["upstream"].items()
            if stage != CAPTURE
        }
        place = (folder.parents[1].name, folder.parent.name, folder.name[:12])
        finished.append(Finished(folder, place, hashlib.sha256(data).hexdigest(), upstream, total))


def judge_unfinished(folder: Path, pruning: Pruning, hosts: set[str]) -> None:
    """Sort a folder that is being written or removed; hosts: machines of which no process lives any more."""
    at, process = owner_of(folder.name)
    if at in ("", host()) and is_alive(process):
        pruning.keep.append(Item(folder, f"process {process.split('-')[0]} is writing it", size_of(folder)))
    elif at not in ("", host(), *hosts):
        pruning.keep.append(Item(folder, f"of {at}; --host-is-gone {at} lists it", size_of(folder)))
    else:
        pruning.remove.append(Item(folder, "unfinished; its process has ended", size_of(folder)))


def size_of(folder: Path) -> int:
    """Sum the bytes of all files below a folder; links count nothing and are not followed."""
    return sum(FolderTree(folder).listing().files.values())


def decide(results: Path, planned: set[Place], *, unnamed: bool = False, hosts: Iterable[str] = ()) -> Pruning:
    """List the results that nothing refers to.

    planned: (scene, stage, key) of everything that the configurations and their sweeps ask for; unnamed: list also
    scenes that no configuration names; hosts: machines of which no process lives any more. Pages and timings of sweeps
    stay.
    """
    pruning = Pruning()
    scenes = {scene for scene, _, _ in planned}
    finished: list[Finished] = []
    for folder in folders_in(results, pruning):
        if folder.name == SWEEPS or folder.name.startswith("."):  # what runs keep there while they are at work
            continue
        if folder.name not in scenes and not unnamed:
            pruning.keep.append(Item(folder, "a scene that no given configuration names; --unnamed lists it"))
            continue
        _look_into(folder, folder.name in scenes, finished, pruning, set(hosts))
    # the artifacts that the folders of published links name
    published: set[Place] = set()
    for scene in scenes:
        try:
            index = json.loads(FolderTree(results / scene / CURRENT).read(INDEX))
            published |= {(scene, str(stage), str(entry["key"])) for stage, entry in index["artifacts"].items()}
        except (OSError, ValueError, KeyError, TypeError, AttributeError):
            continue
    kept = _list_reasons_to_stay(finished, planned, published)
    pruning.keep += [Item(item.folder, kept[item.folder], item.bytes) for item in finished if kept.get(item.folder)]
    unreferenced = [item for item in finished if item.folder not in kept]
    for item in unreferenced:
        why = "superseded" if "." in item.folder.name else "no configuration asks for it"
        pruning.remove.append(Item(item.folder, why, item.bytes))
    order = {stage: number for number, stage in enumerate(CHAIN)}
    pruning.remove.sort(key=lambda item: (-order.get(item.folder.parent.name, len(order)), str(item.folder)))
    return pruning


def _look_into(scene: Path, named: bool, finished: list[Finished], pruning: Pruning, hosts: set[str]) -> None:
    for folder in folders_in(scene, pruning):
        if UNFINISHED.fullmatch(folder.name):
            judge_unfinished(folder, pruning, hosts)
        elif folder.name == CURRENT:
            if named:
                continue
            listing = FolderTree(folder).listing()
            if set(listing.files) <= {INDEX} and not listing.others and not listing.unreadable:
                why = "links of a scene that no configuration names"
                pruning.remove.append(Item(folder, why, sum(listing.files.values())))
            else:
                pruning.left_alone.append(Item(folder, "holds more than links"))
        elif folder.name in CHAIN:
            for inner in folders_in(folder, pruning):
                judge(inner, finished, pruning, hosts)
        else:
            pruning.left_alone.append(Item(folder, "no stage has this name"))


def _list_reasons_to_stay(finished: list[Finished], planned: set[Place], published: set[Place]) -> dict[Path, str]:
    """List folders that stay, each with the reason; an empty one where a configuration names it."""
    standing = [item for item in finished if "." not in item.folder.name]
    kept = {item.folder: "" for item in standing if item.place in planned}
    kept |= {item.folder: "published; run again first" for item in standing if item.place in published - planned}
    by_digest = {(item.place, item.digest): item for item in finished}
    by_place = {item.place: item for item in standing}
    queue = [item for item in finished if item.folder in kept]
    while queue:
        item = queue.pop()
        for stage, (key, digest) in item.upstream.items():
            place = (*place_above(item.place[0], stage), key)
            above = by_digest.get((place, digest)) or by_place.get(place)
            if above is not None and above.folder not in kept:
                kept[above.folder] = f"{item.place[1]}/{item.folder.name} was made from it"
                queue.append(above)
    return kept


def remove(items: Iterable[Item], tell: Callable[[Item], None]) -> tuple[int, list[tuple[Path, str]]]:
    """Remove folders, each renamed first; bytes removed, and what could not be removed with the reason.

    A folder disappears from its place in one step; what a kill leaves has a name that says `.pruned`, and goes the next
    time. Links are removed as links. Stage and scene folders that become empty go as well.
    """
    total, failed, parents = 0, [], set()
    for item in items:
        try:
            doomed = item.folder
            if not item.folder.name.endswith(PRUNED):
                name = item.folder.name.removeprefix(".").split(".")[0]
                doomed = item.folder.with_name(f".{name}.{owner()}{PRUNED}")
                number = 0
                while doomed.exists():
                    number += 1
                    doomed = item.folder.with_name(f".{name}.{number}.{owner()}{PRUNED}")
                os.rename(item.folder, doomed)
                flush(item.folder.parent)
            shutil.rmtree(doomed)
        except OSError as error:
            failed.append((item.folder, str(error.strerror)))
            continue
        total += item.bytes
        parents |= {item.folder.parent, item.folder.parents[1]}
        tell(item)
    for folder in sorted(parents, key=lambda path: -len(path.parts)):
        with suppress(OSError):  # not empty, which is the rule
            folder.rmdir()
    return total, failed
