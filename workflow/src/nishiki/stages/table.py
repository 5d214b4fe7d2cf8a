"""List all stages in one table, in the order of the flow: plan, keys, rules and documentation derive from it."""

from nishiki.artifacts.declaration import Limit
from nishiki.stages.base import Stage, declaration_of

NAMES = (
    "ingest",
    "separate",
    "normals",
    "mosaic",
    "height",
    "spectra",
    "brdf",
    "render",
    "evaluate",
    "export",
    "viewer",
    "report",
    "polarise",
    "cameras",
    "mesh",
    "texels",
    "object_brdf",
    "residual",
    "object_render",
    "object_viewer",
    "object_evaluate",
    "object_export",
    "object_report",
    "goniometer_samples",
    "weave",
    "cloth_brdf",
    "cloth_render",
    "cloth_viewer",
    "cloth_evaluate",
    "cloth_export",
    "cloth_report",
)
"""Names of the stages. Each is a package here, whose `__init__.py` declares it and whose `run.py` runs it."""

CHAIN: dict[str, Stage] = {name: declaration_of(name) for name in NAMES}
PRODUCTS = tuple(dict.fromkeys(stage.asked_as for stage in CHAIN.values() if stage.name != "ingest"))
LIMITS: dict[str, tuple[Limit, ...]] = {name: stage.limits for name, stage in CHAIN.items()}
"""Limits by stage. Stages that judge and show (render, evaluate, report) have none: bad results must be shown too."""


def chain_of(geometry: str) -> dict[str, Stage]:
    """Return the stages for captures of this geometry, in the order of the flow."""
    chain = {name: stage for name, stage in CHAIN.items() if stage.serves(geometry)}
    replaced = {name for stage in chain.values() for name in stage.stands_for}
    return {name: stage for name, stage in chain.items() if name not in replaced}
