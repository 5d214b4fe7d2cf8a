"""The formats that a scene is exported to: how each is written, and the two that paintings and objects share."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from typing import Any

from nishiki.artifacts.stage import Context
from nishiki.formats.textured_surface import SurfaceLook, TexturedMesh
from nishiki.formats.usd import write_materialx, write_usdz


def write_formats(context: Context, writers: Mapping[str, Callable[[], dict[str, Any]]]) -> dict[str, Any]:
    """Write every format that the settings name.

    Parameters
    ----------
    writers : mapping of str to callable
        The registry of a kind of scene: each entry writes one format into `exports` and returns what it loses.

    Returns
    -------
    dict: `losses`, by format its `files` and what its writer returned; `bytes`, the size of every file.
    """
    losses: dict[str, dict[str, Any]] = {}
    sizes: dict[str, int] = {}
    for name in context.progress.over(context.settings.formats, "format"):
        lost, folder = writers[name](), context.output.folder
        paths = {path.relative_to(folder).as_posix(): path for path in sorted((folder / "exports").rglob("*"))}
        made = {file: path.stat().st_size for file, path in paths.items() if path.is_file() and file not in sizes}
        losses[name] = {"files": list(made), **lost}
        sizes |= made
    return {"losses": losses, "bytes": sizes}


def software(context: Context) -> str:
    """Return the program and its version."""
    return f"Nishiki {context.stamp['version']}"


class ExportedSurface(ABC):
    """Mesh, look and errors, each made when the first format asks for it; stem: name of the files."""

    stem: str

    @property
    @abstractmethod
    def mesh(self) -> TexturedMesh:
        """Return the mesh, in metres where its unit is known."""

    @property
    @abstractmethod
    def unit(self) -> str:
        """Return what a length of 1 in a file means."""

    @abstractmethod
    def look_of(self, name: str) -> SurfaceLook:
        """Return the look that a format can hold."""

    @abstractmethod
    def losses(self, name: str) -> dict:
        """Return the diagnostics of a format besides its files."""

    def __init__(self, context: Context):
        self.context = context

    @property
    def formats(self) -> list[str]:
        """Formats of this look that are asked for."""
        return [name for name in ("gltf", "usd", "materialx") if name in self.context.settings.formats]


def write_usd(context: Context, surface: ExportedSurface) -> dict:
    """Write mesh and UsdPreviewSurface as a package of OpenUSD; return the error of its material."""
    mesh, file = surface.mesh, f"exports/{surface.stem}.usdz"
    facts = {**context.stamp, "unit": surface.unit}
    write_usdz(context.output.path(file), mesh, surface.look_of("usd"), name=context.stamp["scene"], facts=facts)
    return {"vertices": len(mesh.positions), "faces": len(mesh.triangles), **surface.losses("usd")}


def write_mtlx(context: Context, surface: ExportedSurface) -> dict:
    """Write an OpenPBR material in a MaterialX document, for the meshes of `gltf` and `usd`; return its error."""
    path = context.output.path(f"exports/materialx/{surface.stem}.mtlx")
    write_materialx(path, surface.look_of("materialx"), facts=context.stamp)
    return surface.losses("materialx")
