"""What of some results no configuration references: decided from names and manifests; nothing is changed here.

Only folders that are artifacts by contract are ever listed for removal: `<scene>/<stage>/<name>` with the name of a key
(also superseded, set aside or unfinished) and, where it is finished, a manifest that says so and no file of others.
"""

import json
from collections.abc import Iterable
from pathlib import Path

from nishiki.archive.inventory import (
    UNFINISHED,
    Finished,
    Item,
    Place,
    Pruning,
    folders_in,
    judge,
    judge_current,
    judge_unfinished,
)
from nishiki.archive.prune_sweeps import judge_sweeps
from nishiki.archive.tree import FolderTree
from nishiki.artifacts.publish import INDEX
from nishiki.engine.project import SWEEPS
from nishiki.stages.table import CHAIN

CURRENT = "current"


def decide(
    results: Path, planned: set[Place], *, sweeps: Iterable[str] = (), unnamed: bool = False, hosts: Iterable[str] = ()
) -> Pruning:
    """What of some results is referenced by nothing.

    planned: (scene, stage, key) of everything that the configurations ask for; sweeps: names of their sweeps; unnamed:
    list also scenes and sweeps that no configuration names; hosts: machines of which no process lives any more.
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
    kept = _kept(finished, planned, _published(results, scenes))
    pruning.keep += [Item(item.folder, kept[item.folder], item.bytes) for item in finished if kept.get(item.folder)]
    unreferenced = [item for item in finished if item.folder not in kept]
    pruning.remove += [Item(item.folder, _why(item), item.bytes) for item in unreferenced]
    staying = {item.place for item in finished if item.folder in kept} | planned
    judge_sweeps(results, staying, set(sweeps), unnamed, pruning)
    order = {stage: number for number, stage in enumerate(CHAIN)}
    pruning.remove.sort(key=lambda item: (-order.get(item.folder.parent.name, len(order)), str(item.folder)))
    return pruning


def _why(item: Finished) -> str:
    return "superseded" if "." in item.folder.name else "no configuration asks for it"


def _look_into(scene: Path, named: bool, finished: list[Finished], pruning: Pruning, hosts: set[str]) -> None:
    for folder in folders_in(scene, pruning):
        if UNFINISHED.fullmatch(folder.name):
            judge_unfinished(folder, pruning, hosts)
        elif folder.name == CURRENT:
            if not named:
                judge_current(folder, pruning)
        elif folder.name in CHAIN:
            for inner in folders_in(folder, pruning):
                judge(inner, finished, pruning, hosts)
        else:
            pruning.left_alone.append(Item(folder, "no stage has this name"))


def _published(results: Path, scenes: set[str]) -> set[Place]:
    """Artifacts that the folders of published links name."""
    published = set()
    for scene in scenes:
        try:
            index = json.loads(FolderTree(results / scene / CURRENT).read(INDEX))
            published |= {(scene, str(stage), str(entry["key"])) for stage, entry in index["artifacts"].items()}
        except (OSError, ValueError, KeyError, TypeError, AttributeError):
            continue
    return published


def _kept(finished: list[Finished], planned: set[Place], published: set[Place]) -> dict[Path, str]:
    """Folders that stay, each with the reason; an empty one where a configuration asks for it."""
    standing = [item for item in finished if "." not in item.folder.name]
    kept = {item.folder: "" for item in standing if item.place in planned}
    kept |= {item.folder: "published; run again first" for item in standing if item.place in published - planned}
    by_digest = {(item.place, item.digest): item for item in finished}
    by_place = {item.place: item for item in standing}
    queue = [item for item in finished if item.folder in kept]
    while queue:
        item = queue.pop()
        for stage, (key, digest) in item.upstream.items():
            place = (item.place[0], stage, key)
            above = by_digest.get((place, digest)) or by_place.get(place)
            if above is not None and above.folder not in kept:
                kept[above.folder] = f"{item.place[1]}/{item.folder.name} was made from it"
                queue.append(above)
    return kept
