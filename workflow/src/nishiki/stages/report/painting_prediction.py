"""Write the section of a painting's page on lights that no fit used: prediction beside photograph."""

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np

from nishiki.evaluate.relighting import DIFFUSE, FADGI, HIGHLIGHT, ISO_19264, SHADOW
from nishiki.formats.stored import load_arrays
from nishiki.report.page import Block, Cell, Figure, Figures, Heading, Note, PageSection, Table
from nishiki.report.pictures import (
    balance,
    brightening,
    class_picture,
    colour_picture,
    describe_brightening,
    heat,
    scalar_picture,
)
from nishiki.report.svg import format_signed
from nishiki.stages.report.painting_surface import PaintingData

MOST_LIGHTS = 4  # on the page, the worst among them
LUMINANCE = np.array([0.2126, 0.7152, 0.0722], np.float32)  # of linear sRGB, IEC 61966-2-1
LEAST_SIGNED_END = 1.0  # per cent of the white: smaller differences are the camera's noise
LARGEST_DE00 = 10.0
"""End of the scale of difference maps: the same for all lights, so that they can be compared."""
CLASSES = ("diffuse", "highlight", "shadow")
CLASS_KEY = {
    DIFFUSE: ("#a9c0c9", "diffuse"),
    HIGHLIGHT: ("#e3a72f", "highlight in view"),
    SHADOW: ("#3c4657", "shadow"),
}


def relighting_section(page: PaintingData) -> PageSection | None:
    """Write the section on relighting; None where no light was held out of the fits."""
    evaluation, finishes = page.evaluation, page.names
    if not evaluation["lights"]:
        return None
    lights, overall, how = evaluation["lights"], evaluation["overall"], evaluation["colour"]["how"]
    lamp = "as if under D65" if evaluation["colour"]["rmse_xyz"] is None else "under the lamp of the capture"
    from_truth = evaluation["classes_from"] == "truth"
    blocks: list[Block] = [
        "The lights below were kept from every fit. Every colour difference of this section is taken "
        f"{lamp}, relative to a perfect white that faces that lamp. The record predicts what the camera would see "
        "under each of them; the photograph shows what it did see. Both are shown through the same map from camera "
        f"channels to display colour ({how})."
    ]
    shown = [lights[k] for k in chosen(lights)]
    previews = [load_arrays(page.inputs["evaluate"].path(f"preview_{light['index']:03d}.npz")) for light in shown]
    differences, end = signed_differences(previews)
    for light, preview, difference in zip(shown, previews, differences, strict=True):
        aside = f"({light['role']}, {light['incidence_deg']:.0f}° from the normal of the plane)"
        blocks.append(Heading(f"Light {light['name']}", aside))
        captions = _captions(from_truth) if light is shown[0] else [""] * 5
        blocks.append(Figures(_pictures(page, light, preview, difference, end, captions), 5))
    classes_from = (
        "the truth"
        if from_truth
        else "the prediction, never from the photograph, so that an error cannot hide by changing its class"
    )
    blocks += [
        _table_of_lights(lights, overall, lamp),
        f"Classes are taken from {classes_from}. Left out: pixels of the object that are saturated or dark in the "
        "photograph, or have no estimate.",
        *_against_truth(lights),
        _table_of_parts(evaluation["parts"], finishes),
        _in_museum_terms(evaluation, finishes),
    ]
    return PageSection("relighting", "Prediction and photograph", blocks)


def _captions(from_truth: bool) -> list[str]:
    source = "the true parts of the light" if from_truth else "the prediction"
    return [
        "as the camera saw it.",
        "from the record alone; highlights and shadows should lie where the photograph has them.",
        "dark is good; hardly anybody sees 1, and from 10 on the colours are plainly different.",
        "prediction less photograph, luminance in per cent of the white: blue is too dark, red too bright; in "
        "highlights, too little or too much gloss.",
        f"by {source}; a highlight is more than a tenth of all light from a pixel.",
    ]


