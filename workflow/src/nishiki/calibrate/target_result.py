"""Calibrate from a photograph of a colour target: write the result and the page that shows it."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from nishiki.calibrate import target
from nishiki.calibrate.result import Calibration, finite
from nishiki.calibrate.target import (
    CRITERIA,
    ColourErrors,
    Patches,
    Sensitivities,
    chart_reflectances,
    recover,
    verdict,
)
from nishiki.capture.tables import read_curves
from nishiki.capture.taking import full_scale_of, table_text
from nishiki.colour.colour import illuminant, srgb_encode, white_xyz, xyz_from_spectra, xyz_to_srgb_linear
from nishiki.colour.sampling import WAVELENGTHS_NM
from nishiki.errors import UserError
from nishiki.formats.coding import RGB
from nishiki.formats.images import read_codes, read_header
from nishiki.report.page import Block, Facts, Figure, Figures, Note, PageSection, Table
from nishiki.report.pictures import encode_picture
from nishiki.report.svg import ChartCurve, chart

WIDEST, SQUARE = 900, 96
CHANNELS = (("red", "#b5542b"), ("green", "#3f7f4c"), ("blue", "#1f4e79"))
LABELS = {
    "delta_e_mean": "mean CIEDE2000",
    "delta_e_90th_percentile": "90th percentile",
    "delta_e_max": "largest CIEDE2000",
    "lightness_max": "tone: largest difference of L*, grey scale",
    "white_balance_max": "white balance: largest distance in a*b*, grey scale",
}
FEWEST = 12
"""Minimum number of unsaturated patches."""
UNSURE = 0.003
"""Residual of omitted patches above which sensitivities are unreliable: measured on cameras that the method knows and
does not know (docs/calibrate/target.md)."""
JUDGED = (
    "Judged are colour, tone and white balance of this target alone. Resolution, sharpness, noise, evenness and "
    "geometry, which both documents limit too, are not; a verdict in their name needs the target that they prescribe."
)


@dataclass(frozen=True)
class TargetInput:
    """Input of a colour target's evaluation."""

    photograph: Path  # of a ColorChecker Classic
    # of the stored values; None: as the file states; without a statement 8 bits are sRGB, all else is linear
    encoding: str | None = None
    # (4, 2) or None: middles of dark skin, bluish green, black and white, (x, y) in pixels; None: the target is
    # searched
    corners: np.ndarray | None = None
    # spectrum of the lamp: a CIE illuminant by name, or a table (CSV); None: no sensitivities are recovered
    light: str | None = None
    reflectances: Path | None = None  # table of this very chart; None: the mean of thirty charts


def calibrate_target(given: TargetInput) -> Calibration:
    """Evaluate the colours of a photographed target; recover the camera's sensitivities if the lamp is known.

    Raises UserError where no target is found, its corners are wrong, too much of it is saturated, or a table is wrong.
    """
    light = None
    if given.light is not None and given.light.lower().endswith(".csv"):
        lamp = read_curves(Path(given.light))
        light = np.interp(WAVELENGTHS_NM, lamp.wavelengths_nm, lamp.values[:, 0])
    elif given.light is not None:
        light = illuminant(given.light)
    names, reflectances = chart_reflectances()
    if given.reflectances:
        table = read_curves(given.reflectances)
        if len(table.names) != len(names):
            found = f"expected {len(names)} columns after wavelength_nm, found {len(table.names)}"
            raise UserError(f"{given.reflectances}: {found}")
        reflectances = np.array([np.interp(WAVELENGTHS_NM, table.wavelengths_nm, each) for each in table.values.T])
    header = read_header(given.photograph)
    assumed = "srgb" if header.sample == "uint8" and header.kind != "raw" else "linear"
    coding = header.choose_coding(given.encoding or ("file" if header.coding else assumed))
    if coding.fault:
        raise UserError(f"{given.photograph.name}: {coding.fault}. Remedy: give --encoding linear or srgb")
    encoding = coding.encoding
    codes = read_codes(given.photograph, RGB, header=header)
    shares = codes / np.float32(full_scale_of(given.photograph))
    linear = coding.curve.decode(shares)
    display = srgb_encode(linear / (1.0 if encoding == "srgb" else max(float(np.percentile(shares, 99.5)), 1e-6)))
    picture = np.round(255 * np.clip(display, 0, 1)).astype(np.uint8)
    reference = xyz_from_spectra(illuminant("D50"), reflectances)
    try:
        corners = target.find_target(picture) if given.corners is None else target.target_at(given.corners)
        patches = target.read_patches(linear, corners, 1.0)
        if np.count_nonzero(patches.usable) < FEWEST or not patches.usable[target.NEUTRAL].any():
            saturated = np.count_nonzero(~patches.usable)
            raise UserError(f"{given.photograph.name}: {saturated} of 24 patches are saturated. Remedy: expose shorter")
        target.expect_target(patches.mean, reference)
    except UserError as error:
        raise UserError(f"{given.photograph.name}: {error}") from None
    judged = {}
    if encoding == "srgb":
        shown = patches.mean if coding.to_srgb is None else patches.mean @ coding.to_srgb.T
        judged["as delivered"] = target.errors_of(shown, reference, patches.usable, delivered=True)
    matrix, predicted = target.fitted_xyz(patches.mean, reference, patches.usable)
    judged["after correction"] = target.errors_of(predicted, reference, patches.usable)
    recovered = None if light is None else recover(patches.mean, light, reflectances, patches.usable)
    numbers = {
        "encoding": encoding,
        "patches": list(names),
        "usable": patches.usable.tolist(),
        "matrix_xyz_d50": matrix.tolist(),
        **{how.replace(" ", "_"): errors.as_dict() for how, errors in judged.items()},
    }
    lines, files = {}, {}
    if recovered is not None:
        numbers["sensitivities"] = {"residual": recovered.residual, "left_out": recovered.left_out}
        lines["camera"] = {"channels": list(RGB), "sensitivities": "sensitivities.csv"}
        curves = zip(WAVELENGTHS_NM, recovered.curves.T, strict=True)
        rows = [[f"{nm:g}", *(f"{value:.5f}" for value in values)] for nm, values in curves]
        files["sensitivities.csv"] = table_text([["wavelength_nm", *RGB], *rows])
    left_out = ", ".join(names[k] for k in np.flatnonzero(~patches.usable))
    warnings = [f"Saturated and left out: {left_out}. Photograph the target with less light."] if left_out else []
    if given.encoding is None:
        how = coding.name if header.coding else f"{encoding} ({header.kind}, {header.sample})"
        warnings.append(f"Read as {how}; --encoding says otherwise.")
    sentences = [f"{given.photograph.name}."]
    for how, errors in judged.items():
        levels = ", ".join(f"{standard}: {verdict(errors.summary, standard)}" for standard in CRITERIA)
        mean, largest = errors.summary["delta_e_mean"], errors.summary["delta_e_max"]
        sentences.append(f"Colours {how}: CIEDE2000 {mean:.2f} mean, {largest:.2f} largest ({levels}).")
    colours = [*_pictures(picture, reference, patches, judged), _table(names, patches, judged)]
    sections = [
        PageSection("colours", "Colours", colours),
        PageSection("verdicts", "Verdicts", [*_verdicts(judged), JUDGED]),
    ]
    if recovered is not None:
        sections.append(PageSection("sensitivities", "Sensitivities of the camera", _sensitivities(recovered)))
    inputs = [given.photograph, *([given.reflectances] if given.reflectances else [])]
    return Calibration("target", numbers, inputs, lines, sections, " ".join(sentences), files, warnings)


