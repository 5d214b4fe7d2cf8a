"""Write recognised layouts of planes, turntables and tables of reflectances as capture folders."""

import re
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import repeat
from pathlib import Path
from typing import Any

import numpy as np

from nishiki.capture import taking
from nishiki.capture.frames import EXPOSURE_COLUMNS, SHIFT_COLUMNS, parse_state
from nishiki.capture.goniometer_tables import ReflectanceTable, is_table, read_table
from nishiki.capture.layouts import MASK_SUFFIXES, Layout, masks_in, natural_key, photographs_in, source_problems
from nishiki.capture.lights import Lights, rearrange
from nishiki.capture.options import NO_PHOTOGRAPHS, ConvertOptions, file_problems, folder_problems
from nishiki.capture.pairing import complete_bands, names_apart, pair_by_name, sort_bands
from nishiki.capture.registered import PictureIndex
from nishiki.capture.schema import FORMAT
from nishiki.capture.tables import LENS_COLUMNS, MATRIX_COLUMNS
from nishiki.capture.turntable_layouts import STATES, RoundLayout
from nishiki.formats.files import files_with
from nishiki.formats.masks import alpha_problems
from nishiki.formats.problems import CaptureError, Problem, expect_one, name_some, raise_errors, refuse, warning

FOLDERS = {"sample": "frames", "check": "frames"}
"""Folders of photographs whose role has no folder of its own."""
ORDER = ("file", "role", "view", "light", "polariser", "silhouette", "band", *EXPOSURE_COLUMNS, *SHIFT_COLUMNS)
"""Columns of frames.csv as they are written."""


def write_plane(folder: Path, layout: Layout, source: Path, options: ConvertOptions) -> list[Problem]:
    """Write the capture into a new folder; return notes for the user.

    Raises CaptureError: file-missing, light-unknown, and those of `pair_by_name` and of reading headers.
    """
    raise_errors(file_problems(mask=options.mask))
    unknown = [name for name in options.checks if layout.lights.find(name) is None]
    if unknown:
        what = f"no lamp {', '.join(unknown)} to keep for evaluation; there are {', '.join(layout.lights.names)}"
        refuse("light-unknown", str(source), what, remedy="Lamps are called as their photographs, without the suffix")
    lights, places = rearrange(layout.lights, options.lights_order, options.lights_axes)
    link, region, names = options.link, options.region or layout.region, lights.names
    folder.mkdir(parents=True)
    header = taking.usual_header(layout.photographs)
    of_file = taking.channel_names(header)
    of_band = {b: (b,) if len(of_file) == 1 else tuple(f"{name}_{b}" for name in of_file) for b in layout.bands}
    channels = tuple(name for part in of_band.values() for name in part) or of_file
    held = {layout.lights.find(name) for name in options.checks}
    roles = ["check" if i in held else "sample" for i in range(len(names))]
    chosen, notes = (_choose_bands if layout.bands else _choose_files)(layout, roles, options)
    rows = []
    same = Counter((FOLDERS.get(role, role), path.name) for path, role, *_ in chosen)
    for path, role, light, band in chosen:
        place = FOLDERS.get(role, role)
        name = path.name if same[place, path.name] == 1 else f"{path.parent.name}_{path.name}"
        cells = {"light": light, "band": "+".join(of_band.get(band, ()))}
        rows.append({"file": taking.take(path, folder / place / name, link), "role": role, **cells})
    settings: dict[str, Any] = {"format": FORMAT, "title": options.title or source.name, "geometry": "plane"}
    coding, doubts = taking.choose_encoding(header, options.encoding, source.name)
    notes += doubts
    settings["camera"] = {"channels": list(channels), "encoding": coding}
    settings["lights"] = {"file": "lights.lp", "kind": layout.kind}
    if options.lights_axes:
        settings["lights"]["axes_confirmed"] = True
    if pitch := options.width_mm / header.columns if options.width_mm else layout.pitch_mm:
        settings["pixel_pitch_mm"] = float(f"{pitch:.9g}")
    if layout.intensities is not None:
        settings["lights"]["intensities"] = "intensities.csv"
        _write_intensities(folder / "intensities.csv", names, layout.intensities[places], channels)
    if layout.mask is not None:
        settings["mask"], doubts = taking.take_mask(layout.mask, folder / f"mask{layout.mask.suffix.lower()}", link)
        notes += doubts
    elif not layout.files:
        notes += alpha_problems(layout.photographs[0])
        if several := masks_in(layout.photographs[0].parent):
            what, found = "several masks: none of them is used", name_some(path.name for path in several)
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
    if not layout.bands:
        notes += taking.state_exposures(folder, rows)
        if layout.shifts is not None:
            for i, row in enumerate(rows):
                shift = layout.shifts[i] if i < len(layout.shifts) else (0.0, 0.0)
                row |= {column: f"{v:.9g}" for column, v in zip(SHIFT_COLUMNS, shift, strict=True)}
    write_tables(folder, settings, rows, lights)
    return notes