def _pictures(page: PaintingData, light, preview, difference: np.ndarray, end: float, captions) -> list[Figure]:
    maps = page.maps["evaluate"]
    inside = np.asarray(preview["inside"])
    observed, predicted = (np.asarray(preview[name], np.float32) for name in ("observed", "predicted"))
    factor = brightening(observed[inside])
    de00, classes = f"de00_{light['index']:03d}", f"classes_{light['index']:03d}"

    def rank(rows: slice) -> np.ndarray:
        """Read classes as floats, 0 (not compared) as NaN, so that a block takes its most severe one."""
        values = maps.read(classes, rows)
        return np.where(values > 0, values, np.nan).astype(np.float32)

    in_view = page.small(rank, "largest")
    small = page.small(partial(maps.read, de00))
    pictures = {
        "Photograph": colour_picture(factor * observed, inside=inside),
        "Prediction": colour_picture(factor * predicted, inside=inside),
        "Difference": scalar_picture(small, heat(), unit="ΔE00", low=0.0, high=LARGEST_DE00),
        "Signed difference": scalar_picture(difference, balance(), unit="% of white", low=-end, high=end),
        "What is in view": class_picture(in_view, CLASS_KEY),
    }
    notes = [describe_brightening(factor)] * 2 + [""] * 3
    items = zip(pictures.items(), captions, notes, strict=True)
    return [Figure(name, (caption + note).strip(), picture) for (name, picture), caption, note in items]


def _table_of_lights(lights: list[dict[str, Any]], overall: dict[str, Any], lamp: str) -> Table:
    rows: list[list[Cell]] = []
    for light in lights:
        row = [light["name"], light["role"], f"{light['incidence_deg']:.0f}°", *_mean_and_p90(light["de00"])]
        for name in CLASSES:
            row += _mean_and_p90(light["by_class"][name]["de00"])
            if name == "highlight":
                row.append(format_signed(light["by_class"][name]["bias"]))
        rows.append([*row, light["psnr_linear_db"], light["psnr_coded_db"], sum(light["excluded"].values())])
    rows.append(["all lights", "", "", *_mean_and_p90(overall["de00"]), *[""] * 10])
    head = ["Light", "kept as", "from normal", *["mean", "90 %"] * 3, "signed", *["mean", "90 %"]]
    return Table(
        [*head, "linear", "coded", "left out"], rows, "llr" + "r" * 12,
        f"Colour difference (CIEDE2000 {lamp}, mean and 90th percentile over pixels), signed error in highlights (mean "
        "of prediction less photograph, in per cent of the white: negative where the predicted gloss is too weak), and "
        "PSNR (dB, peak = white) of prediction against photograph. The photograph's own noise is part of every figure.",
        (("", 3), ("all pixels", 2), ("diffuse", 2), ("highlight", 3), ("shadow", 2), ("PSNR", 2), ("", 1)),
        last_is_sum=True,
    )  # fmt: skip


def _mean_and_p90(part: dict[str, float | None]) -> list[Cell]:
    return [part["mean"], part["p90"]]


def _against_truth(lights: list[dict[str, Any]]) -> list[Block]:
    """Tabulate the prediction against noise-free truth, where there is one."""
    cases = sorted({case for light in lights for case in (light.get("truth") or {})}, key=lambda case: case != "lamp")
    if not cases:
        return []
    rows: list[list[Cell]] = []
    for light in lights:
        if light.get("truth"):
            parts = [light["truth"][case] for case in cases]
            cells = [[*_mean_and_p90(p["de00"]), *(p["by_class"][name]["mean"] for name in CLASSES)] for p in parts]
            rows.append([light["name"], *(cell for part in cells for cell in part)])
    return [
        Table(
            ["Light", *["mean", "90 %", *CLASSES] * len(cases)], rows, "l" + "rrrrr" * len(cases),
            "The same prediction against noise-free truth (CIEDE2000). Under the lamp of the capture it is the error "
            "of the record without the photograph's noise; under D65 it also contains what the spectra got wrong.",
            [("", 1), *(("lamp of the capture" if case == "lamp" else case, 5) for case in cases)],
        )
    ]  # fmt: skip


def part_name(part: dict[str, Any], finishes: Sequence[str]) -> str:
    """Name a part of `evaluation.json` by its finish, or region of the capture."""
    number = part["finish"]
    name = finishes[number] if number < len(finishes) else f"region {number}"
    return f"{name}, darkest quarter" if part["dark"] else name