def _pictures(picture, reference, patches: Patches, judged: dict[str, ColourErrors]) -> list[Block]:
    import cv2

    scale = min(1.0, WIDEST / picture.shape[1])
    small = cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    for quad in patches.corners:
        cv2.polylines(small, [np.round(quad * scale).astype(np.int32)], True, (255, 255, 255), 2)
    figures = [Figure("Photograph", "Outlined: the squares that were averaged.", encode_picture(small))]
    for how, errors in judged.items():
        caption = "Each square: the reference around, the photograph in the middle."
        figures.append(Figure(f"Colours {how}", caption, _mosaic(reference, errors)))
    return [Figures(figures, len(figures))]


def _mosaic(reference: np.ndarray, errors: ColourErrors):
    """Draw squares of the reference colours with those of the photograph inside."""
    white = white_xyz(illuminant("D50"))
    outer, inner = (srgb_encode(np.clip(xyz_to_srgb_linear(xyz, white=white), 0, 1)) for xyz in (reference, errors.xyz))
    codes = np.empty((4 * SQUARE, 6 * SQUARE, 3), np.uint8)
    for k in range(24):
        y, x = k // 6 * SQUARE, k % 6 * SQUARE
        codes[y : y + SQUARE, x : x + SQUARE] = np.round(255 * outer[k])
        edge = SQUARE // 4
        codes[y + edge : y + SQUARE - edge, x + edge : x + SQUARE - edge] = np.round(255 * inner[k])
    return encode_picture(codes, lossless=True)


def _table(names, patches: Patches, judged: dict[str, ColourErrors]) -> Table:
    head = ["", "patch", *(f"CIEDE2000 {how}" for how in judged), "noise, % of the value"]
    rows = []
    for k, patch in enumerate(names):
        differences = [finite(errors.delta_e[k]) for errors in judged.values()]
        noise = float(100 * patches.deviation[k].mean() / max(patches.mean[k].mean(), 1e-6))
        rows.append([str(k + 1), patch, *differences, noise])
    return Table(head, rows, "rl" + "r" * (len(judged) + 1))


def _verdicts(judged: dict[str, ColourErrors]) -> list[Block]:
    blocks: list[Block] = [
        Facts(
            [(f"{standard}, {how}", verdict(e.summary, standard)) for standard in CRITERIA for how, e in judged.items()]
        )
    ]
    for standard, levels in CRITERIA.items():
        rows = [
            [label, *(e.summary[name] for e in judged.values()), *(limits.get(name) for limits in levels.values())]
            for name, label in LABELS.items()
        ]
        head = ["", *judged, *levels]
        blocks.append(Table(head, rows, "w" + "r" * (len(judged) + len(levels)), caption=f"Limits of {standard}"))
    return blocks


def _sensitivities(found: Sensitivities) -> list[Block]:
    curves = [
        ChartCurve(name, WAVELENGTHS_NM, values, colour)
        for (name, colour), values in zip(CHANNELS, found.curves, strict=True)
    ]
    drawing = chart(
        curves,
        x_label="wavelength, nm",
        y_label="sensitivity, largest at 1",
        title="Sensitivities of the camera",
        y_range=(0, 1.1),
    )
    text = (
        f"They leave {100 * found.residual:.2g} % of the white patch, root mean square, and "
        f"{100 * found.left_out:.2g} % of patches that were left out in turn."
    )
    blocks: list[Block] = [Figures([Figure("Sensitivities", text, svg=drawing)], 1)]
    if found.left_out > UNSURE:
        blocks.append(
            Note(
                [
                    "Do not use them: what they leave is more than noise. Either the lamp's spectrum is another one, "
                    "the photograph is not linear, or the camera is unlike those that the method knows."
                ],
                warning=True,
            )
        )
    return blocks
