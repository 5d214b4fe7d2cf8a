"""An existing folder of photographs and lamps made into a capture folder; the sources are only read."""

from __future__ import annotations

import os
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import yaml

from nishiki.capture.headers import read_header
from nishiki.capture.layouts import Layout, photographs_in, recognise
from nishiki.capture.problems import CaptureError, Problem, error, warning
from nishiki.capture.schema import FORMAT

COLOUR = ("red", "green", "blue")


@dataclass(frozen=True)
class Conversion:
    """The capture folder made, the layout recognised, the number of photographs, what the user should know."""

    folder: Path
    layout: str
    photographs: int
    warnings: tuple[Problem, ...]


def convert(
    source: Path | str,
    target: Path | str,
    *,
    lights_file: Path | None = None,
    mask: Path | None = None,
    white: Path | None = None,
    dark: Path | None = None,
    checks: tuple[str, ...] = (),
    encoding: Literal["linear", "srgb"] | None = None,
    title: str | None = None,
    region: tuple[int, int, int, int] | None = None,
    link: bool = False,
) -> Conversion:
    """Make the capture folder `target`, which must not exist, from a folder of photographs.

    white: folder of the white board's photographs, matched by name or, if as many, by order; dark: folder of dark
    frames; checks: lights kept for evaluation; encoding: default srgb for JPEG, otherwise linear; region: row, column,
    rows, columns; link: hard links instead of copies (same disk; then never edit either). The folder appears whole or
    not at all. Raises CaptureError (target-exists, and those of `recognise`).
    """
    source, target = Path(source), Path(target)
    if target.exists():
        remedy = "Choose another name; nothing is overwritten"
        raise CaptureError(error("target-exists", str(target), "target exists", remedy=remedy))
    layout = recognise(source, lights_file=lights_file, mask=mask)
    unknown = [name for name in checks if layout.lights.index(name) is None]
    if unknown:
        found = ", ".join(unknown)
        raise CaptureError(error("light-unknown", str(source), "no such light to keep for evaluation", found=found))
    partial = target.with_name(f".{target.name}.partial")
    if partial.exists():
        shutil.rmtree(partial)
    try:
        notes = _write(partial, layout, source, white, dark, checks, encoding, title, region, link)
        os.rename(partial, target)
    finally:
        if partial.exists():
            shutil.rmtree(partial)
    return Conversion(target, layout.name, len(layout.photographs), (*layout.warnings, *notes))


def _write(
    folder: Path,
    layout: Layout,
    source: Path,
    white: Path | None,
    dark: Path | None,
    checks: tuple[str, ...],
    encoding: str | None,
    title: str | None,
    region: tuple[int, int, int, int] | None,
    link: bool,
) -> list[Problem]:
    folder.mkdir(parents=True)
    header = read_header(layout.photographs[0])
    channels = _channel_names(header)
    names, held = layout.lights.names, {layout.lights.index(name) for name in checks}
    rows = []
    for i, (photograph, file) in enumerate(zip(layout.photographs, _file_names(layout.photographs), strict=True)):
        rows.append((_take(photograph, folder / "frames" / file, link), "check" if i in held else "sample", names[i]))
    for photograph, light in _match_whites(layout, white) if white else ():
        rows.append((_take(photograph, folder / "white" / photograph.name, link), "white", light))
    for photograph in photographs_in(dark) if dark else ():
        rows.append((_take(photograph, folder / "dark" / photograph.name, link), "dark", ""))
    settings = {"format": FORMAT, "title": title or source.name, "geometry": "plane"}
    jpeg = header.kind == "jpeg"
    coding = encoding or ("srgb" if jpeg else "linear")
    settings["camera"] = {"channels": list(channels), "encoding": coding}
    settings["lights"] = {"file": "lights.lp", "kind": "direction"}
    if layout.intensities is not None:
        settings["lights"]["intensities"] = "intensities.csv"
        _write_intensities(folder / "intensities.csv", layout, channels)
    if layout.mask is not None:
        settings["mask"] = _take(layout.mask, folder / f"mask{layout.mask.suffix.lower()}", link)
    if region is not None:
        settings["region_of_interest"] = list(region)
    _write_tables(folder, settings, rows, layout)
    return _notes(header.sample, jpeg, encoding, source)


