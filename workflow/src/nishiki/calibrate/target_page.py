"""The page of a colour target: the photograph with its patches, their colours beside the reference, the verdicts."""

from __future__ import annotations

import numpy as np

from nishiki.calibrate.sensitivities import Sensitivities
from nishiki.calibrate.target import CRITERIA, ColourErrors, Patches, verdict
from nishiki.colour.colour import illuminant, srgb_encode, white_xyz, xyz_to_srgb_linear
from nishiki.colour.sampling import WAVELENGTHS_NM
from nishiki.report.page import Block, Facts, Figure, Figures, Note, Section, Table
from nishiki.report.pictures import encoded
from nishiki.report.svg import Curve, chart

WIDEST, SQUARE = 900, 96
CHANNELS = (("red", "#b5542b"), ("green", "#3f7f4c"), ("blue", "#1f4e79"))
LABELS = {
    "delta_e_mean": "mean CIEDE2000",
    "delta_e_90th_percentile": "90th percentile",
    "delta_e_max": "largest CIEDE2000",
    "lightness_max": "tone: largest difference of L*, grey scale",
    "white_balance_max": "white balance: largest distance in a*b*, grey scale",
}
UNSURE = 0.003
"""Residual of left-out patches from which sensitivities deserve no trust: measured on cameras that the method knows and
does not know (docs/calibrate/target.md)."""
JUDGED = (
    "Judged are colour, tone and white balance of this target alone. Resolution, sharpness, noise, evenness and "
    "geometry, which both documents limit too, are not; a verdict in their name needs the target that they prescribe."
)


def sections_of(
    picture: np.ndarray,
    names: tuple[str, ...],
    reference: np.ndarray,
    patches: Patches,
    judged: dict[str, ColourErrors],
    sensitivities: Sensitivities | None,
) -> list[Section]:
    """What a target's page shows.

    Parameters
    ----------
    picture : (rows, columns, 3) uint8
        The photograph, sRGB-coded.
    names, reference : 24 names, (24, 3)
        Of the patches, XYZ under D50.
    patches : Patches
        What was read.
    judged : dict
        Errors of the colours as delivered and after correction, by these words.
    sensitivities : Sensitivities or None
        Of the camera, where the lamp's spectrum is known.
    """
    sections = [
        Section(
            "colours", "Colours", [*_pictures(picture, reference, patches, judged), _table(names, patches, judged)]
        ),
        Section("verdicts", "Verdicts", [*_verdicts(judged), JUDGED]),
    ]
    if sensitivities is not None:
        sections.append(Section("sensitivities", "Sensitivities of the camera", _sensitivities(sensitivities)))
    return sections


def warnings_of(names: tuple[str, ...], patches: Patches) -> list[str]:
    """What the user should know before the figures."""
    left_out = ", ".join(names[k] for k in np.flatnonzero(~patches.usable))
    return [f"Saturated and left out: {left_out}. Photograph the target with less light."] if left_out else []


def _pictures(picture, reference, patches: Patches, judged: dict[str, ColourErrors]) -> list[Block]:
    import cv2

    scale = min(1.0, WIDEST / picture.shape[1])
    small = cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    for quad in patches.corners:
        cv2.polylines(small, [np.round(quad * scale).astype(np.int32)], True, (255, 255, 255), 2)
    figures = [Figure("Photograph", "Outlined: the squares that were averaged.", encoded(small))]
    for how, errors in judged.items():
        caption = "Each square: the reference around, the photograph in the middle."
        figures.append(Figure(f"Colours {how}", caption, _mosaic(reference, errors)))
    return [Figures(figures, len(figures))]


def _mosaic(reference: np.ndarray, errors: ColourErrors):
    """Squares of the reference colours with those of the photograph inside."""
    white = white_xyz(illuminant("D50"))
    outer, inner = (srgb_encode(np.clip(xyz_to_srgb_linear(xyz, white=white), 0, 1)) for xyz in (reference, errors.xyz))
    codes = np.empty((4 * SQUARE, 6 * SQUARE, 3), np.uint8)
    for k in range(24):
        y, x = k // 6 * SQUARE, k % 6 * SQUARE
        codes[y : y + SQUARE, x : x + SQUARE] = np.round(255 * outer[k])
        edge = SQUARE // 4
        codes[y + edge : y + SQUARE - edge, x + edge : x + SQUARE - edge] = np.round(255 * inner[k])
    return encoded(codes, lossless=True)


def _table(names, patches: Patches, judged: dict[str, ColourErrors]) -> Table:
    head = ["", "patch", *(f"CIEDE2000 {how}" for how in judged), "noise, % of the value"]
    rows = []
    for k, patch in enumerate(names):
        differences = [_known(errors.delta_e[k]) for errors in judged.values()]
        noise = float(100 * patches.deviation[k].mean() / max(patches.mean[k].mean(), 1e-6))
        rows.append([str(k + 1), patch, *differences, noise])
    return Table(head, rows, "rl" + "r" * (len(judged) + 1))


def _known(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


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
        Curve(name, WAVELENGTHS_NM, values, colour)
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