Chosen = tuple[Path, str, str, str]
"""A file to include, its role, its lamp and its band."""


def _choose_files(layout: Layout, roles: list[str], options: ConvertOptions) -> tuple[list[Chosen], list[Problem]]:
    """Choose photographs, boards, dark and ambient frames."""
    chosen, notes = list(zip(layout.photographs, roles, layout.lights.names, repeat(""))), []
    if options.white:
        boards = photographs_in(options.white)
        pairing = pair_by_name(layout.photographs, boards, what="white boards", folder=str(options.white))
        chosen += zip(pairing.partners, repeat("white"), layout.lights.names, repeat(""))
        notes += pairing.warnings
    for role, given in (("dark", options.dark), ("ambient", options.ambient)):
        if given is not None:
            chosen += [(path, role, "", "") for path in (photographs_in(given) if given.is_dir() else [given])]
    return chosen, notes


def _choose_bands(layout: Layout, roles: list[str], options: ConvertOptions) -> tuple[list[Chosen], list[Problem]]:
    """Choose the same where each band has a file; dark frames without bands are those of every band.

    CaptureError: band-missing, those of `pair_by_name`.
    """
    names, bands, chosen = layout.lights.names, layout.bands, []

    def add(files: Iterable[Sequence[Path]], roles: Iterable[str], lights: Iterable[str]) -> None:
        for each, role, light in zip(files, roles, lights, strict=False):
            chosen.extend((path, role, light, band) for band, path in zip(bands, each, strict=True))

    add(layout.band_files, roles, names)
    if options.white:
        boards = _sorted_bands(options.white, bands)
        if boards is None:
            what, expected = "white boards have other bands than the photographs", ", ".join(bands)
            refuse("band-missing", str(options.white), what, expected=expected)
        lamps, pictures = ([Path(f"{name}.tif") for name in some] for some in (names, boards))
        partners = pair_by_name(lamps, pictures, what="white boards", folder=str(options.white)).partners
        files = complete_bands(bands, {path.stem: boards[path.stem] for path in partners}, str(options.white))
        add(files, repeat("white"), names)
    for role, given in (("dark", options.dark), ("ambient", options.ambient)):
        if given is not None:
            found = _sorted_bands(given, bands)
            add(complete_bands(bands, found, str(given)) if found else (), repeat(role), repeat(""))
            chosen += [(path, role, "", "") for path in (() if found else photographs_in(given))]
    return chosen, []


def _sorted_bands(folder: Path, bands: tuple[str, ...]) -> dict[str, dict[str, Path]] | None:
    """Sort the pictures of a folder by name and band; None where they do not have these bands."""
    return next(
        (found.files for found in sort_bands(folder, photographs_in) if set(found.channels) == set(bands)), None
    )


def write_tables(folder: Path, settings: dict, rows: Sequence[dict[str, str]], lights: Lights | None = None) -> None:
    """Write capture.yaml, frames.csv (without columns that are empty) and, of a plane, lights.lp."""
    (folder / "capture.yaml").write_text(taking.settings_text(settings), encoding="utf-8")
    columns = [column for column in ORDER if any(row.get(column) for row in rows)]
    lines = [columns, *([row.get(column, "") for column in columns] for row in rows)]
    (folder / "frames.csv").write_text(taking.table_text(lines), encoding="utf-8")
    if lights is not None:
        (folder / "lights.lp").write_text(taking.lights_text(lights.names, lights.vectors), encoding="utf-8")


def _write_intensities(path: Path, names: Sequence[str], values: np.ndarray, channels: tuple[str, ...]) -> None:
    if len(channels) == 1:
        values = values.mean(axis=1, keepdims=True)
    if values.shape[1] == 1:
        values = np.repeat(values, len(channels), axis=1)
    if values.shape[1] != len(channels):
        expected, found = f"{len(channels)} columns", f"{values.shape[1]}"
        refuse("intensities-invalid", "light intensities", "table", expected=expected, found=found)
    rows = ([n, *(f"{v:.9g}" for v in row)] for n, row in zip(names, values, strict=True))
    path.write_text(taking.table_text([("light", *channels), *rows]), encoding="utf-8")


