"""What is done with artifacts that a run must not build on: they are named and set aside, and are then made again.

Nothing is deleted: a folder that is set aside keeps its files under `<key>.set-aside-<digest>`, for whoever wants to
know what happened; `./nishiki prune` lists it.
"""

import contextlib
import os
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from nishiki.artifacts.artifact import MANIFEST, Artifact, open_artifact
from nishiki.artifacts.provenance import file_digest
from nishiki.errors import UserError

ASIDE = ".set-aside-"


@dataclass(frozen=True)
class Unsound:
    """An artifact folder that must not be built on, and why."""

    folder: Path
    why: str

    def __str__(self) -> str:
        return f"{self.folder}: {self.why}"


def unsound_artifacts(
    plans: dict[str, list[tuple[str, Path, tuple[str, ...]]]], *, contents: bool = False
) -> list[Unsound]:
    """Torn and stale artifacts of some scenes, in the order of the flow.

    plans: scene -> stages in the order of the flow, each its name, its folder, and the names of its upstream stages.
    Torn: files missing or of the wrong size, or no readable manifest. Stale: an upstream artifact that stands there is
    not the one that it was made from. Sizes are looked at; contents: what a stage checks of its inputs too, as after a
    power cut; `./nishiki verify` reads everything.
    """
    return [item for stages in plans.values() for item in _of_scene(stages, contents)]


def _of_scene(stages: list[tuple[str, Path, tuple[str, ...]]], contents: bool) -> Iterator[Unsound]:
    sound: dict[str, str] = {}
    for name, folder, upstream in stages:
        if not folder.exists() or not any(folder.iterdir()):  # Snakemake makes the folder before the stage starts
            continue
        try:
            artifact = open_artifact(folder, contents=contents)
        except UserError as error:
            yield Unsound(folder, str(error).removeprefix(f"{folder}: "))
            continue
        stale = [other for other in upstream if other in sound and _made_from(artifact, other) != sound[other]]
        if stale:
            yield Unsound(folder, f"made from another version of {stale[0]} than the present one")
        else:
            sound[name] = file_digest(folder / MANIFEST)


def _made_from(artifact: Artifact, upstream: str) -> str:
    return str(artifact.manifest["upstream"].get(upstream, {}).get("digest"))


def set_aside(folder: Path) -> Path:
    """Rename an artifact folder out of the way; the new path. The manifest's digest names it, `torn` without one."""
    manifest = folder / MANIFEST
    digest = file_digest(manifest)[:8] if manifest.is_file() else "torn"
    target = folder.with_name(f"{folder.name}{ASIDE}{digest}")
    number = 1
    while target.exists():
        number += 1
        target = folder.with_name(f"{folder.name}{ASIDE}{digest}-{number}")
    os.rename(folder, target)
    return target


def set_aside_unsound(
    plans: dict[str, list[tuple[str, Path, tuple[str, ...]]]], tell: Callable[[str], None], *, contents: bool = False
) -> list[Unsound]:
    """Set every torn or stale artifact aside and tell each; what was found."""
    unsound = list({item.folder: item for item in unsound_artifacts(plans, contents=contents)}.values())
    for item in unsound:
        target = set_aside(item.folder)
        tell(f"set aside and made again: {item}; kept as {target.name}")
    put_dates_right(plans)
    return unsound


def put_dates_right(plans: dict[str, list[tuple[str, Path, tuple[str, ...]]]]) -> None:
    """Date manifests neither after now nor before those of their upstream artifacts.

    Digests have said what is sound. Dates mean nothing then, but Snakemake goes by them: where a clock was set back it
    would make finished artifacts again, and fail every job that has an input from the future.
    """
    now = time.time_ns()
    for stages in plans.values():
        dates: dict[str, int] = {}
        for name, folder, upstream in stages:
            manifest = folder / MANIFEST
            if not manifest.is_file():
                continue
            modified = manifest.stat().st_mtime_ns
            dates[name] = max([min(modified, now), *(dates[other] for other in upstream if other in dates)])
            if dates[name] != modified:
                with contextlib.suppress(OSError):  # results that cannot be written: the run tells of that itself
                    os.utime(manifest, ns=(dates[name], dates[name]))
