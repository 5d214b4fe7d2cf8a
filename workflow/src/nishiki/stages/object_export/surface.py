"""Mesh, look and errors of an object."""

from functools import cached_property

from nishiki.formats.textured_surface import SurfaceLook, TexturedMesh
from nishiki.stages.export.surface import ExportedSurface
from nishiki.stages.object_export.errors import errors
from nishiki.stages.object_export.look import ObjectLook, object_look, object_mesh, unit_of


class ObjectSurface(ExportedSurface):
    """What formats of scenes have in common."""

    stem = "object"

    @cached_property
    def look(self) -> ObjectLook:
        """Textures."""
        return object_look(self._context)

    @cached_property
    def mesh(self) -> TexturedMesh:
        """In metres where its unit is known."""
        return object_mesh(self._context, self.look)

    @property
    def unit(self) -> str:
        """What a length of 1 in a file means."""
        return unit_of(self._context)

    def look_of(self, name: str) -> SurfaceLook:
        """Textures and material as a format takes them; the gloss has one strength in USD."""
        return (self.look.of_one_strength() if name == "usd" else self.look).surface()

    def losses(self, name: str) -> dict:
        """What the diagnostics say of a format, its files left out."""
        return {**self.look.figures(), "kinds": {name: {"psnr_db": self._errors[name]}}}

    @cached_property
    def _errors(self) -> dict[str, dict[str, dict[str, float]]]:
        return errors(self._context, self.look, self.formats)
