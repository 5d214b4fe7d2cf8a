"""What textures of glTF, USD and MaterialX lose where texels cover several pixels, with and without the slopes inside.

    python benchmarks/coarse_textures.py results/SCENE ... [--steps 1 2 4 8]

Needs finished scenes. One JSON line a scene, side of a texel in pixels, and format; dB of coded pictures, peak 1, under
the lights of the fit and under those that no fit saw:

    pixels   against the photographs, as the export states it: texels lose the colours and the relief inside them
    texels   against the photographs' means over texels, in linear light: what is seen from further away

`written` is what the files hold; `one roughness a region` the same without the slopes; `pixels' means` textures with a
texel for a pixel, whose light is averaged over the texel: what a texel would show if it held all its pixels.

--anisotropy: also textures of KHR_materials_anisotropy with a width along each axis of the covariance, in a tangent
plane that is turned with the texel's normal, and with the tangents of the mesh, as three.js 0.187 has them
(lights_physical_fragment.glsl.js).
"""

import argparse
import json
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "scripts"))
import _project  # noqa: F401
from nishiki.artifacts.artifact import Artifact, open_artifact
from nishiki.brdf.slopes import anisotropic_lobe, widened_roughness
from nishiki.colour.colour import srgb_encode
from nishiki.observations.plane import Observations
from nishiki.stages.export import ExportSettings
from nishiki.stages.export.look import GltfMaterial, PaintingLook, PaintingSurface, RegionGloss
from nishiki.stages.export.registry import CodedErrors
from nishiki.stages.export.scene import CodedPhotographs, ExportedScene, block_mean

STAGES = ("ingest", "normals", "height", "spectra", "brdf")


