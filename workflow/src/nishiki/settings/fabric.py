"""Settings of fabric."""

from typing import ClassVar, Literal

from pydantic import Field

from nishiki.artifacts.closed import Guarded
from nishiki.settings.counts import Measurements

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


class FabricSettings(Guarded):
    """The BRDF of the whole hemisphere of every region, from normal incidence and a few oblique measurements."""

    STAGE: ClassVar[str] = "fabric"
    VERSION: ClassVar[int] = 1

    model: Model = Field("yarn_facets", description="the model that stands for the cloth")
    compare: tuple[Model, ...] = Field(
        ("facets", "bard_linear", "bard_great_circle", "bard_scaled", "ward", "ashikhmin_shirley", "ggx"),
        description="models fitted beside it; weave: where the stage weave has run",
    )
    oblique: int = Field(
        20,
        ge=0,
        le=2000,
        description="most oblique measurements that a fit may use, chosen by what they tell; 0: normal incidence alone",
    )
    measurements: Measurements = Field(
        "auto",
        description="views of normal incidence that a fit uses: all; so many evenly spread ones; auto: as many as tell "
        "the others within 1 % (docs/economy.md)",
    )
    index: float = Field(1.5, gt=1, le=3, description="refractive index of the model facets, which takes it as given")
    export: tuple[Literal["table", "csv", "utia"], ...] = Field(
        ("csv",), description="table: sampled 4-D table (npz); csv: rows of angles and values; utia: .bin of doubles"
    )
