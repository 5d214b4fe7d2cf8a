"""Open a decoded object from the artifacts of the stages for rendering."""

import json
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from nishiki.artifacts.artifact import Artifact
from nishiki.atlas.atlas import Atlas
from nishiki.atlas.store import Texels
from nishiki.atlas.surface import texel_points, texel_triangles
from nishiki.brdf.texels.model import Lighting
from nishiki.codec.store import Residual
from nishiki.errors import UserError
from nishiki.geometry.camera import Camera, load_cameras
from nishiki.geometry.mesh import Mesh
from nishiki.observations.views import Views, largest_value
from nishiki.render.object.renderer import ObjectRenderer


@dataclass(frozen=True)
class DecodedObject:
    """Input of the renderer of one object, and the names of its views and lights."""

    mesh: Mesh
    atlas: Atlas
    cameras: list[Camera]
    residual: Residual
    lighting: Lighting
    texel_triangles: np.ndarray  # (tiles, T, T) int32
    encoding: str
    channels: int
    full_turn: bool
    views: tuple[str, ...]
    lights: tuple[str, ...]
    ceiling: float | None

    @classmethod
    def open(cls, inputs: Mapping[str, Artifact]) -> "DecodedObject":
        """Open the artifacts of cameras, mesh, texels, reflection and residual; ingest gives the ceiling alone."""
        texels = Texels(inputs["texels"].folder)
        lighting = json.loads(inputs["object_brdf"].path("object_brdf.json").read_text())["lighting"]
        atlas = texels.atlas
        mesh, cameras = Mesh.load(inputs["mesh"].path("mesh.npz")), load_cameras(inputs["cameras"].path("cameras.json"))
        if len(mesh.triangles) != len(atlas.chart) or [camera.name for camera in cameras] != list(texels.views):
            raise UserError(
                f"{inputs['texels'].folder}: the texels are of {len(atlas.chart)} triangles and {len(texels.views)} "
                f"views, mesh and cameras of {len(mesh.triangles)} and {len(cameras)}; expected the same ones. Remedy: "
                "give artifacts that were made from one another"
            )
        residual, triangles = Residual(inputs["residual"].folder), texel_triangles(atlas)
        names = tuple(texels.views), tuple(texels.lights)
        ceiling = largest_value(Views(inputs["ingest"].folder)) if "ingest" in inputs else None
        described = texels.encoding, texels.channels, texels.full_turn, *names, ceiling
        return cls(mesh, atlas, cameras, residual, Lighting.from_dict(lighting), triangles, *described)

    def renderer(self, *, mesh: Mesh | None = None, **options) -> ObjectRenderer:
        """Make a renderer of the object; `mesh`: the same triangles at other places; options as of `ObjectRenderer`."""
        mesh = mesh or self.mesh

        def geometry(tile: int):
            points = texel_points(mesh, self.atlas, self.texel_triangles, slice(tile, tile + 1))
            return tuple(values[0] for values in points)

        return ObjectRenderer(self, (mesh, geometry), **options)

    def numbers(self, names) -> frozenset[int]:
        """Return places of named views in the order of the turn; UserError for unknown names."""
        return frozenset(self.number(name) for name in names)

    def number(self, name: str) -> int:
        """Return place of a named view."""
        if name not in self.views:
            known = ", ".join(self.views[:12]) + (", ..." if len(self.views) > 12 else "")
            raise UserError(f"view {name!r}: expected one of {known}. Remedy: correct the name in the settings")
        return self.views.index(name)

    def light_weights(self, weights: Mapping[str, float]) -> tuple[tuple[int, float], ...]:
        """Return (place, weight) of named lights; the first light alone where none is named."""
        unknown = [name for name in weights if name not in self.lights]
        if unknown:
            raise UserError(
                f"lights: expected names among {', '.join(map(repr, self.lights))}, found {unknown[0]!r}. Remedy: "
                "correct the name in the settings"
            )
        return tuple((self.lights.index(name), float(w)) for name, w in weights.items()) or ((0, 1.0),)
