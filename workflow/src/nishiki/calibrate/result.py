"""Read the photographs of a calibration, and write its result: numbers, files for captures, and a page."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import yaml

from nishiki.artifacts.closed import merged
from nishiki.capture.layouts import photographs_in
from nishiki.capture.schema import read_mapping
from nishiki.capture.seal import sha256_of
from nishiki.capture.taking import settings_text
from nishiki.errors import UserError
from nishiki.formats.files import put_file, whole_folder
from nishiki.formats.images import read_header
from nishiki.report.page import Facts, Listing, Page, Section, render_page
from nishiki.version import PROJECT_VERSION


def list_photographs(names: Sequence[str], *, what: str = "photographs") -> list[Path]:
    """List files as given, folders replaced by their photographs in natural order, without masks.

    UserError where a name is no file, two are called alike, there is none, or sizes differ.
    """
    paths: list[Path] = []
    for name in names:
        path = Path(name)
        if path.is_dir():
            paths += photographs_in(path)
        elif path.is_file():
            paths.append(path)
        else:
            raise UserError(f"{name}: no such file or folder. Remedy: correct the path of the {what}")
    if not paths:
        raise UserError(f"{what}: expected at least one, found none")
    headers = [read_header(path) for path in paths]
    sizes = {(h.rows, h.columns, h.channels, h.sample) for h in headers}
    if len(sizes) > 1:
        raise UserError(
            f"{what}: expected one size, depth and number of channels, found "
            f"{'; '.join(f'{c} x {r}, {n} channels of {s}' for r, c, n, s in sorted(sizes))}. Remedy: give the "
            "photographs of one camera with one setting"
        )
    return paths


SATURATED_SHARE = 1e-3  # of the pixels of a level or patch that is used
NUMBERS, PAGE, LINES = "calibration.json", "calibration.html", "capture-lines.yaml"


@dataclass(frozen=True)
class Calibration:
    """Result of one calibration."""

    kind: str  # spheres, camera, target or geometry
    numbers: dict  # plain data, with uncertainties
    inputs: Sequence[Path]  # files that were read; their digests are kept
    lines: dict  # keys of capture.yaml and their values; names of files are those of `files`
    sections: Sequence[Section]  # of the page, with the pictures that show whether to trust it
    subtitle: str
    files: Mapping[str, str | bytes] = field(default_factory=dict)  # text or bytes by name, for a capture to use
    warnings: Sequence[str] = ()
    failure: str = ""  # why there is no result; the folder then holds the page and what was measured so far


def write_calibration(folder: Path, result: Calibration) -> None:
    """Write the folder, which must not exist; it appears whole or not at all."""
    if folder.exists():
        raise UserError(f"{folder} exists. Remedy: choose another folder; nothing is overwritten")
    digests = {str(path): sha256_of(path) for path in result.inputs}
    content = {
        "calibration": result.kind,
        "version": PROJECT_VERSION,
        **result.numbers,
        "warnings": list(result.warnings),
        "inputs_sha256": digests,
    }
    lines = yaml.safe_dump(result.lines, sort_keys=False, allow_unicode=True) if result.lines else ""
    page = Page(
        title=f"Calibration: {result.kind}",
        subtitle=result.subtitle,
        sections=[
            *result.sections,
            *([Section("lines", "For capture.yaml", [Listing(lines)])] if lines else []),
            Section("inputs", "Inputs", [Facts([(name, digest) for name, digest in digests.items()])]),
        ],
        version=PROJECT_VERSION,
        footer=f"Nishiki {PROJECT_VERSION}, calibration of {result.kind}. All numbers: {NUMBERS}.",
        warnings=[*([result.failure] if result.failure else []), *result.warnings],
    )
    with whole_folder(folder) as partial:
        partial.mkdir(parents=True)
        for name, data in result.files.items():
            (partial / name).write_bytes(data.encode() if isinstance(data, str) else data)
        (partial / NUMBERS).write_text(json.dumps(content, indent=2, allow_nan=False) + "\n", encoding="utf-8")
        (partial / PAGE).write_text(render_page(page), encoding="utf-8")
        if lines:
            (partial / LINES).write_text(lines, encoding="utf-8")


def put_into_capture(capture: Path, result: Calibration) -> None:
    """Write the lines and files of a calibration into an unsealed capture; comments of its file are lost.

    UserError where it is sealed, or a file of the same name lies there.
    """
    if (capture / "bagit.txt").exists():
        raise UserError(f"{capture} is sealed. Remedy: copy its data folder, and name the copy with --into")
    path = capture / "capture.yaml"
    settings = read_mapping(path)
    files = {name: data for name, data in result.files.items() if _names(result.lines, name)}
    for name in files:
        if (capture / name).exists():
            raise UserError(f"{capture / name} exists. Remedy: move it away; nothing is overwritten")
    text = settings_text(merged(settings, result.lines))
    for name, data in files.items():
        (capture / name).write_bytes(data.encode() if isinstance(data, str) else data)
    put_file(path, text)


def finite(value: float, digits: int = 6) -> float | None:
    """Round a number for JSON to significant digits; None where it is not finite."""
    value = float(value)
    return float(f"{value:.{digits}g}") if abs(value) < float("inf") else None


def _names(lines: object, name: str) -> bool:
    """Check whether lines of capture.yaml name a file."""
    return lines == name or (isinstance(lines, dict) and any(_names(each, name) for each in lines.values()))
