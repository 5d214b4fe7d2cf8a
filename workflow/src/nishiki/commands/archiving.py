"""Commands for the archive of results: verify."""

import argparse
import json
from pathlib import Path

from nishiki.artifact import MANIFEST, verify_artifact
from nishiki.errors import UserError
from nishiki.provenance import file_digest


def verify(options: argparse.Namespace, rest: list[str]) -> int:
    """Verify every artifact below the folders; exit status 1 where anything is damaged, missing or foreign."""
    folders = [Path(folder) for folder in options.folders or ["results"]]
    missing = [folder for folder in folders if not folder.is_dir()]
    if missing:
        raise UserError(f"{missing[0]}: folder not found")
    artifacts = sorted({path for folder in folders for path in _artifact_folders(folder)})
    damages = [damage for path in artifacts for damage in verify_artifact(path)]
    damages += _lost_upstreams(artifacts)
    for damage in damages:
        print(damage)
    count = 0
    for capture in options.capture:
        from nishiki.capture.seal import verify_seal

        problems = verify_seal(Path(capture))
        count += len(problems)
        for problem in problems:
            print(problem)
    total = len(damages) + count
    print(f"{len(artifacts)} artifacts verified: {'sound' if not total else f'{total} problems'}")
    return 1 if total else 0


def _artifact_folders(folder: Path) -> list[Path]:
    """Artifact folders at or below a folder: results/scene/stage/key, entered at any level; links are not followed."""
    if (folder / MANIFEST).is_file() or _is_key(folder.name):
        return [folder]
    found = []
    for child in sorted(folder.iterdir()):
        if child.is_dir() and not child.is_symlink() and child.name != "current" and not child.name.startswith("."):
            found += _artifact_folders(child)
    return found


def _is_key(name: str) -> bool:
    return len(name) == 12 and set(name) <= set("0123456789abcdef")


def _lost_upstreams(artifacts: list[Path]) -> list[str]:
    """Artifacts whose recorded upstream artifact stands there with another digest."""
    lost = []
    for folder in artifacts:
        if not (folder / MANIFEST).is_file() or "superseded" in folder.name:
            continue
        try:
            upstreams = json.loads((folder / MANIFEST).read_text()).get("upstream", {})
        except ValueError:
            continue
        for name, entry in upstreams.items():
            path = folder.parents[1] / name / str(entry.get("key")) / MANIFEST
            if path.is_file() and file_digest(path) != entry["digest"]:
                lost.append(f"stale: {folder} was made from another version of {path.parent}; run again")
    return lost
