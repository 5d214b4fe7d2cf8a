"""Read what a plan requires of a scene from the capture's small files."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

from nishiki.artifacts.provenance import truth_digest
from nishiki.capture.folder import Capture, load_capture
from nishiki.capture.goniometer import NORMAL_DEG, GoniometerCapture
from nishiki.capture.mosaic import MosaicCapture
from nishiki.capture.seal import capture_digest
from nishiki.capture.turntable import TurntableCapture
from nishiki.engine.project import Scene
from nishiki.errors import UserError
from nishiki.formats.images import read_header
from nishiki.formats.problems import CaptureError
from nishiki.observations.blocks import CHECK_BLOCK
from nishiki.observations.region import object_mask, region_around, region_of
from nishiki.stages.base import SceneFacts


def scene_facts(scene: Scene) -> SceneFacts:
    """Facts of a scene. Raises UserError where the capture is missing, not sealed or broken."""
    try:
        capture = load_capture(scene.capture)
    except UserError as error:
        raise UserError(f"scene {scene.name!r} of the scene table: {error}") from None
    if not capture.sealed:
        raise UserError(
            f"scene {scene.name!r}: capture {scene.capture} is not sealed. Remedy: ./nishiki seal {scene.capture}"
        )
    return replace(FACTS[capture.geometry](capture), truth_sha256=truth_digest(scene.truth) if scene.truth else "")


def _of_plane(capture: Capture) -> SceneFacts:
    return SceneFacts(
        **_of_any(capture),
        lights=tuple(frame.light for frame in capture.observed if frame.role == "sample"),
        check_lights=tuple(frame.light for frame in capture.observed if frame.role == "check"),
        channels=len(capture.settings.camera.channels),
        pixels=_pixels(capture),
        parts={role: len(capture.frames_of(role)) for role in ("check", "flat")},
        kept_pixels=_kept_pixels(capture),
    )


def _of_mosaic(capture: MosaicCapture) -> SceneFacts:
    """Return facts of the joined maps; pixels: of all fields, of which their overlaps are counted more than once."""
    fields = [_of_plane(each) for each in capture.captures]
    return replace(
        fields[0],
        capture_digest=capture.digest,
        lights=(),
        check_lights=(),
        pixels=sum(each.kept_pixels or each.pixels for each in fields),
        geometry="mosaic",
        parts={},
        suffixes=(),
        kept_pixels=0,
        fields={each.name: each.position_mm for each in capture.fields},
    )


def _of_turntable(capture: TurntableCapture) -> SceneFacts:
    boards = {frame.view for frame in capture.frames_of("board")}
    given = {
        "matrices": capture.matrices is not None,
        "boards": boards >= set(capture.views),
        "correspondences": capture.points is not None,
        "silhouettes": all(capture.silhouette_of(view) for view in capture.views),
    }
    header = read_header(capture.observed[0].path, name=capture.observed[0].file)
    return SceneFacts(
        **_of_any(capture),
        lights=capture.light_names,
        check_lights=(),
        channels=len(capture.settings.camera.channels),
        pixels=header.rows * header.columns,
        geometry="turntable",
        views=capture.views,
        states=capture.states,
        has_poses=given["matrices"] or given["boards"] or given["correspondences"],
        given=tuple(name for name, is_there in given.items() if is_there),
        parts=_turntable_parts(capture),
    )


def _of_goniometer(capture: GoniometerCapture) -> SceneFacts:
    angles, pixels, table = capture.angles_deg, 1, capture.table is not None
    if not table:
        header = read_header(capture.observed[0].path, name=capture.observed[0].file)
        rows, columns, crop = header.rows, header.columns, capture.settings.goniometer.crop_px
        pixels = rows * columns if capture.regions is not None else min(rows, crop) * min(columns, crop)
    along = sum(angle[0] < NORMAL_DEG for angle in angles)
    return SceneFacts(
        **_of_any(capture),
        lights=(),
        check_lights=(),
        channels=len(capture.channels),
        pixels=pixels,
        geometry="goniometer",
        measurements=len(angles),
        frontal=along,
        parts={} if table or not along else {"oblique": len(angles) - along},
        table=table,
    )


FACTS: dict[str, Callable[[Any], SceneFacts]] = {
    "plane": _of_plane,
    "turntable": _of_turntable,
    "goniometer": _of_goniometer,
    "mosaic": _of_mosaic,
}


def _of_any(capture: Capture | TurntableCapture | GoniometerCapture) -> dict[str, Any]:
    """Return the facts that captures of every geometry have."""
    return {
        "capture_digest": capture_digest(capture.root),
        "has_sensitivities": capture.sensitivities is not None,
        "has_illuminant": capture.illuminant is not None,
        "truth_sha256": "",
        "suffixes": tuple(sorted({frame.path.suffix.lower() for frame in capture.frames})),
    }


def _turntable_parts(capture: TurntableCapture) -> dict[str, int]:
    """Count the files of each part that a scene may do without."""
    observed = capture.observed
    first = [f for f in observed if f.polariser == capture.states[0]]
    return {
        "states": len(observed) - len(first),
        "white_states": sum(bool(f.polariser) for f in capture.frames_of("white")),
        "photographs": len(first),
        "calibration": len(capture.frames_of("board")),
        "silhouettes": len({f.silhouette for f in capture.frames if f.silhouette}),
        "mesh": int(capture.mesh is not None),
        "scans": len(capture.scans),
    }


def _pixels(capture: Capture) -> int:
    """Pixels of the region of interest, from the header of the first photograph."""
    region = capture.settings.region_of_interest
    if region is not None:
        return region[2] * region[3]
    header = read_header(capture.observed[0].path, name=capture.observed[0].file)
    return header.rows * header.columns


def _kept_pixels(capture: Capture) -> int:
    """Count the pixels of the mask's bounding box inside the region of interest.

    The count is 0 without a mask, or with one that ingest will refuse.
    """
    if capture.mask is None:
        return 0
    header = read_header(capture.observed[0].path, name=capture.observed[0].file)
    try:
        region = region_of(capture, header.rows, header.columns)
        mask = object_mask(capture, (header.rows, header.columns), region).inside
    except CaptureError:
        return 0
    _, _, rows, columns = region_around(mask, region, CHECK_BLOCK)
    return rows * columns