def write_round(folder: Path, layout: RoundLayout, source: Path, options: ConvertOptions) -> list[Problem]:
    """Write the capture into a new folder; return notes for the user.

    The folder of silhouettes (`mask`) holds pictures named as the photographs; that of white boards, called by their
    polariser state (off, on, 45, 0_90) where there are states. Raises CaptureError (option-unusable, folder-missing,
    white-unnamed, those of `pair_by_name` and of reading headers).
    """
    options.refuse("Views of a turntable are held out by the setting hold_out when results are made", "checks")
    options.refuse("Camera matrices count from the corner of the whole photograph, so that it is used whole", "region")
    lamps = ("lights_kind", "lights_order", "lights_axes", "width_mm")
    options.refuse("What is converted has cameras and no lights file", *lamps)
    options.refuse("Light of the room is subtracted from flat objects only", "ambient")
    raise_errors(folder_problems(mask=options.mask))
    white, dark, link = options.white, options.dark, options.link
    folder.mkdir(parents=True)
    header = taking.usual_header(layout.photographs)
    outlines, notes = _match_silhouettes(layout, options.mask) if options.mask else ({}, ())
    notes = notes if options.mask else alpha_problems(layout.photographs[0])
    copies, masks = {}, tuple(dict.fromkeys(outlines.values()))
    for path, file in zip(masks, taking.file_names(masks), strict=True):
        copies[path], doubts = taking.take_mask(path, folder / "silhouettes" / file, link)
        notes = (*notes, *doubts)
    rows: list[dict[str, str]] = []
    for i, (photograph, file) in enumerate(zip(layout.photographs, taking.file_names(layout.photographs), strict=True)):
        outline = copies[outlines[photograph]] if photograph in outlines else ""
        cells = {"view": layout.views[i], "polariser": layout.states[i], "silhouette": outline}
        rows.append({"file": taking.take(photograph, folder / "frames" / file, link), "role": "sample", **cells})
    for board, state in _states_of(photographs_in(white), layout, str(white)) if white else ():
        rows.append(
            {"file": taking.take(board, folder / "white" / board.name, link), "role": "white", "polariser": state}
        )
    for photograph in photographs_in(dark) if dark else ():
        rows.append({"file": taking.take(photograph, folder / "dark" / photograph.name, link), "role": "dark"})
    coding, doubts = taking.choose_encoding(header, options.encoding, source.name, display=not any(layout.states))
    notes = (*notes, *doubts)
    block: dict = {}
    if layout.matrices is not None or layout.full_turn:
        block = {"full_turn": layout.full_turn, "unit": "arbitrary"}
        block |= {"unit": "mm", "height": options.height_mm} if options.height_mm else {}
    if layout.matrices is not None:
        block["cameras"] = "cameras.csv"
        block |= {"turn": options.turn} if options.turn else {}
        block |= {"camera_of": options.camera_of} if options.camera_of else {}
        columns, numbers = MATRIX_COLUMNS, layout.matrices.reshape(-1, 12)
        if layout.distortions is not None:
            columns, numbers = columns + LENS_COLUMNS, np.hstack([numbers, layout.distortions])
        # every digit that float64 has, so that reading gives the same matrices
        lines = ([v, *map(repr, n)] for v, n in zip(layout.views, numbers.tolist(), strict=True))
        (folder / "cameras.csv").write_text(taking.table_text([["view", *columns], *lines]), encoding="utf-8")
    if layout.calibration is not None:
        block["calibration"] = taking.take(layout.calibration, folder / layout.calibration.name, link)
    camera = {"channels": list(taking.channel_names(header)), "encoding": coding}
    settings = {"format": FORMAT, "title": options.title or source.name, "geometry": "turntable", "camera": camera}
    settings |= {"turntable": block} if block else {}
    doubts = taking.state_exposures(folder, rows)
    write_tables(folder, settings, rows)
    return [*notes, *doubts]


def _match_silhouettes(layout: RoundLayout, folder: Path) -> tuple[dict[Path, Path], tuple[Problem, ...]]:
    """Match a silhouette to each photograph, see `pair_by_name`.

    One view in many states has one picture. Where the folder has folders like those of the photographs, the silhouette
    has the same path, as COLMAP's `cam0/0000.png.png`.
    """
    present = sorted(files_with(folder, MASK_SUFFIXES), key=natural_key)
    below = PictureIndex(folder)
    nested = {} if present else {p: below.find(f"{p}.png") or below.find(str(p)) for p in layout.photographs}
    found = {photograph: path for photograph, path in nested.items() if path is not None}
    if found and len(set(found.values())) == len(layout.photographs):
        raise_errors(problem for path in found.values() for problem in source_problems(path, folder))
        return found, ()
    raise_errors(problem for path in present for problem in source_problems(path, folder))
    if len(present) == 1 and len(set(layout.views)) == 1:
        return {layout.photographs[0]: present[0]}, ()
    pairing = pair_by_name(layout.photographs, present, what="silhouettes", folder=str(folder))
    return dict(zip(layout.photographs, pairing.partners, strict=True)), pairing.warnings


