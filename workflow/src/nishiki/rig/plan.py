"""Read the plan of a rig's photographs, a few lines of YAML, and expand it to the table of frames."""

import math
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, field_validator, model_validator

from nishiki.artifacts.declaration import Closed, parse
from nishiki.capture.lights import Lights, read_lights
from nishiki.capture.schema import Positive
from nishiki.errors import UserError, require
from nishiki.formats.picture_files import IMAGE_SUFFIXES
from nishiki.goniometry.directions import between, unit
from nishiki.rig.described import State
from nishiki.rig.description import read_yaml
from nishiki.rig.frames_table import AUTOMATIC, FIELDS, PlannedFrame

When = Literal["before", "after"]
Share = Annotated[float, Field(ge=0, le=1)]
Factor = Annotated[float, Field(gt=1)]
Count = Annotated[int, Field(strict=True, ge=0, le=10000)]


class WhiteBoard(Closed):
    """Photographs of the white board in the object's place, one for every lamp (and polariser state)."""

    when: When = Field("before", description="before or after the object")
    exposure_s: Positive | None = Field(None, description="seconds, where they differ from the object's")


class Darks(Closed):
    """Photographs without light."""

    when: When = Field("after", description="before or after everything else")
    frames: Annotated[int, Field(ge=1, le=1000)] = Field(3, description="frames for each exposure time")


class PoseBoard(Closed):
    """Photographs of a ChArUco board that turns with the table, one a view."""

    when: When = Field("after", description="before or after the object")


class Checks(Closed):
    """Acceptance criteria of a frame; null disables a check."""

    saturated: Share | None = Field(0.05, description="largest share of saturated pixels of the object")
    white_saturated: Share | None = Field(0.002, description="largest share of saturated pixels of the white board")
    dark: Share | None = Field(0.98, description="largest share of pixels without light, of lit frames")
    sharpness: Share | None = Field(0.3, description="least sharpness relative to the first frame of the object")
    brightness: Factor | None = Field(
        2.5, description="largest factor between a frame and what its neighbours lead to expect"
    )
    repeats: Count = Field(2, description="times that a frame is taken again before the run stops")


class ClothChecks(Checks):
    """Acceptance criteria of a cloth, whose gloss differs much between neighbouring directions."""

    brightness: Factor | None = Field(10.0, description="as for the other kinds")


class AutomaticExposure(Closed):
    """Settings of `exposure_s: auto`, which meters the frame expected to be the brightest."""

    start_s: Positive = Field(0.1, description="first exposure that is tried, seconds")
    least_s: Positive = Field(0.0005, description="shortest exposure, seconds")
    most_s: Positive = Field(30.0, description="longest exposure, seconds")
    saturated: Share = Field(0.001, description="largest share of saturated pixels")


class Estimate(Closed):
    """Assumptions for durations and sizes in the table."""

    frame_mb: Positive = Field(30.0, description="size of a photograph, megabytes")
    download_s: Positive = Field(3.0, description="seconds from the end of an exposure until the next may begin")
    degrees_per_s: Positive = Field(10.0, description="speed of the axes; millimetres of straight ones")
    polariser_s: Positive = Field(2.0, description="seconds for a change of the polarisers")


class PlanSettings(Closed):
    """Settings common to the plans of all kinds."""

    kind: str
    suffix: str = Field(description="of the camera's files: nef, cr3, tif, png, jpg")
    exposure_s: Positive | Literal["auto"] | tuple[Positive, ...] | None = Field(
        None, description="seconds; auto; left out: as the camera is set; goniometer: also a list"
    )
    aperture: Positive | None = Field(None, description="f-number; left out: as the camera is set")
    iso: Annotated[int, Field(gt=0)] | None = Field(None, description="sensitivity; left out: as the camera is set")
    white: WhiteBoard | None = Field(None, description="left out: no white board")
    dark: Darks | None = Field(None, description="left out: no dark frames")
    capture: dict[str, Any] = Field({}, description="keys of capture.yaml; files relative to the plan")
    checks: Checks = Field(Checks(), description="what a frame must be like to be kept")
    auto: AutomaticExposure = Field(AutomaticExposure(), description="settings of the automatic exposure")
    estimate: Estimate = Field(Estimate(), description="for durations and sizes")

    @field_validator("suffix")
    @classmethod
    def _check_suffix(cls, suffix: str) -> str:
        suffix = f".{suffix.lower().removeprefix('.')}"
        if suffix not in IMAGE_SUFFIXES:
            raise ValueError(f"one of {', '.join(sorted(known.removeprefix('.') for known in IMAGE_SUFFIXES))}")
        return suffix

    @model_validator(mode="after")
    def _agree(self) -> "PlanSettings":
        if isinstance(self.exposure_s, tuple) and (self.kind != "goniometer" or not self.exposure_s):
            raise ValueError("several exposures of one direction are possible with kind: goniometer only")
        if self.exposure_s is None and self.white and self.white.exposure_s:
            raise ValueError("white.exposure_s needs exposure_s: exposures are divided out for all images or none")
        if self.exposure_s == "auto" and self.dark and self.dark.when == "before":
            raise ValueError("exposure_s: auto needs dark: {when: after}, since dark frames have the exposures found")
        if wrong := {"format", "geometry"} & set(self.capture):
            raise ValueError(f"capture: {', '.join(sorted(wrong))} follow from the kind of the plan; leave them out")
        return self


