"""The counterparts of rendered pictures: photographs, silhouettes, and the truth of a simulated capture."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from nishiki.artifacts.artifact import Artifact
from nishiki.errors import UserError
from nishiki.formats.stored import open_array, open_group
from nishiki.observations.views import Views


class Photographs:
    """What was photographed, view by view, in linear light.  From the artifacts of ingest, mesh, and polarise where
    the capture has polariser states."""

    def __init__(self, inputs: Mapping[str, Artifact]):
        self.views = Views(inputs["ingest"].folder)
        if len(self.views.states) > 1 and "off" not in self.views.states and "polarise" not in inputs:
            raise UserError(
                f"{inputs['ingest'].folder}: every photograph was taken through a polariser, expected the artifact of "
                "polarise beside it. Remedy: give it among the inputs"
            )
        self.components = None
        if "polarise" in inputs:
            from nishiki.polarisation.components import Components

            self.components = Components(inputs["polarise"].folder)
        self.outlines = None
        path = inputs["mesh"].path("silhouettes.zarr")
        if path.is_dir():
            self.outlines = open_array(path)

    def read(self, view: int, light: int) -> tuple[np.ndarray, np.ndarray]:
        """Linear (rows, columns, channels) float32 and validity (rows, columns): light of any polarisation.

        The photograph without polariser where there is one, else the sum of the components.
        """
        states, name = self.views.states, self.views.lights[light]
        if self.components is None or "off" in states:
            plain, valid = self.views.read(view, state="off" if "off" in states else states[0], light=name)
        if self.components is None:
            return plain, valid
        diffuse, specular, separated = self.components.read(light * len(self.views.views) + view)
        return (plain, valid & separated) if "off" in states else (diffuse + specular, separated)

    def silhouette(self, view: int) -> np.ndarray | None:
        """(rows, columns) bool, or None where it is not known."""
        if self.outlines is not None:
            outline = self.outlines[view] != 0
            return outline if outline.any() else None
        return self.views.silhouette(view)


class ObjectTruth:
    """truth.zarr of a simulated turntable capture."""

    def __init__(self, folder: Path, photographs: Photographs):
        self.group = open_group(folder / "truth.zarr")
        self.normalised = bool(photographs.views.attributes["white_board"])
        self.names = list(self.group.attrs["views"])

    def read(self, name: str) -> np.ndarray:
        """Linear (rows, columns, channels) float32 without noise, in the unit of the photographs."""
        total = self.group["total"][self.names.index(name)]
        if not self.normalised:
            return total * self.group["sensitivity"][...]
        board = self.group["board"][...][..., None] + np.float32(self.group.attrs.get("stray", 0.0))
        return (total / board * np.float32(self.group.attrs["board_reflectance"])).astype(np.float32)

    def silhouette(self, name: str) -> np.ndarray:
        """(rows, columns) bool: pixels at least half filled by the object."""
        return self.group["coverage"][self.names.index(name)] >= 0.5
