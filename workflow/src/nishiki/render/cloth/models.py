"""The models that the stage cloth_brdf left: which there are, what each was fitted to, and their BRDFs."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from nishiki.brdf.cloth.store import load_brdf
from nishiki.errors import UserError


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
        """Models of a region."""
        return list(self._region(region))

    def brdf(self, region: str, model: str | None = None):
        """BRDF of a region: of this model, or of the default one. UserError where there is none."""
        name = model or self.default
        if name not in self._region(region):
            known = ", ".join(self._region(region))
            raise UserError(f"{self.folder}: expected a model among {known}, found {name!r}. Remedy: correct `model`")
        return load_brdf(self.folder / "models" / region / f"{name}.npz")

    def used(self, region: str, model: str) -> list[int]:
        """Rows of the reflectance table that the fit of a model saw."""
        return list(self._region(region)[model]["used"])

    def facts(self, region: str, model: str) -> dict[str, Any]:
        """What the fit says of itself."""
        return {name: value for name, value in self._region(region)[model].items() if name != "used"}

    def _region(self, region: str) -> dict[str, Any]:
        if region not in self.description["models"]:
            known = ", ".join(self.regions)
            raise UserError(
                f"{self.folder}: expected a region among {known}, found {region!r}. Remedy: correct `region`"
            )
        return self.description["models"][region]