class FieldGrid(Closed):
    """Overlapping fields of a painting, in rows and columns; two straight axes go to them."""

    rows: Annotated[int, Field(strict=True, ge=1, le=26)] = Field(description="a, b … from the upper edge")
    columns: Annotated[int, Field(strict=True, ge=1, le=1000)] = Field(description="1, 2 … from the left edge")
    step_mm: tuple[Positive, Positive] = Field(description="from a field to its neighbour, to the right and down")
    first_mm: tuple[float, float] = Field((0.0, 0.0), description="where the axes stand for field a1")
    axes: tuple[str, str] = Field(("x", "y"), description="names in the rig's description: to the right, up")
    moves: Literal["camera", "painting"] = Field("camera", description="what the axes move")

    @model_validator(mode="after")
    def _several(self) -> "FieldGrid":
        if self.rows * self.columns < 2:
            raise ValueError("one field is no mosaic; leave `fields` out")
        return self

    @property
    def sign(self) -> int:
        """Direction in which the camera moves on the painting when an axis coordinate increases."""
        return 1 if self.moves == "camera" else -1

    def places(self) -> dict[str, tuple[tuple[str, float], ...]]:
        """Compute positions of the axes by names of fields; every other row backwards."""
        found: dict[str, tuple[tuple[str, float], ...]] = {}
        for row, column in product(range(self.rows), range(self.columns)):
            column = self.columns - 1 - column if row % 2 else column
            moved = self.first_mm[0] + self.sign * column * self.step_mm[0]
            lifted = self.first_mm[1] - self.sign * row * self.step_mm[1]
            found[f"{chr(ord('a') + row)}{column + 1}"] = ((self.axes[0], moved), (self.axes[1], lifted))
        return found


class DomePlan(PlanSettings):
    """A flat object under lamps that shine one after the other."""

    kind: Literal["dome"]
    lights: str = Field(description=".lp file, relative to the plan; its line n is lamp n")
    lights_kind: Literal["direction", "position_mm"] = Field("direction", description="what the file holds")
    checks_for: tuple[str, ...] = Field((), description="names of lamps that are kept for evaluation")
    fields: FieldGrid | None = Field(None, description="fields of a mosaic that two axes go to; left out: one")


class TurntablePlan(PlanSettings):
    """An object on a turntable, under one lamp or several, in one or several states of polarisers."""

    kind: Literal["turntable"]
    steps: Annotated[int, Field(ge=1, le=10000)] = Field(description="number of views")
    turn_deg: Annotated[float, Field(gt=0, le=360)] = Field(360.0, description="angle that the steps share")
    axis: str = Field("turntable", description="name of the axis in the rig's description")
    lamps: tuple[Annotated[int, Field(ge=1)], ...] = Field((), description="numbers; left out: lamps are not switched")
    states: tuple[State, ...] = Field((), description="states of the polarisers, named as in frames.csv")
    polarisers: tuple[str, ...] = Field(
        ("polariser",), min_length=1, max_length=2, description="names in the rig's description; two: G/A in states"
    )
    outer: Literal["view", "state"] = Field("view", description="what changes least often; state where a person turns")
    board: PoseBoard | None = Field(None, description="ChArUco board that turns with the table; left out: none")


