"""A recognised layout of a flat object's photographs, written as a capture folder."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np

from nishiki.capture.bands import complete_bands, sort_bands
from nishiki.capture.frames import SHIFT_COLUMNS
from nishiki.capture.layouts import Layout, masks_in, photographs_in
from nishiki.capture.lights import Lights, rearrange
from nishiki.capture.options import ConvertOptions, file_problems
from nishiki.capture.pairing import pair_by_name
from nishiki.capture.schema_base import FORMAT
from nishiki.capture.taking import (
    channel_names,
    choose_encoding,
    file_names,
    lights_text,
    read_exposures,
    settings_text,
    table_text,
    take,
    take_mask,
    usual_header,
)
from nishiki.formats.masks import alpha_problems
from nishiki.formats.problems import CaptureError, Problem, error, raise_errors, warning


def write_plane(folder: Path, layout: Layout, source: Path, options: ConvertOptions) -> list[Problem]:
    """Write the capture into a new folder; returns what the user should know.

    Raises CaptureError: file-missing, light-unknown, and those of `pair_by_name` and of reading headers.
    """
    raise_errors(file_problems(mask=options.mask))
    unknown = [name for name in options.checks if layout.lights.index(name) is None]
    if unknown:
        expected, found = f"one of {', '.join(layout.lights.names)}", ", ".join(unknown)
        what = "no such light to keep for evaluation"
        remedy = "The names of the lamps are those of their photographs, without the suffix"
        raise CaptureError(error("light-unknown", str(source), what, expected=expected, found=found, remedy=remedy))
    lights, places = rearrange(layout.lights, options.lights_order, options.lights_axes)
    strengths = None if layout.intensities is None else layout.intensities[places]
    layout = replace(layout, lights=lights, intensities=strengths)
    link, region = options.link, options.region or layout.region
    folder.mkdir(parents=True)
    header = usual_header(layout.photographs)
    channels = layout.bands or channel_names(header)
    names, held = layout.lights.names, {layout.lights.index(name) for name in options.checks}
    rows: list[tuple[str, ...]] = []
    notes: list[Problem] = []
    if layout.bands:
        rows = _take_bands(folder, layout, held, options)
    else:
        for i, (photograph, file) in enumerate(zip(layout.photographs, file_names(layout.photographs), strict=True)):
            name = take(photograph, folder / "frames" / file, link)
            rows.append((name, "check" if i in held else "sample", names[i]))
    if options.white and not layout.bands:
        boards = photographs_in(options.white)
        pairing = pair_by_name(layout.photographs, boards, what="white boards", folder=str(options.white))
        notes += pairing.warnings
        for board, light in zip(pairing.partners, names, strict=True):
            rows.append((take(board, folder / "white" / board.name, link), "white", light))
    for role, given in (("dark", options.dark), ("ambient", options.ambient)):
        if given is not None and not layout.bands:
            for photograph in photographs_in(given) if given.is_dir() else [given]:
                rows.append((take(photograph, folder / role / photograph.name, link), role, ""))
    settings = {"format": FORMAT, "title": options.title or source.name, "geometry": "plane"}
    coding, doubts = choose_encoding(header, options.encoding, source.name)
    notes += doubts
    settings["camera"] = {"channels": list(channels), "encoding": coding}
    settings["lights"] = {"file": "lights.lp", "kind": layout.kind}
    if pitch := options.width_mm / header.columns if options.width_mm else layout.pitch_mm:
        settings["pixel_pitch_mm"] = float(f"{pitch:.9g}")
    if layout.intensities is not None:
        settings["lights"]["intensities"] = "intensities.csv"
        _write_intensities(folder / "intensities.csv", layout, channels)
    if layout.mask is not None:
        settings["mask"], doubts = take_mask(layout.mask, folder / f"mask{layout.mask.suffix.lower()}", link)
        notes += doubts
    elif not layout.files:
        notes += alpha_problems(layout.photographs[0])
        if several := masks_in(layout.photographs[0].parent):
            what, found = "several masks: none of them is used", ", ".join(path.name for path in several[:5])
            notes.append(
                warning("mask-several", source.name, what, found=found, remedy="Give the right one with --mask")
            )
    for name, content in layout.files.items():
        (folder / name).write_bytes(content)
        if name == "mask.png":
            settings["mask"] = name
    if layout.notes:
        settings["notes"] = layout.notes
    if region is not None:
        settings["region_of_interest"] = list(region)
    exposures, remarks = ({}, []) if layout.bands else read_exposures(folder, rows)
    further = dict(exposures)
    if layout.shifts is not None and not layout.bands:
        shifts = np.zeros((len(rows), 2))
        shifts[: len(layout.shifts)] = layout.shifts
        further |= {c: [f"{v:.9g}" for v in values] for c, values in zip(SHIFT_COLUMNS, shifts.T, strict=True)}
    write_tables(folder, settings, rows, layout.lights, further)
    return [*notes, *remarks]


def _take_bands(folder: Path, layout: Layout, held: set[int | None], options: ConvertOptions) -> list[tuple[str, ...]]:
    """Take photographs of a file a band, their boards, dark and ambient frames; returns rows (file, role, light, band).

    Dark frames without bands are those of every band. CaptureError: band-missing, those of `pair_by_name`.
    """
    names, bands = layout.lights.names, layout.bands
    chosen = [
        (path, "check" if i in held else "sample", names[i], band)
        for i, files in enumerate(layout.band_files)
        for band, path in zip(bands, files, strict=True)
    ]
    if options.white:
        boards = _sorted_bands(options.white, bands)
        if boards is None:
            what, expected = "white boards have other bands than the photographs", ", ".join(bands)
            raise CaptureError(error("band-missing", str(options.white), what, expected=expected))
        lamps, pictures = ([Path(f"{name}.tif") for name in some] for some in (names, boards))
        partners = pair_by_name(lamps, pictures, what="white boards", folder=str(options.white)).partners
        files = complete_bands(bands, {path.stem: boards[path.stem] for path in partners}, str(options.white))
        for light, board in zip(names, files, strict=True):
            chosen += [(path, "white", light, band) for band, path in zip(bands, board, strict=True)]
    for role, given in (("dark", options.dark), ("ambient", options.ambient)):
        if given is None:
            continue
        found = _sorted_bands(given, bands)
        for files in complete_bands(bands, found, str(given)) if found else ():
            chosen += [(path, role, "", band) for band, path in zip(bands, files, strict=True)]
        chosen += [(path, role, "", "") for path in (() if found else photographs_in(given))]
    same = Counter((role, path.name) for path, role, _, _ in chosen)
    rows = []
    for path, role, light, band in chosen:
        name = path.name if same[role, path.name] == 1 else f"{path.parent.name}_{path.name}"
        place = folder / ("frames" if role in ("sample", "check") else role) / name
        rows.append((take(path, place, options.link), role, light, band))
    return rows


def _sorted_bands(folder: Path, bands: tuple[str, ...]) -> dict[str, dict[str, Path]] | None:
    """The pictures of a folder by name and band; None where they do not have these bands."""
    return next(
        (found.files for found in sort_bands(folder, photographs_in) if set(found.channels) == set(bands)), None
    )


def write_tables(
    folder: Path,
    settings: dict,
    rows: list[tuple[str, ...]],
    lights: Lights,
    further: dict[str, list[str]] | None = None,
) -> None:
    """Write capture.yaml, lights.lp and frames.csv.

    rows: file, role, light and, where each has a file, band; further: cells of further columns.
    """
    (folder / "capture.yaml").write_text(settings_text(settings), encoding="utf-8")
    further = further or {}
    columns = ("file", "role", "light", "band")[: len(rows[0])]
    lines = [(*columns, *further), *zip(*zip(*rows, strict=True), *further.values(), strict=True)]
    (folder / "frames.csv").write_text(table_text(lines), encoding="utf-8")
    (folder / "lights.lp").write_text(lights_text(lights), encoding="utf-8")


def _write_intensities(path: Path, layout: Layout, channels: tuple[str, ...]) -> None:
    values = layout.intensities
    if len(channels) == 1:
        values = values.mean(axis=1, keepdims=True)
    if values.shape[1] == 1:
        values = np.repeat(values, len(channels), axis=1)
    if values.shape[1] != len(channels):
        expected, found = f"{len(channels)} columns", f"{values.shape[1]}"
        raise CaptureError(error("intensities-invalid", "light intensities", "table", expected=expected, found=found))
    rows = ([n, *(f"{v:.9g}" for v in row)] for n, row in zip(layout.lights.names, values, strict=True))
    path.write_text(table_text([("light", *channels), *rows]), encoding="utf-8")
