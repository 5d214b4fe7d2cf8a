"""Write the sections of a painting's page on shape and colour: normals, height, spectra and their errors."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from nishiki.artifacts.maps import Maps, shrink
from nishiki.artifacts.stage import Context
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
from nishiki.evaluate.camera_colour import read_camera_colour
from nishiki.observations.plane import Observations
from nishiki.photometric.flags import NO_ESTIMATE, NormalFlag
from nishiki.report.page import Block, Figure, Figures, Heading, PageSection, Table
from nishiki.report.pictures import (
    Ruler,
    block_of,
    brightening,
    class_picture,
    colour_picture,
    describe_brightening,
    heat,
    hexadecimal,
    hillshade,
    normal_picture,
    ruler,
    scalar_picture,
    sea,
)
from nishiki.report.scene_page import SceneData
from nishiki.report.svg import DASHES, PALETTE, SOFT, ChartCurve, chart, figure

# From harmless to grave: later ones win where a block of pixels has several.
CLASSES = (
    (0, "#b9d1b3", "sound estimate"),
    (NormalFlag.FALLBACK, "#cfc08a", "simple estimate stands"),
    (NormalFlag.NO_REDUNDANCY, "#e3b04b", "as many lights as unknowns"),
    (NormalFlag.ILL_CONDITIONED | NormalFlag.FACES_AWAY, "#d9772f", "ill-conditioned, or faces away"),
    (NO_ESTIMATE, "#9c2a2a", "no estimate"),
)
ROWS_AGAINST_TRUTH = {
    "estimated": "with an estimate",
    "unflagged": "of these without a flag",
    "flagged": "of these with a flag",
    "inside": "whole object, pixels without estimate as flat",
}
NORMALS = (
    "OpenGL convention: red to the right, green upwards, blue towards the camera. A flat surface is even lilac-blue; "
    "blotches of colour that follow the paint instead of the relief would be an error."
)
RELIEF = "the integrated height under a slanting lamp from the upper left; slopes are scaled to be seen."
HEIGHT = (
    "integrated from the normals; level and tilt are free, long waves are the least certain. Pieces that nothing "
    "connects stand each at its own level: how one lies above the other is not known."
)
CALIBRATED = (
    "root mean square angle, from lamps left out, from slopes around it that no surface has, and from the tilt. "
    "Errors that all lamps share (light reflected twice, wrong directions) are not in it: of the true errors 64 to "
    "76 % were below it on five of six paintings that were kept back, 30 and 33 % on two objects under 96 lamps, 21 "
    "and 53 % on two mosaics."
)
FORMAL = "root mean square angle, from lamps left out. Errors that all lamps share are not in it."
LIGHTS_OF_REFINED = (
    "how many lights the joint fit of normals and gloss believes at each pixel (with more than half of their weight). "
    "It models highlights instead of leaving them out, so that the selection of diffuse lights does not limit it. "
    "Fewer than three give no normal."
)
LIGHTS = (
    "how many lights showed plain diffuse reflection at each pixel. Few lights at highlights and in hollows are right; "
    "fewer than three give no normal."
)


GLOSSY_DEG, SATIN_DEG = 6.0, 13.0
"""Largest half widths of the facets of a finish named glossy, and satin."""


def finish_names(finishes: list[dict[str, Any]]) -> list[str]:
    """Name every finish of the diagnostics of `normals` by its gloss, alike ones with a number."""
    names = []
    for finish in finishes:
        beta, gamma = (np.array(finish.get(name) or [0.0]) for name in ("gloss_beta", "gloss_gamma_deg"))
        phi = np.linspace(0, 90, 1801)
        profile = np.exp2(-((phi[:, None] / np.maximum(gamma, 1e-9)) ** 2)) @ beta
        half = float(phi[profile >= 0.5 * profile[0]].max())
        shiny = "glossy" if half < GLOSSY_DEG else "satin" if half < SATIN_DEG else "sheen"
        name = shiny if beta.any() and finish.get("gloss_counts", True) else "matt"
        if finish["joint"] and "gloss_colour" in finish:
            colour = finish["gloss_colour"]
            name = "gilding" if len(colour) == 3 and colour[0] >= colour[1] > colour[2] else "metal"
        names.append(name)
    return [f"{name} {names[: k + 1].count(name)}" if names.count(name) > 1 else name for k, name in enumerate(names)]


class PaintingData(SceneData):
    """Input of the sections of a painting's page, beside that of any page.

    frames : observations; kinds : of the lights; maps : of the stages that left some, by their names; mask : (rows,
    columns) bool, the object; pitch : of a pixel, mm; block : side of the squares of pixels whose means make a picture;
    ruler : below pictures; camera : map of the channels to XYZ; finishes, names : of the normals' diagnostics.
    """

    def __init__(self, context: Context):
        super().__init__(context)
        ingest, normals = self.inputs["ingest"], self.inputs["normals"]
        frames = self.frames = Observations(ingest.folder)
        held_out = normals.settings.get("hold_out", [])
        self.kinds = [
            "check" if role == "check" else ("held out" if name in held_out else "sample")
            for name, role in zip(frames.lights, frames.roles, strict=True)
        ]
        self.maps = {name: Maps(each.folder) for name, each in self.inputs.items() if each.path("maps.zarr").is_dir()}
        self.mask, self.pitch = frames.mask, frames.pixel_pitch_mm
        self.block, self.ruler = block_of(frames.shape[1], self.widest), ruler(frames.shape[1], self.pitch)
        self.camera = read_camera_colour(ingest.path("curves.npz"), len(frames.channels), frames.to_srgb)
        self.finishes = normals.diagnostics.get("finishes") or []
        self.names = finish_names(self.finishes)

    def read_known(self, rows: slice) -> np.ndarray:
        """Return the pixels of the object that have an estimate, (r, columns) bool."""
        return self.mask[rows] & ((self.maps["normals"].read("flags", rows) & NO_ESTIMATE) == 0)

    def small(self, read: Callable[[slice], np.ndarray], how: str = "mean", *, masked: bool = False) -> np.ndarray:
        """Reduce a map to the columns of a picture; masked : from the pixels that have an estimate only, else NaN."""

        def values(rows: slice) -> np.ndarray:
            found = np.array(read(rows), np.float32)
            found[~self.read_known(rows)] = np.nan
            return found

        return shrink(values if masked else read, self.mask.shape, self.block, how)


def shape_section(page: PaintingData) -> PageSection:
    """Return normals, height and their errors."""
    diagnostics = page.diagnostics["normals"]
    normals, height, evaluated = (page.maps.get(name) for name in ("normals", "height", "evaluate"))
    known = page.small(lambda rows: page.read_known(rows).astype(np.float32)) > 0

    def small(name: str, maps: Maps = normals) -> np.ndarray:
        return np.where(
            known.reshape(known.shape + (1,) * (maps.group[name].ndim - 2)),
            page.small(partial(maps.read, name)),
            np.nan,
        )

    calibrated = height is not None and "expected_error" in height
    sigma = np.degrees(small("expected_error", height) if calibrated else small("sigma"))
    error = small("angular_error", evaluated) if evaluated is not None and "angular_error" in evaluated else None
    # one scale for both, so that expected and true errors can be compared
    ends = [np.nanpercentile(v, 98) for v in (sigma, error) if v is not None and np.isfinite(v).any()]
    end = float(max(ends, default=1))
    items = [Figure("Normals", NORMALS, normal_picture(small("normals")), ruler=page.ruler)]
    if height is not None:
        items += _height(page, small("height", height).astype(np.float64))
    expected = scalar_picture(sigma, heat(), unit="degrees", low=0.0, high=end)
    items.append(Figure("Expected error of the normals", CALIBRATED if calibrated else FORMAL, expected))
    if error is not None:
        picture = scalar_picture(error, heat(), unit="degrees", low=0.0, high=end)
        items.append(Figure("Angle to the true normals", "compare with the expected error beside it.", picture))
    if "lights_used" in normals:
        lights = scalar_picture(small("lights_used"), sea(), unit="lights", digits=3)
        items.append(Figure("Lights used", LIGHTS_OF_REFINED if diagnostics.get("refined") else LIGHTS, lights))
    key = {k: (colour, text) for k, (_, colour, text) in enumerate(CLASSES)}
    flags = class_picture(_flags(page), key)
    items.append(Figure("Weak places", "where an estimate is missing or weak.", flags))
    given = _given_blocks(diagnostics["given"]) if diagnostics.get("given") else []
    return PageSection("shape", "Shape", [Figures(items), *given, *_against_truth(page.evaluation)])


def _given_blocks(given: dict[str, Any]) -> list[Block]:
    axes, like, following = (given[name] for name in ("axes", "correlation", "correlation_next_axes"))
    apart = figure(given["apart_median_deg"], 3, "degrees")
    blocks: list[Block] = [
        f"The normals are those of a picture that was given (normals.given), read with x = {axes['x']} and "
        f"y = {axes['y']} of the picture. They are {apart} (median) off those of the photographs, and correlate with "
        f"them by {like:.2f} (with the next best axes by {following:.2f}). Light is predicted "
        "with those of the photographs."
    ]
    return blocks


def _against_truth(evaluation: dict[str, Any]) -> list[Block]:
    blocks: list[Block] = []
    if angles := evaluation.get("normals"):
        parts = [(label, angles[name]) for name, label in ROWS_AGAINST_TRUTH.items()]
        for part in angles["by_slope"]:
            if part["count"]:
                parts.append((f"true slope {part['from_deg']:g}° to {part['to_deg']:g}°", part))
        rows = [(label, part["mean"], part["median"], part["p90"], part["count"]) for label, part in parts]
        head = ("Pixels", "mean", "median", "90 %", "number")
        blocks.append(Table(head, rows, "lrrrr", "Angle between estimated and true normals, degrees."))
    if (height := evaluation.get("height")) and height["rms"] is not None:
        rms, p90, relief = (figure(1000 * height[name], 3, "µm") for name in ("rms", "p90", "relief_rms"))
        blocks.append(
            f"Height against truth, less a plane: rms {rms}, 90th percentile {p90}; the relief itself has an rms of "
            f"{relief}."
        )
    return blocks


def _flags(page: PaintingData) -> np.ndarray:
    """Return the most severe class of each block of pixels; NaN outside the mask."""
    classes = page.small(lambda rows: _classes(page.maps["normals"].read("flags", rows)), "largest")
    return np.where(page.small(lambda rows: page.mask[rows].astype(np.float32)) > 0, classes, np.nan)


def _classes(flags: np.ndarray) -> np.ndarray:
    classes = np.zeros(flags.shape, np.float32)
    for rank, (bit, _, _) in enumerate(CLASSES):
        if bit:
            classes[(flags & bit) != 0] = rank
    return classes


def _height(page: PaintingData, values: np.ndarray) -> list[Figure]:
    unit = page.maps["height"].attributes("height").get("unit", "")
    step = (page.pitch or 1.0) * page.block if unit == "mm" else float(page.block)
    flat = values - np.nanmin(values) if np.isfinite(values).any() else values
    relief = np.repeat(hillshade(values, step=step)[..., None], 3, axis=-1)
    return [
        Figure("Relief", RELIEF, colour_picture(relief), ruler=page.ruler),
        Figure("Height", HEIGHT, scalar_picture(flat, sea(), unit=unit, low=0.0), ruler=page.ruler),
    ]


CURVES = 9  # on the page
ILLUMINANTS = {"D65": "daylight, D65", "A": "incandescent, A", "FL11": "fluorescent of three narrow bands, FL11"}
UNDER_D65 = "CIEDE2000 of the diffuse reflectance under D65, not under the lamp of the capture."
EXPECTED_ERROR = "for surfaces like those of the training set; light patches are colours unlike any of them."
PLACES = (
    "Places that differ most in colour, numbered in the picture above. A camera of few channels fixes the colour, not "
    "the curve: fine structure comes from the training set. Dotted: one expected error to either side."
)
VARNISH = (
    "The spectra are those of the surface as the camera sees it, that is through the varnish: a yellowed or matt "
    "varnish is part of them."
)


def colour_section(page: PaintingData) -> PageSection:
    """Return diffuse reflectance, spectra where there are some, and their errors."""
    normals, spectra, evaluated = (page.maps.get(name) for name in ("normals", "spectra", "evaluate"))
    maps, name = (normals, "reflectance") if spectra is None else (spectra, "coefficients")
    small = page.small(partial(maps.read, name), masked=True)
    if spectra is None:
        figure = _diffuse(
            xyz_to_srgb_linear(page.camera.xyz(small), white=page.camera.white), page.camera.how, (), page.ruler
        )
        return PageSection("colour", "Colour", [Figures([figure])])
    basis = np.array(spectra.attributes("coefficients")["basis"])
    xyz = small @ xyz_matrix(illuminant("D65"), basis).T
    sigma = page.small(partial(spectra.read, "sigma"), masked=True)
    profile = np.array(spectra.attributes("sigma")["profile"])
    truth = page.evaluation.get("reflectance") or {}
    curves, marks = _draw_places(small, xyz, basis, sigma[..., None] * profile, page.block)
    items = [_diffuse(xyz_to_srgb_linear(xyz), "from the spectra of the pixels, under D65", marks, page.ruler)]
    if evaluated is not None and "reflectance_de00" in evaluated:
        difference = page.small(partial(evaluated.read, "reflectance_de00"))
        picture = scalar_picture(difference, heat(), unit="ΔE00 under D65", low=0.0)
        items.append(Figure("Difference to the true reflectance", UNDER_D65, picture))
    picture = scalar_picture(sigma, heat(), unit="reflectance, expected rms", low=0.0)
    items.append(Figure("Expected error of the spectra", EXPECTED_ERROR, picture))
    blocks: list[Block] = [Figures(items)]
    if curves:
        blocks += [Heading("Spectra"), f"{PLACES} {VARNISH}", Figures(curves, 3)]
    return PageSection("colour", "Colour", [*blocks, *_tables(page.value("spectra", "expected_de00") or {}, truth)])


def _diffuse(linear: np.ndarray, how: str, marks: tuple, ruler: Ruler | None) -> Figure:
    factor = brightening(linear)
    numbers = " The numbers are the places of the spectra below." if marks else ""
    caption = f"the object without highlights, shadows and shading; {how}.{describe_brightening(factor)}{numbers}"
    return Figure("Diffuse reflectance", caption, replace(colour_picture(factor * linear), marks=marks), ruler=ruler)


def _tables(expected_de00: dict[str, float], truth: dict[str, Any]) -> list[Block]:
    """Tabulate expected colour errors, and errors of the reflectance against a truth."""
    tables: list[Block] = []
    if expected_de00:
        rows: list[list[Any]] = [[ILLUMINANTS[light], value] for light, value in expected_de00.items()]
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
    """Choose at most `count` points (n, k) far from one another: from `first` on, always the farthest next."""
    chosen = [first]
    distance = np.linalg.norm(points - points[first], axis=1)
    while len(chosen) < min(count, len(points)):
        following = int(np.argmax(distance))
        if not distance[following] > 0:
            break
        chosen.append(following)
        distance = np.minimum(distance, np.linalg.norm(points - points[following], axis=1))
    return chosen


def _draw_places(
    small: np.ndarray, xyz: np.ndarray, basis: np.ndarray, sigma: np.ndarray, block: int
) -> tuple[list[Figure], tuple]:
    """Draw spectra of places that differ most in colour: means over blocks of pixels, without extremes; and marks.

    sigma : (rows, columns, 61) expected error of each.
    """
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
        charts.append(_spectrum_chart(place, small[i, j].astype(float) @ basis, sigma[i, j]))
        marks.append((j + 0.5, i + 0.5, str(number)))
    return charts, tuple(marks)


def _spectrum_chart(label: str, spectrum: np.ndarray, sigma: np.ndarray) -> Figure:
    """Draw a spectrum (61,) between its expected errors (61,)."""
    swatch = srgb_encode(xyz_to_srgb_linear(xyz_from_spectra(illuminant("D65"), spectrum)))
    edges = (spectrum - sigma, spectrum + sigma)
    svg = chart(
        [
            ChartCurve("", WAVELENGTHS_NM, spectrum, PALETTE[1]),
            *(ChartCurve("", WAVELENGTHS_NM, edge, SOFT, dashed=True, dash=DASHES[1]) for edge in edges),
        ],
        x_label="wavelength, nm",
        y_label="reflectance",
        title=f"reflectance of {label}",
        x_range=(400, 700),
        y_range=(0.0, max(1.0, float(np.max(spectrum))) * 1.02),
        size=(330, 220),
    )
    return Figure(label, svg=svg, swatch=hexadecimal(np.round(255 * swatch)))
