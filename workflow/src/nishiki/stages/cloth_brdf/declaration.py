"""Declaration of the stage `cloth_brdf`: settings, inputs, limits of its result, cost."""

from collections.abc import Mapping
from typing import Any, ClassVar, Literal

from pydantic import Field

from nishiki.artifacts.closed import Closed, Guarded
from nishiki.artifacts.limits import Limit, extreme
from nishiki.stages.base import Asked, Cost, Measurements, SceneFacts, Stage


def _cloth_error(diagnostics: Mapping[str, Any]) -> float | None:
    """At the incidences that the default model was fitted to."""
    chosen = diagnostics.get("default")
    models = [region.get(chosen) or {} for region in (diagnostics.get("regions") or {}).values()]
    return extreme("all")({"all": [(model.get("rms_rel_used") or {}) for model in models]})


LIMITS = (
    Limit(
        "misfit",
        "relative rms error of the default model at the incidences that it was fitted to, worst region",
        _cloth_error,
        most=1.5,
        doubt=1.0,
        remedy="set cloth_brdf.model, and check directions and regions of the capture",
        why="models gave 0.0003 to 0.95 where they were fitted; at 1.5 the errors are larger than the light",
    ),
)


Model = Literal[
    "yarn_facets",
    "facets",
    "bard_linear",
    "bard_great_circle",
    "bard_scaled",
    "ward",
    "ashikhmin_shirley",
    "ggx",
    "weave",
]


class ClothBrdfSettings(Guarded):
    """The BRDF of the whole hemisphere of every region, from normal incidence and a few oblique measurements."""

    STAGE: ClassVar[str] = "cloth_brdf"
    VERSION: ClassVar[int] = 2
    LIMITS: ClassVar[tuple[Limit, ...]] = LIMITS

    model: Model = Field("yarn_facets", description="the model that stands for the cloth")
    compare: tuple[Model, ...] = Field(
        ("facets", "bard_linear", "bard_great_circle", "bard_scaled", "ward", "ashikhmin_shirley", "ggx"),
        description="models fitted beside it; weave: where the stage weave has run",
    )
    oblique: int = Field(
        20,
        ge=0,
        le=2000,
        description="most oblique measurements that a fit may use, best ones first; 0: normal incidence alone",
    )
    measurements: Measurements = Field(
        "auto",
        description="views of normal incidence that a fit uses: all; so many, evenly spread; auto: as many as predict "
        "the others within 1 % (docs/economy.md)",
    )
    index: float = Field(1.5, gt=1, le=3, description="refractive index of the model facets, which takes it as given")
    export: tuple[Literal["table", "csv", "utia"], ...] = Field(
        ("csv",), description="table: sampled 4-D table (npz); csv: rows of angles and values; utia: .bin of doubles"
    )


EVERY_OBLIQUE = {"bard_scaled"}
"""Models that use every oblique measurement, whatever the setting `oblique` says."""


def _looks_at(facts: SceneFacts, settings: Mapping[str, Closed], asked: Asked) -> tuple[str, ...]:
    cloth = settings["cloth_brdf"]
    return ("oblique",) if cloth.oblique or not EVERY_OBLIQUE.isdisjoint((cloth.model, *cloth.compare)) else ()


STAGE = Stage(
    settings=ClothBrdfSettings,
    does="reflectance for every direction of light and view",
    formerly="fabric",
    geometry="goniometer",
    requires=("goniometer_samples",),
    wants=lambda settings: ("weave",) * ("weave" in (settings.model, *settings.compare)),
    needs_colour=True,
    looks_at=_looks_at,
    libraries=("numpy", "scipy", "numba"),
    deliverables=("*.npz", "*.csv"),
    # it reads one reflectance of a photograph, whatever the photograph's size
    cost=lambda facts: Cost(mib=400, seconds=12 + 0.0025 * facts.measurements),
)
