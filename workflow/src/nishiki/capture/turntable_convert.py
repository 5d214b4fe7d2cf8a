"""A recognised turntable or polarisation series written as a capture folder."""

from __future__ import annotations

import csv
import io
from pathlib import Path

import yaml

from nishiki.capture.cameras import MATRIX_COLUMNS
from nishiki.capture.headers import ImageHeader, read_header
from nishiki.capture.layouts import photographs_in
from nishiki.capture.polariser import parse_state
from nishiki.capture.problems import CaptureError, Problem, error, warning
from nishiki.capture.schema import FORMAT
from nishiki.capture.taking import channel_names, file_names, take
from nishiki.capture.turntable_layouts import STATES, RoundLayout


def write_round(
    folder: Path,
    layout: RoundLayout,
    source: Path,
    *,
    silhouettes: Path | None,
    white: Path | None,
    dark: Path | None,
    encoding: str | None,
    title: str | None,
    link: bool,
) -> list[Problem]:
    """Write the capture into a new folder; returns what the user should know.

    silhouettes: folder of pictures named as the photographs; white, dark: folders of white boards, called by their
    polariser state (off, on, 45, 0_90) where there are states, and of dark frames. Raises CaptureError
    (silhouette-missing, white-unnamed, those of reading headers).
    """
    folder.mkdir(parents=True)
    header = read_header(layout.photographs[0])
    outlines = _match_silhouettes(layout, silhouettes) if silhouettes else {}
    taken = {path: take(path, folder / "silhouettes" / path.name, link) for path in set(outlines.values())}
    rows = []
    for i, (photograph, file) in enumerate(zip(layout.photographs, file_names(layout.photographs), strict=True)):
        outline = taken.get(outlines.get(photograph), "")
        name = take(photograph, folder / "frames" / file, link)
        rows.append((name, "sample", layout.views[i], layout.states[i], outline))
    for photograph in photographs_in(white) if white else ():
        state = _state_of(photograph, layout)
        rows.append((take(photograph, folder / "white" / photograph.name, link), "white", "", state, ""))
    for photograph in photographs_in(dark) if dark else ():
        rows.append((take(photograph, folder / "dark" / photograph.name, link), "dark", "", "", ""))
    coding = encoding or usual_encoding(header, series=any(layout.states))
    block: dict = {"full_turn": layout.full_turn, "unit": "arbitrary"} if layout.matrices is not None else {}
    if layout.matrices is not None:
        block["cameras"] = "cameras.csv"
        _write_cameras(folder / "cameras.csv", layout)
    if layout.calibration is not None:
        block["calibration"] = take(layout.calibration, folder / layout.calibration.name, link)
    camera = {"channels": list(channel_names(header)), "encoding": coding}
    settings = {"format": FORMAT, "title": title or source.name, "geometry": "turntable", "camera": camera}
    settings |= {"turntable": block} if block else {}
    text = "# Capture folder: see docs/capture-folder.md\n" + yaml.safe_dump(
        settings, sort_keys=False, allow_unicode=True
    )
    (folder / "capture.yaml").write_text(text, encoding="utf-8")
    _write_frames(folder / "frames.csv", rows)
    return _notes(header, coding, encoding, source)


def usual_encoding(header: ImageHeader, *, series: bool) -> str:
    """What such photographs are coded in: 8-bit pictures for display; measured states and more bits linearly."""
    return "srgb" if header.kind == "jpeg" or (header.sample == "uint8" and not series) else "linear"


def _notes(header: ImageHeader, coding: str, encoding: str | None, source: Path) -> list[Problem]:
    if encoding is None and header.sample == "uint8" and header.kind != "jpeg":
        what = "8-bit photographs are taken to be " + ("coded for display (sRGB)" if coding == "srgb" else "linear")
        remedy = "Give the encoding, linear or srgb, if it is the other one"
        return [warning("encoding-assumed", source.name, what, remedy=remedy)]
    return []


def _match_silhouettes(layout: RoundLayout, folder: Path) -> dict[Path, Path]:
    """Silhouette of each photograph, by its name without suffix; of one view in many states, the only picture."""
    if not folder.is_dir():
        remedy = "Give a folder of pictures named as the photographs"
        raise CaptureError(error("folder-missing", str(folder), "no such folder of silhouettes", remedy=remedy))
    suffixes = (".png", ".tif", ".tiff", ".jpg", ".jpeg")
    present = sorted(p for p in folder.iterdir() if p.suffix.lower() in suffixes)
    if len(present) == 1 and len(set(layout.views)) == 1:
        return {layout.photographs[0]: present[0]}
    by_stem = {p.stem.casefold(): p for p in present}
    missing = [p.name for p in layout.photographs if p.stem.casefold() not in by_stem]
    if missing:
        found = ", ".join(missing[:5])
        what, expected = "no silhouette for some photographs", "a picture of the same name for each"
        raise CaptureError(error("silhouette-missing", str(folder), what, expected=expected, found=found))
    return {p: by_stem[p.stem.casefold()] for p in layout.photographs}


def _state_of(photograph: Path, layout: RoundLayout) -> str:
    """Polariser state that a white board's file name tells; '' where it tells none, as for a board without one."""
    match = STATES.fullmatch(photograph.stem)
    try:
        state = parse_state(f"{match[1]}/{match[2]}" if match else photograph.stem.casefold()).name
    except CaptureError:
        return ""
    return state if state in layout.states else ""


def _write_cameras(path: Path, layout: RoundLayout) -> None:
    """Every digit that float64 has, so that reading gives the same matrices."""
    rows = [["view", *MATRIX_COLUMNS]]
    rows += [[v, *map(repr, m.ravel().tolist())] for v, m in zip(layout.views, layout.matrices, strict=True)]
    _write_csv(path, rows)


def _write_frames(path: Path, rows: list[tuple[str, ...]]) -> None:
    """The table without the columns that are empty throughout."""
    names = ("file", "role", "view", "polariser", "silhouette")
    kept = [i for i in range(len(names)) if i < 2 or any(row[i] for row in rows)]
    _write_csv(path, [[names[i] for i in kept], *([row[i] for i in kept] for row in rows)])


def _write_csv(path: Path, rows: list) -> None:
    buffer = io.StringIO()
    csv.writer(buffer, lineterminator="\n").writerows(rows)
    path.write_text(buffer.getvalue(), encoding="utf-8")
