"""Write the section of a page on a mosaic: places of its fields, their agreement, and how they were levelled."""

import json
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from nishiki.colour.colour import xyz_to_srgb_linear
from nishiki.report.page import LONGEST_TABLE, Block, Figure, Figures, Fold, Metric, Note, PageSection, Table
from nishiki.report.pictures import brightening, colour_picture, describe_brightening
from nishiki.report.scene_page import Head, headline
from nishiki.stages.report.capture import about_capture, size_of
from nishiki.stages.report.painting_surface import PaintingData

FIT_PX, SEAM_DE, SEAM_DEG = 0.5, 2.0, 2.0
"""Residual, colour difference and angle between fields above which a headline warns."""
FIELDS = "Outlines of the fields over the joined reflectance; each pixel is a mean of the fields that show it."
PLACED = (
    "Each field as it was placed: turn and scale against the mosaic, angles by which its normals were tilted, and "
    "factors of its reflectance by channel."
)
OVERLAPS = (
    "Fields that overlap, the worst first: places that were compared, residual of the registration, mean colour "
    "difference (CIEDE2000) and mean angle of the normals before and after the fields were made alike, on pixels that "
    "the solution did not use."
)
LAMPS_OF_FIELDS = (
    "Lamps and photographs belong to the fields: with a row of its own in the scene table, a field has a page that "
    "shows them."
)


def mosaic_section(page: PaintingData) -> PageSection:
    """Return the section."""
    import cv2

    described = json.loads(page.inputs["mosaic"].path("mosaic.json").read_text())
    maps, camera = page.maps["normals"], page.camera
    linear = page.small(partial(maps.read, "reflectance"), masked=True)
    linear = np.ascontiguousarray(xyz_to_srgb_linear(camera.xyz(linear), white=camera.white), np.float32)
    factor = brightening(linear)
    linear *= factor
    marks = []
    for name, field in described["fields"].items():
        corners = (np.array(field["corners"]) + 0.5) / page.block
        cv2.polylines(linear, [np.round(corners).astype(np.int32)], isClosed=True, color=(1.0, 0.3, 0.0), thickness=1)
        marks.append((*map(float, corners.mean(axis=0)), name))
    picture = replace(colour_picture(linear), marks=tuple(marks))
    figure = Figure("Fields", FIELDS + describe_brightening(factor), picture, ruler=page.ruler)
    overlaps = sorted(described["overlaps"], key=lambda each: -(each.get("rms_px") or np.inf))
    nothing = [None, None]
    rows: list[list[Any]] = [
        [
            " – ".join(each["fields"]),
            each["windows"],
            each["rms_px"],
            *(each["delta_e"] or nothing),
            *(each["angle_deg"] or nothing),
            "" if each["used"] else f"not used: {each['why']}",
        ]
        for each in overlaps
    ]
    groups = (("", 3), ("ΔE00", 2), ("angle, degrees", 2), ("", 1))
    head: tuple[str, ...] = ("Fields", "places", "residual, px", "before", "after", "before", "after", "")
    blocks: list[Block] = [
        Figures([figure], 1),
        _fold_long("Overlaps", Table(head, rows, "lrrrrrrl", OVERLAPS, groups)),
    ]
    rows = [
        [name, each["residual_px"], each["rotation_deg"], each["scale"], *each["tilt_deg"], *each["gain"]]
        for name, each in described["fields"].items()
    ]
    head = ("Field", "residual, px", "turn, degrees", "scale", "tilt about x, degrees", "about y")
    factors = [f"factor {number}" for number in range(1, len(rows[0]) - len(head) + 1)]
    blocks.append(_fold_long("Fields", Table([*head, *factors], rows, "l" + "r" * (len(rows[0]) - 1), PLACED)))
    if described.get("notes"):
        blocks.append(Note(described["notes"], listed=True))
    return PageSection("mosaic", "Mosaic", blocks)


def _fold_long(title: str, table: Table) -> Block:
    """Return the table, folded where it is long."""
    return Fold(title, f"all {len(table.rows)}", [table]) if len(table.rows) > LONGEST_TABLE else table


def mosaic_head(title: str | None, diagnostics: dict[str, Any], page: PaintingData, tiles: list[Metric]) -> Head:
    """Return the head of the page: merits and doubts of a mosaic, and its most effective improvement.

    diagnostics : of the stage mosaic; tiles : figures of the later stages.
    """
    fit, colour, angle = (diagnostics[name] for name in ("registration_rms_px", "seam_delta_e", "seam_deg"))
    overlap = "photograph fields with more overlap, and calibrate the lens"
    boards = "photograph a white board with the camera and the lamps of the fields"
    measured = [
        (fit if fit < FIT_PX else None, FIT_PX, f"the fields fit each other to {fit:.2f} pixels"),
        (colour if colour < SEAM_DE else None, SEAM_DE, "no seam is visible in colour"),
    ]
    advice = [
        (fit >= FIT_PX, f"the fields fit each other to {fit:.1f} pixels only", overlap),
        (colour >= SEAM_DE, f"colours of fields differ by ΔE00 {colour:.1f} where they overlap", boards),
        (angle >= SEAM_DEG, f"normals of fields differ by {angle:.1f}° where they overlap", boards),
    ]
    return Head(
        title=title,
        about=f"joined from {diagnostics['fields']} overlapping fields, each photographed under several lights",
        facts=[*about_capture(diagnostics), ("Picture", size_of(page.mask.shape[0], page.mask.shape[1], page.pitch))],
        tiles=[
            Metric(fit, "px", "residual of the registration of the fields"),
            Metric(colour, "ΔE00", "mean colour difference of two fields where they overlap"),
            Metric(angle, "°", "mean angle between the normals of two fields where they overlap"),
            *tiles,
        ],
        verdict=headline(measured, advice),
    )
