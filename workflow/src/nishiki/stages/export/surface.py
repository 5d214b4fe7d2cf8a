"""The surface of a painting or an object, as formats of scenes write it."""

from nishiki.artifacts.stage import Context


class ExportedSurface:
    """Mesh, look and errors, each made when the first format asks for it.

    A kind of surface has the attributes stem (name of its files), mesh (`TexturedMesh`, in metres where its unit is
    known) and unit (what a length of 1 in a file means), and the methods look_of(format), which returns the
    `SurfaceLook` that a format can hold, and losses(format), what the diagnostics say of it besides its files.
    """

    stem: str

    def __init__(self, context: Context):
        self._context = context

    @property
    def formats(self) -> list[str]:
        """Formats of this look that are asked for."""
        return [name for name in ("gltf", "usd", "materialx") if name in self._context.settings.formats]
