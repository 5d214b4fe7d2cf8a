"""Read the counterparts of rendered pictures: photographs, silhouettes, and the truth of a simulated capture."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from nishiki.artifacts.artifact import Artifact
from nishiki.errors import UserError
from nishiki.formats.stored import open_array, open_group
from nishiki.observations.views import Views


class LinearPictures:
    """Photographs by view in linear light: all light and, with polarisation separation, its parts."""

    def __init__(self, inputs: Mapping[str, Artifact]):
        self.views, self.separated = Views(inputs["ingest"].folder), None
        self.state = "off" if "off" in self.views.states else self.views.states[0]
        if "polarise" in inputs:
            from nishiki.polarisation.polarisation import Components

            self.separated = Components(inputs["polarise"].folder)
        self.components = ("diffuse", "specular", "total") if self.separated else ("total",)

    def parts(self, view: int, light: int) -> tuple[dict[str, np.ndarray], np.ndarray]:
        """Read every component (rows, columns, channels) float32 of a view, and its validity (rows, columns).

        The total is the photograph without polariser where there is one, else the sum of the components.
        """
        if self.separated is None:
            picture, valid = self.views.read(view, state=self.state, light=self.views.lights[light])
            return {"total": picture}, valid
        diffuse, specular, valid = self.separated.read(light * len(self.views.views) + view)
        total = diffuse + specular
        if self.state == "off":
            total, known = self.views.read(view, state="off", light=self.views.lights[light])
            valid = valid & known
        return {"diffuse": diffuse, "specular": specular, "total": total}, valid

    def find_saturated(self, view: int, light: int) -> np.ndarray:
        """Find the values (rows, columns, channels) bool of a photograph that are saturated."""
        return self.views.find_saturated(view, state=self.state, light=self.views.lights[light])


class Photographs(LinearPictures):
    """Counterparts of rendered pictures from ingest, mesh and, with polariser states, polarise."""

    def __init__(self, inputs: Mapping[str, Artifact]):
        super().__init__(inputs)
        if len(self.views.states) > 1 and self.state != "off" and self.separated is None:
            raise UserError(
                f"{inputs['ingest'].folder}: every photograph was taken through a polariser, expected the artifact of "
                "polarise beside it. Remedy: give it among the inputs"
            )
        path = inputs["mesh"].path("silhouettes.zarr")
        self.outlines = open_array(path) if path.is_dir() else None

    def read(self, view: int, light: int) -> tuple[np.ndarray, np.ndarray]:
        """Read linear (rows, columns, channels) float32 and validity (rows, columns): light of any polarisation."""
        parts, valid = self.parts(view, light)
        return parts["total"], valid

    def silhouette(self, view: int) -> np.ndarray | None:
        """Return (rows, columns) bool, or None where it is unknown."""
        if self.outlines is not None:
            outline = self.outlines[view] != 0
            return outline if outline.any() else None
        return self.views.silhouette(view)


class ObjectTruth:
    """Truth of a simulated turntable capture, from truth.zarr."""

    def __init__(self, folder: Path, photographs: Photographs):
        self.group = open_group(folder / "truth.zarr")
        self.normalised = bool(photographs.views.attributes["white_board"])
        self.names = list(self.group.attrs["views"])

    def read(self, name: str) -> np.ndarray:
        """Read linear (rows, columns, channels) float32 without noise, in the unit of the photographs."""
        total = self.group["total"][self.names.index(name)]
        if not self.normalised:
            return total * self.group["sensitivity"][...]
        board = self.group["board"][...][..., None] + np.float32(self.group.attrs.get("stray", 0.0))
        return (total / board * np.float32(self.group.attrs["board_reflectance"])).astype(np.float32)

    def silhouette(self, name: str) -> np.ndarray:
        """Read (rows, columns) bool: pixels at least half filled by the object."""
        return self.group["coverage"][self.names.index(name)] >= 0.5
