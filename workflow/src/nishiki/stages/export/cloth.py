"""Export files of the draped cloth, and measure the error of their materials against the fitted model.

For base colour c, alpha = roughness^2, anisotropy strength s, weight w and colour k of the specular reflection, index
1.5 (glTF 2.0, appendix B; KHR_materials_specular, _anisotropy):

    f  = (1 - max F) c / pi + F D V,    F  = w (F0 + (1 - F0) (1 - o.h)^5),    F0 = min(0.04 k, 1)
    D V: anisotropic Trowbridge-Reitz with Smith's masking; alpha_t = alpha + (1 - alpha) s^2 along, alpha across
"""

import json
from dataclasses import asdict, dataclass
from functools import partial
from itertools import product
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np

from nishiki.artifacts.artifact import Artifact
from nishiki.artifacts.declaration import parse
from nishiki.artifacts.stage import Context
from nishiki.brdf.cloth.interface import halves, only_above
from nishiki.brdf.half_vector_table import HalfVectorTable
from nishiki.brdf.slopes import anisotropic_lobe
from nishiki.colour.colour import decode, delta_e_2000, srgb_encode, srgb_matrix, xyz_to_lab
from nishiki.formats.banded_pictures import png_bytes
from nishiki.formats.textured_surface import NORMAL_REFLECTANCE, Glb
from nishiki.geometry.camera import Camera
from nishiki.geometry.mesh import write_ply
from nishiki.optional_formats.reflectance_tables import bsdf_bytes
from nishiki.render.cloth.models import ClothModels
from nishiki.render.cloth.scene import EDGE, STEPS, Brdf, BrdfTable, ClothScene
from nishiki.render.cloth.studio import MARGIN, Lighting, RenderVariant, frame_camera, paper_below, render
from nishiki.render.display import three_channels
from nishiki.stages.export import mitsuba_cloth
from nishiki.stages.export.registry import software, write_formats
from nishiki.stages.render import ClothRenderSettings
from nishiki.stages.render.cloth import DrapedCloth, draped_cloth, lights_of

PAIRS = 1500
"""Number of pairs of light and view in the fit."""
LEAST = np.array([0, 0, 0, 0.05, 0.0, 0, 0, 0, 0])
MOST = np.array([1, 1, 1, 1.0, 1.0, 1, 25, 25, 25])
"""Bounds of the parameters, in the order of `GltfCloth.from_parameters`."""
STARTS = ((0.35, 0.7), (0.6, 0.4))
"""Initial roughness and anisotropy strength of the fit, along either yarn."""


@dataclass(frozen=True)
class GltfCloth:
    """base, specular_colour (3,): linear sRGB; along_warp: the rougher direction is the warp's."""

    base: np.ndarray
    roughness: float
    anisotropy: float
    weight: float
    specular_colour: np.ndarray
    along_warp: bool
    channels: int = 3

    @classmethod
    def from_parameters(cls, x: np.ndarray, along_warp: bool) -> "GltfCloth":
        """Return base, roughness, anisotropy, weight, specular colour (9,)."""
        return cls(x[:3], float(x[3]), float(x[4]), float(x[5]), x[6:9], along_warp)

    def evaluate(self, incident: np.ndarray, outgoing: np.ndarray) -> np.ndarray:
        """Compute (..., 3) 1 / sr for unit vectors (..., 3) in the frame weft, warp, normal; 0 below the horizon."""
        g = halves(incident, outgoing)
        normal = np.minimum(NORMAL_REFLECTANCE * self.specular_colour, 1.0)
        fresnel = self.weight * (normal + (1 - normal) * (1 - g.cos_d[..., None]) ** 5)
        across = self.roughness**2
        along = across + (1 - across) * self.anisotropy**2
        x, y = (across, along) if self.along_warp else (along, across)
        gloss = anisotropic_lobe(g.h, incident, outgoing, x, y)[..., None]
        body = (1 - fresnel.max(axis=-1, keepdims=True)) * self.base / np.pi
        return only_above(g.above, body + fresnel * gloss)

    def as_dict(self) -> dict:
        """Return its numbers, as plain values."""
        return {name: np.asarray(value).tolist() for name, value in asdict(self).items() if name != "channels"}

    def material(self) -> dict:
        """Return the properties of the file's material; the tangents run along the weft."""
        extensions = {
            "KHR_materials_specular": {
                "specularFactor": self.weight,
                "specularColorFactor": self.specular_colour.tolist(),
            },
            "KHR_materials_anisotropy": {
                "anisotropyStrength": self.anisotropy,
                "anisotropyRotation": np.pi / 2 if self.along_warp else 0.0,
            },
        }
        return {
            "pbrMetallicRoughness": {
                "baseColorFactor": [*self.base.tolist(), 1.0],
                "metallicFactor": 0.0,
                "roughnessFactor": self.roughness,
            },
            "doubleSided": True,
            "extensions": extensions,
        }


