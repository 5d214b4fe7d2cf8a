"""Commands that calibrate lamps, cameras and devices: each writes a folder with figures, tables and a page."""

import sys
from pathlib import Path

import click

from nishiki.commands.declare import Group, option
from nishiki.errors import UserError


@click.group(
    "calibrate",
    cls=Group,
    examples=(
        "calibrate spheres dome/ calibration/dome",
        "calibrate camera series.csv calibration/camera",
        "calibrate geometry boards/ calibration/lens --board 9 6 15 11",
        "calibrate target chart.tif calibration/chart --light D50",
    ),
)
def calibrate() -> None:
    """Measure what captures need: lamps of a dome; response, noise, colour and lens of a camera; axes.

    Each calibration leaves a folder with its figures (JSON), tables, and a page that shows whether to trust it.
    """


folder = click.argument("folder", type=Path, help="new folder for the results")
into = option("--into CAPTURE", "also write the results into this capture, which must not be sealed", type=Path)


def corner(context: click.Context, parameter: click.Parameter, texts: tuple[str, ...] | None):
    """Read X,Y in pixels."""
    try:
        return texts and tuple(tuple(float(part) for part in text.split(",", 1)) for text in texts)
    except ValueError:
        raise click.BadParameter(f"expected X,Y in pixels, found {' '.join(texts or ())!r}") from None


@calibrate.command(
    examples=(
        "calibrate target chart.tif calibration/chart",
        "calibrate target chart.tif calibration/chart --light D50",
    )
)
@click.argument("photograph", type=Path, help="photograph of the target; for sensitivities camera raw or linear")
@folder
@into
@option(
    "--corners X,Y X,Y X,Y X,Y",
    "pixel positions of the four corner patches: dark skin, bluish green, black, white (default: detect the chart)",
    nargs=4,
    callback=corner,
)
@option(
    "--encoding linear|srgb",
    "encoding of the photograph (default: as the file states; else srgb for 8 bit, linear for all others)",
)
@option(
    "--light SPECTRUM",
    "spectrum of the lamp: A, D50, D65, E, FL2, FL7, FL11, or a CSV table; with it the sensitivities are recovered",
)
@option(
    "--reflectances CSV", "of this very chart: wavelength_nm and 24 columns (default: mean of thirty charts)", type=Path
)
def target(photograph, folder, into, corners, encoding, light, reflectances) -> None:
    """Compare the colours of a photographed ColorChecker Classic with the reference; recover sensitivities."""
    from nishiki.calibrate.target_result import TargetInput, calibrate_target

    _finish(folder, into, calibrate_target(TargetInput(photograph, encoding, corners, light, reflectances)))


@calibrate.command(
    examples=(
        "calibrate spheres dome/ calibration/dome",
        "calibrate spheres dome/ calibration/dome --count 3 --radius-mm 10 --focal-px 9500",
        "convert painting/ captures/painting --lights calibration/dome/lamps.dome",
    ),
    epilog="""\
Look at calibration/dome/calibration.html: the green outlines must lie on the rims of the balls, each red cross in a
highlight. lamps.lp and lamps.dome serve all captures of this dome, until it or the camera is moved.""",
)
@click.argument(
    "photographs", nargs=-1, required=True, help="one photograph per lamp, of the same balls: files, or folders"
)
@folder
@into
@option(
    "--sphere ROW COLUMN RADIUS",
    "roughly where a ball is, in pixels (repeatable; default: found in the photographs)",
    "seeds",
    nargs=3,
    type=float,
    multiple=True,
)
@option("--mask FILE", "picture that is light on the balls: their outlines are taken from it", type=Path)
@option("--count N", "number of balls that must be found (default: all that there are)", type=int)
@option(
    "--focal-px N",
    "focal length in pixels; inf: seen from afar (default: from Exif, else from the agreement of the balls)",
    type=float,
)
@option("--radius-mm MM", "radius of every sphere; needed for positions", type=float)
@option(
    "--object-height-mm MM",
    "height of the object's surface above the plane on which the balls lie",
    type=float,
    default=0.0,
)
@option(
    "--board FOLDER",
    "folder of a flat matt board in the object's plane, one photograph a lamp: the fall-off refines the lamps",
)
@option("--compare LP", "lights file; the page shows the angles between its lamps and these", type=Path)
def spheres(photographs, folder, into, board, seeds, **given) -> None:
    """Measure the lamps of a dome: directions from one mirror ball, positions from two or more.

    Lay the balls where the object will lie, and photograph them once under every lamp, with the camera fixed.
    """
    from nishiki.calibrate.result import calibrate_spheres, list_photographs
    from nishiki.capture.spheres.search import SphereInput

    boards = list_photographs([board], what="board") if board else ()
    pictures = list_photographs(photographs)
    _finish(folder, into, calibrate_spheres(SphereInput(pictures, seeds=list(seeds), board=boards, **given)))


