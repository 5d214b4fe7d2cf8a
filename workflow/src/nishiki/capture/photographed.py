"""What captures of all geometries have in common: a folder, its description, its photographs."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from nishiki.capture.frames import Frame
from nishiki.capture.schema_base import Session


class SourcePhotographs:
    """Photographs of a folder that `convert` reads, of any geometry; channels: their names where a file states them."""

    photographs: tuple[Path, ...]
    channels: tuple[str, ...] = ()

    @property
    def count(self) -> int:
        """Number of the photographs."""
        return len(self.photographs)


@dataclass(frozen=True)
class Photographed:
    """root: the folder; payload: where capture.yaml lies (root, or root/data of a sealed one); frames: every
    photograph, in the order of frames.csv."""

    root: Path
    payload: Path
    settings: Session
    frames: tuple[Frame, ...]

    @property
    def geometry(self) -> str:
        """plane, turntable or goniometer."""
        return self.settings.geometry

    @property
    def sealed(self) -> bool:
        """Whether the folder is a bag with the digests of all its files."""
        return (self.root / "bagit.txt").is_file()

    def frames_of(self, role: str) -> tuple[Frame, ...]:
        """Frames of one role, in the order of the table."""
        return tuple(f for f in self.frames if f.role == role)
