"""The section of a painting's page on colour: diffuse reflectance as a picture, spectra of some places or regions."""

from dataclasses import replace
from typing import Any

import numpy as np

from nishiki.colour.colour import (
    illuminant,
    srgb_encode,
    white_xyz,
    xyz_from_spectra,
    xyz_matrix,
    xyz_to_lab,
    xyz_to_srgb_linear,
)
from nishiki.colour.sampling import WAVELENGTHS_NM
from nishiki.evaluate.camera_colour import CameraColour
from nishiki.report.colour_map import heat, hexadecimal
from nishiki.report.page import Block, Figure, Figures, Heading, Section, Table
from nishiki.report.pictures import Ruler, block_of, brightened, brightening, colour_picture, scalar_picture, shrink
from nishiki.report.svg import INK, PALETTE, Curve, chart

CURVES = 9
LEAST_SHARE = 0.002
LIGHTS = {"D65": "daylight, D65", "A": "incandescent, A", "FL11": "fluorescent of three narrow bands, FL11"}
UNDER_D65 = "CIEDE2000 of the diffuse reflectance under D65, not under the lamp of the capture."
EXPECTED_ERROR = "for surfaces like those of the training set; light patches are colours unlike any of them."
PLACES = (
    "Places that differ most in colour, numbered in the picture above. A camera of few channels fixes the colour, not "
    "the curve: fine structure comes from the training set."
)
VARNISH = (
    "The spectra are those of the surface as the camera sees it, that is through the varnish: a yellowed or matt "
    "varnish is part of them."
)


