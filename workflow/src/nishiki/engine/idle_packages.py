"""In which scenes a stage loads a heavy package, and why not in the others."""

from collections.abc import Callable, Mapping

from nishiki.artifacts.closed import Closed
from nishiki.engine.capture_parts import surface_of
from nishiki.engine.stage_types import SceneFacts, Stage
from nishiki.formats.image_header import RAW_SUFFIXES

Reason = Callable[[SceneFacts, Mapping[str, Closed]], str | None]


def _only_files(suffixes: frozenset[str], what: str) -> Reason:
    return lambda facts, settings: None if suffixes & set(facts.suffixes) else f"no photograph is {what}"


def _no_pictures(facts: SceneFacts, settings: Mapping[str, Closed]) -> str | None:
    decoded_elsewhere = RAW_SUFFIXES | {".exr"}
    return None if set(facts.suffixes) - decoded_elsewhere else "no PNG, JPEG or TIFF is read"


def _no_film(stage: str, key: str) -> Reason:
    return lambda facts, settings: None if getattr(settings[stage], key) else "no video is asked for"


def _only_surface(source: tuple[str, ...], reason: str) -> Reason:
    return lambda facts, settings: None if surface_of(facts, settings) in source else reason


def _no_mesh_file(facts: SceneFacts, settings: Mapping[str, Closed]) -> str | None:
    return None if settings["fabric_render"].mesh else "no mesh file is draped"


IDLE: dict[tuple[str, str], Reason] = {
    ("ingest", "rawpy"): _only_files(RAW_SUFFIXES, "camera raw"),
    ("ingest", "OpenEXR"): _only_files(frozenset({".exr"}), "an EXR file"),
    ("ingest", "opencv-contrib-python-headless"): _no_pictures,
    ("render", "av"): _no_film("render", "sequences"),
    ("object_render", "av"): _no_film("object_render", "film"),
    ("fabric_render", "av"): _no_film("fabric_render", "film"),
    ("fabric_render", "trimesh"): _no_mesh_file,
    ("mesh", "trimesh"): _only_surface(("file", "scans"), "the surface comes from silhouettes"),
    ("mesh", "pymeshlab"): _only_surface(("scans",), "there are no range scans to merge"),
    ("mesh", "scikit-image"): _only_surface(("silhouettes",), "the surface does not come from silhouettes"),
}
"""(stage, package) of the stage's libraries to the reason why this scene does without it, None where it is loaded."""


def packages_of(stage: Stage, facts: SceneFacts, settings: Mapping[str, Closed]) -> tuple[str, ...]:
    """Those of the stage's libraries that it loads in this scene; settings: of all stages of the scene."""
    return tuple(name for name in stage.libraries if idle_reason(stage.name, name, facts, settings) is None)


def idle_reason(stage: str, package: str, facts: SceneFacts, settings: Mapping[str, Closed]) -> str | None:
    """Why a stage does not load one of its libraries in this scene; None where it does."""
    found = IDLE.get((stage, package))
    return found(facts, settings) if found else None
