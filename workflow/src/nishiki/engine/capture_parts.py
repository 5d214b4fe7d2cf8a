"""Parts of a capture that a scene may do without, and which stages look at them.

What is not named here (the photographs that a fit needs, their white boards and dark frames, tables, spectra, masks) is
always read.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from nishiki.artifacts.closed import Closed
from nishiki.engine.stage_types import SceneFacts

Asked = tuple[str, ...]
Looks = Callable[[SceneFacts, Mapping[str, Closed], Asked], tuple[str, ...]]


@dataclass(frozen=True)
class Part:
    """what: the files, in words; idle: why they are left out, beside that no stage of the plan looks at them."""

    what: str
    idle: Callable[[SceneFacts, Mapping[str, Closed]], str] = lambda facts, settings: ""


PARTS = {
    "check": Part("photographs under check lights", lambda facts, settings: "only evaluate looks at them"),
    "flat": Part("flat frames", lambda facts, settings: "no stage uses flat frames; white boards do their work"),
    "states": Part(
        "photographs through the other polariser states",
        lambda facts, settings: "only polarise looks at them; the others take the state off",
    ),
    "white_states": Part("white boards through polarisers", lambda facts, settings: "only polarise looks at them"),
    "photographs": Part("photographs of the object", lambda facts, settings: "no stage of the plan looks at a picture"),
    "calibration": Part(
        "pictures of the calibration board",
        lambda facts, settings: "the camera matrices are given" if poses_of(facts, settings) == "matrices" else "",
    ),
    "silhouettes": Part("silhouettes", lambda facts, settings: "only mesh looks at them"),
    "mesh": Part("the mesh file", lambda facts, settings: surface_from(facts, settings)),
    "scans": Part("range scans", lambda facts, settings: surface_from(facts, settings)),
    "oblique": Part(
        "photographs with the light away from the normal",
        lambda facts, settings: "only the fit of the fabric and its evaluation look at them",
    ),
}
"""Every part that can be left out, by its name in the setting `ingest.without`."""


def poses_of(facts: SceneFacts, settings: Mapping[str, Closed]) -> str:
    """What gives the poses: matrices, boards or correspondences (see the stage cameras)."""
    wanted = settings["cameras"].source
    there = [name for name in ("matrices", "boards", "correspondences") if name in facts.given]
    return wanted if wanted != "auto" else next(iter(there), "")


def surface_of(facts: SceneFacts, settings: Mapping[str, Closed]) -> str:
    """Where the surface comes from: file, scans or silhouettes (see the stage mesh)."""
    wanted = settings["mesh"].source
    there = [name for name, part in (("file", "mesh"), ("scans", "scans")) if facts.parts.get(part)]
    return wanted if wanted != "auto" else next(iter(there), "silhouettes")


def surface_from(facts: SceneFacts, settings: Mapping[str, Closed]) -> str:
    """The reason why a file or scans are not needed."""
    source = {"file": "the mesh file", "scans": "range scans", "silhouettes": "silhouettes"}
    return f"the surface comes from {source[surface_of(facts, settings)]}"


def _cameras(facts: SceneFacts, settings: Mapping[str, Closed], asked: Asked) -> tuple[str, ...]:
    return () if poses_of(facts, settings) == "matrices" else ("calibration",)


def _mesh(facts: SceneFacts, settings: Mapping[str, Closed], asked: Asked) -> tuple[str, ...]:
    # The preview shows the surface beside photographs, so these are looked at whatever the surface comes from.
    given = {"file": ("mesh",), "scans": ("scans",), "silhouettes": ()}[surface_of(facts, settings)]
    return ("silhouettes", "photographs", *given)


def _texels(facts: SceneFacts, settings: Mapping[str, Closed], asked: Asked) -> tuple[str, ...]:
    return ("photographs",) if "off" in facts.states else ("photographs", "states")


def _reflectance(facts: SceneFacts, settings: Mapping[str, Closed], asked: Asked) -> tuple[str, ...]:
    # Asked for by name the reflectances themselves are wanted, all of them. A light within normal_deg counts as along
    # the normal, where ingest would take it for oblique.
    return ("oblique",) if "reflectance" in asked or settings["reflectance"].normal_deg > 1 else ()


def _fabric(facts: SceneFacts, settings: Mapping[str, Closed], asked: Asked) -> tuple[str, ...]:
    own = settings["fabric"]
    return ("oblique",) if own.oblique or not EVERY_OBLIQUE.isdisjoint((own.model, *own.compare)) else ()


EVERY_OBLIQUE = {"bard_scaled"}
"""Models that use every oblique measurement, whatever the setting `oblique` says."""

LOOKS_AT: dict[str, Looks] = {
    "evaluate": lambda facts, settings, asked: ("check",),
    "polarise": lambda facts, settings, asked: ("photographs", "states", "white_states"),
    "cameras": _cameras,
    "mesh": _mesh,
    "texels": _texels,
    "object_evaluate": _texels,
    "reflectance": _reflectance,
    "fabric": _fabric,
    "fabric_evaluate": lambda facts, settings, asked: ("oblique",),
}
"""Stage to the parts that it looks at, from the facts, all settings of the scene, and the products asked for."""


def left_parts(
    facts: SceneFacts, settings: Mapping[str, Closed], wanted: set[str], asked: Asked
) -> tuple[tuple[str, ...], dict[str, str]]:
    """Parts of the capture that no wanted stage looks at, in a fixed order, and the reason for each, by its words."""
    looked = {part for stage in wanted if stage in LOOKS_AT for part in LOOKS_AT[stage](facts, settings, asked)}
    without = tuple(part for part in PARTS if facts.parts.get(part) and part not in looked)
    return without, {f"{facts.parts[part]} {PARTS[part].what}": _why(part, facts, settings) for part in without}


def _why(part: str, facts: SceneFacts, settings: Mapping[str, Closed]) -> str:
    return PARTS[part].idle(facts, settings) or "no stage of the plan looks at them"
