"""Write the sections of a page on the capture and on the exported files with their losses."""

from typing import Any

import numpy as np

from nishiki.capture.schema import OBJECT_FACTS
from nishiki.formats.problems import error_text
from nishiki.report.page import LONGEST_TABLE, Block, Figure, Figures, Fold, Note, PageSection, Table
from nishiki.report.scene_page import SceneData
from nishiki.report.svg import bars, degrees, figure, lights_plot, percent

FACTS = (
    ("object_id", "Object"),
    *OBJECT_FACTS.items(),
    ("creator", "Creator"),
    ("date", "Date"),
    ("rights", "Rights"),
    ("notes", "Notes"),
)
SATURATION = (
    "Share of the object that is saturated, by light. Such samples enter no fit. Highlights that saturate are normal; "
    "several per cent mean too long an exposure."
)
LEAST_SATURATED = 1e-4
"""Least saturated share of the object for which a light has a bar."""


def capture_section(
    diagnostics: dict[str, Any], *, lights: list[str], kinds: list[str], directions: np.ndarray
) -> PageSection:
    """Write the section. diagnostics : of ingest; kinds : of the lights (see `kind_of`); directions : (lights, 3)."""
    blocks: list[Block] = ["Ingest had nothing to warn of."]
    if diagnostics["warnings"]:
        blocks = [Note(["Ingest warned:"]), Note(diagnostics["warnings"], listed=True, warning=True)]
    caption = "Seen from the camera; rings: 30°, 60° and 90° from the normal of the plane. Filled: used for the fits."
    if "check" in kinds:
        caption += " Open circles: check lights, kept from all fits."
    if "held out" in kinds:
        caption += " Diamonds: held out of all fits."
    items = [Figure("Lights", caption, svg=lights_plot(directions, lights, kinds))]
    shares = sorted(zip(diagnostics["saturated"], lights, strict=True), key=lambda pair: (-pair[0], pair[1]))
    if largest := [(100 * share, name) for share, name in shares if share >= LEAST_SATURATED][:12]:
        values, names = map(list, zip(*largest, strict=True))
        drawing = bars(values, names, title="saturated share of the object by light", unit="%")
        items.append(Figure("Saturation", SATURATION, svg=drawing))
    blocks.append(Figures(items))
    if table := _corrections_table(diagnostics.get("corrections", {})):
        blocks.append(table)
    table = _exposure(diagnostics, lights, kinds, directions)
    summary = f"angles and exposure of all {len(lights)}"
    blocks.append(Fold("Each photograph", summary, [table]) if len(lights) > LONGEST_TABLE else table)
    if diagnostics["defects"]:
        blocks.append(f"{figure(diagnostics['defects'])} hot or dead pixels of the object are used nowhere.")
    return PageSection("capture", "Capture", blocks)


def _corrections_table(corrections: dict[str, Any]) -> Table | None:
    """Return one row a photograph that was corrected or omitted: measurements before, and the correction."""
    done = corrections.get("done", {})
    rows = []
    for name, row in corrections.get("photographs", {}).items():
        said = ["moved back"] if name in done["registered"] else []
        said += [f"divided by {done['gains'][name]:.2f}"] if name in done["gains"] else []
        said += [f"left out: {done['left_out'][name]}"] if name in done["left_out"] else []
        if said:
            known = row.get("gain_sigma") is not None
            gain = f"{row['gain']:.2f} {error_text(row['gain_sigma'], 2)}" if known else "–"
            moved = f"{row['shift_px'][0]:+.1f}, {row['shift_px'][1]:+.1f}"
            rows.append((name, moved, gain, "; ".join(said)))
    if not rows:
        return None
    caption = "Photographs put right or left out, as they were before: movement in pixels, strength of the lamp."
    return Table(["Light", "moved by", "strength", "what was done"], rows, "lrrl", caption)


