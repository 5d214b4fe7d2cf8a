"""What is exported: the cloth that the stage cloth_render drapes, and the model that it shows."""

from __future__ import annotations

from dataclasses import dataclass

from nishiki.artifacts.artifact import Artifact
from nishiki.artifacts.closed import parse
from nishiki.render.cloth.models import ClothModels
from nishiki.render.cloth.scene import Brdf
from nishiki.stages.cloth_render.declaration import ClothRenderSettings
from nishiki.stages.cloth_render.scene import DrapedCloth, draped_cloth


@dataclass(frozen=True)
class ExportedCloth:
    """shown: settings of the pictures; brdf: that of this model of a region of the capture."""

    shown: ClothRenderSettings
    draped: DrapedCloth
    region: str
    model: str
    brdf: Brdf

    @classmethod
    def of(cls, inputs: dict[str, Artifact]) -> ExportedCloth:
        """The cloth of the pictures in the artifact of cloth_render."""
        shown = parse(ClothRenderSettings, inputs["cloth_render"].settings, "settings of cloth_render")
        models = ClothModels(inputs["cloth_brdf"].folder)
        region, model = shown.region or models.regions[0], shown.model or models.default
        return cls(shown, draped_cloth(shown), region, model, models.brdf(region, model))