def _notes(sample: str, jpeg: bool, encoding: str | None, source: Path) -> list[Problem]:
    if encoding is None and sample == "uint8" and not jpeg:
        what = "8-bit photographs are taken to be linear"
        remedy = "Give the encoding srgb if the camera or a converter coded them for display"
        return [warning("encoding-assumed", source.name, what, remedy=remedy)]
    return []


def _channel_names(header) -> tuple[str, ...]:
    if header.kind == "exr":
        rest = tuple(sorted(set(header.names) - {"A"}))
        return COLOUR if set(rest) == {"R", "G", "B"} else rest
    count = header.channels - header.alpha
    known = {1: ("grey",), 3: COLOUR}
    return known.get(count, tuple(f"channel{i + 1}" for i in range(count)))


def _file_names(photographs: tuple[Path, ...]) -> list[str]:
    """Names in the capture: those of the files, numbered where two from different folders are the same."""
    names = [p.name for p in photographs]
    same = len(set(names)) != len(names)
    return [f"{i + 1:03d}_{name}" for i, name in enumerate(names)] if same else names


def _take(origin: Path, place: Path, link: bool) -> str:
    """Copy or hard-link one file; returns its name relative to the capture."""
    place.parent.mkdir(parents=True, exist_ok=True)
    if link:
        os.link(origin.resolve(), place)
    else:
        shutil.copyfile(origin, place)
    return f"{place.parent.name}/{place.name}" if place.parent.name in ("frames", "white", "dark") else place.name


def _match_whites(layout: Layout, folder: Path) -> list[tuple[Path, str]]:
    present = photographs_in(folder)
    by_stem = {p.stem.casefold(): p for p in present}
    wanted = [p.stem.casefold() for p in layout.photographs]
    if all(stem in by_stem for stem in wanted):
        return [(by_stem[stem], name) for stem, name in zip(wanted, layout.lights.names, strict=True)]
    if len(present) != len(wanted):
        expected, found = f"{len(wanted)}, one a light", f"{len(present)}"
        raise CaptureError(error("photographs-count", str(folder), "white frames", expected=expected, found=found))
    return list(zip(present, layout.lights.names, strict=True))


def _write_tables(folder: Path, settings: dict, rows: list[tuple[str, str, str]], layout: Layout) -> None:
    text = "# Capture folder: see docs/capture-folder.md\n" + yaml.safe_dump(
        settings, sort_keys=False, allow_unicode=True
    )
    (folder / "capture.yaml").write_text(text, encoding="utf-8")
    table = "file,role,light\n" + "".join(",".join(_quoted(v) for v in row) + "\n" for row in rows)
    (folder / "frames.csv").write_text(table, encoding="utf-8")
    lines = (
        f"{name} {x:.9g} {y:.9g} {z:.9g}\n"
        for name, (x, y, z) in zip(layout.lights.names, layout.lights.vectors, strict=True)
    )
    (folder / "lights.lp").write_text(f"{len(layout.lights.names)}\n" + "".join(lines), encoding="utf-8")


def _quoted(value: str) -> str:
    return '"' + value.replace('"', '""') + '"' if any(c in value for c in ',"\n') else value


def _write_intensities(path: Path, layout: Layout, channels: tuple[str, ...]) -> None:
    values = layout.intensities
    if values.shape[1] == 1:
        values = np.repeat(values, len(channels), axis=1)
    if values.shape[1] != len(channels):
        expected, found = f"{len(channels)} columns", f"{values.shape[1]}"
        raise CaptureError(error("intensities-invalid", "light intensities", "table", expected=expected, found=found))
    rows = (
        f"{_quoted(n)},{','.join(f'{v:.9g}' for v in row)}\n"
        for n, row in zip(layout.lights.names, values, strict=True)
    )
    path.write_text(f"light,{','.join(channels)}\n" + "".join(rows), encoding="utf-8")
