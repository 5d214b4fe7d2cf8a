"""`results/<scene>/current`: links to the present artifacts, and to the files that a user wants to open."""

import json
import os
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path

from nishiki.artifacts.artifact import MANIFEST, date_not_before
from nishiki.artifacts.provenance import file_digest
from nishiki.errors import UserError
from nishiki.processes import owner

INDEX = "index.json"


def publish(
    current: Path, *, scene: str, stages: dict[str, str], deliverables: Mapping[str, Sequence[str]], code: str = ""
) -> Path:
    """Make `current` hold a link a stage and a link a deliverable, and an index with the artifacts' digests.

    current: results/<scene>/current; stages: names and keys; deliverables: patterns of the files
    to link, by stage; code: digest of the code that publishes. The folder is
    built beside its place and swapped in.
    """
    folder = current.parent
    partial, old = (folder / f".current{what}.{owner()}.partial" for what in ("", ".old"))
    for path in (partial, old):
        shutil.rmtree(path, ignore_errors=True)
    partial.mkdir(parents=True)
    artifacts = {}
    for stage, key in stages.items():
        os.symlink(os.path.join("..", stage, key), partial / stage)
        artifacts[stage] = {"key": key, "digest": file_digest(folder / stage / key / MANIFEST)}
        for pattern in deliverables.get(stage, ()):
            for path in sorted((folder / stage / key).glob(pattern)):
                os.symlink(os.path.join("..", stage, key, path.name), partial / path.name)
    (partial / INDEX).write_text(index_text(scene, artifacts, code))
    date_not_before(partial / INDEX, [folder / stage / key / MANIFEST for stage, key in stages.items()])
    # Moved away whole: killed here, there is no folder, and the next run publishes; never one that lacks links.
    if current.exists() or current.is_symlink():
        os.rename(current, old)
    os.rename(partial, current)
    shutil.rmtree(old, ignore_errors=True)
    return current


def expect_links(results: Path) -> None:
    """Raise UserError where the file system of the results has no symbolic links, which `publish` makes."""
    link = results / f".link.{owner()}.partial"
    try:
        os.symlink(INDEX, link)
    except OSError as error:
        raise UserError(
            f"{results}: this file system has no symbolic links ({error.strerror}). The folder `current` of a scene "
            "consists of them. Remedy: set results: /folder/on/another/disk in the configuration, or mount the share "
            "with links (CIFS: option mfsymlinks)"
        ) from None
    link.unlink()


def index_text(scene: str, artifacts: dict[str, dict[str, str]], code: str = "") -> str:
    """Text of the index: of every stage the key and the digest of its artifact, and the digest of the code."""
    values = {"scene": scene, "artifacts": artifacts} | ({"code": code} if code else {})
    return json.dumps(values, indent=1, sort_keys=True) + "\n"
