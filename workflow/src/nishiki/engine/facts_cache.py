"""Facts of scenes, remembered between runs: a campaign of thousands of scenes is planned at every start of a job.

What was read of a capture is kept beside the results, under a *signature* of everything that it was read from: name,
size, inode and both times of every file of the capture and of the truth, and the source of this package.
Any change of a file or of the program gives another signature; the facts are then read afresh. The
cache holds nothing that cannot be read again, and may be deleted at any time.
"""

import hashlib
import json
import os
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import asdict
from functools import cache
from pathlib import Path
from typing import Any

from nishiki.artifacts.provenance import PACKAGE
from nishiki.engine.facts import scene_facts
from nishiki.engine.project import Scene
from nishiki.installation import SOURCE
from nishiki.stages.base import SceneFacts

FOLDER = Path(".cache", "facts")
"""Place below the results; names with a dot are no scenes."""


def remembered_facts(scene: Scene, results: Path) -> SceneFacts:
    """Facts of a scene, from the cache where nothing changed. Raises UserError as `scene_facts` does."""
    signature = _signature(scene)
    place = f"{os.path.abspath(scene.capture)}\0{scene.truth and os.path.abspath(scene.truth)}"
    path = Path(results) / FOLDER / f"{hashlib.sha256(place.encode()).hexdigest()[:16]}.json"
    facts = _read(path, signature)
    if facts is None:
        facts = scene_facts(scene)
        if signature == _signature(scene):  # nothing was changed while it was read
            _write(path, signature, facts)
    return facts


def _signature(scene: Scene) -> str:
    digest = hashlib.sha256(_source().encode())
    for root in filter(None, (scene.capture, scene.truth)):
        digest.update(f"\0\0{os.path.abspath(root)}\0".encode())
        for line in _stats(str(root)):
            digest.update(line.encode("utf-8", "surrogateescape"))
    return digest.hexdigest()


def _stats(root: str) -> Iterator[str]:
    """A line for each file below a folder (or for a file), in a fixed order; links are followed as readers do."""
    if not os.path.isdir(root):
        yield _stat("", root)
        return
    waiting = [(root, "")]
    while waiting:
        folder, name = waiting.pop()
        with os.scandir(folder) as entries:
            for entry in sorted(entries, key=lambda entry: entry.name):
                below = f"{name}/{entry.name}"
                yield _stat(below, entry.path)
                if entry.is_dir(follow_symlinks=False):
                    waiting.append((entry.path, below))


def _stat(name: str, path: str) -> str:
    try:
        status = os.stat(path)
    except OSError as error:
        return f"{name}\0{error.errno}\n"
    return f"{name}\0{status.st_size}\0{status.st_mtime_ns}\0{status.st_ctime_ns}\0{status.st_ino}\0{status.st_mode}\n"


@cache
def _source() -> str:
    """Digest of the package: more than reads facts, but found without looking for what is imported."""
    digest = hashlib.sha256()
    for path in sorted((SOURCE / PACKAGE).rglob("*.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest()


def _read(path: Path, signature: str) -> SceneFacts | None:
    try:
        content = json.loads(path.read_bytes())
        if content.pop("signature") != signature:
            return None
        values: dict[str, Any] = {
            name: tuple(each) if isinstance(each, list) else each for name, each in content.items()
        }
        return SceneFacts(**values)
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return None  # absent, torn or of another version: read afresh


def _write(path: Path, signature: str, facts: SceneFacts) -> None:
    partial = path.with_name(f"{path.name}.{os.getpid()}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        partial.write_text(json.dumps({"signature": signature, **asdict(facts)}))
        partial.rename(path)
    except OSError:  # results that may not be written to: plans work without the cache
        with suppress(OSError):
            partial.unlink()
