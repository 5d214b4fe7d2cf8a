"""Archives of small artifacts that are real by contract: written by the writer, keys and digests as a run makes them.

As a program it makes a large one:  .venv/bin/python tests/archives.py FOLDER --scenes 1250
"""

import argparse
import hashlib
import os
import sys
from pathlib import Path
from unittest.mock import patch

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "workflow/src"))
from nishiki.archive.audit import Damage, read_file, survey_artifact
from nishiki.archive.pack import FolderTree
from nishiki.artifacts.artifact import Artifact, ArtifactWriter, publish
from nishiki.artifacts.provenance import stage_key

READS = {
    "ingest": (),
    "separate": ("ingest",),
    "normals": ("ingest", "separate"),
    "height": ("normals",),
    "spectra": ("ingest", "normals"),
    "brdf": ("ingest", "separate", "normals"),
    "render": ("normals", "height", "spectra", "brdf"),
    "report": ("ingest", "normals", "render"),
}
"""A chain of eight stages, each with the stages that it reads; upstream first."""
FILES = ("maps.zarr/zarr.json", "maps.zarr/values/c/0/0", "maps.zarr/values/c/0/1", "summary.json", "values.bin")


def verify_artifact(folder: Path) -> list[Damage]:
    """Recompute every digest of one artifact, and its key; each damage, an empty list if it is sound."""
    survey = survey_artifact(FolderTree(Path(folder)))
    return survey.damages + [damage for work in survey.to_read for damage in read_file(survey, *work)]


def write_artifact(
    scene: Path,
    stage: str,
    upstream: dict[str, Artifact],
    *,
    settings: dict | None = None,
    capture: str = "",
    code: str = "c1",
    file_bytes: int = 400,
    salt: str = "",
) -> Artifact:
    """One artifact in its place below a scene's folder; its content follows from its key, file name and salt."""
    settings = settings or {"method": "default"}
    reads = {name: item.key for name, item in upstream.items()} or {"capture": capture}
    key = stage_key(stage, 1, settings, reads)
    with ArtifactWriter(scene / stage / key) as output:
        for name in FILES:
            output.path(name).write_bytes(content(f"{scene.name}/{key}/{name}/{salt}", file_bytes))
        manifest = {
            "scene": scene.name,
            "stage": stage,
            "key": key,
            "version": "0.1.0",
            "format_version": 1,
            "settings": settings,
            "upstream": {name: {"key": item.key, "digest": item.digest} for name, item in upstream.items()}
            or {"capture": {"digest": capture}},
            "code": code,
            "libraries": {"numpy": "2.4.6"},
            "diagnostics": {"error": 0.5},
        }
        facts = {"seconds": 1.0, "host": "somewhere", "finished": "2026-01-01T00:00:00Z"}
        return output.finish(manifest, facts)


def content(seed: str, size: int) -> bytes:
    """Bytes that follow from a text and look random."""
    block = hashlib.sha256(seed.encode()).digest()
    return (block * (size // len(block) + 1))[:size]


def write_scene(
    scene: Path, *, capture: str = "", file_bytes: int = 400, published: bool = True, **settings: dict
) -> dict[str, Artifact]:
    """A scene of eight artifacts; capture: digest of what they go back to; settings: of stages, if not default."""
    made: dict[str, Artifact] = {}
    capture = capture or hashlib.sha256(scene.name.encode()).hexdigest()
    for stage, reads in READS.items():
        upstream = {name: made[name] for name in reads}
        made[stage] = write_artifact(
            scene, stage, upstream, settings=settings.get(stage), capture=capture, file_bytes=file_bytes
        )
    if published:
        publish(
            scene / "current",
            scene=scene.name,
            deliverables={},
            stages={stage: item.key for stage, item in made.items()},
        )
    return made


def write_archive(results: Path, scenes: int, *, file_bytes: int = 400, flush: bool = True) -> int:
    """Many scenes; number of artifacts. flush: to disk after each, as a run does; otherwise when the system likes."""
    with patch.object(os, "fsync", os.fsync if flush else lambda descriptor: None):
        for number in range(scenes):
            write_scene(results / f"scene-{number:05}", file_bytes=file_bytes)
    return scenes * len(READS)


def main() -> None:
    """Arguments in, an archive on the disk."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="results folder to make")
    parser.add_argument("--scenes", type=int, default=1250, help="scenes of eight artifacts each (default %(default)s)")
    parser.add_argument("--file-bytes", type=int, default=400, help="size of each file (default %(default)s)")
    options = parser.parse_args()
    if os.path.exists(options.folder):
        parser.error(f"{options.folder} exists")
    print(write_archive(options.folder, options.scenes, file_bytes=options.file_bytes, flush=False), "artifacts")


if __name__ == "__main__":
    main()
