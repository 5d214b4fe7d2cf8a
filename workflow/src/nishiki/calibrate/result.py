"""Write a calibration: its folder, its page and lines for capture.yaml; and calibrate lamps from mirror spheres."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import yaml

from nishiki.artifacts.declaration import merge_blocks
from nishiki.capture.layouts import photographs_in
from nishiki.capture.lights import read_lights
from nishiki.capture.schema import read_mapping
from nishiki.capture.seal import sha256_of
from nishiki.capture.spheres.lamps import LampFit
from nishiki.capture.spheres.measure import MeasuredSpheres, measure_spheres
from nishiki.capture.spheres.search import Findings, SphereInput, SpheresError, draw_findings, draw_sphere
from nishiki.capture.taking import lights_text, settings_text
from nishiki.errors import UserError
from nishiki.formats.files import put_file, whole_folder
from nishiki.formats.images import read_header
from nishiki.report.page import Block, CommandLines, Facts, Figure, Figures, Page, PageSection, Table, render_page
from nishiki.report.pictures import encode_picture
from nishiki.report.svg import lights_plot
from nishiki.version import PROJECT_VERSION


def list_photographs(names: Sequence[str], *, what: str = "photographs") -> list[Path]:
    """List files as given, folders replaced by their photographs in natural order, without masks.

    UserError where a name is no file, two are called alike, there is none, or sizes differ.
    """
    paths: list[Path] = []
    for name in names:
        path = Path(name)
        if path.is_dir():
            paths += photographs_in(path)
        elif path.is_file():
            paths.append(path)
        else:
            raise UserError(f"{name}: no such file or folder. Remedy: correct the path of the {what}")
    if not paths:
        raise UserError(f"{what}: expected at least one, found none")
    headers = [read_header(path) for path in paths]
    sizes = {(h.rows, h.columns, h.channels, h.sample) for h in headers}
    if len(sizes) > 1:
        raise UserError(
            f"{what}: expected one size, depth and number of channels, found "
            f"{'; '.join(f'{c} x {r}, {n} channels of {s}' for r, c, n, s in sorted(sizes))}. Remedy: give the "
            "photographs of one camera with one setting"
        )
    return paths


SATURATED_SHARE = 1e-3  # of the pixels of a level or patch that is used
NUMBERS, PAGE, LINES = "calibration.json", "calibration.html", "capture-lines.yaml"


@dataclass(frozen=True)
class Calibration:
    """Result of one calibration."""

    kind: str  # spheres, camera, target or geometry
    numbers: dict  # plain data, with uncertainties
    inputs: Sequence[Path]  # files that were read; their digests are kept
    lines: dict  # keys of capture.yaml and their values; names of files are those of `files`
    sections: Sequence[PageSection]  # of the page, with the pictures that show whether to trust it
    subtitle: str
    files: Mapping[str, str | bytes] = field(default_factory=dict)  # text or bytes by name, for a capture to use
    warnings: Sequence[str] = ()
    failure: str = ""  # why there is no result; the folder then holds the page and what was measured so far


def write_calibration(folder: Path, result: Calibration) -> None:
    """Write the folder, which must not exist; it appears whole or not at all."""
    if folder.exists():
        raise UserError(f"{folder} exists. Remedy: choose another folder; nothing is overwritten")
    digests = {str(path): sha256_of(path) for path in result.inputs}
    content = {
        "calibration": result.kind,
        "version": PROJECT_VERSION,
        **result.numbers,
        "warnings": list(result.warnings),
        "inputs_sha256": digests,
    }
    lines = yaml.safe_dump(result.lines, sort_keys=False, allow_unicode=True) if result.lines else ""
    page = Page(
        title=f"Calibration: {result.kind}",
        subtitle=result.subtitle,
        sections=[
            *result.sections,
            *([PageSection("lines", "For capture.yaml", [CommandLines(lines)])] if lines else []),
            PageSection("inputs", "Inputs", [Facts([(name, digest) for name, digest in digests.items()])]),
        ],
        version=PROJECT_VERSION,
        footer=f"Nishiki {PROJECT_VERSION}, calibration of {result.kind}. All numbers: {NUMBERS}.",
        warnings=[*([result.failure] if result.failure else []), *result.warnings],
    )
    with whole_folder(folder) as partial:
        partial.mkdir(parents=True)
        for name, data in result.files.items():
            (partial / name).write_bytes(data.encode() if isinstance(data, str) else data)
        (partial / NUMBERS).write_text(json.dumps(content, indent=2, allow_nan=False) + "\n", encoding="utf-8")
        (partial / PAGE).write_text(render_page(page), encoding="utf-8")
        if lines:
            (partial / LINES).write_text(lines, encoding="utf-8")


def put_into_capture(capture: Path, result: Calibration) -> None:
    """Write the lines and files of a calibration into an unsealed capture; comments of its file are lost.

    UserError where it is sealed, or a file of the same name lies there.
    """
    if (capture / "bagit.txt").exists():
        raise UserError(f"{capture} is sealed. Remedy: copy its data folder, and name the copy with --into")
    path = capture / "capture.yaml"
    settings = read_mapping(path)
    files = {name: data for name, data in result.files.items() if _names(result.lines, name)}
    for name in files:
        if (capture / name).exists():
            raise UserError(f"{capture / name} exists. Remedy: move it away; nothing is overwritten")
    text = settings_text(merge_blocks(settings, result.lines))
    for name, data in files.items():
        (capture / name).write_bytes(data.encode() if isinstance(data, str) else data)
    put_file(path, text)


def finite(value: float, digits: int = 6) -> float | None:
    """Round a number for JSON to significant digits; None where it is not finite."""
    value = float(value)
    return float(f"{value:.{digits}g}") if abs(value) < float("inf") else None


def _names(lines: object, name: str) -> bool:
    """Check whether lines of capture.yaml name a file."""
    return lines == name or (isinstance(lines, dict) and any(_names(each, name) for each in lines.values()))


def calibrate_spheres(given: SphereInput) -> Calibration:
    """Measure the lamps of all photographs with a highlight: uncertainties, files and page.

    Where they cannot be measured the result holds the reason and what was found so far.
    """
    inputs = [*given.photographs, *given.board, *([given.mask] if given.mask else [])]
    inputs += [given.compare] if given.compare else []
    try:
        measured = measure_spheres(given)
    except SpheresError as e:
        section = _picture_section(e.findings)
        return Calibration("spheres", {}, inputs, {}, [section], "No lamps were measured.", failure=str(e))
    names, camera, fit = measured.names, measured.findings.camera, measured.fit
    numbers = _numbers(measured, given)
    sections = [_lamp_section(measured), _picture_section(measured.findings)]
    if given.compare is not None:
        numbers["comparison"], section = _comparison(fit, names, given.compare)
        sections.insert(1, section)
    files_named = [path.name for path in measured.photographs]
    photographs = [f'"{name}"' if " " in name else name for name in files_named]
    files = {"lamps.lp": lights_text(photographs, fit.directions)}
    lines: dict = {"lights": {"file": "lamps.lp"}}
    if measured.positioned:
        files["lamps_mm.lp"] = lights_text(photographs, fit.positions)
        lines = {"lights": {"file": "lamps_mm.lp", "kind": "position_mm"}, "pixel_pitch_mm": finite(fit.pitch)}
    if not measured.findings.left_out:  # its lamps have no names, so that none may be missing
        width_mm = fit.pitch * camera.columns if given.radius_mm else 0.0
        files["lamps.dome"] = dome_text(names, fit.directions, fit.positions if measured.positioned else None, width_mm)
    kind = "orthographic camera" if camera.focal_px is None else f"focal length {camera.focal_px:.0f} px"
    spheres = len(measured.findings.outlines)
    sigma = np.degrees(np.median(fit.direction_sigma))
    subtitle = (
        f"{len(names)} of {len(given.photographs)} lamps from {spheres} mirror sphere{'s' if spheres > 1 else ''}, "
        f"{kind}; directions to {sigma:.2g} degrees."
    )
    return Calibration("spheres", numbers, inputs, lines, sections, subtitle, files, measured.warnings)


def dome_text(names: list[str], directions: np.ndarray, positions: np.ndarray | None, width_mm: float) -> str:
    """Write Relight's description of a dome: lamps in order, lengths in millimetres.

    Directions are from the middle of the picture; `names` are those of the photographs, which Relight does not read.
    """

    def list_vectors(vectors: np.ndarray) -> list[dict[str, float]]:
        return [{axis: float(f"{v:.9g}") for axis, v in zip("xyz", vector, strict=True)} for vector in vectors]

    near = [] if positions is None else list_vectors(positions)
    content = {
        "label": "",
        "notes": "measured by nishiki calibrate spheres; lengths in mm",
        "imageWidth": float(f"{width_mm:.9g}"),
        "domeDiameter": float(f"{2 * np.linalg.norm(positions, axis=1).mean():.6g}") if positions is not None else 0.0,
        "verticalOffset": 0.0,
        "lightConfiguration": "lights3d" if near else "directional",
        "directions": list_vectors(directions),
        "positionsSphere": near,
        "positions3d": near,
        "ledAdjust": [],
        "names": names,
    }
    return json.dumps(content, indent=1) + "\n"


def _numbers(measured: MeasuredSpheres, given: SphereInput) -> dict:
    fit, names, positioned = measured.fit, measured.names, measured.positioned
    camera, outlines, found = measured.findings.camera, measured.findings.outlines, measured.findings.highlights
    lamps = []
    for i, (name, photograph) in enumerate(zip(names, measured.numbers, strict=True)):
        lamp = {
            "lamp": name,
            "direction": [finite(v, 9) for v in fit.directions[i]],
            "direction_sigma_deg": finite(np.degrees(fit.direction_sigma[i])),
            "lens_sigma_deg": finite(np.degrees(measured.lens_sigma[i])),
            "highlights": [
                None
                if (highlight := found[photograph, k]) is None
                else {
                    "column": finite(highlight.pixel[0]),
                    "row": finite(highlight.pixel[1]),
                    "sigma_px": finite(highlight.sigma_px),
                    "residual_px": finite(fit.residuals_px[i, k]) if (i, k) in fit.residuals_px else None,
                }
                for k in range(len(outlines))
            ],
        }
        if positioned:
            lamp["position_mm"] = [finite(v, 9) for v in fit.positions[i]]
            lamp["position_sigma_mm"] = finite(fit.position_sigma[i])
        lamps.append(lamp)
    spheres = []
    for each in outlines:
        column, row, radius = each.circle(camera)
        spheres.append(
            {
                "row": finite(row),
                "column": finite(column),
                "radius_px": finite(radius),
                "outline_rms_px": finite(each.rms_px),
                "outline_share": finite(each.support),
            }
        )
    return {
        "camera": {"kind": "orthographic" if camera.focal_px is None else "perspective", "focal_px": camera.focal_px},
        "seen_from": "centre of the sphere"
        if len(outlines) == 1 and not given.board
        else "middle of the object's plane",
        "spheres": spheres,
        "radius_mm": given.radius_mm,
        "pixel_pitch_mm": finite(fit.pitch) if given.radius_mm else None,
        "lamps": lamps,
        "left_out": measured.findings.left_out,
        "scene": None if measured.scene is None else {key: finite(v) for key, v in vars(measured.scene).items()},
        "positions_written": positioned,
        "chi_square": finite(fit.chi_square) if np.isfinite(fit.chi_square) else None,
        "falloff_rms": finite(fit.falloff_rms) if np.isfinite(fit.falloff_rms) else None,
    }


def _lamp_section(measured: MeasuredSpheres) -> PageSection:
    fit, names, positioned = measured.fit, measured.names, measured.positioned
    rows = []
    for i, name in enumerate(names):
        u = fit.directions[i]
        rows.append(
            (
                name,
                float(np.degrees(np.arctan2(u[1], u[0]))),
                float(np.degrees(np.arccos(np.clip(u[2], -1, 1)))),
                float(np.degrees(fit.direction_sigma[i])),
                float(1 / fit.inverse_distance[i]) if positioned else None,
                float(fit.position_sigma[i]) if positioned else None,
                max(px for (lamp, _), px in fit.residuals_px.items() if lamp == i),
                sum(1 for lamp, _ in fit.residuals_px if lamp == i),
            )
        )
    head = ("lamp", "azimuth °", "polar °", "± °", "distance mm", "± mm", "residual px", "spheres used")
    plot = lights_plot(np.asarray(fit.directions), list(names), ["sample"] * len(names))
    caption = "From above: the middle is towards the camera, the rim the object's plane."
    return PageSection(
        "lamps", "Lamps", [Figures([Figure("Directions", caption, svg=plot)], 2), Table(head, rows, "lrrrrrrr")]
    )


def _picture_section(found: Findings) -> PageSection:
    """Show photographs with accepted and rejected circles, every sphere with all highlights, and reasons."""
    figures = []
    for k, outline in enumerate(found.outlines):
        caption = (
            f"Brightest of all photographs. Green: the outline fitted, {outline.rms_px:.2g} px root mean square, along "
            f"{100 * outline.support:.0f} % of it. Red: where each lamp's highlight was measured."
        )
        figures.append(Figure(f"Sphere {k + 1}", caption, encode_picture(draw_sphere(found, k))))
    caption = "Brightest of all photographs. Green: spheres. Grey: circles that were examined and are none."
    figures.append(Figure("All circles", caption, encode_picture(draw_findings(found))))
    parts: list[Block] = [Figures(figures, 2)]
    if found.rejected:
        rows = [(c.row, c.column, c.radius, why) for c, why in found.rejected]
        parts.append(Table(("row", "column", "radius px", "why it is no sphere"), rows, "rrrl"))
    if found.left_out:
        parts.append(Table(("photograph", "why its lamp was left out"), list(found.left_out.items()), "ll"))
    return PageSection("spheres", "Spheres", parts)


def _comparison(fit: LampFit, names: list[str], path: Path) -> tuple[dict, PageSection]:
    """Compute angles to the directions of another file, by name where it has names, else in order."""
    other = read_lights(path, frontal=False)
    if all(file is None for file in other.files):
        if len(other.names) != len(names):
            raise UserError(f"{path}: expected {len(names)} lamps, one a photograph, found {len(other.names)}")
        theirs = other.directions
    else:
        if unknown := [name for name in names if other.find(name) is None]:
            raise UserError(f"{path}: no lamp for the photograph {unknown[0]}")
        theirs = other.directions[[other.index(name) for name in names]]
    cosines = np.clip((fit.directions * theirs).sum(axis=1), -1, 1)
    angles = np.degrees(np.arccos(cosines))
    left, _, right = np.linalg.svd(fit.directions.T @ theirs)
    turn = (left * [1, 1, np.sign(np.linalg.det(left @ right))]) @ right
    turned = np.degrees(np.arccos(np.clip(((fit.directions @ turn) * theirs).sum(axis=1), -1, 1)))
    numbers = {
        "file": path.name,
        "mean_deg": finite(angles.mean()),
        "max_deg": finite(angles.max()),
        "mean_deg_after_common_turn": finite(turned.mean()),
    }
    rows = [(name, float(angle), float(rest)) for name, angle, rest in zip(names, angles, turned, strict=True)]
    text = (
        f"Against {path.name}: mean {angles.mean():.2f}°, largest {angles.max():.2f}°; {turned.mean():.2f}° after one "
        "turn that all lamps share, as between two cameras' frames."
    )
    return numbers, PageSection(
        "comparison", "Compared", [text, Table(("lamp", "angle °", "after turn °"), rows, "lrr")]
    )