class GoniometerPlan(PlanSettings):
    """A cloth: the quarter hemisphere at normal incidence, and the most informative oblique pairs."""

    kind: Literal["goniometer"]
    theta_step_deg: Annotated[float, Field(gt=0, le=45)] = Field(9.0, description="step of the camera's polar angle")
    theta_most_deg: Annotated[float, Field(gt=0, lt=90)] = Field(81.0, description="largest polar angle of the camera")
    phi_step_deg: Annotated[float, Field(gt=0, le=45)] = Field(
        15.0, description="step of the camera's azimuth, 0 to 90"
    )
    oblique: Annotated[int, Field(ge=0, le=700)] = Field(20, description="number of oblique pairs")
    separation_deg: Annotated[float, Field(ge=0, lt=90)] = Field(
        0.0, description="least angle between lamp and camera, where one would stand before the other"
    )
    lamp: Annotated[int, Field(ge=1)] | None = Field(None, description="number; left out: the lamp is not switched")
    checks: ClothChecks = Field(ClothChecks(), description="what a frame must be like to be kept")
    axes: dict[str, dict[str, float]] = Field(
        {name: {name: 1.0} for name in ("theta_i", "phi_i", "theta_r", "phi_r")},
        description="angle of each axis: factors of theta_i, phi_i, theta_r, phi_r, and `offset`, degrees",
    )

    @field_validator("axes")
    @classmethod
    def _check_angles(cls, axes: dict[str, dict[str, float]]) -> dict[str, dict[str, float]]:
        known = ("theta_i", "phi_i", "theta_r", "phi_r", "offset")
        wrong = sorted({name for terms in axes.values() for name in terms} - set(known))
        if wrong:
            raise ValueError(f"axes: expected {', '.join(known)}, found {', '.join(wrong)}")
        return axes


AnyPlan = DomePlan | TurntablePlan | GoniometerPlan
KINDS: dict[str, type[AnyPlan]] = {"dome": DomePlan, "turntable": TurntablePlan, "goniometer": GoniometerPlan}
GEOMETRIES = {"dome": "plane", "turntable": "turntable", "goniometer": "goniometer"}


@dataclass(frozen=True)
class ReadPlan:
    """Plan, base folder of its file names, and lamps."""

    settings: AnyPlan
    folder: Path

    @cached_property
    def lights(self) -> Lights | None:
        """Lamps of a dome, in the order of their numbers; None for the other kinds."""
        if not isinstance(self.settings, DomePlan):
            return None
        path = self.folder / self.settings.lights
        if not path.is_file():
            raise UserError(f"plan: no file {path}. Remedy: correct 'lights', relative to the plan")
        return read_lights(path, kind=self.settings.lights_kind)

    def frames(self) -> tuple[PlannedFrame, ...]:
        """Return the table of frames."""
        plan = self.settings
        if isinstance(plan, DomePlan):
            groups = _dome_frames(plan, require(self.lights))
        elif isinstance(plan, TurntablePlan):
            groups = _turntable_frames(plan)
        else:
            groups = _goniometer_frames(plan)
        lit = _in_order(plan, groups)
        darks = _darks(plan, lit)
        ordered = [*darks, *lit] if plan.dark and plan.dark.when == "before" else [*lit, *darks]
        estimate, before, rows = plan.estimate, {}, []
        state: tuple[tuple[str, str], ...] = ()
        for frame in ordered:
            exposure = frame.exposure_s if isinstance(frame.exposure_s, float) else plan.auto.start_s
            seconds = exposure + estimate.download_s
            turns = [abs(angle - before.get(name, 0.0)) for name, angle in frame.axes]
            if plan.kind != "dome":
                turns = [min(turn % 360, -turn % 360) for turn in turns]
            seconds += max(turns, default=0.0) / estimate.degrees_per_s
            before |= dict(frame.axes)
            if frame.polarisers and frame.polarisers != state:
                seconds, state = seconds + estimate.polariser_s, frame.polarisers
            rows.append(replace(frame, seconds=round(seconds, 1), bytes=int(estimate.frame_mb * 1e6)))
        return tuple(rows)


def read_plan(path: Path) -> ReadPlan:
    """Read a plan. UserError names every key that is wrong."""
    values = read_yaml(path)
    kind = values.get("kind")
    if kind not in KINDS:
        raise UserError(f"{path}: kind: expected {', '.join(KINDS)}, found {kind!r}. docs/rig.md shows a plan of each")
    return ReadPlan(parse(KINDS[kind], values, str(path)), path.parent)


def _exposures(plan: AnyPlan, group: str) -> tuple[float | str | None, ...]:
    """Return exposures of the object or of the white board, as written in the table."""
    if group == "white" and plan.white and plan.white.exposure_s:
        return (plan.white.exposure_s,)
    if plan.exposure_s == "auto":
        return (AUTOMATIC[group],)
    if isinstance(plan.exposure_s, tuple):
        return plan.exposure_s if group == "object" else plan.exposure_s[:1]
    return (plan.exposure_s,)


