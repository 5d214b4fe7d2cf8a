"""The command line: one parser, each command in a function that imports what it needs."""

import argparse
import sys

from nishiki.capture.options import LIGHT_KINDS
from nishiki.errors import UserError, of_the_machine
from nishiki.installation import COMMAND, INSTALLED
from nishiki.version import PROJECT_VERSION

DESCRIPTION = f"""\
From photographs under controlled light to the appearance of an object, with provenance.

first steps:
  {COMMAND} demo                              simulate a painting, digitise it, write the report
  {COMMAND} convert photographs/ captures/x   turn a folder of photographs, with its lights or cameras, into a capture
  {COMMAND} check captures/x                  everything that is wrong with a capture, in one pass
  {COMMAND} run                               make what config/config.yaml and config/scenes.tsv ask for
"""


def main(arguments: list[str] | None = None) -> None:
    """Parse and run. Exit status 0: done; 1: a stage failed or damage was found; 2: bad input, told in one line."""
    parser = _parser()
    options, rest = parser.parse_known_args(arguments)
    if rest and options.command not in ("run", "sweep", "demo", "test", "simulate"):
        parser.error(f"unknown arguments: {' '.join(rest)}")
    if not hasattr(options, "call"):
        parser.print_help()
        raise SystemExit(2)
    try:
        raise SystemExit(options.call(options, rest) or 0)
    except UserError as error:
        # Remedies name the launcher of a checkout; an installed package has the command instead.
        message = str(error).replace("./nishiki ", f"{COMMAND} ")
        print(f"nishiki {options.command}: {message}", file=sys.stderr)
        raise SystemExit(2) from None
    except BrokenPipeError:
        raise SystemExit(0) from None
    except KeyboardInterrupt:
        print(f"nishiki {options.command}: interrupted", file=sys.stderr)
        raise SystemExit(130) from None
    except OSError as error:
        message = of_the_machine(error)
        if message is None:
            raise
        print(f"nishiki {options.command}: {message}", file=sys.stderr)
        raise SystemExit(2) from None


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="nishiki",
        description=DESCRIPTION,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    parser.add_argument("--version", action="version", version=f"nishiki {PROJECT_VERSION}")
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", title="commands")

    def command(name: str, function: str, text: str, **options) -> argparse.ArgumentParser:
        sub = commands.add_parser(name, help=text, description=text, allow_abbrev=False, **options)
        sub.set_defaults(call=lambda options, rest: _call(function, options, rest))
        return sub

    sub = command("demo", "running:demo", "simulate a painting, run the whole workflow on it, name the report")
    which = sub.add_mutually_exclusive_group()
    which.add_argument("--object", action="store_true", help="an object on a turntable in place of the painting")
    which.add_argument("--cloth", action="store_true", help="a satin on a gonioreflectometer in place of the painting")
    text = "photograph the painting once more through a simulated dome, and digitise that capture (needs the extra rig)"
    which.add_argument("--rig", action="store_true", help=text)
    where = " (only in a checkout of the project)" if INSTALLED else ""
    sub = command("test", "running:test", f"run the tests{where}; further arguments go to pytest")
    tier = sub.add_mutually_exclusive_group()
    tier.add_argument("--quick", action="store_true", help="without the tests that are marked slow or long")
    tier.add_argument("--long", action="store_true", help="also much fuzzing, faults, Slurm and many scenes")
    sub = command("run", "running:run", "make everything that the configuration asks for; further arguments: snakemake")
    sub.add_argument("--configfile", default="config/config.yaml", help="configuration (default %(default)s)")
    text = "processors to use (default: all; on a cluster: as many as are allocated)"
    sub.add_argument("--cores", type=_cores, help=text)
    sub.add_argument("--profile", default="default", help="slurm for a cluster, or a folder of Snakemake's options")
    text = "end the run where a scene fails or cannot be planned (default: the other scenes are made)"
    sub.add_argument("--stop-at-first-failure", action="store_true", help=text)
    _with_gone(sub)
    sub = command(
        "sweep", "sweeping:sweep", "error against run time over variants of settings; further arguments: snakemake"
    )
    sub.add_argument("sweeps", nargs="+", metavar="SWEEP", help="files, or names of blocks of `sweeps`")
    sub.add_argument("--configfile", help="configuration (default: the one that the file names, config/config.yaml)")
    sub.add_argument("--cores", type=_cores, help="processors to use (default: all)")
    sub.add_argument("--profile", default="default", help="slurm for a cluster, or a folder of Snakemake's options")
    _with_gone(sub)
    sub = command(
        "export",
        "exporting:export",
        "write files of a scene's results for other programs",
        epilog=FORMATS,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    sub.add_argument("scene", help="name of the scene")
    sub.add_argument("formats", nargs="+", metavar="FORMAT", help="what to write, see below")
    text = "copy the files there, too; the folder must not exist"
    sub.add_argument("--output", metavar="FOLDER", help=text)
    sub.add_argument("--configfile", default="config/config.yaml", help="configuration (default %(default)s)")
    sub.add_argument("--cores", type=_cores, help="processors to use (default: all)")
    _with_gone(sub)
    text = "open a scene's interactive viewer, or the page of all scenes, in the browser"
    sub = command("view", "viewing:view", text)
    _with_scene(sub)
    text = "through a server for this machine alone, until Ctrl-C (default port: any that is free)"
    sub.add_argument("--serve", nargs="?", type=int, const=0, metavar="PORT", help=text)
    sub.add_argument("--print", action="store_true", help="print the address only; open nothing")
    text = "another scene, or a folder of its viewer's results, on the left of a divider, under the same lamps"
    sub.add_argument("--beside", metavar="OTHER", help=text)
    sub = command("table", "exporting:table", "write the figures of a campaign as a table, one row a scene")
    sub.add_argument("file", help="file to write, .csv or .parquet (needs the extra export)")
    sub.add_argument("--configfile", default="config/config.yaml", help="configuration (default %(default)s)")
    sub = command("plan", "planning:plan", "what will run, be read and be loaded; what is left out and why")
    _with_scene(sub)
    sub.add_argument("--json", action="store_true", help="one JSON object a scene and line")
    sub = command(
        "explain", "inspecting:explain", "why each stage of a scene would run or not; or what differs between keys"
    )
    _with_scene(sub)
    sub.add_argument("--keys", nargs=2, metavar="KEY", help="two keys of one stage: what differs between them")
    sub = command("verify", "archiving:verify", "recompute every digest; name each damaged, missing or foreign file")
    sub.add_argument("folders", nargs="*", help="results, scene, stage, artifact or crate (default: results)")
    sub.add_argument("--capture", action="append", default=[], help="a sealed capture to verify as well")
    sub.add_argument("--json", action="store_true", help="one JSON object a line: each problem, last the summary")
    sub.add_argument("--threads", type=int, default=0, help="threads that read (default: one a processor)")
    text = "rename each artifact with a problem, so that the next run makes it again"
    sub.add_argument("--set-aside", action="store_true", help=text)
    sub = command("pack", "packing:pack_scene", "pack a finished scene, with all that it was made from, as an RO-Crate")
    sub.add_argument("scene", help="name of the scene")
    sub.add_argument("--output", required=True, metavar="FOLDER", help="folder to make; must not exist")
    sub.add_argument("--without-capture", action="store_true", help="not the photographs, only their names and digests")
    sub.add_argument("--zip", action="store_true", help="the folder as a ZIP file too, beside it")
    sub.add_argument("--configfile", default="config/config.yaml", help="configuration (default %(default)s)")
    sub = command("prune", "pruning:prune", "list results that no configuration references; --delete removes them")
    sub.add_argument("--configfile", action="append", help="configuration (repeatable; default config/config.yaml)")
    sub.add_argument("--sweep", action="append", default=[], help="file of a sweep to keep (repeatable)")
    sub.add_argument("--unnamed", action="store_true", help="also scenes and sweeps that no given configuration names")
    sub.add_argument("--delete", action="store_true", help="remove what is listed")
    sub.add_argument("--json", action="store_true", help="one JSON object a line: each folder, last the sum")
    _with_gone(sub)
    sub = command("check", "capturing:check", "everything that is wrong with a capture, in one pass")
    sub.add_argument("captures", nargs="+", help="capture folders")
    sub.add_argument("--quick", action="store_true", help="read headers and tables only, not every pixel")
    text = "write and open a contact sheet: each photograph with its lamp as stated and as measured, the odd ones first"
    sub.add_argument("--open", action="store_true", help=text)
    sub = command(
        "seal", "capturing:seal", "seal a capture with a BagIt manifest (RFC 8493); its files move into data/"
    )
    sub.add_argument("captures", nargs="+", help="capture folders")
    sub = command(
        "convert",
        "capturing:convert",
        "turn photographs, with their lights or cameras, or a goniometer's table, into a sealed capture folder",
    )
    sub.add_argument(
        "source",
        help="folder of photographs with an .lp file, camera matrices, or polariser angles; a table of reflectances "
        "by direction (.csv, .brdf, .bin, .binary); or a relightable image (.ptm, .rti, a folder of relight), from "
        "which pictures are rendered",
    )
    sub.add_argument("capture", nargs="?", help="capture folder to make; must not exist")
    text = "say what each folder below the source is and whether it can be converted; nothing is made"
    sub.add_argument("--list", action="store_true", help=text)
    sub.add_argument("--title", help="title of the object")
    sub.add_argument("--encoding", choices=("linear", "srgb"), help="of the photographs (default: as they state)")
    sub.add_argument(
        "--lights", help="file of the lights, where it is not found by itself; of a relightable image: to render under"
    )
    sub.add_argument(
        "--lights-kind", choices=LIGHT_KINDS, help="what the numbers of the lights file are, where it is not clear"
    )
    text = "which listed lamp each photograph shows: shift:N (the lamp N places on), reverse, or numbers: 2,1,3"
    sub.add_argument("--lights-order", metavar="ORDER", help=text)
    text = "axes of the lamps in terms of those listed: x,-y where y was counted downwards; --lights-axes=-x,y"
    sub.add_argument("--lights-axes", metavar="X,Y", help=text)
    sub.add_argument("--width-mm", type=float, metavar="MM", help="width of the whole photographs on the object")
    sub.add_argument(
        "--mask", help="picture, light where the object is, or with its shape as alpha; turntable: a folder of them"
    )
    sub.add_argument(
        "--white",
        help="folder of the white board's photographs, one a light, paired by name",
    )
    sub.add_argument("--dark", help="folder of dark frames")
    sub.add_argument("--ambient", help="photograph without lamp, in the light of the room alone, or a folder of such")
    sub.add_argument("--check", action="append", metavar="LIGHT", help="a light kept for evaluation (repeatable)")
    quantities = ("brdf", "radiance_factor", "radiance_factor_percent", "brdf_cos_view", "brdf_cos_light")
    sub.add_argument("--values", choices=quantities, help="what a table of reflectances holds (default: brdf, in 1/sr)")
    text = "what the azimuth of the view in a table is counted from (default: cloth, the weft, as that of the light)"
    sub.add_argument("--azimuths", choices=("cloth", "lamp", "mirror"), help=text)
    sub.add_argument("--link", action="store_true", help="hard links instead of copies, on the same disk")
    sub.add_argument("--open", action="store_true", help="do not seal yet: camera curves and the like will be added")
    text = "turntable: the object turned against the order of the cameras"
    sub.add_argument("--turn", choices=("reverse",), help=text)
    text = "turntable: views that have the camera of another view"
    sub.add_argument("--camera-of", metavar="VIEW=CAMERA,...", help=text)
    sub.add_argument("--roi", nargs=4, type=int, metavar=("ROW", "COLUMN", "ROWS", "COLUMNS"), help="crop")
    _with_rig(
        command(
            "rig",
            "rig:ports",
            "control a capture rig: what is connected, whether it works",
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
    )
    _with_calibrations(
        command(
            "calibrate",
            "calibrate:target",
            "measure what captures need: lamps of a dome; response, noise, colour and lens of a camera; axes",
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
    )
    sub = command("compile", "running:compile_kernels", "compile all kernels, by running tiny scenes somewhere else")
    sub.add_argument("--plane", action="store_true", help="only what paintings need")
    text = "photograph a simulated painting, object or cloth; see --help"
    command("simulate", "running:simulate", text, add_help=False)
    command("schema", "inspecting:schema", "print the JSON schema of config.yaml")
    return parser


FORMATS = """\
formats of a painting: normals, height, albedo, relight, spectral, gltf, usd, materialx, mitsuba, merl, iiif
formats of an object:  gltf, usd, materialx, mitsuba, iiif, kintsugi
formats of a cloth:    gltf, mitsuba, bsdf
See docs/stages/export.md."""


RIG = f"""\
Take the photographs of a capture with cameras, lamps, turntables and goniometers.

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
{COMMAND} demo --rig
"""


def _with_rig(sub: argparse.ArgumentParser) -> None:
    """The subcommands of `rig`."""
    sub.description = RIG
    sub.set_defaults(call=lambda options, rest: sub.error("expected what to do: ports, test, plan or run; see --help"))
    actions = sub.add_subparsers(dest="action", metavar="ACTION", title="actions")

    def action(name: str, function: str, text: str, **options) -> argparse.ArgumentParser:
        made = actions.add_parser(name, help=text, description=text, allow_abbrev=False, **options)
        made.set_defaults(call=lambda options, rest: _call(function, options, rest))
        return made

    action("ports", "rig:ports", "list what is connected: serial ports with vendor and product, cameras")
    made = action("plan", "rig:plan", "print the table of frames that a plan expands to, with duration and size")
    made.add_argument("plan", metavar="PLAN", help="plan of a dome, turntable or goniometer (YAML)")
    made.add_argument(
        "--table", metavar="FRAMES.tsv", help="save the table there, to be edited, instead of printing it"
    )
    made = action("run", "rig:run", "take the photographs of a plan, or go on where it stopped; checked and sealed")
    made.add_argument("rig", metavar="RIG", help="description of the rig (YAML)")
    made.add_argument("plan", metavar="PLAN", help="plan (YAML), or a table made from it by rig plan --table (.tsv)")
    made.add_argument("capture", metavar="CAPTURE", help="capture folder to make, or to go on with")
    text = "show how far it is on a page for this computer's browser (default port 8377; 0: any that is free)"
    made.add_argument("--page", nargs="?", type=int, const=8377, metavar="PORT", help=text)
    made.add_argument("--dry-run", action="store_true", help="print what would be taken; nothing moves")
    made = action("test", "rig:test", "move every device of a rig once and take one photograph; a line a device")
    made.add_argument("rig", metavar="RIG", help="description of the rig (YAML)")


CALIBRATE = f"""\
Measure what captures need. Each calibration leaves a folder with its figures (JSON), tables, and a page that shows
whether to trust it.

  {COMMAND} calibrate spheres dome/ calibration/dome
  {COMMAND} calibrate camera series.csv calibration/camera
  {COMMAND} calibrate geometry boards/ calibration/lens --board 9 6 15 11
  {COMMAND} calibrate target chart.tif calibration/chart --light D50
"""


SPHERES = f"""\
Where the lamps of a dome are: directions from one mirror sphere, positions from two or more. Lay the spheres where
the object will lie, and photograph them once under every lamp, the camera fixed.

  {COMMAND} calibrate spheres dome/ calibration/dome
  {COMMAND} calibrate spheres dome/ calibration/dome --count 3 --radius-mm 10 --focal-px 9500
  {COMMAND} convert painting/ captures/painting --lights calibration/dome/lamps.dome

Look at calibration/dome/calibration.html: the green outlines must lie on the spheres' rims, each red cross in a
highlight. lamps.lp and lamps.dome serve all captures of this dome, until it or the camera is moved.
"""


def _with_calibrations(sub: argparse.ArgumentParser) -> None:
    """The subcommands of `calibrate`."""
    from nishiki.commands.calibrate import corner

    sub.description = CALIBRATE
    sub.set_defaults(
        call=lambda options, rest: sub.error(
            "expected what to calibrate: spheres, camera, target or geometry; see --help"
        )
    )
    kinds = sub.add_subparsers(dest="kind", metavar="WHAT", title="calibrations")

    def kind(name: str, function: str, text: str, **options) -> argparse.ArgumentParser:
        made = kinds.add_parser(name, help=text, description=text, allow_abbrev=False, **options)
        made.set_defaults(call=lambda options, rest: _call(function, options, rest))
        made.add_argument("--into", metavar="CAPTURE", help="write the lines into a capture that is not sealed, too")
        return made

    text = "colours of a photographed ColorChecker Classic against the reference, and the camera's sensitivities"
    made = kind("target", "calibrate:target", text)
    made.add_argument("photograph", help="photograph of the target; for sensitivities camera raw or linear")
    made.add_argument("folder", help="new folder for the results")
    made.add_argument(
        "--corners",
        nargs=4,
        type=corner,
        metavar="X,Y",
        help="middles of dark skin, bluish green, black and white, in pixels (default: the target is searched)",
    )
    made.add_argument(
        "--encoding",
        choices=("linear", "srgb"),
        help="of the stored values (default: as the file states; else 8 bit srgb, all others linear)",
    )
    made.add_argument(
        "--light",
        metavar="SPECTRUM",
        help="of the lamp: A, D50, D65, E, FL2, FL7, FL11, or a CSV table; with it the sensitivities are recovered",
    )
    made.add_argument(
        "--reflectances",
        metavar="CSV",
        help="of this very chart: wavelength_nm and 24 columns (default: mean of thirty charts)",
    )
    text = "linearity, dark level, noise, shading and defective pixels from an exposure series of an even surface"
    made = kind("camera", "calibrate:camera", text)
    text = "table file,exposure_s: every exposure twice, nothing changed between; exposure 0 is the closed lens"
    made.add_argument("series", help=text)
    made.add_argument("folder", help="new folder for the results")
    made.add_argument("--bits", type=int, choices=range(8, 17), help="significant bits (default: all of the file)")
    text = "lens, turntable's axis and goniometer's centre from photographs of a ChArUco board; boards to print"
    made = kind("geometry", "calibrate:geometry", text)
    made.add_argument("photographs", nargs="*", help="the board, tilted another way in each: files, or folders of them")
    made.add_argument("folder", help="new folder for the results")
    names = ("COLUMNS", "ROWS", "SQUARE_MM", "MARKER_MM")
    made.add_argument("--board", nargs=4, type=float, required=True, metavar=names, help="squares and their size")
    made.add_argument("--dictionary", default="DICT_4X4_50", help="of the markers, OpenCV's name (default %(default)s)")
    made.add_argument("--print", action="store_true", help="write the board as SVG and PNG instead")
    made.add_argument("--stage", metavar="FOLDER", help="the board on the turntable or goniometer, the camera at rest")
    text = "terms of the distortion (default %(default)s)"
    made.add_argument("--distortion", choices=("none", "radial", "tangential", "full"), default="tangential", help=text)
    text = "directions of lamps from one mirror sphere, positions from two or more"
    made = kind("spheres", "calibrate:spheres", text, formatter_class=argparse.RawDescriptionHelpFormatter)
    made.description = SPHERES
    made.add_argument("photographs", nargs="+", help="one a lamp, of the same spheres: files, or folders of them")
    made.add_argument("folder", help="new folder for the results")
    text = "roughly where a sphere is, in pixels (repeatable; default: found)"
    made.add_argument(
        "--sphere", nargs=3, type=float, action="append", default=[], metavar=("ROW", "COLUMN", "RADIUS"), help=text
    )
    made.add_argument("--mask", help="picture, light on the spheres: their outlines are taken from it")
    made.add_argument("--count", type=int, help="spheres that must be found (default: all that there are)")
    text = "focal length in pixels; inf: seen from afar (default: from Exif, else from the agreement of the spheres)"
    made.add_argument("--focal-px", type=float, help=text)
    made.add_argument("--radius-mm", type=float, help="radius of every sphere; needed for positions")
    text = "height of the object's surface above the plane on which the spheres lie (default 0)"
    made.add_argument("--object-height-mm", type=float, default=0.0, help=text)
    text = "folder of a flat matt board in the object's plane, one photograph a lamp: the fall-off refines the lamps"
    made.add_argument("--board", help=text)
    made.add_argument("--compare", metavar="LP", help="a lights file: the angles to it stand on the page")


def _with_scene(sub: argparse.ArgumentParser) -> None:
    sub.add_argument("scene", nargs="?", help="name of a scene (default: all)")
    sub.add_argument("--configfile", default="config/config.yaml", help="configuration (default %(default)s)")


def _with_gone(sub: argparse.ArgumentParser) -> None:
    text = "a machine whose unfinished runs are certainly dead (repeatable)"
    sub.add_argument("--host-is-gone", action="append", default=[], metavar="HOST", help=text)


def _cores(text: str) -> str:
    if text != "all" and not (text.isascii() and text.isdecimal() and int(text) > 0):
        raise argparse.ArgumentTypeError(f"expected a number of processors from 1, or all, found {text!r}")
    return text


def _call(function: str, options: argparse.Namespace, rest: list[str]) -> int | None:
    import importlib

    module, name = function.split(":")
    return getattr(importlib.import_module(f"nishiki.commands.{module}"), name)(options, rest)
