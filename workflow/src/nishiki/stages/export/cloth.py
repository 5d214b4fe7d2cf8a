"""Export: files of the draped cloth for other programs, and how far its material there is from the fitted model."""

import json
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from nishiki.artifacts.artifact import Artifact
from nishiki.artifacts.closed import parse
from nishiki.artifacts.stage import Context
from nishiki.brdf.half_vector_table import HalfVectorTable
from nishiki.colour.colour import decode, delta_e_2000, srgb_encode, srgb_matrix, xyz_to_lab
from nishiki.formats.merl import bsdf_bytes
from nishiki.formats.picture_tiles import png_bytes
from nishiki.formats.textured_surface import Glb
from nishiki.geometry.camera import Camera
from nishiki.geometry.mesh import write_ply
from nishiki.render.cloth.frame import RenderVariant, render
from nishiki.render.cloth.models import ClothModels
from nishiki.render.cloth.scene import EDGE, STEPS, Brdf, BrdfTable, ClothScene
from nishiki.render.cloth.studio import MARGIN, Lighting, framed, paper_below
from nishiki.render.display import three_channels
from nishiki.stages.export import mitsuba_cloth
from nishiki.stages.export.cloth_material import coded_error, fitted_cloth
from nishiki.stages.export.registry import software, write_formats
from nishiki.stages.render import ClothRenderSettings
from nishiki.stages.render.draping import DrapedCloth, draped_cloth, lights_of


@dataclass(frozen=True)
class ExportedCloth:
    """shown: settings of the pictures; brdf: that of this model of a region of the capture."""

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
"""Elevation and azimuth in degrees of the views on which the loss is measured,"""
LAMPS = ((38, -50), (24, 68), (60, 180))
"""and of the lamps, from the view: beside, low at the other side, behind."""
SIDE = 128
"""Pixels along a side of these pictures."""


def errors(cloth: ExportedCloth, material: Brdf) -> dict:
    """Compare pictures of the cloth with the material and with the model, under one lamp each, without shadows.

    PSNR of the sRGB codes, dB, peak 1, of all and of the worst; CIEDE2000, mean and 95th percentile.
    """
    scene = ClothScene.of([cloth.draped.surface])
    squares, differences = [], []
    for elevation, azimuth in np.radians(VIEWS):
        points = cloth.draped.surface.mesh.vertices
        camera = framed(
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
    """Return CIEDE2000 (n,) of sRGB codes (n, 3)."""
    to_xyz = np.linalg.inv(srgb_matrix())
    labs = (
        xyz_to_lab(decode(codes.astype(np.float64), "srgb") @ to_xyz.T, to_xyz @ np.ones(3))
        for codes in (first, second)
    )
    return delta_e_2000(*labs)


ALONG_TANGENT = np.array([[[255, 128, 255]]], np.uint8)
"""The texel of KHR_materials_anisotropy that says: along the tangent, with the whole strength."""


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
        "files": ["exports/cloth.glb"],
        "vertices": len(mesh.vertices),
        "faces": len(mesh.triangles),
        "material": material.as_dict(),
        "fit_rms": coded_error(material, cloth.brdf),
        "against_model": errors(cloth, material),
    }


def write_mitsuba(context: Context, cloth: ExportedCloth) -> dict:
    """Write the folder `mitsuba`; return how far its table is from the model."""
    folder = context.output.path("exports/mitsuba/scene.json").parent
    shown, surface = cloth.shown, cloth.draped.surface
    azimuth = np.radians(shown.view.azimuth_deg)
    stamp = {f"nishiki.{name}": text for name, text in context.stamp.items()}
    about: dict[str, Any] = {"stamp": stamp, "unit": "m" if shown.mesh is None else "of the file"}
    write_ply(folder / "cloth.ply", surface.mesh, **about, uv=cloth.draped.uv, attributes={"weft": surface.weft})
    names = ["cloth.ply", "brdf.npz", "scene.json", "nishiki_cloth.py"]
    if shown.paper > 0:
        write_ply(folder / "paper.ply", paper_below(surface.mesh.vertices, azimuth=azimuth).mesh, **about)
        names.append("paper.ply")
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
    return {
        "files": [f"exports/mitsuba/{name}" for name in names],
        "vertices": len(surface.mesh.vertices),
        "against_model": errors(cloth, table),
    }


def camera_of(cloth: ExportedCloth) -> Camera:
    """Return the camera of the draped pictures."""
    view = cloth.shown.view
    place = {"elevation": np.radians(view.elevation_deg), "azimuth": np.radians(view.azimuth_deg)}
    size: dict[str, Any] = {"rows": view.rows, "columns": view.columns, "distance": view.distance}
    return framed(cloth.draped.surface.mesh.vertices, **place, **size, margin=MARGIN)


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
    """Write `cloth.bsdf`; return how far its table is from the model."""
    table = HalfVectorTable.of(lambda light, eye: three_channels(cloth.brdf.evaluate(light, eye)))
    described = f"{context.stamp['scene']}, {cloth.region}, {cloth.model}; x weft, y warp; {software(context)}"
    context.output.path("exports/cloth.bsdf").write_bytes(bsdf_bytes(table.arrays(described)))
    return {"files": ["exports/cloth.bsdf"], "against_model": errors(cloth, table)}


WRITERS = {"gltf": write_gltf, "mitsuba": write_mitsuba, "bsdf": write_bsdf}


def run(context: Context) -> dict:
    """Write every format that the settings name."""
    cloth = ExportedCloth.of(context.inputs)
    about = {"region": cloth.region, "model": cloth.model, "surface": cloth.draped.about}
    return about | write_formats(context, {name: partial(write, context, cloth) for name, write in WRITERS.items()})