def _frame(plan: AnyPlan, file: str, role: str, exposure: float | str | None, **where: Any) -> PlannedFrame:
    return PlannedFrame(
        file=f"{file}{plan.suffix}", role=role, exposure_s=exposure, aperture=plan.aperture, iso=plan.iso, **where
    )


def _dome_frames(plan: DomePlan, lights: Lights) -> dict[str, list[PlannedFrame]]:
    unknown = [name for name in plan.checks_for if lights.find(name) is None]
    if unknown:
        known = ", ".join(lights.names[:8])
        raise UserError(f"plan: checks_for: no lamp {', '.join(unknown)} in {plan.lights}, which has {known} ...")
    held = {lights.find(name) for name in plan.checks_for}
    (exposure,), (white_exposure,) = _exposures(plan, "object"), _exposures(plan, "white")
    groups: dict[str, list[PlannedFrame]] = {"object": [], "white": []}
    places = {f"{FIELDS}/{name}/": axes for name, axes in plan.fields.places().items()} if plan.fields else {"": ()}
    for (i, name), (folder, axes) in ((lamp, place) for place in places.items() for lamp in enumerate(lights.names)):
        shared, role = {"lamp": i + 1, "light": name, "axes": axes}, "check" if i in held else "sample"
        groups["object"].append(_frame(plan, f"{folder}frames/{name}", role, exposure, **shared))
        if len(groups["white"]) == i:
            groups["white"].append(_frame(plan, f"white/{name}", "white", white_exposure, **shared))
    return groups


def _turntable_frames(plan: TurntablePlan) -> dict[str, list[PlannedFrame]]:
    angles = [plan.turn_deg * i / plan.steps for i in range(plan.steps)]
    if plan.turn_deg < 360 and plan.steps > 1:
        angles = [plan.turn_deg * i / (plan.steps - 1) for i in range(plan.steps)]
    digits = max(3, len(str(plan.steps)))
    views: list[tuple] = [
        (f"{i:0{digits}d}" if plan.steps > 1 else "", ((plan.axis, angle),)) for i, angle in enumerate(angles)
    ]
    if plan.steps == 1:
        views = [("", ())]
    states = plan.states or ("",)
    lamps = plan.lamps or (None,)
    (exposure,), (white_exposure,) = _exposures(plan, "object"), _exposures(plan, "white")

    def place(lamp: int | None, state: str) -> dict[str, Any]:
        light = f"lamp{lamp}" if len(lamps) > 1 else ""
        return {"lamp": lamp, "light": light, "polariser": state, "polarisers": _states_of(plan, state)}

    def name(*parts: str) -> str:
        return "-".join(part.replace("/", "_") for part in parts if part)

    groups: dict[str, list[PlannedFrame]] = {"object": [], "white": [], "board": []}
    order = [(view, state) for view, state in product(views, states)]
    if plan.outer == "state":
        order = [(view, state) for state, view in product(states, views)]
    for (view, axes), state in order:
        for lamp in lamps:
            where = place(lamp, state)
            file = f"frames/{name(view, where['light'], state) or 'view'}"
            groups["object"].append(_frame(plan, file, "sample", exposure, view=view, axes=axes, **where))
    for state, lamp in product(states, lamps):
        where = place(lamp, state)
        groups["white"].append(
            _frame(
                plan,
                f"white/{name(where['light'], state) or 'white'}",
                "white",
                white_exposure,
                axes=views[0][1],
                **where,
            )
        )
    for view, axes in views if plan.board else ():
        where = place(lamps[0], states[0]) | {"polariser": ""}
        groups["board"].append(_frame(plan, f"board/{view}", "board", exposure, view=view, axes=axes, **where))
    return groups


def _states_of(plan: TurntablePlan, state: str) -> tuple[tuple[str, str], ...]:
    """Return the state of each polariser of the rig."""
    if not state:
        return ()
    parts = state.split("/") if len(plan.polarisers) > 1 else [state]
    if len(parts) != len(plan.polarisers):
        raise UserError(f"plan: states: expected {' / '.join(plan.polarisers)}, such as 0/90, found '{state}'")
    return tuple(zip(plan.polarisers, parts, strict=True))


