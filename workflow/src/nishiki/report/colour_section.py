"""The part of the page on colour: diffuse reflectance as a picture, spectra of some places or regions."""

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
from nishiki.report.pictures import block_of, brightened, brightening, colour_picture, scalar_picture, shrink
from nishiki.report.svg import INK, PALETTE, Curve, chart

CURVES = 9
LEAST_SHARE = 0.002


def colour_section(
    normals, *, widest: int, camera: CameraColour, spectra=None, evaluated=None, evaluation=None, known=None
) -> dict[str, Any]:
    """Content of the section.

    normals, spectra, evaluated : `Maps` of those stages or None; camera : map of the channels to XYZ, used where there
    are no spectra; evaluation : evaluation.json or None; known : (rows, columns) bool, pixels with an estimate.
    """
    shape = tuple(normals.group["reflectance"].shape[:2])
    block = block_of(shape[1], widest)
    content = {"spectra": [], "how": "", "de00": None, "sigma": None, "against_truth": False}
    maps, name = (normals, "reflectance") if spectra is None else (spectra, "coefficients")
    small = shrink(lambda rows: _masked(maps.read(name, rows), known, rows), shape, block)
    if spectra is None:
        content |= _diffuse(xyz_to_srgb_linear(camera.xyz(small), white=camera.white), camera.how)
        return content
    basis = np.array(spectra.attributes("coefficients")["basis"])
    lamp = illuminant("D65")
    xyz = small @ xyz_matrix(lamp, basis).T
    content |= _diffuse(xyz_to_srgb_linear(xyz), "from the spectra of the pixels, under D65")
    sigma = shrink(lambda rows: _masked(spectra.read("sigma", rows), known, rows), shape, block)
    content["sigma"] = scalar_picture(sigma, heat(), unit="reflectance, expected rms", low=0.0)
    regions = ((evaluation or {}).get("reflectance") or {}).get("regions")
    if regions:
        labels = None
        if evaluated is not None and "regions" in evaluated:
            labels = np.asarray(evaluated.read("regions"))[block // 2 :: block, block // 2 :: block]
        content["spectra"], marks = _of_regions(regions, evaluation["reflectance"]["region_names"], labels)
        content["diffuse"] = replace(content["diffuse"], marks=marks)
        content["against_truth"] = True
    else:
        content["spectra"], marks = _of_places(small, xyz, basis, block)
        content["diffuse"] = replace(content["diffuse"], marks=marks)
    if evaluated is not None and "reflectance_de00" in evaluated:
        difference = shrink(lambda rows: evaluated.read("reflectance_de00", rows), shape, block)
        content["de00"] = scalar_picture(difference, heat(), unit="ΔE00 under D65", low=0.0)
    return content


def _diffuse(linear: np.ndarray, how: str) -> dict[str, Any]:
    factor = brightening(linear)
    return {"diffuse": colour_picture(factor * linear), "how": f"{how}.{brightened(factor)}"}


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


def _of_regions(regions: list[dict], names: list[str], labels: np.ndarray | None) -> tuple[list[dict], tuple]:
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
        note = f"{region['pixels']} pixels, rms {region['rmse']:.3f}"
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


def _of_places(small: np.ndarray, xyz: np.ndarray, basis: np.ndarray, block: int) -> tuple[list[dict], tuple]:
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


def _spectrum_chart(label: str, note: str, curves: list[tuple[Any, bool]]) -> dict[str, Any]:
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
    return {"label": label, "note": note, "svg": svg, "swatch": hexadecimal(np.round(255 * swatch))}
