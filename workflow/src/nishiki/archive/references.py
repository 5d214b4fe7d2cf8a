"""How artifacts hang together: each was made from upstream artifacts whose digests it records."""

from collections.abc import Iterator
from pathlib import Path

from nishiki.archive.damage import Damage
from nishiki.archive.survey import CAPTURE, Survey
from nishiki.artifacts.artifact import MANIFEST
from nishiki.artifacts.provenance import file_digest


class References:
    """Place, digest and upstream artifacts of every audited artifact; about a kilobyte each."""

    def __init__(self) -> None:
        self.digests: dict[Path, str] = {}
        self._upstream: dict[Path, dict[str, tuple[str, str]]] = {}
        self._stamps: dict[Path, tuple[str, str]] = {}

    def add(self, survey: Survey) -> None:
        """Note an artifact; one without a readable manifest is no reference."""
        if survey.digest and survey.stage:
            self.digests[survey.folder] = survey.digest
            self._upstream[survey.folder] = survey.upstream
            self._stamps[survey.folder] = (survey.scene, survey.stage)

    def digest(self, folder: Path) -> str | None:
        """Digest of the manifest of an artifact, audited or not; None where there is none."""
        if folder not in self.digests:
            path = folder / MANIFEST
            if folder.is_symlink() or path.is_symlink() or not path.is_file():
                return None
            return file_digest(path)
        return self.digests[folder]

    def problems(self) -> Iterator[Damage]:
        """Artifacts in a wrong place; upstream artifacts that are lost, or stand there with another content."""
        for folder, (scene, stage) in self._stamps.items():
            yield from self._misplaced(folder, scene, stage)
            if "." not in folder.name:
                yield from self._lost(folder)

    def _misplaced(self, folder: Path, scene: str, stage: str) -> Iterator[Damage]:
        from nishiki.stages.table import CHAIN

        if stage != folder.parent.name and folder.parent.name in CHAIN:
            yield Damage(folder, "misplaced", f"made by stage {stage}, lies in {folder.parent.name}", folder)
        elif (folder.parents[1] / "current").is_dir() and scene != folder.parents[1].name:
            yield Damage(folder, "misplaced", f"of scene {scene}, lies in {folder.parents[1].name}", folder)

    def _lost(self, folder: Path) -> Iterator[Damage]:
        for stage, (key, digest) in self._upstream[folder].items():
            if stage == CAPTURE:
                continue
            upstream = folder.parents[1] / stage / key
            present = self.digest(upstream)
            if present is None:
                yield Damage(upstream, "missing", f"{folder} was made from it; run again")
            elif present != digest:
                yield Damage(folder, "stale", f"made from another version of {upstream}; run again", folder)
