"""Photographs taken over into a capture folder: their names, their channels, copies or hard links."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

from nishiki.formats.image_header import ImageHeader

COLOUR = ("red", "green", "blue")
FOLDERS = ("frames", "white", "dark", "silhouettes")


def channel_names(header: ImageHeader) -> tuple[str, ...]:
    """Names for the channels of a photograph, alpha apart."""
    if header.kind == "exr":
        rest = tuple(sorted(set(header.names) - {"A"}))
        return COLOUR if set(rest) == {"R", "G", "B"} else rest
    count = header.channels - header.alpha
    known = {1: ("grey",), 3: COLOUR}
    return known.get(count, tuple(f"channel{i + 1}" for i in range(count)))


def file_names(photographs: tuple[Path, ...]) -> list[str]:
    """Names in the capture: those of the files, numbered where two from different folders are the same."""
    names = [p.name for p in photographs]
    same = len(set(names)) != len(names)
    return [f"{i + 1:03d}_{name}" for i, name in enumerate(names)] if same else names


def take(origin: Path, place: Path, link: bool) -> str:
    """Copy or hard-link one file; returns its name relative to the capture."""
    place.parent.mkdir(parents=True, exist_ok=True)
    if link:
        os.link(origin.resolve(), place)
    else:
        shutil.copyfile(origin, place)
    return f"{place.parent.name}/{place.name}" if place.parent.name in FOLDERS else place.name