def colour_section(
    normals,
    *,
    widest: int,
    camera: CameraColour,
    spectra=None,
    evaluated=None,
    evaluation: dict[str, Any] | None = None,
    known: np.ndarray | None = None,
    expected_de00: dict[str, float] | None = None,
    ruler: Ruler | None = None,
) -> Section:
    """Diffuse reflectance, spectra where there are some, and their errors.

    normals, spectra, evaluated : `Maps` of those stages or None; camera : map of the channels to XYZ, used where there
    are no spectra; evaluation : evaluation.json or None; known : (rows, columns) bool, pixels with an estimate;
    expected_de00 : diagnostic of the spectra.
    """
    shape = tuple(normals.group["reflectance"].shape[:2])
    block = block_of(shape[1], widest)
    maps, name = (normals, "reflectance") if spectra is None else (spectra, "coefficients")
    small = shrink(lambda rows: _masked(maps.read(name, rows), known, rows), shape, block)
    if spectra is None:
        figure = _diffuse(xyz_to_srgb_linear(camera.xyz(small), white=camera.white), camera.how, (), ruler)
        return Section("colour", "Colour", [Figures([figure])])
    basis = np.array(spectra.attributes("coefficients")["basis"])
    xyz = small @ xyz_matrix(illuminant("D65"), basis).T
    truth = (evaluation or {}).get("reflectance") or {}
    if truth.get("regions"):
        labels = None
        if evaluated is not None and "regions" in evaluated:
            labels = np.asarray(evaluated.read("regions"))[block // 2 :: block, block // 2 :: block]
        curves, marks = _of_regions(truth["regions"], truth["region_names"], labels)
        numbered = ", each numbered in the picture above where it is widest" if marks else ""
        means = "mean of the estimated spectra, and of the true ones (dashed)"
        about = f"Regions that differ most in colour{numbered}: {means}."
    else:
        curves, marks = _of_places(small, xyz, basis, block)
        about = PLACES
    items = [_diffuse(xyz_to_srgb_linear(xyz), "from the spectra of the pixels, under D65", marks, ruler)]
    if evaluated is not None and "reflectance_de00" in evaluated:
        difference = shrink(lambda rows: evaluated.read("reflectance_de00", rows), shape, block)
        picture = scalar_picture(difference, heat(), unit="ΔE00 under D65", low=0.0)
        items.append(Figure("Difference to the true reflectance", UNDER_D65, picture))
    sigma = shrink(lambda rows: _masked(spectra.read("sigma", rows), known, rows), shape, block)
    picture = scalar_picture(sigma, heat(), unit="reflectance, expected rms", low=0.0)
    items.append(Figure("Expected error of the spectra", EXPECTED_ERROR, picture))
    blocks: list[Block] = [Figures(items)]
    if curves:
        blocks += [Heading("Spectra"), f"{about} {VARNISH}", Figures(curves, 3)]
    return Section("colour", "Colour", [*blocks, *_tables(expected_de00 or {}, truth)])


def _diffuse(linear: np.ndarray, how: str, marks: tuple, ruler: Ruler | None) -> Figure:
    factor = brightening(linear)
    numbers = " The numbers are the places of the spectra below." if marks else ""
    caption = f"the object without highlights, shadows and shading; {how}.{brightened(factor)}{numbers}"
    return Figure("Diffuse reflectance", caption, replace(colour_picture(factor * linear), marks=marks), ruler=ruler)


def _tables(expected_de00: dict[str, float], truth: dict[str, Any]) -> list[Block]:
    """Colour errors to be expected, and errors of the reflectance against a truth."""
    tables: list[Block] = []
    if expected_de00:
        rows = [[LIGHTS[light], value] for light, value in expected_de00.items()]
        caption = (
            "Colour under lights that the camera has not seen: mean ΔE00 to be expected of the estimated spectra, from "
            "training spectra of like colours"
        )
        if truth:
            rows = [[*row, truth["de00"][light]["mean"]] for row, light in zip(rows, expected_de00, strict=True)]
            tables.append(
                Table(("Light", "expected", "measured"), rows, "lrr", f"{caption}; measured: against the truth.")
            )
        else:
            tables.append(Table(("Light", "expected"), rows, "lr", f"{caption}."))
    if truth:
        parts = {"rms over 61 bands, reflectance": truth["rmse"]}
        parts |= {f"ΔE00 under {name}": part for name, part in truth["de00"].items()}
        rows = [[name, *(part[key] for key in ("mean", "median", "p90", "count"))] for name, part in parts.items()]
        head = ("Measure", "mean", "median", "90 %", "number")
        tables.append(Table(head, rows, "lrrrr", "Reflectance of the pixels against truth."))
    return tables


def spread_out(points: np.ndarray, count: int, first: int) -> list[int]:
    """Indices of at most `count` points (n, k) far from one another: from `first` on, always the farthest next."""
    chosen = [first]
    distance = np.linalg.norm(points - points[first], axis=1)
    while len(chosen) < min(count, len(points)):
        following = int(np.argmax(distance))
        if not distance[following] > 0:
            break
        chosen.append(following)
        distance = np.minimum(distance, np.linalg.norm(points - points[following], axis=1))
    return chosen


def _masked(values: np.ndarray, known: np.ndarray | None, rows: slice) -> np.ndarray:
    if known is None:
        return values
    values = np.array(values, np.float32)
    values[~known[rows]] = np.nan
    return values


def _of_regions(regions: list[dict], names: list[str], labels: np.ndarray | None) -> tuple[list[Figure], tuple]:
    """Charts of regions that differ most in colour, the largest first; regions of a few pixels are left out.

    labels : (rows, columns) region of each pixel of the picture, or None. The marks stand where the regions are widest.
    """
    total = sum(region["pixels"] for region in regions)
    large = sorted((r for r in regions if r["pixels"] >= LEAST_SHARE * total), key=lambda r: (-r["pixels"], r["label"]))
    lamp = illuminant("D65")
    lab = xyz_to_lab(xyz_from_spectra(lamp, np.array([r["truth"] for r in large])), white_xyz(lamp))
    charts, marks = [], []
    for number, k in enumerate(sorted(spread_out(lab, CURVES, 0)), 1):
        region = large[k]
        label = names[region["label"]] if region["label"] < len(names) else f"region {region['label']}"
        curves = [(region["estimate"], False), (region["truth"], True)]
        note = f"{region['pixels']} pixels, rms {region['rmse']:.3f}."
        if labels is not None and (labels == region["label"]).any():
            label = f"{number}: {label}"
            marks.append((*_widest_place(labels == region["label"]), str(number)))
        charts.append(_spectrum_chart(label, note, curves))
    return charts, tuple(marks)


def _widest_place(inside: np.ndarray) -> tuple[float, float]:
    """(x, y) of the pixel of a region (rows, columns) bool that is farthest from its edge."""
    import cv2

    depth = cv2.distanceTransform(np.pad(inside, 1).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)[1:-1, 1:-1]
    row, column = np.unravel_index(int(depth.argmax()), depth.shape)
    return column + 0.5, row + 0.5


def _of_places(small: np.ndarray, xyz: np.ndarray, basis: np.ndarray, block: int) -> tuple[list[Figure], tuple]:
    """Charts of places that differ most in colour: means over blocks of pixels, away from the extremes; their marks."""
    step = max(1, int(np.sqrt(small.shape[0] * small.shape[1] / 4000)))
    rows, columns = (axis.ravel() for axis in np.mgrid[0 : small.shape[0] : step, 0 : small.shape[1] : step])
    there = np.isfinite(xyz[rows, columns]).all(axis=-1)
    rows, columns = rows[there], columns[there]
    if not rows.size:
        return [], ()
    lab = xyz_to_lab(xyz[rows, columns], white_xyz(illuminant("D65")))
    middle = np.linalg.norm(lab - np.median(lab, axis=0), axis=1)
    usual = np.flatnonzero(middle <= np.percentile(middle, 99))
    charts, marks = [], []
    for number, k in enumerate(spread_out(lab[usual], CURVES, int(np.argmin(middle[usual]))), 1):
        i, j = int(rows[usual[k]]), int(columns[usual[k]])
        place = f"{number}: row {i * block + block // 2}, column {j * block + block // 2}"
        charts.append(_spectrum_chart(place, "", [(small[i, j].astype(float) @ basis, False)]))
        marks.append((j + 0.5, i + 0.5, str(number)))
    return charts, tuple(marks)


def _spectrum_chart(label: str, note: str, curves: list[tuple[Any, bool]]) -> Figure:
    swatch = srgb_encode(xyz_to_srgb_linear(xyz_from_spectra(illuminant("D65"), np.asarray(curves[0][0], float))))
    drawn = [
        Curve("", WAVELENGTHS_NM, np.asarray(values, float), INK if dashed else PALETTE[1], dashed)
        for values, dashed in curves
    ]
    top = max(1.0, *(float(np.max(curve.y)) for curve in drawn))
    svg = chart(
        drawn,
        x_label="wavelength, nm",
        y_label="reflectance",
        title=f"reflectance of {label}",
        x_range=(400, 700),
        y_range=(0.0, top * 1.02),
        width=330,
        height=220,
    )
    return Figure(label, note, svg=svg, swatch=hexadecimal(np.round(255 * swatch)))
