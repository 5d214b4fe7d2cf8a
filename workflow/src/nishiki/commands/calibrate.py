"""Commands that measure what captures need: each leaves a folder with figures, tables and a page."""

import argparse
import sys
from pathlib import Path

from nishiki.errors import UserError


def target(options: argparse.Namespace, rest: list[str]) -> None:
    """Judge the colours of a photographed ColorChecker Classic; recover the camera's sensitivities where asked for."""
    import numpy as np

    from nishiki.calibrate import target as chart
    from nishiki.calibrate.result import PAGE, Calibration, write_calibration
    from nishiki.calibrate.sensitivities import chart_reflectances, recover
    from nishiki.calibrate.target_page import sections_of, warnings_of
    from nishiki.colour.colour import srgb_encode
    from nishiki.colour.encoding import decode
    from nishiki.formats.image_headers import read_header
    from nishiki.formats.images import read_codes

    photograph = Path(options.photograph)
    light = None if options.light is None else _spectrum(options.light)
    names, reflectances = chart_reflectances()
    if options.reflectances:
        reflectances = _chart_of_its_own(Path(options.reflectances), names)
    header = read_header(photograph)
    encoding = options.encoding or ("srgb" if header.sample == "uint8" and header.kind != "raw" else "linear")
    if options.encoding is None:
        print(f"{photograph.name}: read as {encoding} ({header.kind}, {header.sample}); --encoding says otherwise")
    codes = read_codes(photograph, ("red", "green", "blue"), header=header)
    full_scale = 1.0 if codes.dtype.kind == "f" else float(np.iinfo(codes.dtype).max)
    shares = codes / np.float32(full_scale)
    display = shares if encoding == "srgb" else srgb_encode(shares / max(float(np.percentile(shares, 99.5)), 1e-6))
    picture = np.round(255 * np.clip(display, 0, 1)).astype(np.uint8)
    values = decode(shares, "srgb") if encoding == "srgb" else shares
    reference = chart.reference_xyz(reflectances)
    try:
        corners = chart.find_target(picture) if options.corners is None else chart.target_at(options.corners)
        patches = chart.read_patches(values, corners, 1.0)
        if np.count_nonzero(patches.usable) < 12 or not patches.usable[chart.NEUTRAL].any():
            raise UserError(
                f"{np.count_nonzero(~patches.usable)} of 24 patches are saturated. Remedy: photograph the target with "
                "less light or a shorter exposure"
            )
        chart.expect_target(patches.mean, reference)
    except UserError as error:
        raise UserError(f"{photograph.name}: {error}") from None
    judged = {}
    if encoding == "srgb":
        judged["as delivered"] = chart.errors_of(chart.xyz_as_delivered(patches.mean), reference, patches.usable)
    matrix, predicted = chart.fitted_xyz(patches.mean, reference, patches.usable)
    judged["after correction"] = chart.errors_of(predicted, reference, patches.usable)
    found = None if light is None else recover(patches.mean, light, reflectances, patches.usable)
    numbers = {
        "encoding": encoding,
        "patches": list(names),
        "usable": patches.usable.tolist(),
        "matrix_xyz_d50": matrix.tolist(),
        **{how.replace(" ", "_"): errors.as_dict() for how, errors in judged.items()},
    }
    lines, files = {}, {}
    if found is not None:
        numbers["sensitivities"] = {"residual": found.residual, "left_out": found.left_out}
        lines["camera"] = {"channels": ["red", "green", "blue"], "sensitivities": "sensitivities.csv"}
        files["sensitivities.csv"] = _table(found.curves)
    result = Calibration(
        "target",
        numbers,
        [photograph],
        lines,
        sections_of(picture, names, reference, patches, judged, found),
        photograph.name,
        files,
        warnings_of(names, patches),
    )
    write_calibration(Path(options.folder), result)
    for how, errors in judged.items():
        levels = ", ".join(f"{standard}: {chart.verdict(errors.summary, standard)}" for standard in chart.CRITERIA)
        mean, largest = errors.summary["delta_e_mean"], errors.summary["delta_e_max"]
        print(f"{how}: CIEDE2000 {mean:.2f} mean, {largest:.2f} largest; {levels}")
    print(Path(options.folder) / PAGE)


def spheres(options: argparse.Namespace, rest: list[str]) -> None:
    """Measure the lamps of a dome from photographs of mirror spheres."""
    from nishiki.calibrate.photographs import list_photographs
    from nishiki.calibrate.spheres import SphereInput, calibrate_spheres

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
    write_calibration(folder, result)
    if options.into:
        put_into_capture(Path(options.into), result)
    for text in result.warnings:
        print(f"warning: {text}", file=sys.stderr)
    lines = f"Written into {options.into}" if options.into else f"For capture.yaml: {folder / LINES}"
    print(f"{result.subtitle} {lines}")
    print(folder / PAGE)


def _table(curves) -> str:
    """Sensitivities (3, 61) as captures take them."""
    from nishiki.colour.sampling import WAVELENGTHS_NM

    rows = ["wavelength_nm,red,green,blue"]
    for nm, values in zip(WAVELENGTHS_NM, curves.T, strict=True):
        rows.append(",".join([f"{nm:g}", *(f"{value:.5f}" for value in values)]))
    return "\n".join(rows) + "\n"


def _spectrum(text: str):
    """The spectrum (61,) of a lamp: a CIE illuminant by name, or a table."""
    import numpy as np

    from nishiki.capture.spectra_tables import read_curves
    from nishiki.colour.colour import illuminant
    from nishiki.colour.sampling import WAVELENGTHS_NM

    if not text.lower().endswith(".csv"):
        return illuminant(text)
    curves = read_curves(Path(text))
    return np.interp(WAVELENGTHS_NM, curves.wavelengths_nm, curves.values[:, 0])


def _chart_of_its_own(path: Path, names: tuple[str, ...]):
    """Reflectances (24, 61) from a table with one column a patch, in the chart's order."""
    import numpy as np

    from nishiki.capture.spectra_tables import read_curves
    from nishiki.colour.sampling import WAVELENGTHS_NM

    curves = read_curves(path)
    if len(curves.names) != len(names):
        raise UserError(f"{path}: expected {len(names)} columns after wavelength_nm, found {len(curves.names)}")
    return np.array([np.interp(WAVELENGTHS_NM, curves.wavelengths_nm, values) for values in curves.values.T])


def corner(text: str) -> tuple[float, float]:
    """X,Y in pixels, of the command line."""
    try:
        x, y = (float(part) for part in text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(f"expected X,Y in pixels, found {text!r}") from None
    return x, y
