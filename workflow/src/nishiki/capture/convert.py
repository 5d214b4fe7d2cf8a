"""An existing folder of photographs and lamps made into a capture folder; the sources are only read."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import yaml

from nishiki.capture.goniometer_convert import recognise_table, write_table_capture
from nishiki.capture.goniometer_tables import ReflectanceTable
from nishiki.capture.layouts import Layout, has_lamps, photographs_in, recognise
from nishiki.capture.lights import Lights
from nishiki.capture.pairing import pair_by_name
from nishiki.capture.relightable import lamps_for, recognise_relightable, write_rendered
from nishiki.capture.schema_base import FORMAT
from nishiki.capture.taking import channel_names, file_names, refuse_without_photographs, take
from nishiki.capture.turntable_convert import write_round
from nishiki.capture.turntable_layouts import recognise_round
from nishiki.formats.image_headers import read_header
from nishiki.formats.problems import CaptureError, Problem, error, raise_errors, warning

Examination = Callable[[Path], list[Problem]]


@dataclass(frozen=True)
class Conversion:
    """The capture folder made, the layout recognised, the number of photographs, what the user should know.

    channels: of a table of reflectances, in 1/sr.
    """

    folder: Path
    layout: str
    photographs: int
    warnings: tuple[Problem, ...]
    geometry: str = "plane"
    channels: tuple[str, ...] = ()


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
    examine: Examination | None = None,
) -> Conversion:
    """Make the capture folder `target`, which must not exist, from a folder of photographs, a table of reflectances or
    a relightable image (`.ptm`, `.rti`, a folder of relight), from which pictures are rendered.

    white: folder of the white board's photographs, paired by the part of the names that varies, see `pair_by_name` (for
    a turntable: named by their polariser state); dark: folder of dark frames, all of which are averaged; checks: lights
    kept for evaluation; encoding: of the photographs, None for what is usual; region: row, column, rows, columns; mask:
    picture of the object, for a turntable the folder of the silhouettes; link: hard links instead of copies (same disk;
    then never edit either); examine: what is wrong with the folder that was made, as `check_capture` tells it: errors
    are raised. The folder appears whole or not at all.
    Raises CaptureError (target-exists, option-unusable, folder-missing, file-missing, light-unknown, and those of
    `pair_by_name`, `recognise`, `recognise_round`, `recognise_table`, `read_table` and `open_relightable`).
    """
    source, target = _named(Path(source)), Path(target)
    if target.exists():
        remedy = "Choose another name; nothing is overwritten"
        raise CaptureError(error("target-exists", str(target), "target exists", remedy=remedy))
    raise_errors([*folder_problems(white=white, dark=dark), *file_problems(lights=lights_file)])
    relightable = recognise_relightable(source)
    if relightable is not None:
        refuse_without_photographs(white=white, dark=dark, check=checks)
        raise_errors(file_problems(mask=mask))
        return _of_relightable(target, relightable, lights_file, mask, encoding, title, region, link, examine)
    table = recognise_table(source) if lights_file is None else None
    if table is not None:
        refuse_without_photographs(mask=mask, white=white, dark=dark, check=checks, encoding=encoding, roi=region)
        return _of_table(target, table, title, link, examine)
    turntable = recognise_round(source) if lights_file is None and source.is_dir() and not has_lamps(source) else None
    if turntable is not None:
        refuse_for_round(checks, region)
        raise_errors(folder_problems(mask=mask))

        def write_turntable(partial: Path) -> list[Problem]:
            return write_round(
                partial,
                turntable,
                source,
                silhouettes=mask,
                white=white,
                dark=dark,
                encoding=encoding,
                title=title,
                link=link,
            )

        notes = _write_complete(target, write_turntable, examine)
        return Conversion(
            target, turntable.name, len(turntable.photographs), (*turntable.warnings, *notes), "turntable"
        )
    raise_errors(file_problems(mask=mask))
    layout = recognise(source, lights_file=lights_file, mask=mask)
    unknown = [name for name in checks if layout.lights.index(name) is None]
    if unknown:
        expected, found = f"one of {', '.join(layout.lights.names)}", ", ".join(unknown)
        what = "no such light to keep for evaluation"
        remedy = "The names of the lamps are those of their photographs, without the suffix"
        raise CaptureError(error("light-unknown", str(source), what, expected=expected, found=found, remedy=remedy))
    notes = _write_complete(
        target, lambda p: _write(p, layout, source, white, dark, checks, encoding, title, region, link), examine
    )
    return Conversion(target, layout.name, len(layout.photographs), (*layout.warnings, *notes))


def _named(source: Path) -> Path:
    """The source by a path that ends in its name, from which titles are taken; `.` and `..` have none."""
    return Path(os.path.abspath(source)) if source.name in ("", "..") else source


def folder_problems(**given: Path | None) -> list[Problem]:
    """folder-missing for each option that must name a folder of photographs and does not."""
    remedy = "Give a folder that holds one picture a light; of a turntable one a view, or one a polariser state"
    return [
        error("folder-missing", f"--{name} {path}", "no such folder", remedy=remedy)
        for name, path in given.items()
        if path is not None and not path.is_dir()
    ]


def file_problems(**given: Path | None) -> list[Problem]:
    """file-missing for each option that must name a file and does not."""
    return [
        error("file-missing", f"--{name} {path}", "no such file", remedy="Give a file that is there")
        for name, path in given.items()
        if path is not None and not path.is_file()
    ]


def _of_table(target: Path, table: Path, title: str | None, link: bool, examine: Examination | None) -> Conversion:
    """The capture of a table of reflectances; `photographs` counts its measurements."""
    read: list[ReflectanceTable] = []

    def write(partial: Path) -> list[Problem]:
        content, notes = write_table_capture(partial, table, title=title, link=link)
        read.append(content)
        return notes

    notes = _write_complete(target, write, examine)
    count, channels = len(read[0].values), read[0].channels
    return Conversion(target, "table of reflectances", count, tuple(notes), "goniometer", channels)


def _of_relightable(
    target: Path,
    file: Path,
    lights_file: Path | None,
    mask: Path | None,
    encoding: str | None,
    title: str | None,
    region: tuple[int, int, int, int] | None,
    link: bool,
    examine: Examination | None,
) -> Conversion:
    """The capture of pictures rendered from a relightable image, under the lamps of a lights file or our own."""
    lamps = lamps_for(lights_file)

    def write(partial: Path) -> list[Problem]:
        settings, rows, notes = write_rendered(
            partial, file, lamps, encoding=encoding, mask=mask, title=title, link=link
        )
        if region is not None:
            settings["region_of_interest"] = list(region)
        _write_tables(partial, settings, rows, lamps)
        return notes

    notes = _write_complete(target, write, examine)
    return Conversion(target, f"rendered from {file.name}", len(lamps.names), tuple(notes))


def _write_complete(target: Path, write: Callable[[Path], list[Problem]], examine: Examination | None) -> list[Problem]:
    """Write into a folder beside the target and rename it when it is whole, and nothing is wrong with it."""
    partial = target.with_name(f".{target.name}.partial")
    if partial.exists():
        shutil.rmtree(partial)
    try:
        notes = write(partial)
        raise_errors(examine(partial) if examine else ())
        os.rename(partial, target)
    finally:
        if partial.exists():
            shutil.rmtree(partial)
    return notes


def refuse_for_round(checks: tuple[str, ...], region: tuple | None) -> None:
    """CaptureError (option-unusable) for what has a meaning for planes only."""
    if checks:
        remedy = "Views are held out by the setting hold_out when results are made"
        raise CaptureError(error("option-unusable", "check", "a turntable has no check lights", remedy=remedy))
    if region is not None:
        remedy = "Camera matrices count from the corner of the whole photograph"
        raise CaptureError(error("option-unusable", "roi", "photographs of a turntable are used whole", remedy=remedy))


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
    channels = channel_names(header)
    names, held = layout.lights.names, {layout.lights.index(name) for name in checks}
    rows = []
    for i, (photograph, file) in enumerate(zip(layout.photographs, file_names(layout.photographs), strict=True)):
        rows.append((take(photograph, folder / "frames" / file, link), "check" if i in held else "sample", names[i]))
    notes: list[Problem] = []
    if white:
        pairing = pair_by_name(layout.photographs, photographs_in(white), what="white boards", folder=str(white))
        notes += pairing.warnings
        for board, light in zip(pairing.partners, names, strict=True):
            rows.append((take(board, folder / "white" / board.name, link), "white", light))
    for photograph in photographs_in(dark) if dark else ():
        rows.append((take(photograph, folder / "dark" / photograph.name, link), "dark", ""))
    settings = {"format": FORMAT, "title": title or source.name, "geometry": "plane"}
    jpeg = header.kind == "jpeg"
    coding = encoding or ("srgb" if jpeg else "linear")
    settings["camera"] = {"channels": list(channels), "encoding": coding}
    settings["lights"] = {"file": "lights.lp", "kind": "position_mm" if layout.width_mm else "direction"}
    if layout.width_mm:
        settings["pixel_pitch_mm"] = float(f"{layout.width_mm / header.columns:.9g}")
    if layout.intensities is not None:
        settings["lights"]["intensities"] = "intensities.csv"
        _write_intensities(folder / "intensities.csv", layout, channels)
    if layout.mask is not None:
        settings["mask"] = take(layout.mask, folder / f"mask{layout.mask.suffix.lower()}", link)
    if region is not None:
        settings["region_of_interest"] = list(region)
    _write_tables(folder, settings, rows, layout.lights)
    return [*notes, *_notes(header.sample, jpeg, encoding, source)]


def _notes(sample: str, jpeg: bool, encoding: str | None, source: Path) -> list[Problem]:
    if encoding is None and sample == "uint8" and not jpeg:
        what = "8-bit photographs are taken to be linear"
        remedy = "Give the encoding srgb if the camera or a converter coded them for display"
        return [warning("encoding-assumed", source.name, what, remedy=remedy)]
    return []


def _write_tables(folder: Path, settings: dict, rows: list[tuple[str, str, str]], lights: Lights) -> None:
    text = "# Capture folder: see docs/capture-folder.md\n" + yaml.safe_dump(
        settings, sort_keys=False, allow_unicode=True
    )
    (folder / "capture.yaml").write_text(text, encoding="utf-8")
    table = "file,role,light\n" + "".join(",".join(_quoted(v) for v in row) + "\n" for row in rows)
    (folder / "frames.csv").write_text(table, encoding="utf-8")
    lines = (f"{name} {x:.9g} {y:.9g} {z:.9g}\n" for name, (x, y, z) in zip(lights.names, lights.vectors, strict=True))
    (folder / "lights.lp").write_text(f"{len(lights.names)}\n" + "".join(lines), encoding="utf-8")


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
