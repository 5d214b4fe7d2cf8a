"""Commands that make, check and seal capture folders, and those of a capture rig."""

import functools
import os
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import fields
from functools import partial
from pathlib import Path
from typing import Any

import click

from nishiki.capture.options import ConvertOptions
from nishiki.commands.declare import Group, apply, command, option
from nishiki.errors import UserError, printable
from nishiki.formats.problems import group_problems, name_some
from nishiki.installation import COMMAND
from nishiki.progress import Progress

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
        from nishiki.capture.convert import list_archive

        archive = Path(source)
        if not archive.is_dir():
            raise UserError(f"{archive}: expected a folder to list. Remedy: correct the path")
        rows = [(*row[:3], row.reason or "can be converted") for row in list_archive(archive)]
        widths = [max((len(row[i]) for row in rows), default=0) for i in range(3)]
        for row in rows:
            cells = (f"{printable(cell):<{width}}" for cell, width in zip(row, (*widths, 0), strict=True))
            print("  ".join(cells).rstrip())
        print(f"{sum(row[3] == 'can be converted' for row in rows)} of {len(rows)} can be converted")
        return
    if capture is None:
        raise UserError("expected the capture folder to make, CAPTURE, or --list. Remedy: name it")
    made = convert_source(Path(source), Path(capture), given, checked=not unsealed)
    things = "measurements" if made.geometry == "goniometer" else "photographs"
    if made.channels:
        print(f"{len(made.channels)} channels, taken to be in 1/sr: {name_some(made.channels)}")
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


NOTHING_CONNECTED = """\
no serial device on USB and no camera found. What helps:
  a serial device   plug in its USB cable and switch it on; a container or virtual machine must be given the device
  a camera          switch it on and wake it up, set its USB mode to PTP, unmount it in the file manager
  neither           simulated devices need no hardware: ./nishiki demo --rig"""


@click.group(
    "rig",
    cls=Group,
    epilog=f"""\
  1. {COMMAND} rig ports              lists serial ports and cameras
  2. write rig.yaml, which names the devices of your rig:

       camera: {{kind: gphoto}}
       lamps: {{kind: dome, port: /dev/serial/by-id/usb-1a86_USB_Serial-if00-port0, count: 64}}
       axes:
         turntable: {{kind: comxim, port: /dev/ttyUSB0}}

  3. {COMMAND} rig test rig.yaml      moves every device once
  4. write plan.yaml (docs/rig.md), then

       {COMMAND} rig plan plan.yaml                          the frames, their time and size
       {COMMAND} rig run rig.yaml plan.yaml captures/NAME    takes, checks and seals them

Kinds of devices, their wiring and their keys, and devices of your own: docs/devices/README.md. Without hardware:
{COMMAND} demo --rig""",
)
def rig() -> None:
    """Take the photographs of a capture with cameras, lamps, turntables and goniometers."""


@rig.command(examples=("rig ports",))
def ports() -> None:
    """List what is connected: serial ports with vendor and product, cameras."""
    from nishiki.installation import install_extras, is_installed
    from nishiki.rig.description import camera_ports, serial_ports

    on_usb, others = serial_ports()
    on_usb += camera_ports()
    for line in on_usb + others:
        print(line)
    if not on_usb:
        print(NOTHING_CONNECTED)
    if not is_installed("gphoto2"):
        print(f"cameras are not listed: gphoto2 is not installed. Remedy: {install_extras('rig')}", file=sys.stderr)


@rig.command(examples=("rig plan plan.yaml", "rig plan plan.yaml --table frames.tsv"))
@click.argument("plan_file", metavar="PLAN", type=Path, help="plan of a dome, turntable or goniometer (YAML)")
@option("--table FRAMES.tsv", "save the table there, to be edited", type=Path)
def plan(plan_file: Path, table: Path | None) -> None:
    """Print the table of frames that a plan expands to, with duration and size."""
    from nishiki.rig.frames_table import summary, table_text
    from nishiki.rig.plan import read_plan

    frames = read_plan(plan_file).frames()
    folder = table.parent if table else Path()
    text = table_text(frames, os.path.relpath(plan_file, folder))
    if table:
        folder.mkdir(parents=True, exist_ok=True)
        table.write_text(text, encoding="utf-8")
        print(f"{table}: edit it as you like, then ./nishiki rig run RIG.yaml {table} CAPTURE")
    else:
        print(text, end="")
    print(summary(frames, folder))


