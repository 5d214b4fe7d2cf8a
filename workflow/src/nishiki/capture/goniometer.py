"""A capture of a cloth on a gonioreflectometer, photographs or a table of reflectances, as one frozen value."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from nishiki.capture.frames import Frame, inside
from nishiki.capture.goniometer_rules import NORMAL_DEG, goniometer_problems
from nishiki.capture.goniometer_schema import GoniometerFile
from nishiki.capture.goniometer_tables import ReflectanceTable, read_table
from nishiki.capture.photographed import Photographed
from nishiki.capture.spectra_tables import Curves
from nishiki.formats.image_headers import read_header
from nishiki.formats.problems import Problem, error


@dataclass(frozen=True)
class GoniometerCapture(Photographed):
    """frames: none where there is a table; table: the reflectances given instead, or None; regions: label picture of
    the cloth, or None; warnings: what was tolerated."""

    settings: GoniometerFile
    table: ReflectanceTable | None
    regions: Path | None
    sensitivities: Curves | None
    illuminant: Curves | str | None
    warnings: tuple[Problem, ...]

    @property
    def observed(self) -> tuple[Frame, ...]:
        """Frames of the cloth, in the order of the table."""
        return self.frames_of("sample")

    @property
    def channels(self) -> tuple[str, ...]:
        """Names of the channels: of the camera, or of the table's columns."""
        return self.settings.camera.channels if self.table is None else self.table.channels

    @property
    def angles_deg(self) -> list[tuple[float, float, float, float]]:
        """theta_i, phi_i, theta_r, phi_r of every measurement of the cloth."""
        if self.table is None:
            return [f.angles_deg for f in self.observed]
        rows = zip(self.table.incident_deg.tolist(), self.table.outgoing_deg.tolist(), strict=True)
        return [(*incident, *outgoing) for incident, outgoing in rows]


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


def examine_goniometer(
    root: Path,
    payload: Path,
    settings: GoniometerFile,
    frames: tuple[Frame, ...] | None,
    spectra: tuple[Curves | None, Curves | str | None],
    attempt: Callable,
) -> tuple[GoniometerCapture | None, list[Problem]]:
    """The capture (None where its tables cannot be read) and what is wrong with how its tables fit together.

    frames: of frames.csv, None where it cannot be read; spectra: sensitivities and illuminant; attempt: runs a reader,
    collecting the problems that it raises.
    """
    block = settings.goniometer
    named = {key: attempt(lambda f=file, k=key: inside(payload, f, f"capture.yaml {k}")) for key, file in block.files}
    path, table = named.get("goniometer.table"), None
    if block.table is not None:
        table = (
            attempt(lambda: read_table(path, block.table, values=block.values, azimuths=block.azimuths))
            if path
            else None
        )
        if table is None:
            return None, []
        problems = list(table.warnings)
        if (payload / "frames.csv").exists():
            remedy = "Remove frames.csv, or goniometer.table from capture.yaml"
            what = "photographs and a table of reflectances in one capture"
            problems.append(error("frames-unexpected", "frames.csv", what, remedy=remedy))
    elif frames is None:
        return None, []
    else:
        problems = goniometer_problems(frames)
    capture = GoniometerCapture(
        root=root,
        payload=payload,
        settings=settings,
        frames=frames or (),
        table=table,
        regions=named.get("goniometer.regions"),
        sensitivities=spectra[0],
        illuminant=spectra[1],
        warnings=tuple(p for p in problems if p.severity == "warning"),
    )
    return capture, problems
