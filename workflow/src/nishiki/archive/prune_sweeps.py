"""Pages and timings of sweeps, judged for removal; they are no artifacts, and known by their own contents."""

import json
import re
from pathlib import Path
from typing import Any

from nishiki.archive.inventory import FINISHED, PRUNED, Item, Place, Pruning, folders_in, size_of
from nishiki.archive.tree import FolderTree
from nishiki.engine.project import SWEEPS
from nishiki.engine.sweep_plan import TIMINGS


def judge_sweeps(results: Path, kept: set[Place], sweeps: set[str], unnamed: bool, pruning: Pruning) -> None:
    """Sort pages of sweeps and timings of single artifacts into `pruning`. kept: artifacts that stay."""
    root = results / SWEEPS
    if root.is_symlink() or not root.is_dir():
        return
    for folder in folders_in(root, pruning):
        if folder.name.endswith(PRUNED):
            pruning.remove.append(Item(folder, "left by an interrupted removal", size_of(folder)))
        elif folder.name == TIMINGS:
            for scene in folders_in(folder, pruning):
                for stage in folders_in(scene, pruning):
                    for timing in folders_in(stage, pruning):
                        _judge_timing(timing, kept, pruning)
        elif folder.name not in sweeps:
            page = Item(folder, "a sweep that no given configuration names", size_of(folder))
            of_ours = unnamed and _is_page_of(folder / "sweep.json", folder.name)
            (pruning.remove if of_ours else pruning.keep if not unnamed else pruning.left_alone).append(page)


def _judge_timing(folder: Path, kept: set[Place], pruning: Pruning) -> None:
    scene, stage, key = folder.parts[-3:]
    if key.endswith(PRUNED):
        pruning.remove.append(Item(folder, "left by an interrupted removal", size_of(folder)))
        return
    if (scene, stage, key) in kept or not FINISHED.fullmatch(key):
        return
    listing = FolderTree(folder).listing()
    records_only = all(re.fullmatch(r"\d+\.json", name) for name in listing.files)
    item = Item(folder, "timing of an artifact that no configuration asks for", sum(listing.files.values()))
    (pruning.remove if records_only and not listing.links and not listing.others else pruning.left_alone).append(item)


def _is_page_of(path: Path, name: str) -> bool:
    try:
        content: Any = json.loads(FolderTree(path.parent).read(path.name))
    except (OSError, ValueError, RecursionError):
        return False
    return isinstance(content, dict) and content.get("name") == name
