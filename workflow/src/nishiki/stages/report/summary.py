"""The first lines of the page: the figures that matter most, and which methods made them."""

from typing import Any

from nishiki.observations.plane import Observations
from nishiki.report.page import Table, Tile

PAINTINGS = "Tominaga and Tanaka 2004"
PAPER_CHOICES = {
    ("separate", "method"): ("threshold", "selection of the lights", f"thresholds w1, w2 ({PAINTINGS}, section 3.2)"),
    ("normals", "solver"): ("least_squares", "normals", f"plain least squares ({PAINTINGS}, section 3.3)"),
    ("normals", "refine"): ("none", "normals and gloss together", "one after the other"),
    ("spectra", "method"): ("paper", "spectra", f"three bases and matrix inverse ({PAINTINGS}, eq. 8)"),
    ("brdf", "method"): ("paper", "gloss", f"brightest light, Levenberg-Marquardt ({PAINTINGS}, eq. 14–18)"),
}


def choices(settings: dict[str, dict[str, Any]]) -> Table:
    """For each step where the paper's choice can be selected: what ran, and whether it was the paper's.

    settings : stage name -> its settings, of the stages that ran.
    """
    rows = []
    for (stage, name), (paper, step, meaning) in PAPER_CHOICES.items():
        if name in settings.get(stage, {}):
            ran = str(settings[stage][name])
            published = " (the published one)" if ran == paper else ""
            rows.append((step, f"{ran}{published}", f"{stage}.{name}", f"{paper}: {meaning}"))
    return Table(
        ("Step", "ran", "setting", "published choice"), rows, "llll",
        "Which method ran where the published one can be chosen as well. Only what ran is in this page; to see the "
        "other, give the scene table a second row with that setting.",
    )  # fmt: skip


def expected_angle(normals: dict[str, Any], height: dict[str, Any] | None) -> float | None:
    """Return the median expected error of a normal, degrees: measured by the integration where that was done."""
    return (height or {}).get("expected_error_median_deg", normals.get("sigma_median_deg"))


def at_a_glance(
    normals: dict[str, Any],
    evaluation: dict[str, Any] | None,
    height: dict[str, Any] | None = None,
    spectra: dict[str, Any] | None = None,
) -> list[Tile]:
    """The figures that matter most.

    normals, height, spectra : diagnostics of those stages, None where one is left out; evaluation : evaluation.json or
    None.
    """
    expected = expected_angle(normals, height)
    evaluation = evaluation or {}
    tiles = []
    if evaluation.get("lights"):
        overall, count = evaluation["overall"]["de00"], len(evaluation["lights"])
        guessed = (evaluation.get("colour") or {}).get("rmse_xyz") is None
        lamp = "colours taken as under D65" if guessed else "under the lamp of the capture"
        tiles.append(
            Tile(
                overall["mean"],
                "ΔE00",
                f"mean colour error of {count} photograph{'s' * (count > 1)} that no fit used, {lamp}",
            )
        )
        tiles.append(Tile(overall["p90"], "ΔE00", "colour error that nine of ten pixels stay below"))
    if evaluation.get("normals"):
        tiles.append(Tile(evaluation["normals"]["estimated"]["mean"], "°", "mean angle of the normals to the truth"))
    elif expected is not None:
        tiles.append(Tile(expected, "°", "median expected error of a normal"))
    if evaluation.get("reflectance"):
        tiles.append(
            Tile(
                evaluation["reflectance"]["de00"]["D65"]["mean"],
                "ΔE00",
                "mean colour difference of the reflectance to the truth, D65",
            )
        )
    elif colour_error := (spectra or {}).get("expected_de00"):
        tiles.append(
            Tile(colour_error["D65"], "ΔE00", "expected mean colour error of the spectra under daylight (D65)")
        )
    if evaluation.get("height") and evaluation["height"]["rms"] is not None:
        height = evaluation["height"]
        tiles.append(
            Tile(
                1000 * height["rms"],
                "µm",
                f"rms error of the height; the relief itself has {1000 * height['relief_rms']:.0f} µm",
            )
        )
    share = normals["valid_pixels"] / normals["object_pixels"] if normals.get("object_pixels") else None
    if share is not None:
        tiles.append(Tile(100 * share, "%", "of the object's pixels have a normal"))
    return tiles


VISIBLE, PLAIN = 2.0, 5.0
"""Colour differences (CIEDE2000) from which most people see one, and from which everybody does."""
FEW_LAMPS = 8


def verdict(
    diagnostics: dict[str, dict[str, Any]], evaluation: dict[str, Any] | None, frames: Observations, *, guessed: bool
) -> list[tuple[str, str]]:
    """State what is good of a painting's record, what is doubtful, and what would improve it most.

    diagnostics : of the stages; guessed : whether the colours of the camera's channels are a guess.
    """
    normals, good, doubtful = diagnostics["normals"], [], []
    error = evaluation["overall"]["de00"]["mean"] if evaluation and evaluation.get("lights") else None
    if error is not None:
        words = (
            "hardly visible" if error < VISIBLE else "visible beside each other" if error < PLAIN else "plain to see"
        )
        text = f"photographs that no fit used are predicted with errors that are {words} (ΔE00 {error:.1f})"
        (good if error < PLAIN else doubtful).append(text)
    sigma = expected_angle(normals, diagnostics.get("height"))
    if sigma is not None and not (evaluation or {}).get("normals"):
        (good if sigma < VISIBLE else doubtful).append(
            f"half of the normals are expected within {sigma:.1f}° of the true ones"
        )
    missing = 1 - normals["valid_pixels"] / max(normals["object_pixels"], 1)
    if missing > 0.05:
        doubtful.append(f"{100 * missing:.0f} % of the object has no estimate")
    lamps = len(frames.lights)
    advice = {
        "no white board: colours and brightness are relative": (
            not frames.white_board,
            "photograph an even white or grey card in place of the object, once under every lamp (--white)",
        ),
        f"{lamps} lamps are few: gloss and shadows are hard to tell apart": (
            lamps < FEW_LAMPS,
            "photograph under twelve lamps or more, all round and at two elevations",
        ),
        "colours of the camera are a guess": (
            guessed,
            "photograph a colour target and run ./nishiki calibrate target",
        ),
        "no scale: heights and lengths are in pixels": (
            not frames.pixel_pitch_mm,
            "measure the width of the photographs on the object (--width-mm)",
        ),
    }
    doubtful += [text for text, (holds, _) in advice.items() if holds]
    remedy = next((remedy for holds, remedy in advice.values() if holds), "")
    rows = [("Good", "; ".join(good)), ("Doubtful", "; ".join(doubtful)), ("To improve it most", remedy)]
    return [(label, text[:1].upper() + text[1:] + ".") for label, text in rows if text]