@rig.command(examples=("rig run rig.yaml plan.yaml captures/altarpiece --page",))
@click.argument("rig_file", metavar="RIG", type=Path, help="description of the rig (YAML)")
@click.argument("plan_file", metavar="PLAN", type=Path, help="plan (YAML), or a table of `rig plan --table` (.tsv)")
@click.argument("capture", type=Path, help="capture folder to make, or to go on with")
@option(
    "--page [PORT]",
    "show the progress on a page for the browsers of this computer (default port 8377; 0: any that is free)",
    type=int,
    flag_value=8377,
    is_flag=False,
)
@option("--dry-run", "print what would be taken; nothing moves")
def run(rig_file: Path, plan_file: Path, capture: Path, page: int | None, dry_run: bool) -> None:
    """Take the photographs of a plan, or go on where an earlier run stopped; they are checked and sealed."""
    from nishiki.rig.run import describe_run, run_capture

    if dry_run:
        print(describe_run(rig_file, plan_file, capture))
        return
    state = _teller(str(capture))
    if page is None:
        digest = run_capture(rig_file, plan_file, capture, observer=state)
    else:
        from nishiki.rig.live_page import serve

        with serve(state, capture.name, page) as address:
            print(f"rig run {capture}: {address} shows how far it is", file=sys.stderr, flush=True)
            digest = run_capture(rig_file, plan_file, capture, observer=state)
    print(f"{capture}: complete, checked and sealed, digest {digest[:12]}")


def _teller(capture: str) -> Any:
    """Return a function that prints the progress of a run, and what is repeated and why."""
    from nishiki.progress import Progress
    from nishiki.rig.frames_table import duration
    from nishiki.rig.records import REPEATED, RunState, why

    class Teller(RunState):
        progress = Progress(f"rig run {capture}")

        def record_event(self, event: dict) -> None:
            super().record_event(event)
            if event["event"] == "frame":
                left = duration(self.seconds_left())
                self.progress(len(self.kept), len(self.frames), f"{event['file']}, {left} left")
            elif event["event"] in REPEATED:
                text = f"{event['file']} is taken again: {why(event)}"
                print(f"rig run {capture}: {text}", file=sys.stderr, flush=True)

    return Teller()


@rig.command(examples=("rig test rig.yaml",))
@click.argument("rig_file", metavar="RIG", type=Path, help="description of the rig (YAML)")
def test(rig_file: Path) -> int:
    """Move every device of a rig once and take one photograph; exit status 2 if one fails."""
    from nishiki.rig.description import open_rig
    from nishiki.rig.device import DeviceError

    failures = 0
    with open_rig(rig_file) as opened:
        checks: dict[str, Callable[[], str]] = {}
        if opened.lamps is not None:
            checks["lamps"] = lambda: _try_lamps(opened.lamps)
        for name, axis in opened.axes.items():
            checks[f"axis {name}"] = functools.partial(_try_axis, axis)
        for name, polariser in opened.polarisers.items():
            checks[f"polariser {name}"] = functools.partial(_try_polariser, polariser)
        checks["camera"] = lambda: _try_camera(opened.camera, opened.lamps)
        for name, check in checks.items():
            start = time.monotonic()
            try:
                print(f"{name}: {check()} ({time.monotonic() - start:.1f} s)", flush=True)
            except DeviceError as error:
                failures += 1
                print(f"{name}: FAILED: {error}", flush=True)
    print(f"{rig_file}: {'every device works' if not failures else f'{failures} of {len(checks)} devices failed'}")
    return 2 if failures else 0


def _try_lamps(lamps: Any) -> str:
    for number in range(1, lamps.count + 1):
        lamps.light(number)
    lamps.light(None)
    return f"{lamps.count} lit one after the other, then switched off"


def _try_axis(axis: Any) -> str:
    axis.home()
    low, high = axis.range_deg
    target = low + (high - low) / 12
    axis.move_to(target)
    axis.move_to(low)
    unit = "mm" if getattr(axis, "straight", False) else "degrees"
    return f"homed, moved to {target:g} and back to {low:g} {unit}"


def _try_polariser(polariser: Any) -> str:
    for state in polariser.states:
        polariser.set(state)
    return f"put into {', '.join(polariser.states)}"


def _try_camera(camera: Any, lamps: Any) -> str:
    from nishiki.rig.device import Exposure

    if lamps is not None:
        lamps.light(1)
    taken = camera.configure(Exposure())
    with tempfile.TemporaryDirectory() as folder:
        files = camera.photograph(Path(folder))
        named = ", ".join(f"{file.name} ({file.stat().st_size / 1e6:.1f} MB)" for file in files)
    if lamps is not None:
        lamps.light(None)
    facts = {"s": taken.seconds, "f-number": taken.aperture, "ISO": taken.iso}
    known = ", ".join(f"{value:g} {unit}" for unit, value in facts.items() if value is not None)
    return f"photographed {named}{f' with {known}' if known else ''}"
