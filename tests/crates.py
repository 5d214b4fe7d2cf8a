"""A finished scene of small artifacts to pack, and the audit of what was packed."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from archives import write_scene

from nishiki.archive.audit import Damage
from nishiki.archive.crate_audit import CrateAudit, audit_crate
from nishiki.archive.pack import pack
from nishiki.artifacts.packed import PackedScene
from nishiki.artifacts.provenance import stage_program
from nishiki.capture.seal import capture_digest, seal

ABOUT = {
    "title": "Höhe & Tiefe",
    "creator": "A. Photographer",
    "date": "2026-01-01",
    "object_id": "inv. 12",
    "object_kind": "panel",
    "object_holder": "Museum of Works",
    "rights": "https://creativecommons.org/licenses/by/4.0/",
    "notes": "a note",
}


def scene_to_pack(folder: Path) -> tuple[PackedScene, Path]:
    """Below a folder: a scene of eight stages and its sealed capture; the project that made it."""
    capture = folder / "capture"
    capture.mkdir()
    (capture / "capture.yaml").write_text("format: 1\n")
    for number in range(3):
        (capture / f"photograph {number}.tif").write_bytes(bytes([number]) * 1000)
    seal(capture)
    digest = capture_digest(capture)
    made = write_scene(folder / "results/scene", capture=digest)
    project = folder / "project"
    (project / "scripts").mkdir(parents=True)
    for name in ("Snakefile", "LICENSE", "uv.lock"):
        (project / name).write_text(f"{name}\n")
    for stage in made:
        (project / stage_program(stage)).parent.mkdir(parents=True)
        (project / stage_program(stage)).write_text("print()\n")
    facts = {"stages": {stage: {"key": item.key} for stage, item in made.items()}}
    does = {stage: f"does {stage}" for stage in made}
    return PackedScene("scene", "0.1.0", list(made.values()), capture, digest, ABOUT, facts, does), project


def packed(scene: tuple[PackedScene, Path], target: Path, *, with_capture: bool = True) -> str:
    """The crate made; digest of its manifest."""
    return pack(replace(scene[0], with_capture=with_capture), scene[1], target, tell=lambda *_: None)


def audit(path: Path) -> tuple[list[Damage], CrateAudit]:
    """Everything wrong with a crate, a folder or a ZIP file, and what it says of itself."""
    found = CrateAudit(path)
    return list(audit_crate(found, threads=2, tell=lambda *_: None)), found