def facts_of_object(diagnostics: dict[str, Any]) -> list[tuple[str, str]]:
    """List label and text of each fact on the capture of an object."""
    capture = diagnostics["capture"]
    facts = about_capture(diagnostics)
    views, states = len(diagnostics["views"]), [state for state in diagnostics["states"] if state]
    turn = "a full turn" if (capture.get("turntable") or {}).get("full_turn") else "part of a turn"
    channels = len(diagnostics["channels"])
    size = f"{diagnostics['columns']} × {diagnostics['rows']} pixels, {channels} channel{'s' * (channels != 1)}"
    facts.append(("Views", f"{views} over {turn}, each {size}"))
    if states:
        facts.append(("Polarisers", ", ".join(states)))
    lights = capture.get("lights") or {}
    kinds = {"camera": "a lamp beside the camera", "direction": "known directions", "position_mm": "known places"}
    kind = lights.get("kind", "") if isinstance(lights, dict) else ""
    facts.append(("Lighting", kinds.get(kind, "not stated; fitted")))
    return facts


def about_capture(diagnostics: dict[str, Any]) -> list[tuple[str, str]]:
    """List object, photographer and camera from capture.yaml, and the conversion of codes to light."""
    capture = diagnostics["capture"]
    facts = [(label, str(capture[key])) for key, label in FACTS if capture.get(key)]
    camera = capture.get("camera") or {}
    coding = diagnostics.get("coding")
    bits = f"{camera['bits']} bits" if camera.get("bits") else None
    parts = [camera.get("model"), bits, f"encoding of the photographs: {coding}" if coding else None]
    return [*facts, ("Camera", ", ".join(part for part in parts if part) or "not stated")]


def size_of(rows: int, columns: int, pitch_mm: float | None) -> str:
    """Describe the size of a picture in pixels, and in mm where their pitch is known."""
    size = f"{columns} × {rows} pixels"
    return f"{size} of {pitch_mm:g} mm, {columns * pitch_mm:.0f} × {rows * pitch_mm:.0f} mm" if pitch_mm else size


def facts_of_painting(
    diagnostics: dict[str, Any], channels: list[str], pitch_mm: float | None, kinds: list[str]
) -> list[tuple[str, str]]:
    """List label and text of each fact on the capture of a painting."""
    rows, columns = diagnostics["rows"], diagnostics["columns"]
    capture = diagnostics["capture"]
    facts = about_capture(diagnostics)
    size = size_of(rows, columns, pitch_mm)
    (row, column, *part), photograph = diagnostics["region"], diagnostics["photograph"]
    if part != list(photograph):
        why = "cropped to the object mask" if capture.get("mask") else "region of interest"
        place = f"columns {column} to {column + part[1] - 1}, rows {row} to {row + part[0] - 1}"
        size += f"; {why}: {place} of {photograph[1]} × {photograph[0]}"
    facts.append(("Picture", size))
    share = diagnostics["mask_pixels"] / (rows * columns)
    if share < 1:
        facts.append(("Object mask", f"{100 * share:.1f} % of the picture"))
    facts.append(("Channels", f"{len(channels)}: {', '.join(channels)} ({diagnostics['dtype']})"))
    count = {kind: kinds.count(kind) for kind in ("sample", "check", "held out")}
    used = f"{count['sample']} used for the fits"
    words = {"check": "kept from them to check the result", "held out": "held out of them and predicted instead"}
    kept = [f"{count[kind]} {text}" for kind, text in words.items() if count[kind]]
    spectrum = "not known"
    if illuminant := capture.get("illuminant"):
        spectrum = f"in {illuminant}" if illuminant.endswith(".csv") else f"taken as CIE {illuminant}"
    facts.append(("Lights", f"{len(kinds)}: {', '.join([used, *kept])}; spectrum {spectrum}"))
    return facts


