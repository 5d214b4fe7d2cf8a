"""What stands in a results folder, judged folder by folder: whose it is, and whether it is an artifact by contract."""

import hashlib
import os
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from nishiki.archive.survey import CAPTURE
from nishiki.archive.tree import FolderTree
from nishiki.artifacts.artifact import MANIFEST, RUN, parse_manifest
from nishiki.artifacts.publish import INDEX
from nishiki.engine.running_lock import RUNS
from nishiki.processes import host, is_alive, owner_of

FINISHED = re.compile(r"([0-9a-f]{12})(?:\.superseded-[0-9a-f]{8})?")
ASIDE = re.compile(r"([0-9a-f]{12})\.set-aside-[0-9a-z-]+")
UNFINISHED = re.compile(r"\.([0-9a-f]{12}|current)\..*\.(partial|pruned)")
PRUNED = ".pruned"
"""What the name of a folder ends with that is being removed."""
Place = tuple[str, str, str]


@dataclass(frozen=True)
class Item:
    """A folder and what is said of it. bytes: of its files."""

    folder: Path
    why: str
    bytes: int = 0


@dataclass
class Pruning:
    """What would go, in this order; what stays though no configuration names it; what is not ours to judge."""

    remove: list[Item] = field(default_factory=list)
    keep: list[Item] = field(default_factory=list)
    left_alone: list[Item] = field(default_factory=list)


@dataclass(frozen=True)
class Finished:
    """A finished artifact that stands there: its place, digest and upstream artifacts (stage -> key, digest)."""

    folder: Path
    place: Place
    digest: str
    upstream: dict[str, tuple[str, str]]
    bytes: int


def folders_in(parent: Path, pruning: Pruning) -> Iterator[Path]:
    """Real folders inside a folder, by name; links are noted and left alone."""
    with os.scandir(parent) as entries:
        inner = sorted(entries, key=lambda entry: entry.name)
    for entry in inner:
        if entry.is_symlink():
            pruning.left_alone.append(Item(parent / entry.name, f"a link, to {os.readlink(entry.path)}"))
        elif entry.is_dir(follow_symlinks=False) and entry.name != RUNS:
            yield parent / entry.name


def judge(folder: Path, finished: list[Finished], pruning: Pruning, hosts: set[str]) -> None:
    """Sort a folder of a stage: into `finished` where it is a finished artifact, otherwise into `pruning`."""
    name = folder.name
    if UNFINISHED.fullmatch(name):
        judge_unfinished(folder, pruning, hosts)
    elif ASIDE.fullmatch(name):
        pruning.remove.append(Item(folder, "set aside", size_of(folder)))
    elif FINISHED.fullmatch(name) and not any(folder.iterdir()):
        pruning.remove.append(Item(folder, "empty: its stage was never finished"))
    elif not FINISHED.fullmatch(name):
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
    if folder.name.endswith(PRUNED):
        pruning.remove.append(Item(folder, "left by an interrupted removal", size_of(folder)))
    elif at in ("", host()) and is_alive(process):
        pruning.keep.append(Item(folder, f"process {process.split('-')[0]} is writing it", size_of(folder)))
    elif at not in ("", host(), *hosts):
        pruning.keep.append(Item(folder, f"of {at}; --host-is-gone {at} lists it", size_of(folder)))
    else:
        pruning.remove.append(Item(folder, "unfinished; its process has ended", size_of(folder)))


def judge_current(folder: Path, pruning: Pruning) -> None:
    """Published links of a scene that no configuration names: links and an index, nothing else."""
    listing = FolderTree(folder).listing()
    if set(listing.files) <= {INDEX} and not listing.others and not listing.unreadable:
        pruning.remove.append(Item(folder, "links of a scene that no configuration names", sum(listing.files.values())))
    else:
        pruning.left_alone.append(Item(folder, "holds more than links"))


def size_of(folder: Path) -> int:
    """Bytes of all files below a folder; links count nothing and are not followed."""
    return sum(FolderTree(folder).listing().files.values())