def shone(brdf: Brdf, incident: np.ndarray, outgoing: np.ndarray) -> np.ndarray:
    """Compute (n, 3) sRGB-coded light relative to a white that faces the lamp, at most 1."""
    return srgb_encode(np.pi * three_channels(brdf.evaluate(incident, outgoing)) * incident[:, 2:])


def coded_error(material: GltfCloth, brdf: Brdf) -> float:
    """Compute the root mean square difference of the coded brightness, on pairs held out of the fit."""
    incident, outgoing = pairs(PAIRS, 1)
    difference = shone(material, incident, outgoing) - shone(brdf, incident, outgoing)
    return float(np.sqrt(np.mean(difference**2)))


def pairs(count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Draw light and view (count, 3): the light uniformly from above, the view as on a ball."""
    random = np.random.default_rng(seed)
    made = []
    for power in (1.0, 0.5):
        z, turn = random.random(count) ** power, 2 * np.pi * random.random(count)
        level = np.sqrt(1 - z * z)
        made.append(np.stack([level * np.cos(turn), level * np.sin(turn), z], axis=1))
    return made[0], made[1]


def fitted_cloth(brdf: Brdf, *, count: int = PAIRS) -> GltfCloth:
    """Fit the material whose coded brightness over all lights and views is nearest to a BRDF's, in the mean square.

    count: pairs of light and view.
    """
    from scipy.optimize import least_squares

    incident, outgoing = pairs(count, 0)
    true = shone(brdf, incident, outgoing)
    colour = np.clip(np.median(true, axis=0) / 12.92, 0.002, 0.9)  # a guess: dark, where the coding is linear
    fits = []
    for along_warp, (roughness, anisotropy) in product((False, True), STARTS):
        material = partial(GltfCloth.from_parameters, along_warp=along_warp)
        solved = least_squares(
            lambda x, made=material: (shone(made(x), incident, outgoing) - true).ravel(),
            [*colour, roughness, anisotropy, 0.8, 1, 1, 1],
            bounds=(LEAST, MOST),
            x_scale=0.1,
            max_nfev=60,
        )
        fits.append((solved.cost, material(solved.x)))
    return min(fits, key=itemgetter(0))[1]


@dataclass(frozen=True)
class ExportedCloth:
    """shown: settings of the pictures; brdf: that model of a region of the capture."""

    shown: ClothRenderSettings
    draped: DrapedCloth
    region: str
    model: str
    brdf: Brdf

    @classmethod
    def of(cls, inputs: dict[str, Artifact]) -> "ExportedCloth":
        """Return the cloth of the pictures in the artifact of cloth_render."""
        shown = parse(ClothRenderSettings, inputs["cloth_render"].settings, "settings of cloth_render")
        models = ClothModels(inputs["cloth_brdf"].folder)
        region, model = shown.region or models.regions[0], shown.model or models.default
        return cls(shown, draped_cloth(shown), region, model, models.brdf(region, model))


VIEWS = ((21, 12), (21, 132), (21, 252), (60, 12))
"""Elevation and azimuth in degrees of the views for measuring the loss,"""
LAMPS = ((38, -50), (24, 68), (60, 180))
"""and of the lamps, from the view: beside, low at the other side, behind."""
SIDE = 128
"""Side of these pictures in pixels."""


def errors(cloth: ExportedCloth, material: Brdf) -> dict:
    """Compare pictures of the cloth with the material and with the model, under one lamp each, without shadows.

    PSNR of the sRGB codes, dB, peak 1, of all and of the worst; CIEDE2000, mean and 95th percentile.
    """
    scene = ClothScene.of([cloth.draped.surface])
    squares, differences = [], []
    for elevation, azimuth in np.radians(VIEWS):
        points = cloth.draped.surface.mesh.vertices
        camera = frame_camera(
            points, elevation=elevation, azimuth=azimuth, rows=SIDE, columns=SIDE, distance=cloth.shown.view.distance
        )
        lamps = [Lighting(above, turn, (1.0, 1.0, 1.0), 0.0).lamp(azimuth) for above, turn in np.radians(LAMPS)]
        takes = [
            RenderVariant((brdf,), tuple(np.eye(len(lamps))[k]))
            for k in range(len(lamps))
            for brdf in (cloth.brdf, material)
        ]
        made = render(scene, takes, lamps, camera, supersampling=1, shadows=False)
        for true, shown in zip(made[::2], made[1::2], strict=True):
            codes = [srgb_encode(picture.linear[picture.coverage > 0]) for picture in (true, shown)]
            squares.append(np.mean((codes[0] - codes[1]) ** 2))
            differences.append(colour_differences(*codes))
    together = np.concatenate(differences)
    decibels = -10 * np.log10(np.maximum([np.mean(squares), np.max(squares)], 1e-12))
    return {
        "pictures": len(squares),
        "psnr_db": {"all": float(decibels[0]), "worst": float(decibels[1])},
        "delta_e": {"mean": float(together.mean()), "percentile_95": float(np.percentile(together, 95))},
    }


def colour_differences(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Compute CIEDE2000 (n,) of sRGB codes (n, 3)."""
    to_xyz = np.linalg.inv(srgb_matrix())
    labs = (
        xyz_to_lab(decode(codes.astype(np.float64), "srgb") @ to_xyz.T, to_xyz @ np.ones(3))
        for codes in (first, second)
    )
    return delta_e_2000(*labs)


ALONG_TANGENT = np.array([[[255, 128, 255]]], np.uint8)
"""Texel of KHR_materials_anisotropy: along the tangent, with full strength."""


def write_gltf(context: Context, cloth: ExportedCloth) -> dict:
    """Write `cloth.glb`, its tangents along the weft, bitangents along the warp; return the errors of its material."""
    material, surface, uv = fitted_cloth(cloth.brdf), cloth.draped.surface, cloth.draped.uv
    mesh = surface.mesh
    normals = mesh.normals / np.linalg.norm(mesh.normals, axis=1, keepdims=True)
    properties = material.material()
    glb = Glb(extensions=set(properties["extensions"]))
    attributes = {
        "POSITION": glb.vertices(mesh.vertices, bounds=True),
        "NORMAL": glb.vertices(normals),
        "TANGENT": glb.vertices(np.column_stack([surface.weft, np.ones(len(surface.weft))])),
    }
    if uv is not None:
        attributes["TEXCOORD_0"] = glb.vertices(np.column_stack([uv[:, 0], 1 - uv[:, 1]]))  # from the top
        # What the extension assumes without a texture. Blender takes tangents from the mesh only where there is one.
        along = {"index": glb.texture(png_bytes(ALONG_TANGENT), mime="image/png")}
        properties["extensions"]["KHR_materials_anisotropy"]["anisotropyTexture"] = along
    number = glb.add("materials", name=f"{cloth.region} {cloth.model}", **properties)
    glb.add_mesh(attributes, mesh.triangles, number, name=context.stamp["scene"])
    unit = "metres" if cloth.shown.mesh is None else "of the file, taken as metres"
    extras = {**context.stamp, "unit": unit, "region": cloth.region, "model": cloth.model}
    glb.write(context.output.path("exports/cloth.glb"), generator=software(context), extras=extras)
    return {
        "vertices": len(mesh.vertices),
        "faces": len(mesh.triangles),
        "material": material.as_dict(),
        "fit_rms": coded_error(material, cloth.brdf),
        "against_model": errors(cloth, material),
    }


def write_mitsuba(context: Context, cloth: ExportedCloth) -> dict:
    """Write the folder `mitsuba`; return the error of its table against the model."""
    folder = context.output.path("exports/mitsuba/scene.json").parent
    shown, surface = cloth.shown, cloth.draped.surface
    azimuth = np.radians(shown.view.azimuth_deg)
    stamp = {f"nishiki.{name}": text for name, text in context.stamp.items()}
    about: dict[str, Any] = {"stamp": stamp, "unit": "m" if shown.mesh is None else "of the file"}
    write_ply(folder / "cloth.ply", surface.mesh, **about, uv=cloth.draped.uv, attributes={"weft": surface.weft})
    if shown.paper > 0:
        write_ply(folder / "paper.ply", paper_below(surface.mesh.vertices, azimuth=azimuth).mesh, **about)
    (table,) = BrdfTable.of(cloth.brdf)
    np.savez_compressed(folder / "brdf.npz", codes=table.codes, largest=table.largest, steps=STEPS, edge=EDGE)
    facts = {
        "camera": camera_facts(camera_of(cloth), surface.mesh.vertices.mean(axis=0)),
        "lamps": {
            name: {
                "direction": light.lamp(azimuth).direction,
                "colour": light.colour,
                "radius_deg": float(np.degrees(light.radius)),
            }
            for name, light in zip(shown.lights, lights_of(shown), strict=True)
        },
        "around": shown.around,
        "paper": shown.paper,
        "stamp": dict(context.stamp),
    }
    (folder / "scene.json").write_text(json.dumps(facts, indent=1) + "\n")
    (folder / "nishiki_cloth.py").write_text(Path(mitsuba_cloth.__file__).read_text(encoding="utf-8"))
    return {"vertices": len(surface.mesh.vertices), "against_model": errors(cloth, table)}


def camera_of(cloth: ExportedCloth) -> Camera:
    """Return the camera of the draped pictures."""
    view = cloth.shown.view
    place = {"elevation": np.radians(view.elevation_deg), "azimuth": np.radians(view.azimuth_deg)}
    size: dict[str, Any] = {"rows": view.rows, "columns": view.columns, "distance": view.distance}
    return frame_camera(cloth.draped.surface.mesh.vertices, **place, **size, margin=MARGIN)


def camera_facts(camera: Camera, middle: np.ndarray) -> dict:
    """Return place, target, up, vertical field of view, degrees, size, and distance from the cloth's middle (3,)."""
    return {
        "origin": camera.centre.tolist(),
        "target": (camera.centre + camera.rotation[2]).tolist(),
        "up": (-camera.rotation[1]).tolist(),
        "field_of_view_deg": float(2 * np.degrees(np.arctan(camera.rows / (2 * camera.intrinsics[1, 1])))),
        "rows": camera.rows,
        "columns": camera.columns,
        "distance": float(np.linalg.norm(camera.centre - middle)),
    }


def write_bsdf(context: Context, cloth: ExportedCloth) -> dict:
    """Write `cloth.bsdf`; return the error of its table against the model."""
    table = HalfVectorTable.of(lambda light, eye: three_channels(cloth.brdf.evaluate(light, eye)))
    described = f"{context.stamp['scene']}, {cloth.region}, {cloth.model}; x weft, y warp; {software(context)}"
    context.output.path("exports/cloth.bsdf").write_bytes(bsdf_bytes(table.arrays(described)))
    return {"against_model": errors(cloth, table)}


WRITERS = {"gltf": write_gltf, "mitsuba": write_mitsuba, "bsdf": write_bsdf}


def run(context: Context) -> dict:
    """Write every format that the settings name."""
    cloth = ExportedCloth.of(context.inputs)
    about = {"region": cloth.region, "model": cloth.model, "surface": cloth.draped.about}
    return about | write_formats(context, {name: partial(write, context, cloth) for name, write in WRITERS.items()})
