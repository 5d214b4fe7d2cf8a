"""Project folders of RTIBuilder: which lights file and which of its folders of photographs belong together.

A project has `assembly-files` (the `.lp` that was made from mirror spheres or a dome, and pictures of the spheres),
`jpeg-exports` (the photographs that it worked on), and perhaps `cropped-files`, `edited-captures`, `original-captures`
(raw or TIFF) and `finished-files` (`.ptm`, `.rti`).
"""

from __future__ import annotations

import re
import shlex
from dataclasses import dataclass
from pathlib import Path

from nishiki.capture.lights import Lights
from nishiki.formats.files import files_with, leads_out, same_name
from nishiki.formats.image_header import IMAGE_SUFFIXES
from nishiki.formats.problems import CaptureError, Problem, error, expect_one, warning

ASSEMBLY, FINISHED = "assembly-files", "finished-files"
PHOTOGRAPHS = ("jpeg-exports", "cropped-files", "edited-captures", "original-captures")
"""Folders that may hold the photographs, in the order in which they are looked through."""


@dataclass(frozen=True)
class RtiProject:
    """A project's folders by name, as far as they are there."""

    root: Path
    folders: dict[str, Path]

    @classmethod
    def of(cls, source: Path) -> RtiProject | None:
        """The project in a folder, known by `assembly-files` or `jpeg-exports`; None where there is neither.

        None, too, where only the folder itself holds pictures: those of the project may be lost, or never were.
        """
        known = (*PHOTOGRAPHS, ASSEMBLY, FINISHED)
        present = {path.name.casefold(): path for path in source.iterdir() if path.is_dir()}
        folders = {name: present[name] for name in known if name in present and not leads_out(present[name], source)}
        if not {ASSEMBLY, PHOTOGRAPHS[0]} & set(folders):
            return None
        filled = any(_stems_in(folders[name]) for name in PHOTOGRAPHS if name in folders)
        return cls(source, folders) if filled or not _stems_in(source) else None

    def lights_file(self) -> Path:
        """The only `.lp` in `assembly-files`, or in the project's own folder. CaptureError (layout-unknown)."""
        places = [self.folders[ASSEMBLY]] if ASSEMBLY in self.folders else []
        for place in (*places, self.root):
            files = files_with(place, (".lp",))
            remedy = f"Name one: --lights {next(iter(files), '')}"
            if one := expect_one(files, place, "several .lp files", remedy):
                return one
        finished = self._finished()
        remedy = f"Convert {finished}, from which pictures are rendered" if finished else "Name one with --lights"
        what = "an RTIBuilder project without a .lp file"
        raise CaptureError(error("layout-unknown", str(self.root), what, expected=f"one in {ASSEMBLY}", remedy=remedy))

    def photographs(self, lights: Lights) -> Path:
        """The folder that the lights file names, if it holds these photographs; else the first that does.

        CaptureError (photograph-missing) where none does.
        """
        counts = {}
        for name in self._order(lights):
            stems = _stems_in(self.folders[name])
            counts[name] = sum(same_name(light) in stems for light in lights.names)
            if counts[name] == len(lights.names):
                return self.folders[name]
        found = ", ".join(f"{count} in {name}" for name, count in counts.items()) or "no folder of photographs"
        finished = self._finished()
        remedy = f"Copy the photographs back, or convert {finished}" if finished else "Copy the photographs back"
        what, expected = "an RTIBuilder project without its photographs", f"{len(lights.names)} that the .lp names"
        raise CaptureError(
            error("photograph-missing", str(self.root), what, expected=expected, found=found, remedy=remedy)
        )

    def note(self, lights_file: Path, lights: Lights, chosen: Path) -> Problem:
        """What was taken to belong together, and what else there is."""
        others = [
            name
            for name in reversed(PHOTOGRAPHS)
            if name in self.folders
            and self.folders[name] != chosen
            and {same_name(light) for light in lights.names} <= _stems_in(self.folders[name])
        ]
        what = f"an RTIBuilder project: the lights of {lights_file.name} and the photographs of {chosen.name}"
        found = f"the same photographs in {', '.join(others)}, not used" if others else ""
        words = [str(self.folders[others[0]]), "--lights", str(lights_file)] if others else []
        remedy = f"For those: ./nishiki convert {shlex.join(words)}" if words else ""
        return warning("project-folders", str(self.root), what, found=found, remedy=remedy)

    def _order(self, lights: Lights) -> list[str]:
        """Folders of photographs: first the one that the lights file names most."""
        named = [re.split(r"[\\/]", file)[-2:-1] for file in lights.files if file]
        asked = [part[0].casefold() for part in named if part]
        present = [name for name in PHOTOGRAPHS if name in self.folders]
        return sorted(present, key=lambda name: -asked.count(name))

    def _finished(self) -> Path | None:
        place = self.folders.get(FINISHED)
        return next(iter(files_with(place, (".rti", ".ptm"))), None) if place else None


def _stems_in(folder: Path) -> set[str]:
    """Names of the pictures in a folder, without suffix."""
    return {same_name(path.stem) for path in files_with(folder, IMAGE_SUFFIXES)}
