"""What a plan leaves out of a scene: parts of the capture that no stage looks at, packages that none loads, and why.

What is not named here (the photographs that a fit needs, their white boards and dark frames, tables, spectra, masks) is
always read.
"""

from collections.abc import Callable
from dataclasses import dataclass

from nishiki.stages.base import Asked, SceneFacts, SceneSettings, Stage, poses_of, surface_of
from nishiki.stages.table import CHAIN


@dataclass(frozen=True)
class CapturePart:
    """what: the files, in words; idle: why they are left out, beside that no stage of the plan looks at them."""

    what: str
    idle: Callable[[SceneFacts, SceneSettings], str] = lambda facts, settings: ""


def surface_from(facts: SceneFacts, settings: SceneSettings) -> str:
    """The reason why a file or scans are not needed."""
    source = {"file": "the mesh file", "scans": "range scans", "silhouettes": "silhouettes"}
    return f"the surface comes from {source[surface_of(facts, settings)]}"


PARTS = {
    "check": CapturePart(
        "photographs under check lights", lambda facts, settings: "only evaluate and export look at them"
    ),
    "flat": CapturePart("flat frames", lambda facts, settings: "no stage uses flat frames; white boards do their work"),
    "states": CapturePart(
        "photographs through the other polariser states",
        lambda facts, settings: "only polarise looks at them; the others take the state off",
    ),
    "white_states": CapturePart(
        "white boards through polarisers", lambda facts, settings: "only polarise looks at them"
    ),
    "photographs": CapturePart(
        "photographs of the object", lambda facts, settings: "no stage of the plan looks at a picture"
    ),
    "calibration": CapturePart(
        "pictures of the calibration board",
        lambda facts, settings: "the camera matrices are given" if poses_of(facts, settings) == "matrices" else "",
    ),
    "silhouettes": CapturePart("silhouettes", lambda facts, settings: "only mesh looks at them"),
    "mesh": CapturePart("the mesh file", lambda facts, settings: surface_from(facts, settings)),
    "scans": CapturePart("range scans", lambda facts, settings: surface_from(facts, settings)),
    "oblique": CapturePart(
        "photographs with the light away from the normal",
        lambda facts, settings: "only the fit of the reflection and its evaluation look at them",
    ),
}
"""Every part that can be left out, by its name in the setting `ingest.without`."""


def left_parts(
    facts: SceneFacts, settings: SceneSettings, stages: set[str], asked: Asked
) -> tuple[tuple[str, ...], dict[str, str]]:
    """Parts of the capture that no stage looks at, in a fixed order, and the reason for each, by its words."""
    looked = {part for stage in stages for part in CHAIN[stage].looks_at(facts, settings, asked)}
    without = tuple(part for part in PARTS if facts.parts.get(part) and part not in looked)
    return without, {f"{facts.parts[part]} {PARTS[part].what}": _why(part, facts, settings) for part in without}


def _why(part: str, facts: SceneFacts, settings: SceneSettings) -> str:
    return PARTS[part].idle(facts, settings) or "no stage of the plan looks at them"


def packages_of(stage: Stage, facts: SceneFacts, settings: SceneSettings) -> tuple[str, ...]:
    """Those of the stage's libraries that it loads in this scene."""
    return tuple(name for name in stage.libraries if idle_reason(stage, name, facts, settings) is None)


def idle_reason(stage: Stage, package: str, facts: SceneFacts, settings: SceneSettings) -> str | None:
    """Why a stage does not load one of its libraries in this scene; None where it does."""
    reason = stage.idle.get(package)
    return reason(facts, settings) if reason else None