def look_of(inputs: dict[str, Artifact], step: int) -> PaintingLook:
    """Textures whose texels have `step` pixels along a side."""
    scene = ExportedScene(inputs)
    settings = ExportSettings(gltf={"texture_px": max(16, -(-max(scene.shape) // step))})
    look = PaintingSurface(SimpleNamespace(inputs=inputs, settings=settings), scene).look
    if look.step != step:
        sys.exit(f"the picture is too small for texels of {step} pixels")
    return look


@dataclass(frozen=True)
class AnisotropicGloss:
    """A gloss with widths along both axes of the slopes' covariance, in 8 bits as KHR_materials_anisotropy has them.

    turned : whether the tangents are turned with the texel's normal, or are those of the mesh.
    """

    gloss: RegionGloss
    covariance: np.ndarray
    turned: bool

    def of(self, rows: np.ndarray, columns: np.ndarray) -> "AnisotropicTexels":
        material = replace(self.gloss, widened=None).of(rows, columns)
        return AnisotropicTexels(material, self.covariance[rows][:, columns].reshape(-1, 3), self.turned)


@dataclass(frozen=True)
class AnisotropicTexels:
    """What it shows of pixels."""

    material: GltfMaterial
    covariance: np.ndarray
    turned: bool

    def render(self, base: np.ndarray, normals: np.ndarray, light: np.ndarray) -> np.ndarray:
        """As `GltfMaterial.shown`."""
        xx, xy, yy = self.covariance.T
        mean, half_difference = (xx + yy) / 2, (xx - yy) / 2
        radius, turn = np.hypot(half_difference, xy), np.arctan2(xy, half_difference) / 2
        roughness = self.material.roughness
        across = np.maximum(coded(widened_roughness(roughness, np.maximum(mean - radius, 0))), 1 / 255) ** 2
        along = widened_roughness(roughness, mean + radius) ** 2
        along = (
            across + (1 - across) * coded(np.sqrt(np.maximum(along - across, 0) / np.maximum(1 - across, 1e-9))) ** 2
        )
        x, y = np.broadcast_to([1.0, 0, 0], normals.shape), np.broadcast_to([0, 1.0, 0], normals.shape)
        if self.turned:
            x = x - normals * normals[:, :1]
            x /= np.linalg.norm(x, axis=1, keepdims=True)
            y = np.cross(normals, x)
        cosine, sine = np.cos(turn)[:, None], np.sin(turn)[:, None]
        frame = np.stack([cosine * x + sine * y, cosine * y - sine * x, normals], axis=1)
        view = np.array([0.0, 0.0, 1.0])
        half = (light + view) / np.linalg.norm(light + view)
        above = [np.maximum(each, [-1, -1, 0]) for each in (frame @ light, frame @ view)]
        gloss = np.pi * self.material.fresnel(half[2]) * anisotropic_lobe(frame @ half, *above, along, across)
        body = np.expand_dims(1 - self.material.fresnel(half[2]), -1) * base
        return (body + gloss[:, None]) * above[0][:, 2:]


def coded(values: np.ndarray) -> np.ndarray:
    """As 8 bits hold them."""
    return np.rint(255 * values) / 255


def linear_photographs(inputs: dict[str, Artifact], lights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(lights, rows, columns, 3) linear sRGB relative to a white that faces the lamp, and where they count."""
    frames = Observations(inputs["ingest"].folder)
    matrix = CodedPhotographs(frames, ExportedScene(inputs)).matrix
    values = np.zeros((len(lights), *frames.shape, 3), np.float32)
    valid = np.zeros(values.shape[:-1], bool)
    for band in frames.bands():
        for rows, each, usable in frames.strips(band, lights=lights):
            values[:, rows], valid[:, rows] = each @ matrix.T, usable
    return values, valid


def shown(
    look: PaintingLook, gloss: "RegionGloss | AnisotropicGloss", shape: tuple[int, int], light: np.ndarray
) -> np.ndarray:
    """(rows, columns, 3) linear light of every pixel's texel."""
    texels = look.texels(slice(0, shape[0]), shape[1])
    return gloss.of(texels.rows, texels.columns).render(texels.colours, texels.normals, light).reshape(*shape, 3)


def texel_means(values: np.ndarray, valid: np.ndarray, step: int) -> np.ndarray:
    """Of pixels (rows, columns, 3) that count."""
    share = block_mean(valid, step)[..., None]
    return block_mean(np.where(valid[..., None], values, 0), step) / np.maximum(share, 1e-9)


def figures(
    inputs: dict[str, Artifact], looks: dict[int, PaintingLook], step: int, form: str, *, anisotropy: bool
) -> dict:
    """dB of the format's textures."""
    frames, look, fine = Observations(inputs["ingest"].folder), looks[step], looks[1]
    hold_out = open_artifact(inputs["normals"].folder).settings.get("hold_out", ())
    gloss = getattr(look.gloss, form)
    ways: dict[str, tuple[PaintingLook, RegionGloss | AnisotropicGloss]] = {
        "written": (look, gloss),
        "one roughness a region": (look, replace(gloss, widened=None)),
        "pixels' means": (fine, getattr(fine.gloss, form)),
    }
    if anisotropy:
        scene = ExportedScene(inputs)
        covariance = scene.slopes(slice(0, scene.shape[0]), step)
        ways["anisotropy"] = look, AnisotropicGloss(gloss, covariance, turned=True)
        ways["anisotropy, tangents of the mesh"] = look, AnisotropicGloss(gloss, covariance, turned=False)
    found: dict[str, dict] = {}
    for group, lights in {"fitted": frames.fit_lights(hold_out), "check": frames.check_lights(hold_out)}.items():
        if not len(lights):
            continue
        photographs, valid = linear_photographs(inputs, lights)
        for name, (its, lobes) in ways.items():
            pixels, texels = CodedErrors(len(lights)), CodedErrors(len(lights))
            for number, light in enumerate(lights):
                light_of = shown(its, lobes, frames.shape, frames.directions[light])
                usable, photograph = valid[number], photographs[number]
                coded = [srgb_encode(each) for each in (light_of, photograph)]
                pixels.add(number, *(each.reshape(-1, 3) for each in coded), usable.ravel())
                means = [texel_means(each, usable, step) for each in (light_of, photograph)]
                coded = [srgb_encode(each).reshape(-1, 3) for each in means]
                texels.add(number, *coded, block_mean(usable, step).ravel() > 0)
            told = {"pixels": pixels.decibels()["all"], "texels": texels.decibels()["all"]}
            found.setdefault(name, {})[group] = {kind: round(value, 2) for kind, value in told.items()}
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", nargs="+", type=Path, help="results/SCENE")
    parser.add_argument("--steps", nargs="+", type=int, default=[1, 2, 4, 8], help="pixels along the side of a texel")
    parser.add_argument("--formats", nargs="+", choices=("gltf", "usd", "materialx"), default=["gltf"])
    parser.add_argument("--anisotropy", action="store_true", help="gltf with anisotropy as well")
    options = parser.parse_args()
    for folder in options.folders:
        current = folder / "current"
        inputs = {name: open_artifact(current / name) for name in STAGES if (current / name).exists()}
        looks = {step: look_of(inputs, step) for step in {1, *options.steps}}
        for step in options.steps:
            for form in options.formats:
                line = {"scene": folder.name, "pixels along a texel": step, "format": form}
                print(
                    json.dumps({**line, **figures(inputs, looks, step, form, anisotropy=options.anisotropy)}),
                    flush=True,
                )


if __name__ == "__main__":
    main()