def _states_of(boards: list[Path], layout: RoundLayout, folder: str) -> list[tuple[Path, str]]:
    """Assign white boards to polariser states.

    The state is the whole name, its end (`board_off`), or the part of the names that varies. A board whose name states
    none is the one without polarisers.

    CaptureError (white-unnamed) unless there is a board for every state, and at most one without.
    """
    known = set(layout.states) - {""}
    endings = []
    for stem in (p.stem for p in boards):  # the longest end after a separator that is a known state
        places = [0, *(match.end() for match in re.finditer(r"[^0-9A-Za-z.]+|(?<=[A-Za-z])(?=[0-9])", stem))]
        endings.append(next((stem[at:] for at in places if _state(stem[at:]) in known), stem))
    readings = ([p.stem for p in boards], endings, ["".join(map(str, part)) for part in names_apart(boards, folder)])
    for names in readings:
        states = [state if state in known else "" for state in map(_state, names)]
        if len(set(states)) == len(states) and set(states) - {""} in (known, set()):
            return list(zip(boards, states, strict=True))
    expected = f"one for each of the polariser states {', '.join(sorted(known))}" if known else "one"
    found = ", ".join(p.name for p in boards[:5])
    remedy = "Name each board by its state (off, on, 45, 0_90); keep one board where there are no states"
    what = "white boards cannot be assigned to polariser states"
    refuse("white-unnamed", folder, what, expected=expected, found=found, remedy=remedy)


def _state(name: str) -> str | None:
    """Return the polariser state that a name contains, 'G_A' being two angles; None where it contains none."""
    match = STATES.fullmatch(name)
    try:
        return parse_state(f"{match[1]}/{match[2]}" if match else name.casefold()).name
    except CaptureError:
        return None


@dataclass(frozen=True)
class MeasuredTable:
    """A table of reflectances in its file."""

    file: Path
    content: ReflectanceTable
    name = "table of reflectances"
    geometry = "goniometer"

    @property
    def warnings(self) -> tuple[Problem, ...]:
        """Tolerated faults of the table."""
        return self.content.warnings

    @property
    def channels(self) -> tuple[str, ...]:
        """Channels, in 1/sr."""
        return self.content.channels

    @property
    def count(self) -> int:
        """Number of the measurements."""
        return len(self.content.values)

    @property
    def parts(self) -> str:
        """Measurements and channels in words."""
        return f"{self.count} measurements, {len(self.channels)} channels"


def recognise_table(source: Path, options: ConvertOptions) -> Path | None:
    """Find the table of reflectances that the source is, or that lies in this folder without photographs.

    Raises CaptureError (layout-unknown) where a folder holds several.
    """
    if source.is_file():
        return source if is_table(source, named=True) else None
    if photographs_in(source):
        return None
    visible = (path for path in source.iterdir() if not path.name.startswith(".") and path.is_file())
    tables = sorted(path for path in visible if is_table(path))
    return expect_one(tables, source, "several tables of reflectances", f"Convert one: {next(iter(tables), '')}")


def read_measurements(source: Path, table: Path, options: ConvertOptions) -> MeasuredTable:
    """Read the table. Raises the CaptureErrors of `read_table`, and option-unusable."""
    options.refuse(NO_PHOTOGRAPHS, "lights_file", "lights_kind", "width_mm", "mask", "white", "dark", "ambient")
    options.refuse(NO_PHOTOGRAPHS, "checks", "encoding", "region")
    values, azimuths = options.values or "brdf", options.azimuths or "cloth"
    return MeasuredTable(table, read_table(table, table.name, values=values, azimuths=azimuths))


def write_table_capture(folder: Path, layout: MeasuredTable, source: Path, options: ConvertOptions) -> list[Problem]:
    """Copy the unchanged table into a new folder; return no notes."""
    table = layout.file
    folder.mkdir(parents=True)
    name = taking.take(table, folder / table.name, options.link)
    stated = {"values": options.values, "azimuths": options.azimuths}
    block = {"table": name} | {key: value for key, value in stated.items() if value}
    block |= {"symmetry": "unknown", "weave": "unknown"}
    settings = {"format": FORMAT, "title": options.title or table.stem, "geometry": "goniometer", "goniometer": block}
    (folder / "capture.yaml").write_text(taking.settings_text(settings), encoding="utf-8")
    return []
