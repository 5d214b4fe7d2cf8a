"""Register the export formats of a scene: how each is written, its errors, and formats shared by several scenes."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from nishiki.artifacts.stage import Context
from nishiki.formats.banded_pictures import png_bytes
from nishiki.formats.textured_surface import Glb, SurfaceLook, TexturedMesh, write_materialx, write_usdz

METRES: dict[Any, float] = {"mm": 1e-3, "cm": 1e-2, "m": 1.0}


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


class CodedErrors:
    """Squared errors of coded pictures against photographs, by light."""

    def __init__(self, lights: int):
        self._squares, self._counts = np.zeros(lights), np.zeros(lights, np.int64)

    def add(self, number: int, shown: np.ndarray, values: np.ndarray, valid: np.ndarray) -> None:
        """Add pixels (n, 3) under one light: the viewer's picture, the photograph, and a mask (n,) to compare by."""
        self._squares[number] += np.sum((np.clip(shown[valid], 0, 1) - values[valid]) ** 2)
        self._counts[number] += 3 * np.count_nonzero(valid)

    @classmethod
    def compare_strip(cls, shown: np.ndarray, values: np.ndarray, valid: np.ndarray) -> "CodedErrors":
        """Compare pixels (lights, 3, n) under all lights where valid (lights, n); `shown` is overwritten."""
        errors = cls(len(values))
        np.clip(shown, 0, 1, out=shown)
        shown -= values
        shown *= valid[:, None]
        errors._squares[:] = np.einsum("lkn,lkn->l", shown, shown)
        errors._counts[:] = 3 * valid.sum(axis=1)
        return errors

    def include(self, others: "CodedErrors") -> None:
        """Add the errors of other pixels."""
        self._squares += others._squares
        self._counts += others._counts

    def decibels(self, lights: slice = slice(None)) -> dict[str, float]:
        """Compute the PSNR, dB, peak 1, at most 120: some lights together and the worst; and count the lights."""
        squares, counts = self._squares[lights], self._counts[lights]
        means = squares / np.maximum(counts, 1)
        together = squares.sum() / max(counts.sum(), 1)
        all_db, worst_db = -10 * np.log10(np.maximum([together, means.max()], 1e-12))
        return {"all": float(all_db), "worst": float(worst_db), "lights": len(means)}


@dataclass(frozen=True)
class GltfLook:
    """Textures and constants of a material of glTF 2.0 with KHR_materials_ior and KHR_materials_specular."""

    colour: np.ndarray  # (rows, columns, 3) uint8 ndarray: base colour, sRGB
    # roughness, weight, metallic: float or (rows, columns) uint8 ndarray, of which 255 is 1; weight: specularFactor
    roughness: float | np.ndarray
    weight: float | np.ndarray
    factor: float  # specularColorFactor, of each channel
    index: float  # of refraction
    metallic: float | np.ndarray = 0.0
    normals: np.ndarray | None = None  # (rows, columns, 3) uint8 ndarray: tangent space, y up, (n + 1) / 2


class ExportedSurface(ABC):
    """Mesh, look and errors, each computed for the first format that uses it; stem: name of the files."""

    stem: str

    def __init__(self, context: Context):
        self.context = context

    @property
    @abstractmethod
    def mesh(self) -> TexturedMesh:
        """Mesh, in metres where its unit is known."""

    @property
    @abstractmethod
    def unit(self) -> str:
        """Length of 1 unit in a file."""

    @property
    @abstractmethod
    def gltf_look(self) -> GltfLook:
        """Look in the terms of glTF."""

    @abstractmethod
    def look_of(self, name: str) -> SurfaceLook:
        """Return the look within the limits of USD or MaterialX."""

    @abstractmethod
    def figures(self, name: str) -> dict:
        """Return a format's figures for the diagnostics besides its files and its error."""

    @abstractmethod
    def errors(self, formats: list[str]) -> dict[str, dict]:
        """Compute the PSNR of these formats against photographs."""

    @cached_property
    def _errors(self) -> dict[str, dict]:
        # the photographs are read once for all formats
        return self.errors([name for name in ("gltf", "usd", "materialx") if name in self.context.settings.formats])

    def losses(self, name: str) -> dict:
        """Return the diagnostics of a format besides its files."""
        return {**self.figures(name), "kinds": {name: {"psnr_db": self._errors[name]}}}

    def add_to(self, glb: Glb, texture: Callable[[str, np.ndarray], int], *, extras: dict | None = None) -> None:
        """Add mesh and material; texture: adds a named picture and returns its number; extras: of the material."""
        mesh, look = self.mesh, self.gltf_look
        attributes = {
            "POSITION": glb.vertices(mesh.positions, bounds=True),
            "NORMAL": glb.vertices(mesh.normals),
            "TEXCOORD_0": glb.vertices(mesh.texture),
        }
        material: dict[str, Any] = {"extras": extras}
        pbr: dict[str, Any] = {"baseColorTexture": {"index": texture("albedo", look.colour)}}
        if look.normals is not None:
            attributes["TANGENT"] = glb.vertices(np.broadcast_to([1.0, 0.0, 0.0, 1.0], (len(mesh.positions), 4)))
            material["normalTexture"] = {"index": texture("normals", look.normals)}
        if isinstance(look.roughness, np.ndarray):
            several = isinstance(look.metallic, np.ndarray)
            blue = look.metallic if several else np.zeros_like(look.roughness)
            picture = np.stack([np.full_like(look.roughness, 255), look.roughness, blue], axis=-1)
            pbr |= {"metallicRoughnessTexture": {"index": texture("orm", picture)}}
            pbr["metallicFactor"] = 1.0 if several else look.metallic
        else:
            pbr |= {"roughnessFactor": look.roughness, "metallicFactor": look.metallic}
        specular: dict[str, Any] = {"specularColorFactor": [look.factor] * 3}
        if isinstance(look.weight, np.ndarray):
            alpha = np.stack([*[np.full_like(look.weight, 255)] * 3, look.weight], axis=-1)
            specular["specularTexture"] = {"index": texture("strength", alpha)}
        else:
            specular["specularFactor"] = look.weight
        extensions = {"KHR_materials_ior": {"ior": look.index}, "KHR_materials_specular": specular}
        glb.extensions |= set(extensions)
        number = glb.add("materials", pbrMetallicRoughness=pbr, extensions=extensions, **material)
        glb.add_mesh(attributes, mesh.triangles, number, name=self.context.stamp["scene"])

    def save(self, glb: Glb, file: str) -> None:
        """Write a file with the artifact's stamp and the unit of length."""
        extras = {**self.context.stamp, "unit": self.unit}
        glb.write(self.context.output.path(file), generator=software(self.context), extras=extras)


def write_gltf(context: Context, surface: ExportedSurface) -> dict:
    """Write mesh and material as binary glTF; return the error of its material."""
    glb = Glb()
    surface.add_to(glb, lambda _, picture: glb.texture(png_bytes(picture), mime="image/png"))
    surface.save(glb, f"exports/{surface.stem}.glb")
    mesh = surface.mesh
    return {"vertices": len(mesh.positions), "faces": len(mesh.triangles), **surface.losses("gltf")}


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
