"""What a capture of a turntable or a goniometer holds, in words and numbers that tests compare."""

from dataclasses import dataclass

from nishiki.capture.frames import parse_state
from nishiki.capture.goniometer import GoniometerCapture
from nishiki.capture.turntable import TurntableCapture
from nishiki.formats.images import read_header
from nishiki.goniometry.table import NORMAL_DEG


@dataclass(frozen=True)
class TurntableFacts:
    """What a plan has to know. lights, states: ('',) where unnamed or none; boards: calibration pictures, view_boards:
    one for every view; white_states: polariser states of white boards, '' for none; scans: how many."""

    geometry: str
    views: tuple[str, ...]
    lights: tuple[str, ...]
    states: tuple[str, ...]
    polarisation: str
    white_states: tuple[str, ...]
    white_board: bool
    lamp: str
    full_turn: bool
    unit: str
    cameras: bool
    boards: int
    view_boards: bool
    correspondences: bool
    intrinsics: bool
    mesh: bool
    scans: int
    silhouettes: bool
    channels: int
    rows: int
    columns: int
    encoding: str
    has_sensitivities: bool
    has_illuminant: bool

    @property
    def pixels(self) -> int:
        """Of one photograph."""
        return self.rows * self.columns


def turntable_facts(capture: TurntableCapture) -> TurntableFacts:
    """Facts of a loaded capture; one photograph's header is read, none is decoded."""
    block, camera = capture.settings.turntable, capture.settings.camera
    first = capture.observed[0]
    header = read_header(first.path, name=first.file)
    boards = capture.frames_of("board")
    whites = tuple(dict.fromkeys(f.polariser for f in capture.frames_of("white")))
    return TurntableFacts(
        geometry=capture.geometry,
        views=capture.views,
        lights=capture.light_names,
        states=capture.states,
        polarisation=parse_state(capture.states[0]).kind if capture.states else "none",
        white_states=whites,
        white_board="" in whites,
        lamp=capture.settings.lights.kind if capture.settings.lights else "unknown",
        full_turn=block.full_turn,
        unit=block.unit,
        cameras=capture.matrices is not None,
        boards=len(boards),
        view_boards={f.view for f in boards} >= set(capture.views),
        correspondences=capture.points is not None,
        intrinsics=capture.intrinsics is not None,
        mesh=capture.mesh is not None,
        scans=len(capture.scans),
        silhouettes=all(capture.silhouette_of(view) for view in capture.views),
        channels=len(camera.channels),
        rows=header.rows,
        columns=header.columns,
        encoding=header.choose_coding(camera.encoding).encoding,
        has_sensitivities=capture.sensitivities is not None,
        has_illuminant=capture.illuminant is not None,
    )


@dataclass(frozen=True)
class GoniometerFacts:
    """What a plan has to know. measurements: pairs of directions, repeats counted; normal: of these, lit along the
    normal; incidences: number of directions of light; pixels: kept of one photograph, 1 for a table; regions: a label
    picture is there."""

    geometry: str
    measurements: int
    normal: int
    incidences: int
    channels: int
    pixels: int
    table: bool
    regions: bool
    symmetry: str
    weave: str
    has_sensitivities: bool
    has_illuminant: bool

    @property
    def oblique(self) -> int:
        """Measurements not lit along the normal."""
        return self.measurements - self.normal


def goniometer_facts(capture: GoniometerCapture) -> GoniometerFacts:
    """Facts of a loaded capture; one photograph's header is read, none is decoded."""
    block, angles = capture.settings.goniometer, capture.angles_deg
    pixels = 1
    if capture.table is None:
        header = read_header(capture.observed[0].path, name=capture.observed[0].file)
        has_regions = capture.regions is not None
        pixels = (header.rows if has_regions else min(header.rows, block.crop_px)) * (
            header.columns if has_regions else min(header.columns, block.crop_px)
        )
    normal = sum(a[0] < NORMAL_DEG for a in angles)
    oblique = {(round(a[0], 1), round(a[1] % 360, 1) % 360) for a in angles if a[0] >= NORMAL_DEG}
    return GoniometerFacts(
        geometry=capture.geometry,
        measurements=len(angles),
        normal=normal,
        incidences=len(oblique) + (normal > 0),
        channels=len(capture.channels),
        pixels=pixels,
        table=capture.table is not None,
        regions=capture.regions is not None,
        symmetry=block.symmetry,
        weave=block.weave,
        has_sensitivities=capture.sensitivities is not None,
        has_illuminant=capture.illuminant is not None,
    )
