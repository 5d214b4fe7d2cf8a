"""What a plan has to know of a scene, read from the capture's small files only."""

from nishiki.artifacts.provenance import truth_digest
from nishiki.capture.folder import Capture, load_capture
from nishiki.capture.frames import Frame
from nishiki.capture.goniometer import GoniometerCapture, goniometer_facts
from nishiki.capture.seal import capture_digest
from nishiki.capture.turntable import TurntableCapture, TurntableFacts, turntable_facts
from nishiki.engine.project import Scene
from nishiki.errors import UserError
from nishiki.formats.image_headers import read_header
from nishiki.formats.problems import CaptureError
from nishiki.observations.region import object_mask, region_around, region_of
from nishiki.stages.base import SceneFacts

USUAL_BLOCK = 16  # pixels, as `ingest.white_block` is by default: the rim about the object has at least one block


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
    truth = truth_digest(scene.truth) if scene.truth else ""
    if isinstance(capture, GoniometerCapture):
        return _of_goniometer(scene, capture, truth)
    if isinstance(capture, TurntableCapture):
        return _of_turntable(scene, capture, truth)
    return _of_plane(scene, capture, truth)


def _of_plane(scene: Scene, capture: Capture, truth: str) -> SceneFacts:
    return SceneFacts(
        capture_digest=capture_digest(scene.capture),
        lights=tuple(frame.light for frame in capture.observed if frame.role == "sample"),
        check_lights=tuple(frame.light for frame in capture.observed if frame.role == "check"),
        channels=len(capture.settings.camera.channels),
        pixels=_pixels(capture),
        parts={role: len(capture.frames_of(role)) for role in ("check", "flat")},
        suffixes=_suffixes(capture.frames),
        has_sensitivities=capture.sensitivities is not None,
        has_illuminant=capture.illuminant is not None,
        truth_sha256=truth,
        kept_pixels=_kept_pixels(capture),
    )


def _of_turntable(scene: Scene, capture: TurntableCapture, truth: str) -> SceneFacts:
    facts = turntable_facts(capture)
    return SceneFacts(
        capture_digest=capture_digest(scene.capture),
        lights=facts.lights,
        check_lights=(),
        channels=facts.channels,
        pixels=facts.pixels,
        has_sensitivities=facts.has_sensitivities,
        has_illuminant=facts.has_illuminant,
        truth_sha256=truth,
        geometry="turntable",
        views=facts.views,
        states=facts.states,
        has_poses=facts.cameras or facts.view_boards or facts.correspondences,
        given=_given(facts),
        parts=_turntable_parts(capture),
        suffixes=_suffixes(capture.frames),
    )


def _of_goniometer(scene: Scene, capture: GoniometerCapture, truth: str) -> SceneFacts:
    facts = goniometer_facts(capture)
    return SceneFacts(
        capture_digest=capture_digest(scene.capture),
        lights=(),
        check_lights=(),
        channels=facts.channels,
        pixels=facts.pixels,
        has_sensitivities=facts.has_sensitivities,
        has_illuminant=facts.has_illuminant,
        truth_sha256=truth,
        geometry="goniometer",
        measurements=facts.measurements,
        frontal=facts.normal,
        parts={} if facts.table or not facts.normal else {"oblique": facts.oblique},
        suffixes=_suffixes(capture.frames),
        table=facts.table,
    )


def _given(facts: TurntableFacts) -> tuple[str, ...]:
    there = {
        "matrices": facts.cameras,
        "boards": facts.view_boards,
        "correspondences": facts.correspondences,
        "silhouettes": facts.silhouettes,
    }
    return tuple(name for name, is_there in there.items() if is_there)


def _turntable_parts(capture: TurntableCapture) -> dict[str, int]:
    """Number of files of each part that a scene may do without."""
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


def _suffixes(frames: tuple[Frame, ...]) -> tuple[str, ...]:
    return tuple(sorted({f.path.suffix.lower() for f in frames}))


def _pixels(capture: Capture) -> int:
    """Pixels of the region of interest, from the header of the first photograph."""
    region = capture.settings.region_of_interest
    if region is not None:
        return region[2] * region[3]
    header = read_header(capture.observed[0].path, name=capture.observed[0].file)
    return header.rows * header.columns


def _kept_pixels(capture: Capture) -> int:
    """Pixels of the bounding box of the mask inside the region of interest; 0 without a mask, or with one that ingest
    will refuse."""
    if capture.mask is None:
        return 0
    header = read_header(capture.observed[0].path, name=capture.observed[0].file)
    try:
        region = region_of(capture, header.rows, header.columns)
        mask = object_mask(capture, (header.rows, header.columns), region).inside
    except CaptureError:
        return 0
    _, _, rows, columns = region_around(mask, region, USUAL_BLOCK)
    return rows * columns
