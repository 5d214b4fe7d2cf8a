"""State what is good of a record, what is doubtful, and what would improve it most: the headline of a report."""

from typing import Any

from nishiki.report.svg import figure

CLOSE, PLAIN = 1.0, 3.0  # % of full scale, rms, from which a rendered view is told from its photograph, and at a glance
FEW_VIEWS = 24  # of an object: steps of more than 15 degrees, between which gloss moves further than its width
UNSEEN = 0.05  # share of a surface that may lie hidden without a word
CLOTH_ERROR = 0.15  # relative error on directions left out from which a cloth's gloss looks different
NOISE = 0.05  # relative noise of a reflectance from which it hides the weave


def headline(good: list[str], doubtful: list[str], advice: list[tuple[bool, str, str]]) -> list[tuple[str, str]]:
    """Return label and text of each line; a line without anything to say is left out.

    advice : whether a lack holds, the lack, and its remedy; the first that holds is what would improve most.
    """
    doubtful = doubtful + [lack for holds, lack, _ in advice if holds]
    remedy = next((remedy for holds, _, remedy in advice if holds), "")
    rows = [("Good", "; ".join(good)), ("Doubtful", "; ".join(doubtful)), ("To improve it most", remedy)]
    return [(label, text[:1].upper() + text[1:] + ".") for label, text in rows if text]


def object_headline(diagnostics: dict[str, dict[str, Any]]) -> list[tuple[str, str]]:
    """Return the headline of a turntable scene; diagnostics : of its stages."""
    found: tuple[list[str], list[str]] = [], []  # doubtful, good
    psnr = (diagnostics.get("object_evaluate") or {}).get("psnr") or {}
    left_out = next((part for name, part in psnr.items() if name.startswith("left_out") and part), None)
    for part, what, limit in (
        (psnr.get("captured"), "rendered views differ from their photographs by", CLOSE),
        (left_out, "views that took no part are predicted with errors of", PLAIN),
    ):
        if part:
            error = 100 * 10 ** (-part["mean_psnr_db"] / 20)
            found[error < limit].append(f"{what} {figure(error, 2)} % of full scale")
    covered = ((diagnostics.get("mesh") or {}).get("fit") or {}).get("iou_mean")
    if covered is not None:
        found[covered > 1 - UNSEEN].append(f"the surface covers {100 * covered:.1f} % of the outlines")
    ingest, views = diagnostics["ingest"], len(diagnostics["ingest"]["views"])
    unseen = (diagnostics.get("object_brdf") or {}).get("unseen_share") or 0.0
    unit = ((ingest.get("capture") or {}).get("turntable") or {}).get("unit", "mm")
    hidden, untold = f"{100 * unseen:.0f} % of the surface is in no photograph", bool(psnr) and left_out is None
    pictures = (diagnostics.get("residual") or {}).get("pictures") or {}
    carried = "captured views are stored as pictures, because texels of the surface in as many bytes reach "
    carried += f"{figure(pictures.get('equal_bytes_psnr_db'), 3)} dB; these figures do not hold for views between them"
    scan = "give a mesh or scans of the object"
    scan += "" if "polarise" in diagnostics else ", or photograph it through polarisers"
    advice = [
        (bool(pictures), carried, scan),
        (1 < views < FEW_VIEWS, f"{views} views are few", "photograph the object every ten degrees"),
        (unseen > UNSEEN, hidden, "add a turn with the camera higher, or with the object laid down"),
        (
            untold,
            "no view was left out to test views between the photographs",
            "name some in the setting texels.hold_out",
        ),
        (not ingest.get("boards"), "no white board: brightness is relative", "photograph a white board (--white)"),
        (unit in (None, "none"), "no unit of length: sizes are relative", "state turntable.unit"),
    ]
    return headline(found[True], found[False], advice)


def cloth_headline(samples: dict[str, Any], evaluation: dict[str, Any] | None, region: str) -> list[tuple[str, str]]:
    """Return the headline of a cloth; samples : diagnostics of goniometer_samples; evaluation : evaluation.json."""
    found: tuple[list[str], list[str]] = [], []  # doubtful, good
    models = ((evaluation or {}).get("regions", {}).get(region) or {}).get("models", {})
    fitted = models.get((evaluation or {}).get("default")) or {}
    errors = [part["rms_rel"] for part in ((fitted.get("held_out") or {}).get("by_incidence") or {}).values()]
    if errors:
        error = sum(errors) / len(errors)
        text = f"directions that no fit used are predicted with a mean error of {100 * error:.0f} %"
        found[error < CLOTH_ERROR].append(text)
    noise = samples.get("noise_relative")
    if noise is not None:
        found[noise < NOISE].append(f"half of the measurements have a noise below {figure(100 * noise, 2)} %")
    saturated = sum(samples.get("saturated") or [])
    above, cut = samples.get("normal_incidence"), f"{saturated} measurements are saturated: the gloss is cut off"
    advice = [
        (above == 0, "nothing was lit along the normal", "measure one set of views with the light along the normal"),
        (saturated > 0, cut, "measure the brightest directions again with a shorter exposure"),
        (
            not errors,
            "no direction was left out to test the others",
            "run cloth_evaluate, with a second plane of light",
        ),
        (noise is None, "the noise of a measurement is not known", "measure some directions twice"),
    ]
    return headline(found[True], found[False], advice)