def _exposure(diagnostics, lights, kinds, directions) -> Table:
    """Return one row a light: angles, saturated and dark shares, level and evenness of the white board."""
    rows = []
    for j, (name, kind) in enumerate(zip(lights, kinds, strict=True)):
        x, y, z = (float(v) for v in directions[j])
        horizontal = np.hypot(x, y)
        rows.append(
            (
                name,
                kind,
                degrees(float(np.degrees(np.arctan2(horizontal, z)))),
                degrees(float(np.degrees(np.arctan2(y, x))) if horizontal > 1e-9 else None),
                percent(100 * diagnostics["saturated"][j]),
                percent(100 * diagnostics["dark"][j]),
                percent(_at(diagnostics["white_level"], j, 100)),
                percent(_at(diagnostics["white_uniformity"], j, 100)),
            )
        )
    head = ["Light", "role", "from normal", "azimuth", "saturated", "dark", "white level", "evenness"]
    align = "llrrrrrr"
    if diagnostics["white_level"]:
        caption = (
            "Each photograph. White board, in its worst channel: median level (share of full scale) and evenness over "
            "the field (5th over 95th percentile)."
        )
        return Table(head, rows, align, caption)
    caption = "Each photograph. No white board was photographed."
    return Table(head[:6], [row[:6] for row in rows], align[:6], caption)


def _at(values: list, j: int, factor: float) -> float | None:
    return factor * values[j] if j < len(values) and values[j] is not None else None


INTRO = (
    "Files for other programs, in the folder exports beside this page's artifacts. What a format loses was measured on "
    "the very files; what it cannot hold is said in docs/stages/export.md."
)
LOSSES = {
    "largest_deg": (-1, 1, "16 bits move a normal by at most {}°"),
    "pixels_a_vertex": (1, 1, "a vertex of the mesh is the mean of {} pixels"),
    "pixels_a_texel": (1, 1, "a texel is the mean of {} pixels"),
    "clipped": (-1, 100, "{} % of the samples are outside of the colour space"),
    "outside": (-1, 100, "{} % of the reflectances are outside of 0 to 1, and kept so"),
    "camera_px": (0.01, 1, "its cameras are off by at most {} pixels"),
}
"""Losses of one number: the value up to which it is none, factor of the number, and sentence."""


def export_section(data: SceneData) -> PageSection:
    """Return the files of each format with their losses."""
    return exports_section(
        next(diagnostics for name, diagnostics in data.diagnostics.items() if name.endswith("export"))
    )


def exports_section(diagnostics: dict[str, Any]) -> PageSection:
    """Return the files of each format with their losses; diagnostics : of the stage export."""
    rows = []
    for name, each in diagnostics["losses"].items():
        names = (file.removeprefix("exports/").split("/") for file in each["files"])
        files = ", ".join(dict.fromkeys(first + "/" * bool(below) for first, *below in names))
        megabytes = sum(diagnostics["bytes"][file] for file in each["files"]) / 1e6
        rows.append((name, files, f"{megabytes:.2f}", lost(each)))
    return PageSection("exports", "Exports", [INTRO, Table(("format", "files", "MB", "what it loses"), rows, "lwrw")])


def lost(each: dict) -> str:
    """Describe the loss of a format in words."""
    texts = [
        words.format(figure(factor * each[key]))
        for key, (least, factor, words) in LOSSES.items()
        if each.get(key, -1) > least
    ]
    if each.get("colour_spread"):
        spread = figure(100 * max(each["colour_spread"]))
        texts.append(f"colours of single pixels differ from the one colour of their region by {spread} % (rms)")
    for kind, figures in each.get("kinds", {}).items():
        lights = "check" if "check" in figures["psnr_db"] else "fitted"
        error = figures["psnr_db"][lights]
        which = "that no fit saw" if lights == "check" else "of the fit, because no others are kept"
        of = "of views" if {"lamp_strength", "jpeg_psnr_db"} & each.keys() else "under lights"  # objects, or paintings
        texts.append(f"{kind}: {figure(error['all'])} dB against photographs {of} {which} ({error['lights']})")
    if "against_model" in each:
        measured = each["against_model"]
        texts.append(
            f"its material is {figure(measured['psnr_db']['all'])} dB and on average CIEDE2000 "
            f"{figure(measured['delta_e']['mean'])} from the fitted model, in {measured['pictures']} pictures"
        )
    for layer, decibels in each.get("jpeg_psnr_db", {}).items():
        texts.append(f"{layer}: JPEG keeps {figure(decibels)} dB of the coded picture")
    return "; ".join(texts) or "nothing"
