"""The links of `results/<scene>/current`: they lead to artifacts of the same scene, and the index names those."""

import json
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

from nishiki.archive.damage import Damage
from nishiki.artifacts.publish import INDEX, index_text

if TYPE_CHECKING:
    from nishiki.archive.references import References


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
    """A link has the form `../<stage>/<key>` or `../<stage>/<key>/<file>`, and leads somewhere."""
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
