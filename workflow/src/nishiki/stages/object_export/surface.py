"""Mesh, look and errors of an object: made once for all formats, when the first asks for them."""

from functools import cached_property

from nishiki.artifacts.stage import Context
from nishiki.formats.textured_surface import TexturedMesh
from nishiki.stages.object_export.errors import errors
from nishiki.stages.object_export.look import ObjectLook, object_look, object_mesh, unit_of

FORMATS = ("gltf", "usd", "materialx")


class ObjectSurface:
    """What formats of scenes have in common."""

    def __init__(self, context: Context):
        self._context = context

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

    def losses(self, name: str) -> dict:
        """What the diagnostics say of a format, its files left out."""
        return {**self.look.figures(), "kinds": {name: {"psnr_db": self._errors[name]}}}

    @cached_property
    def _errors(self) -> dict[str, dict[str, dict[str, float]]]:
        asked = [name for name in FORMATS if name in self._context.settings.formats]
        return errors(self._context, self.look, asked)
