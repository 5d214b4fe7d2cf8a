"""Commands that make and check capture folders."""

import argparse
import sys
from functools import partial
from pathlib import Path

from nishiki.errors import UserError, printable
from nishiki.formats.problems import group_problems
from nishiki.progress import Progress

SHOWN = 8  # channels of a table that are listed
TO_COMPLETE = {
    "plane": "camera sensitivities, illuminant, pixel_pitch_mm",
    "turntable": "lights, turntable.mesh, turntable.unit, turntable.background",
    "goniometer": "goniometer.symmetry, goniometer.weave",
}


def check(options: argparse.Namespace, rest: list[str]) -> int:
    """Print everything that is wrong with each capture; exit status 2 where one cannot be used."""
    from nishiki.observations.check import check_capture

    worst = 0
    for name in options.captures:
        judgements: list = []
        problems = check_capture(
            Path(name),
            level="quick" if options.quick else "full",
            progress=Progress(f"check {name}").tell,
            judged=judgements.append,
        )
        errors = [problem for problem in problems if problem.severity == "error"]
        for problem in group_problems(problems):
            print(f"{name}: {problem.severity}: {problem}")
        warnings = len(problems) - len(errors)
        print(f"{name}: {'usable' if not errors else 'cannot be used'}, {len(errors)} errors, {warnings} warnings")
        if options.open:
            _open_sheet(Path(name), problems, judgements)
        worst = max(worst, 2 if errors else 0)
    return worst


def _open_sheet(capture: Path, problems: list, judgements: list) -> None:
    """Write the contact sheet beside the capture, and open it."""
    import webbrowser

    from nishiki.report.contact_sheet import contact_sheet

    if not judgements:
        print(f"{capture}: no contact sheet: compared are photographs of a plane, without --quick")
        return
    page = capture.resolve().with_name(f"{capture.resolve().name}-check.html")
    page.write_text(contact_sheet(judgements[0], problems, capture.resolve().name), encoding="utf-8")
    print(f"{capture}: contact sheet {page}")
    webbrowser.open(page.as_uri())


def seal(options: argparse.Namespace, rest: list[str]) -> None:
    """Seal captures: BagIt manifests with SHA-256; the files move into data/."""
    from nishiki.capture.seal import seal as seal_capture

    for name in options.captures:
        progress = Progress(f"seal {name}")
        digest = seal_capture(Path(name), progress=progress.tell)
        print(f"{name}: sealed, digest {digest[:12]}")


def convert(options: argparse.Namespace, rest: list[str]) -> None:
    """Make a sealed capture from photographs and lights, or cameras, or polariser states; the sources are only read."""
    from nishiki.capture.convert import convert as convert_folder
    from nishiki.capture.options import ConvertOptions
    from nishiki.capture.seal import seal as seal_capture
    from nishiki.observations.check import check_capture

    if options.list:
        _list(Path(options.source))
        return
    if options.capture is None:
        raise UserError("convert: expected the capture folder to make, CAPTURE, or --list. Remedy: name it")
    progress = Progress(f"check {options.capture}")
    given = ConvertOptions(
        lights_file=_path(options.lights),
        lights_kind=options.lights_kind,
        lights_order=options.lights_order,
        lights_axes=options.lights_axes,
        width_mm=options.width_mm,
        mask=_path(options.mask),
        white=_path(options.white),
        dark=_path(options.dark),
        ambient=_path(options.ambient),
        checks=tuple(options.check or ()),
        encoding=options.encoding,
        title=options.title,
        region=tuple(options.roi) if options.roi else None,
        values=options.values,
        azimuths=options.azimuths,
        turn=options.turn,
        camera_of=dict(_camera_of(pair) for pair in options.camera_of.split(",")) if options.camera_of else {},
        link=options.link,
        examine=None if options.open else partial(check_capture, level="full", progress=progress.tell),
    )
    made = convert_folder(Path(options.source), Path(options.capture), given)
    things = "measurements" if made.geometry == "goniometer" else "photographs"
    if made.channels:
        shown = (
            made.channels if len(made.channels) <= SHOWN else (*made.channels[: SHOWN - 1], "...", made.channels[-1])
        )
        print(f"{len(made.channels)} channels, taken to be in 1/sr: {', '.join(shown)}")
    for problem in group_problems(made.warnings):
        print(f"warning: {problem}", file=sys.stderr)
    if options.open:
        print(
            f"{made.folder}: {made.photographs} {things} ({made.layout}); not sealed: complete capture.yaml "
            f"({TO_COMPLETE[made.geometry]}; see docs/capture-folder.md), then ./nishiki seal {made.folder}"
        )
        return
    digest = seal_capture(Path(options.capture), progress=Progress(f"seal {options.capture}").tell)
    print(f"{made.folder}: {made.photographs} {things} ({made.layout}), sealed, digest {digest[:12]}")


def _list(archive: Path) -> None:
    """Print a line for each source below a folder: path, layout, parts, and why it cannot be converted."""
    from nishiki.capture.archive_list import list_archive

    if not archive.is_dir():
        raise UserError(f"{archive}: expected a folder to list. Remedy: correct the path")
    rows = [(*row[:3], row.reason or "can be converted") for row in list_archive(archive)]
    widths = [max((len(row[i]) for row in rows), default=0) for i in range(3)]
    for row in rows:
        cells = (f"{printable(cell):<{width}}" for cell, width in zip(row, (*widths, 0), strict=True))
        print("  ".join(cells).rstrip())
    print(f"{sum(row[3] == 'can be converted' for row in rows)} of {len(rows)} can be converted")


def _camera_of(pair: str) -> tuple[str, str]:
    view, equals, camera = pair.partition("=")
    if not equals:
        raise UserError(f"--camera-of: expected VIEW=CAMERA,..., found {pair!r}. Remedy: --camera-of 002=007,007=002")
    return view, camera


def _path(text: str | None) -> Path | None:
    return Path(text) if text else None
