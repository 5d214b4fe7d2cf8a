"""Removing artifact folders so that, killed at any moment, each is whole or gone."""

import os
import shutil
from collections.abc import Callable, Iterable
from pathlib import Path

from nishiki.archive.inventory import PRUNED, Item
from nishiki.formats.files import flush_folder
from nishiki.processes import owner


def remove(items: Iterable[Item], tell: Callable[[Item], None]) -> tuple[int, list[tuple[Path, str]]]:
    """Remove folders, each renamed first; bytes removed, and what could not be removed with the reason.

    A folder disappears from its place in one step; what a kill leaves has a name that says `.pruned`, and goes the next
    time. Links are removed as links. Stage and scene folders that become empty go as well.
    """
    total, failed, parents = 0, [], set()
    for item in items:
        try:
            _remove(item.folder)
        except OSError as error:
            failed.append((item.folder, str(error.strerror)))
            continue
        total += item.bytes
        parents |= {item.folder.parent, item.folder.parents[1]}
        tell(item)
    for folder in sorted(parents, key=lambda path: -len(path.parts)):
        try:
            folder.rmdir()
        except OSError:
            continue  # not empty, which is the rule
    return total, failed


def _remove(folder: Path) -> None:
    doomed = folder
    if not folder.name.endswith(PRUNED):
        name = folder.name.removeprefix(".").split(".")[0]
        doomed = folder.with_name(f".{name}.{owner()}{PRUNED}")
        number = 0
        while doomed.exists():
            number += 1
            doomed = folder.with_name(f".{name}.{number}.{owner()}{PRUNED}")
        os.rename(folder, doomed)
        flush_folder(folder.parent)
    shutil.rmtree(doomed)
