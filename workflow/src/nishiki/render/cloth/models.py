"""The models of a cloth by region, as stored, and dyed: another body below the same gloss."""

import json
from pathlib import Path
from typing import Any

import numpy as np

from nishiki.brdf.cloth.interface import PHIS, THETAS, Dyed, gloss_of
from nishiki.brdf.cloth.store import load_brdf
from nishiki.errors import UserError
from nishiki.render.cloth.around import grid_views, lookup, shares
from nishiki.render.cloth.scene import Brdf
from nishiki.render.display import three_channels


class ClothModels:
    """Reader of an artifact of the stage cloth_brdf."""

    def __init__(self, folder: Path):
        """UserError where there is no cloth_brdf.json."""
        self.folder = Path(folder)
        path = self.folder / "cloth_brdf.json"
        if not path.is_file():
            raise UserError(f"{path}: file not found. Remedy: run the stage cloth_brdf first")
        self.description: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))

    @property
    def regions(self) -> list[str]:
        """Regions of the capture."""
        return list(self.description["regions"])

    @property
    def default(self) -> str:
        """The model that stands for the cloth."""
        return self.description["default"]

    def names(self, region: str) -> list[str]:
        """Return models of a region."""
        return list(self._region(region))

    def brdf(self, region: str, model: str | None = None):
        """Load the BRDF of a region: of this model, or of the default one. UserError where there is none."""
        name = model or self.default
        if name not in self._region(region):
            known = ", ".join(self._region(region))
            raise UserError(f"{self.folder}: expected a model among {known}, found {name!r}. Remedy: correct `model`")
        return load_brdf(self.folder / "models" / region / f"{name}.npz")

    def used(self, region: str, model: str) -> list[int]:
        """Return rows of the reflectance table that the fit of a model saw."""
        return list(self._region(region)[model]["used"])

    def facts(self, region: str, model: str) -> dict[str, Any]:
        """Return what the fit says of itself."""
        return {name: value for name, value in self._region(region)[model].items() if name != "used"}

    def _region(self, region: str) -> dict[str, Any]:
        if region not in self.description["models"]:
            known = ", ".join(self.regions)
            raise UserError(
                f"{self.folder}: expected a region among {known}, found {region!r}. Remedy: correct `region`"
            )
        return self.description["models"][region]


def dyed(
    brdf: Brdf, colours: dict[str, tuple[float, float, float]], share: np.ndarray | None = None
) -> dict[str, Dyed]:
    """Return the gloss of a cloth over dyes of these colours (linear sRGB albedo); share: of the gloss, where known.

    The gloss' directional albedo is read from the table of `around.shares`: by reciprocity, what comes out of even
    light is what is reflected in all directions.
    """
    if not colours:
        return {}
    gloss = gloss_of(brdf)
    theta, phi = (np.arange(THETAS) + 0.5) * (np.pi / 2 / THETAS), np.arange(PHIS) * (2 * np.pi / PHIS)
    t, p = (a.ravel() for a in np.meshgrid(theta, phi, indexing="ij"))
    views = np.stack([np.sin(t) * np.cos(p), np.sin(t) * np.sin(p), np.cos(t)], axis=1)
    gloss_albedo = np.clip(lookup(shares(gloss)[0] if share is None else share, views).mean(axis=1), 0, 1).reshape(
        THETAS, PHIS
    )
    weight = (np.sin(theta) * np.cos(theta))[:, None]
    mean = float(np.sum(weight * gloss_albedo) / np.sum(weight) / PHIS)
    return {name: Dyed(gloss, np.asarray(colour, float), gloss_albedo, mean) for name, colour in colours.items()}


def share_of(brdf: Brdf) -> np.ndarray:
    """`around.shares` of a BRDF; of a dyed cloth a + albedo (1 - a), a being its gloss' share, which it comes to."""
    if not isinstance(brdf, Dyed):
        return shares(brdf)[0]
    gloss_albedo = brdf.gloss_albedo_at(grid_views())[..., None]
    return np.clip(gloss_albedo + (1 - gloss_albedo) * three_channels(brdf.albedo), 0, 1)
