"""JavaScript modules of this project: which of them a page is built from."""

import re
from collections.abc import Iterable
from pathlib import Path

IMPORT = re.compile(r'from "viewer/(\w+)";')


def modules_of(entry: Path, folders: Iterable[Path]) -> list[Path]:
    """The module that a page begins with, and those of the folders that it imports, directly or not, in order of names.

    Raises
    ------
    FileNotFoundError
        If an imported module is in none of the folders.
    """
    known = {path.stem: path for folder in folders for path in folder.glob("*.js")}
    modules: set[Path] = set()
    queue = [entry]
    while queue:
        path = queue.pop()
        if path in modules:
            continue
        modules.add(path)
        names = IMPORT.findall(path.read_text(encoding="utf-8"))
        if missing := set(names) - set(known):
            raise FileNotFoundError(f"{path}: imports viewer/{min(missing)}, which is no module of the page")
        queue += [known[name] for name in names]
    return [entry, *sorted(modules - {entry})]
