"""The first lines of the page: the figures that matter most, and which methods made them."""

from typing import Any

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
    expected = (height or {}).get("expected_error_median_deg", normals.get("sigma_median_deg"))
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
                f"mean difference, prediction to photograph, {count} unseen light{'s' * (count > 1)}, {lamp}; "
                "of the camera's channels, the spectra take no part",
            )
        )
        tiles.append(Tile(overall["p90"], "ΔE00", "90th percentile of that difference"))
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
