"""What each folder below an archive is and whether it can be converted, without writing anything."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from nishiki.capture.options import ConvertOptions
from nishiki.capture.registry import LAYOUTS, UNKNOWN, read_source, recognise
from nishiki.formats.bounds import bound
from nishiki.formats.files import Refused, files_with, leads_out
from nishiki.formats.image_header import IMAGE_SUFFIXES
from nishiki.formats.problems import CaptureError

NOTHING = ConvertOptions()


class ArchiveEntry(NamedTuple):
    """One folder or file: path relative to the archive, name of its layout, its parts in words, reason or ''."""

    path: str
    layout: str
    parts: str
    reason: str


def list_archive(archive: Path) -> Iterator[ArchiveEntry]:
    """Recognise each folder below an archive, and each file where a folder holds several that stand for themselves.

    A folder that is recognised, or a capture, is not entered. `reason` says in one line why a source cannot be read.
    """
    pending = [(archive, 0)]
    while pending:
        place, depth = pending.pop()
        inner = sorted(path for path in place.iterdir() if not path.name.startswith("."))
        folders = [path for path in inner if path.is_dir() and not leads_out(path, archive)]
        if any((place / part / "capture.yaml").is_file() for part in (".", "data")):
            yield ArchiveEntry(str(place.relative_to(archive)), "capture", "", "it is a capture already")
            continue
        entry = _entry_of(place, archive)
        single = [path for path in inner if path.is_file() and any(_stands_alone(path))]
        if entry.reason and len(single) > 1:
            yield from (_entry_of(path, archive) for path in single)
        elif entry.layout or not folders:
            yield entry
        if not entry.layout and depth < bound("folder_depth"):
            pending += [(path, depth + 1) for path in reversed(folders)]


def _stands_alone(file: Path) -> Iterator[bool]:
    return (entry.files and entry.matches(file, NOTHING) is not None for entry in LAYOUTS)


def _entry_of(source: Path, archive: Path) -> ArchiveEntry:
    """What one source is; the layout is '' where none is recognised and no picture lies there."""
    name, layout = str(source.relative_to(archive)), ""
    try:
        found = recognise(source, NOTHING)
        layout = found[0].name if found else ""
        return ArchiveEntry(name, layout, read_source(source, NOTHING, search=False).parts, "")
    except (CaptureError, Refused) as problem:
        problems = problem.problems if isinstance(problem, CaptureError) else (problem,)
        pictures = len(files_with(source, IMAGE_SUFFIXES)) if source.is_dir() else 0
        known = layout or problems[0].what != UNKNOWN
        reason = f"{problems[0]}" + (f" (and {len(problems) - 1} more)" if len(problems) > 1 else "")
        if not known:
            reason = f"{UNKNOWN}; convert searches the pictures for mirror balls" if pictures else UNKNOWN
        parts = f"{pictures} pictures" if pictures else ""
        return ArchiveEntry(name, layout or ("unknown" if pictures else ""), parts, reason)