def worst_part(parts: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return the part with the largest mean difference."""
    return max(parts, key=lambda part: part["de00"]["mean"])


def worst_level(part: dict[str, Any]) -> dict[str, Any]:
    """Return the light with the largest error of a part's level."""
    return max(part["lights"], key=lambda light: abs(light["level_error"]))


def _table_of_parts(parts: Sequence[dict[str, Any]], finishes: Sequence[str]) -> Table:
    rows: list[list[Cell]] = []
    for part in parts:
        light = worst_level(part)
        level = format_signed(light["level_error"]), f"{light['incidence_deg']:.0f}°"
        rows.append([part_name(part, finishes), 100 * part["share"], *_mean_and_p90(part["de00"]), *level])
    return Table(
        ("Part", "share, %", "mean", "90 %", "level", "under a lamp at"), rows, "lrrrrr",
        "The same by finish, its darkest quarter apart: colour difference over all lights, and how much brighter the "
        "prediction is than the photograph, on the mean, under the lamp where they differ most (from the normal).",
    )  # fmt: skip


def _in_museum_terms(evaluation: dict[str, Any], finishes: Sequence[str]) -> Note:
    levels, parts, lights = evaluation["overall"]["levels"], evaluation["parts"], evaluation["lights"]
    part = part_name(worst_part(parts), finishes) if parts else "the whole"
    incidence = [light["incidence_deg"] for light in lights]
    iso = f"level {levels['iso_19264']}" if levels["iso_19264"] in ("A", "B") else levels["iso_19264"]
    stars = [f"{level.mean:g}" + (f" and {level.p90:g}" if level.p90 else "") + f" ({level.name})" for level in FADGI]
    grades = [f"{level.mean:g} ({level.name})" for level in ISO_19264]
    return Note([
        "In museum terms: held against the limits for colour accuracy of two guidelines, the differences of the part "
        f"that is predicted worst ({part}) are of the order of FADGI: {levels['fadgi']}, ISO 19264-1: {iso}. There is "
        "none where a part is a tenth too dark or too bright under any lamp.",
        f"What the level covers: {len(lights)} photographs of this camera and lamp, with the lamp "
        f"{min(incidence):.0f}° to {max(incidence):.0f}° from the normal. What it leaves out: lamps beyond these, "
        "other lamps' spectra, views from the side, and whether the reflectance is the paint's or holds some gloss.",
        f"Limits used: FADGI 2023, mean and 90th percentile of ΔE00 below {', '.join(stars)}; ISO 19264-1:2021, mean "
        f"at most {', '.join(grades)}. Both are defined for the patches of a colour target under the studio's light, "
        "not for pixels of a prediction under new lights: this is an orientation, not a certificate.",
    ])  # fmt: skip


def chosen(lights: list[dict[str, Any]], count: int = MOST_LIGHTS) -> list[int]:
    """Choose lights for display: all, or evenly by rank of their mean difference, best and worst among them."""
    if len(lights) <= count:
        return list(range(len(lights)))
    ranks = sorted(range(len(lights)), key=lambda k: (lights[k]["de00"]["mean"] or 0.0, k))
    places = np.round(np.linspace(0, len(ranks) - 1, count)).astype(int)
    return sorted(ranks[p] for p in places)


def signed_differences(pairs: Sequence[Mapping[str, Any]]) -> tuple[list[np.ndarray], float]:
    """Return the luminance of prediction less photograph of previews, and the end of their common scale.

    Per cent of the white; NaN outside the object. The end is the 98th percentile of all magnitudes, up to 1, 2 or 5
    times 10^n.
    """
    maps = []
    for pair in pairs:
        difference = np.asarray(pair["predicted"], np.float32) - np.asarray(pair["observed"], np.float32)
        maps.append(np.where(np.asarray(pair["inside"]), 100 * (difference @ LUMINANCE), np.nan))
    values = np.concatenate([np.abs(values[np.isfinite(values)]) for values in maps])
    least_end = max(float(np.percentile(values, 98)) if values.size else 0.0, LEAST_SIGNED_END)
    power = 10.0 ** np.floor(np.log10(least_end))
    return maps, float(next(power * step for step in (1, 2, 5, 10) if power * step >= least_end * (1 - 1e-9)))
