"""A recognised turntable or polarisation series written as a capture folder."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from nishiki.capture.cameras import LENS_COLUMNS, MATRIX_COLUMNS
from nishiki.capture.layouts import MASK_SUFFIXES, natural_key, photographs_in, source_problems
from nishiki.capture.options import ConvertOptions, folder_problems
from nishiki.capture.pairing import names_apart, pair_by_name
from nishiki.capture.polariser import parse_state
from nishiki.capture.registered import Pictures
from nishiki.capture.schema_base import FORMAT
from nishiki.capture.taking import (
    channel_names,
    choose_encoding,
    file_names,
    read_exposures,
    settings_text,
    table_text,
    take,
    take_mask,
    usual_header,
)
from nishiki.capture.turntable_layouts import STATES, RoundLayout
from nishiki.formats.files import files_with
from nishiki.formats.masks import alpha_problems
from nishiki.formats.problems import CaptureError, Problem, error, raise_errors


def write_round(folder: Path, layout: RoundLayout, source: Path, options: ConvertOptions) -> list[Problem]:
    """Write the capture into a new folder; returns what the user should know.

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
    header = usual_header(layout.photographs)
    outlines, notes = _match_silhouettes(layout, options.mask) if options.mask else ({}, ())
    notes = notes if options.mask else alpha_problems(layout.photographs[0])
    copies, masks = {}, tuple(dict.fromkeys(outlines.values()))
    for path, file in zip(masks, file_names(masks), strict=True):
        copies[path], doubts = take_mask(path, folder / "silhouettes" / file, link)
        notes = (*notes, *doubts)
    rows = []
    for i, (photograph, file) in enumerate(zip(layout.photographs, file_names(layout.photographs), strict=True)):
        outline = copies.get(outlines.get(photograph), "")
        name = take(photograph, folder / "frames" / file, link)
        rows.append((name, "sample", layout.views[i], layout.states[i], outline))
    for board, state in _states_of(photographs_in(white), layout, str(white)) if white else ():
        rows.append((take(board, folder / "white" / board.name, link), "white", "", state, ""))
    for photograph in photographs_in(dark) if dark else ():
        rows.append((take(photograph, folder / "dark" / photograph.name, link), "dark", "", "", ""))
    coding, doubts = choose_encoding(header, options.encoding, source.name, display=not any(layout.states))
    notes = (*notes, *doubts)
    block: dict = {"full_turn": layout.full_turn, "unit": "arbitrary"} if layout.matrices is not None else {}
    if layout.matrices is not None:
        block["cameras"] = "cameras.csv"
        block |= {"turn": options.turn} if options.turn else {}
        block |= {"camera_of": options.camera_of} if options.camera_of else {}
        _write_cameras(folder / "cameras.csv", layout)
    if layout.calibration is not None:
        block["calibration"] = take(layout.calibration, folder / layout.calibration.name, link)
    camera = {"channels": list(channel_names(header)), "encoding": coding}
    settings = {"format": FORMAT, "title": options.title or source.name, "geometry": "turntable", "camera": camera}
    settings |= {"turntable": block} if block else {}
    (folder / "capture.yaml").write_text(settings_text(settings), encoding="utf-8")
    exposures, doubts = read_exposures(folder, rows)
    _write_frames(folder / "frames.csv", rows, exposures)
    return [*notes, *doubts]


def _match_silhouettes(layout: RoundLayout, folder: Path) -> tuple[dict[Path, Path], tuple[Problem, ...]]:
    """Silhouette of each photograph, see `pair_by_name`; of one view in many states, the only picture; where the folder
    has folders like those of the photographs, that of the same path, as COLMAP's `cam0/0000.png.png`."""
    present = sorted(files_with(folder, MASK_SUFFIXES), key=natural_key)
    below = Pictures(folder)
    nested = [] if present else [below.find(f"{p}.png") or below.find(str(p)) for p in layout.photographs]
    if nested and None not in nested and len(set(nested)) == len(nested):
        raise_errors(problem for path in nested for problem in source_problems(path, folder))
        return dict(zip(layout.photographs, nested, strict=True)), ()
    raise_errors(problem for path in present for problem in source_problems(path, folder))
    if len(present) == 1 and len(set(layout.views)) == 1:
        return {layout.photographs[0]: present[0]}, ()
    pairing = pair_by_name(layout.photographs, present, what="silhouettes", folder=str(folder))
    return dict(zip(layout.photographs, pairing.partners, strict=True)), pairing.warnings


def _states_of(boards: list[Path], layout: RoundLayout, folder: str) -> list[tuple[Path, str]]:
    """White boards with their polariser states: told by the whole name, by its end (`board_off`), or by the part of
    the names that varies. One whose name tells none is the board without polarisers.

    CaptureError (white-unnamed) unless there is a board for every state, and at most one without.
    """
    known = set(layout.states) - {""}
    readings = (
        [p.stem for p in boards],
        [_ending(p.stem, known) for p in boards],
        ["".join(map(str, part)) for part in names_apart(boards, folder)],
    )
    for names in readings:
        states = [state if state in known else "" for state in map(_state, names)]
        if len(set(states)) == len(states) and set(states) - {""} in (known, set()):
            return list(zip(boards, states, strict=True))
    expected = f"one for each of the polariser states {', '.join(sorted(known))}" if known else "one"
    found = ", ".join(p.name for p in boards[:5])
    remedy = "Name each board by its state (off, on, 45, 0_90); keep one board where there are no states"
    what = "white boards cannot be assigned to polariser states"
    raise CaptureError(error("white-unnamed", folder, what, expected=expected, found=found, remedy=remedy))


def _state(name: str) -> str | None:
    """Polariser state that a name tells, 'G_A' being two angles; None where it tells none."""
    match = STATES.fullmatch(name)
    try:
        return parse_state(f"{match[1]}/{match[2]}" if match else name.casefold()).name
    except CaptureError:
        return None


def _ending(stem: str, known: set[str]) -> str:
    """The longest end of a name, after a separator, that is a known state."""
    places = [0, *(match.end() for match in re.finditer(r"[^0-9A-Za-z.]+|(?<=[A-Za-z])(?=[0-9])", stem))]
    return next((stem[at:] for at in places if _state(stem[at:]) in known), stem)


def _write_cameras(path: Path, layout: RoundLayout) -> None:
    """Every digit that float64 has, so that reading gives the same matrices."""
    columns, numbers = MATRIX_COLUMNS, layout.matrices.reshape(-1, 12)
    if layout.distortions is not None:
        columns, numbers = columns + LENS_COLUMNS, np.hstack([numbers, layout.distortions])
    rows = [["view", *columns], *([v, *map(repr, n)] for v, n in zip(layout.views, numbers.tolist(), strict=True))]
    path.write_text(table_text(rows), encoding="utf-8")


def _write_frames(path: Path, rows: list[tuple[str, ...]], exposures: dict[str, list[str]]) -> None:
    """Write the table without the columns that are empty throughout."""
    names = ("file", "role", "view", "polariser", "silhouette")
    columns = dict(zip(names, zip(*rows, strict=True), strict=True)) | exposures
    kept = {name: cells for name, cells in columns.items() if name in names[:2] or any(cells)}
    path.write_text(table_text([list(kept), *zip(*kept.values(), strict=True)]), encoding="utf-8")
