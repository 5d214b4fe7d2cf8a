"""Commands that make, check and seal capture folders."""

import sys
from dataclasses import fields
from functools import partial
from pathlib import Path

import click

from nishiki.capture.options import ConvertOptions
from nishiki.commands.declare import apply, command, option
from nishiki.errors import UserError, printable
from nishiki.formats.problems import group_problems
from nishiki.progress import Progress

SHOWN = 8  # channels of a table that are listed
TO_COMPLETE = {
    "plane": "camera sensitivities, illuminant, pixel_pitch_mm",
    "turntable": "lights, turntable.mesh, turntable.unit, turntable.background",
    "goniometer": "goniometer.symmetry, goniometer.weave",
    "mosaic": "camera sensitivities, illuminant, pixel_pitch_mm, alike in each field",
}
convert_options = apply(
    *(
        option(each.metadata["spelling"], each.metadata["text"], each.name, **each.metadata["how"])
        for each in fields(ConvertOptions)
        if each.metadata
    )
)
"""Options of `convert`, which are fields of ConvertOptions; `run` takes them, too."""


@command(
    "check captures/altarpiece",
    "check captures/altarpiece --open     # with a page of all photographs beside their lamps",
)
@click.argument("captures", nargs=-1, required=True, help="capture folders")
@option("--quick", "read headers and tables only, not every pixel")
@option(
    "--open",
    "write and open a contact sheet: each photograph with its lamp as stated and as measured, the odd ones first",
    "open_page",
)
def check(captures: tuple[str, ...], quick: bool, open_page: bool) -> int:
    """List everything that is wrong with captures, in one pass."""
    return max(2 if examine(name, quick=quick, open_page=open_page) else 0 for name in captures)


def examine(name: str, *, quick: bool = False, open_page: bool = False) -> int:
    """Print what is wrong with a capture; the number of errors."""
    from nishiki.observations.check import check_capture

    judgements: list = []
    tell = Progress(f"check {name}").tell
    problems = check_capture(Path(name), level="quick" if quick else "full", progress=tell, judged=judgements.append)
    errors = sum(problem.severity == "error" for problem in problems)
    for problem in group_problems(problems):
        print(f"{name}: {problem.severity}: {problem}")
    warnings = len(problems) - errors
    print(f"{name}: {'cannot be used' if errors else 'usable'}, {errors} errors, {warnings} warnings")
    if open_page:
        _open_sheet(Path(name), problems, judgements)
    return errors


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


@command("seal captures/altarpiece")
@click.argument("captures", nargs=-1, required=True, help="capture folders")
def seal(captures: tuple[str, ...]) -> None:
    """Seal captures with a BagIt manifest (RFC 8493); their files move into data/."""
    for name in captures:
        print(f"{name}: sealed, digest {seal_folder(Path(name))[:12]}")


def seal_folder(capture: Path) -> str:
    """Seal a capture, or each unsealed field of a mosaic, and tell how far it is; its digest."""
    from nishiki.capture.folder import load_capture
    from nishiki.capture.mosaic import MosaicCapture, is_mosaic
    from nishiki.capture.seal import seal as seal_capture

    if is_mosaic(capture) and isinstance(mosaic := load_capture(capture), MosaicCapture):
        for each in mosaic.captures:
            if not each.sealed:
                seal_folder(each.root)
        return mosaic.digest
    return seal_capture(capture, progress=Progress(f"seal {capture}").tell)


@command(
    "convert my-photographs captures/altarpiece",
    "convert my-photographs captures/altarpiece --lights dome.lp --width-mm 320",
    "convert my-fields captures/wall --fields",
    "convert reflectances.csv captures/brocade",
    "convert old-photographs --list",
)
@click.argument(
    "source",
    help="folder of photographs with an .lp file, mirror balls, camera matrices, or polariser angles; a table of "
    "reflectances by direction (.csv, .brdf, .bin, .binary); or a relightable image (.ptm, .rti, a folder of relight), "
    "from which pictures are rendered",
)
@click.argument("capture", required=False, help="capture folder to make; must not exist")
@option(
    "--list", "say what each folder below the source is and whether it can be converted; nothing is made", "list_only"
)
@convert_options
@option("--unsealed", "do not seal yet: camera curves and the like will be added")
def convert(source: str, capture: str | None, list_only: bool, unsealed: bool, **given) -> None:
    """Turn photographs with their lamps or cameras, or a goniometer's table, into a sealed capture folder."""
    if list_only:
        _list(Path(source))
        return
    if capture is None:
        raise UserError("expected the capture folder to make, CAPTURE, or --list. Remedy: name it")
    made = convert_source(Path(source), Path(capture), given, checked=not unsealed)
    things = "measurements" if made.geometry == "goniometer" else "photographs"
    if made.channels:
        names = made.channels
        shown = names if len(names) <= SHOWN else (*names[: SHOWN - 1], "...", names[-1])
        print(f"{len(names)} channels, taken to be in 1/sr: {', '.join(shown)}")
    for problem in group_problems(made.warnings):
        print(f"warning: {problem}", file=sys.stderr)
    if unsealed:
        print(
            f"{made.folder}: {made.photographs} {things} ({made.layout}); not sealed: complete capture.yaml "
            f"({TO_COMPLETE[made.geometry]}; see docs/capture-folder.md), then ./nishiki seal {made.folder}"
        )
        return
    digest = seal_folder(Path(capture))
    print(f"{made.folder}: {made.photographs} {things} ({made.layout}), sealed, digest {digest[:12]}")


def convert_source(source: Path, capture: Path, given: dict, *, checked: bool):
    """Make a capture of a source with the values of `convert_options`; `nishiki.capture.convert.Conversion`.

    Raises CaptureError for what a check of the capture finds, where it is checked.
    """
    from nishiki.capture.convert import convert as convert_folder
    from nishiki.observations.check import check_capture

    paths = {name: Path(given[name]) for name in ("lights_file", "mask", "white", "dark", "ambient") if given[name]}
    turned = {}
    for pair in given["camera_of"].split(",") if given["camera_of"] else ():
        view, equals, camera = pair.partition("=")
        if not equals:
            expected = "expected VIEW=CAMERA,..."
            raise UserError(f"--camera-of: {expected}, found {pair!r}. Remedy: --camera-of 002=007,007=002")
        turned[view] = camera
    tell = Progress(f"check {capture}").tell
    examine = partial(check_capture, level="full", progress=tell) if checked else None
    return convert_folder(source, capture, ConvertOptions(**{**given, **paths, "camera_of": turned}, examine=examine))


def _list(archive: Path) -> None:
    """Print a line for each source below a folder: path, layout, parts, and why it cannot be converted."""
    from nishiki.capture.registry import list_archive

    if not archive.is_dir():
        raise UserError(f"{archive}: expected a folder to list. Remedy: correct the path")
    rows = [(*row[:3], row.reason or "can be converted") for row in list_archive(archive)]
    widths = [max((len(row[i]) for row in rows), default=0) for i in range(3)]
    for row in rows:
        cells = (f"{printable(cell):<{width}}" for cell, width in zip(row, (*widths, 0), strict=True))
        print("  ".join(cells).rstrip())
    print(f"{sum(row[3] == 'can be converted' for row in rows)} of {len(rows)} can be converted")