def _goniometer_frames(plan: GoniometerPlan) -> dict[str, list[PlannedFrame]]:
    from nishiki.rig.frames_table import recommend_oblique

    thetas = np.arange(0, plan.theta_most_deg + 1e-6, plan.theta_step_deg)
    phis = np.arange(0, 90 + 1e-6, plan.phi_step_deg)
    views = [(float(theta), float(phi)) for theta in thetas for phi in (phis if theta else phis[:1])]
    pairs = [(0.0, 0.0, *view) for view in views if view[0] >= plan.separation_deg]
    if plan.oblique:
        pairs += recommend_oblique(np.array(pairs)[:, 2:], plan.oblique, plan.separation_deg)
    groups: dict[str, list[PlannedFrame]] = {"object": [], "white": []}
    exposures = _exposures(plan, "object")
    digits = max(3, len(str(len(pairs))))
    for i, pair in enumerate(pairs):
        for j, exposure in enumerate(exposures):
            file = f"frames/{i:0{digits}d}{f'-{j}' if len(exposures) > 1 else ''}"
            groups["object"].append(_pair_frame(plan, file, "sample", exposure, pair))
    (white_exposure,) = _exposures(plan, "white")[:1]
    for i, (theta, phi) in enumerate(dict.fromkeys(pair[:2] for pair in pairs)):
        aside = 0.0 if theta >= plan.separation_deg else plan.separation_deg
        file = f"white/{i:0{digits}d}"
        groups["white"].append(_pair_frame(plan, file, "white", white_exposure, (theta, phi, aside, 0.0)))
    return groups


def _pair_frame(
    plan: GoniometerPlan, file: str, role: str, exposure: float | str | None, pair: tuple[float, ...]
) -> PlannedFrame:
    values = dict(zip(("theta_i", "phi_i", "theta_r", "phi_r"), pair, strict=True)) | {"offset": 1.0}
    axes = tuple((name, sum(factor * values[t] for t, factor in terms.items())) for name, terms in plan.axes.items())
    return _frame(plan, file, role, exposure, lamp=plan.lamp, angles_deg=pair, axes=axes)


def _in_order(plan: AnyPlan, groups: dict[str, list[PlannedFrame]]) -> list[PlannedFrame]:
    """Sort frames: boards before the object, the object, boards after it."""
    boards = {"white": plan.white, "board": getattr(plan, "board", None)}
    before = [f for name, settings in boards.items() if settings and settings.when == "before" for f in groups[name]]
    after = [f for name, settings in boards.items() if settings and settings.when == "after" for f in groups[name]]
    return [*before, *groups["object"], *after]


def _darks(plan: AnyPlan, lit: list[PlannedFrame]) -> list[PlannedFrame]:
    """List dark frames of every exposure in use."""
    exposures = list(dict.fromkeys(frame.exposure_s for frame in lit))
    count = plan.dark.frames if plan.dark else 0
    names = [f"-{chr(ord('a') + i)}" if len(exposures) > 1 else "" for i in range(len(exposures))]
    return [
        _frame(plan, f"dark/dark{name}-{i + 1}", "dark", exposure)
        for name, exposure in zip(names, exposures, strict=True)
        for i in range(count)
    ]


def incidence_cosines(plan: ReadPlan, frames: tuple[PlannedFrame, ...]) -> dict[str, float]:
    """Compute each lit frame's relative brightness on a flat diffuse surface, by file.

    The cosine of the lamp's angle from the normal, over the squared distance where lamps have positions; 1 where the
    lamp's place is not known.
    """
    lights, settings = plan.lights, plan.settings
    values = {}
    for frame in frames:
        if lights is not None and isinstance(settings, DomePlan) and frame.light:
            i = lights.index(frame.light)
            distance = np.linalg.norm(lights.vectors[i]) if settings.lights_kind == "position_mm" else 1.0
            values[frame.file] = float(lights.directions[i, 2] / distance**2)
        elif frame.angles_deg:
            values[frame.file] = math.cos(math.radians(frame.angles_deg[0]))
        else:
            values[frame.file] = 1.0
    return values


def frame_distance(plan: ReadPlan, a: PlannedFrame, b: PlannedFrame) -> float:
    """Compute the distance of two frames of one kind, for the choice of neighbours; infinite if not comparable."""
    if (a.group, a.polariser) != (b.group, b.polariser):
        return math.inf
    if plan.lights is not None:
        i, j = plan.lights.index(a.light), plan.lights.index(b.light)
        return float(between(plan.lights.directions[i], plan.lights.directions[j]))
    if a.angles_deg and b.angles_deg:
        first, second = (np.radians(frame.angles_deg) for frame in (a, b))
        return float(between(unit(*first[:2]), unit(*second[:2])) + between(unit(*first[2:]), unit(*second[2:])))
    if a.light != b.light:
        return math.inf
    turns = dict(b.axes)
    return sum(abs((angle - turns.get(name, angle) + 180) % 360 - 180) for name, angle in a.axes)