@calibrate.command(examples=("calibrate camera series.csv calibration/camera",))
@click.argument(
    "series",
    type=Path,
    help="table file,exposure_s: every exposure twice, nothing changed between; exposure 0 is the closed lens",
)
@folder
@into
@option("--bits N", "significant bits (default: all of the file)", type=click.IntRange(8, 16))
def camera(series, folder, into, bits) -> None:
    """Measure linearity, dark level, noise, shading and defective pixels from an exposure series of an even surface."""
    from nishiki.calibrate.camera import calibrate_camera

    _finish(folder, into, calibrate_camera(series, bits=bits))


@calibrate.command(
    examples=(
        "calibrate geometry boards/ calibration/lens --board 9 6 15 11",
        "calibrate geometry board-to-print --board 9 6 15 11 --print",
    )
)
@click.argument("photographs", nargs=-1, help="photographs of the board, tilted differently in each: files, or folders")
@folder
@into
@option("--board COLUMNS ROWS SQUARE_MM MARKER_MM", "squares and their size", nargs=4, type=float, required=True)
@option("--dictionary NAME", "OpenCV's name for the dictionary of the markers", default="DICT_4X4_50")
@option("--print", "write the board as SVG and PNG instead", "print_only")
@option("--stage FOLDER", "the board on the turntable or goniometer, the camera at rest")
@option("--distortion none|radial|tangential|full", "terms of the distortion", default="tangential")
def geometry(photographs, folder, into, board, dictionary, print_only, stage, distortion) -> None:
    """Measure the lens, a turntable's axis and a goniometer's centre with a ChArUco board, or print a board."""
    from nishiki.calibrate.camera import calibrate_geometry, print_board
    from nishiki.calibrate.result import list_photographs
    from nishiki.geometry.board import BoardShape

    columns, rows, square, marker = board
    if not (columns == int(columns) and rows == int(rows)):
        raise UserError(f"--board: expected whole numbers of squares, found {columns:g} and {rows:g}")
    shape = BoardShape(int(columns), int(rows), square, marker, dictionary)
    if print_only:
        if folder.exists():
            raise UserError(f"{folder} exists. Remedy: choose another folder; nothing is overwritten")
        svg, png = print_board(shape)
        folder.mkdir(parents=True)
        (folder / "board.svg").write_text(svg, encoding="utf-8")
        (folder / "board.png").write_bytes(png)
        print(f"{folder / 'board.svg'}: {columns * square:g} x {rows * square:g} mm. Print without scaling")
        return
    if not photographs:
        raise UserError("expected photographs of the board before the folder. Remedy: name them, or give --print")
    views = list_photographs([stage], what="stage") if stage else ()
    pictures = list_photographs(photographs)
    _finish(folder, into, calibrate_geometry(pictures, shape, stage=views, distortion=distortion))


def _finish(folder: Path, capture: Path | None, result) -> None:
    """Write the folder of a calibration, its lines into a capture where asked for, and say so."""
    from nishiki.calibrate.result import LINES, PAGE, put_into_capture, write_calibration

    if capture and not result.lines and not result.failure:
        raise UserError("a capture takes nothing of this. Remedy: omit --into, or give --light for sensitivities")
    write_calibration(folder, result)
    if result.failure:
        raise UserError(f"{result.failure}\nWhat was found so far: {folder / PAGE}")
    if capture:
        put_into_capture(capture, result)
    for text in result.warnings:
        print(f"warning: {text}", file=sys.stderr)
    print(result.subtitle)
    if capture:
        print(f"written into {capture}")
    elif result.lines:
        print(f"for capture.yaml: {folder / LINES}")
    print(folder / PAGE)
