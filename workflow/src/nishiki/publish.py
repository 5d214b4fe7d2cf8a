"""`results/<scene>/current`: links to the present artifacts, and to the files that a user wants to open."""

import json
import os
import shutil
from pathlib import Path

from nishiki.artifact import MANIFEST
from nishiki.provenance import file_digest

DELIVERABLES = {
    "report": ("*.html",),
    "object_report": ("*.html",),
    "object_render": ("*.png", "*.exr", "*.mp4", "*.webp"),
    "mesh": ("*.ply",),
    "reflectance": ("*.png", "*.csv"),
    "weave": ("*.ply", "*.png", "*.svg"),
    "fabric": ("*.npz", "*.csv"),
    "fabric_render": ("*.png", "*.exr", "*.mp4"),
    "fabric_evaluate": ("*.csv",),
    "fabric_report": ("*.html",),
    "polarise": ("*.png", "*.exr"),
    "render": ("*.png", "*.exr", "*.mp4", "*.webp"),
    "normals": ("*.png", "*.exr"),
    "spectra": ("*.exr",),
    "height": ("*.exr",),
}


def publish(current: Path, *, scene: str, stages: dict[str, str]) -> Path:
    """Make `current` hold a link a stage and a link a deliverable, and an index with the artifacts' digests.

    current: results/<scene>/current; stages: names and keys. The folder is built beside its place and swapped in.
    """
    folder = current.parent
    partial = folder / f".current.{os.getpid()}.partial"
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True)
    artifacts = {}
    for stage, key in stages.items():
        os.symlink(os.path.join("..", stage, key), partial / stage)
        artifacts[stage] = {"key": key, "digest": file_digest(folder / stage / key / MANIFEST)}
        for pattern in DELIVERABLES.get(stage, ()):
            for path in sorted((folder / stage / key).glob(pattern)):
                os.symlink(os.path.join("..", stage, key, path.name), partial / path.name)
    index = {"scene": scene, "artifacts": artifacts}
    (partial / "index.json").write_text(json.dumps(index, indent=1, sort_keys=True) + "\n")
    shutil.rmtree(current, ignore_errors=True)
    os.rename(partial, current)
    return current
