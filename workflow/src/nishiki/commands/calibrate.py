"""Commands that measure what captures need: each leaves a folder with figures, tables and a page."""

import argparse
import sys
from pathlib import Path

from nishiki.errors import UserError


def target(options: argparse.Namespace, rest: list[str]) -> None:
    """Judge the colours of a photographed ColorChecker Classic; recover the camera's sensitivities where asked for."""
    from nishiki.calibrate.target_result import TargetInput, calibrate_target

    table = Path(options.reflectances) if options.reflectances else None
    given = TargetInput(Path(options.photograph), options.encoding, options.corners, options.light, table)
    _finish(options, calibrate_target(given))


def spheres(options: argparse.Namespace, rest: list[str]) -> None:
    """Measure the lamps of a dome from photographs of mirror spheres."""
    from nishiki.calibrate.photographs import list_photographs
    from nishiki.calibrate.spheres_result import calibrate_spheres
    from nishiki.capture.spheres.findings import SphereInput

    result = calibrate_spheres(
        SphereInput(
            list_photographs(options.photographs),
            seeds=[tuple(each) for each in options.sphere],
            mask=Path(options.mask) if options.mask else None,
            count=options.count,
            focal_px=options.focal_px,
            radius_mm=options.radius_mm,
            object_height_mm=options.object_height_mm,
            board=list_photographs([options.board], what="board") if options.board else (),
            compare=Path(options.compare) if options.compare else None,
        )
    )
    _finish(options, result)


def camera(options: argparse.Namespace, rest: list[str]) -> None:
    """Measure linearity, dark level and noise of a camera from an exposure series."""
    from nishiki.calibrate.camera import calibrate_camera

    _finish(options, calibrate_camera(Path(options.series), bits=options.bits))


def geometry(options: argparse.Namespace, rest: list[str]) -> None:
    """Measure lens and stage with a ChArUco board, or write a board to print."""
    from nishiki.calibrate.geometry import calibrate_geometry, print_board
    from nishiki.calibrate.photographs import list_photographs
    from nishiki.geometry.board import BoardShape

    columns, rows, square, marker = options.board
    if not (columns == int(columns) and rows == int(rows)):
        raise UserError(f"--board: expected whole numbers of squares, found {columns:g} and {rows:g}")
    shape = BoardShape(int(columns), int(rows), square, marker, options.dictionary)
    if options.print:
        folder = Path(options.folder)
        if folder.exists():
            raise UserError(f"{folder} exists. Remedy: choose another folder; nothing is overwritten")
        svg, png = print_board(shape)
        folder.mkdir(parents=True)
        (folder / "board.svg").write_text(svg, encoding="utf-8")
        (folder / "board.png").write_bytes(png)
        print(f"{folder / 'board.svg'}: {columns * square:g} x {rows * square:g} mm. Print without scaling")
        return
    if not options.photographs:
        raise UserError("expected photographs of the board before the folder. Remedy: name them, or give --print")
    stage = list_photographs([options.stage], what="stage") if options.stage else ()
    pictures = list_photographs(options.photographs)
    _finish(options, calibrate_geometry(pictures, shape, stage=stage, distortion=options.distortion))


def _finish(options: argparse.Namespace, result) -> None:
    """Write the folder of a calibration, its lines into a capture where asked for, and say so."""
    from nishiki.calibrate.result import LINES, PAGE, put_into_capture, write_calibration

    folder = Path(options.folder)
    if options.into and not result.lines and not result.failure:
        raise UserError(
            "there is nothing for a capture to take. Remedy: leave out --into, or give --light for sensitivities"
        )
    write_calibration(folder, result)
    if result.failure:
        raise UserError(f"{result.failure}\nWhat was found so far: {folder / PAGE}")
    if options.into:
        put_into_capture(Path(options.into), result)
    for text in result.warnings:
        print(f"warning: {text}", file=sys.stderr)
    print(result.subtitle)
    if options.into:
        print(f"written into {options.into}")
    elif result.lines:
        print(f"for capture.yaml: {folder / LINES}")
    print(folder / PAGE)


def corner(text: str) -> tuple[float, float]:
    """X,Y in pixels, of the command line."""
    try:
        x, y = (float(part) for part in text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(f"expected X,Y in pixels, found {text!r}") from None
    return x, y
