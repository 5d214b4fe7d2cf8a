"""The section of a scene's page with the exported files, and what each of them loses."""

from nishiki.artifacts.artifact import Artifact
from nishiki.report.numbers import figure
from nishiki.report.page import Section, Table

INTRO = (
    "Files for other programs, in the folder exports beside this page's artifacts. What a format loses was measured on "
    "the very files; what it cannot hold is said in docs/stages/export.md."
)
LEAST_PX = 0.01  # distances of cameras below it are rounding


def export_section(export: Artifact | None) -> Section | None:
    """The files of each format with their losses; None where nothing was exported."""
    if export is None:
        return None
    rows = []
    for name, each in export.diagnostics["losses"].items():
        names = (file.removeprefix("exports/").split("/") for file in each["files"])
        files = ", ".join(dict.fromkeys(first + "/" * bool(below) for first, *below in names))
        megabytes = sum(export.diagnostics["bytes"][file] for file in each["files"]) / 1e6
        rows.append((name, files, f"{megabytes:.2f}", lost(each)))
    return Section("exports", "Exports", [INTRO, Table(("format", "files", "MB", "what it loses"), rows, "lwrw")])


def lost(each: dict) -> str:
    """What a format loses, in words."""
    texts = []
    if "largest_deg" in each:
        texts.append(f"16 bits move a normal by at most {figure(each['largest_deg'])}°")
    if each.get("pixels_a_vertex", 1) > 1:
        texts.append(f"a vertex of the mesh is the mean of {each['pixels_a_vertex']} pixels")
    if each.get("pixels_a_texel", 1) > 1:
        texts.append(f"a texel is the mean of {each['pixels_a_texel']} pixels")
    if "clipped" in each:
        texts.append(f"{figure(100 * each['clipped'])} % of the samples are outside of the colour space")
    if "outside" in each:
        texts.append(f"{figure(100 * each['outside'])} % of the reflectances are outside of 0 to 1, and kept so")
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
    if each.get("camera_px", 0) >= LEAST_PX:
        texts.append(f"its cameras are off by at most {figure(each['camera_px'])} pixels")
    if each.get("lamp_falloff"):
        texts.append(
            f"lamps of scene.xml, whose distance always counts, are off by at most "
            f"{figure(100 * each['lamp_falloff'])} % on the object"
        )
    return "; ".join(texts) or "nothing"
