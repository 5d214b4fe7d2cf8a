"""Export files of a painting for other programs, and measure the loss of each.

Maps as pictures of high depth and as a mesh, a scene of Mitsuba 3, tables of the MERL database.
"""

import json
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path

import numpy as np

from nishiki.artifacts.stage import Context
from nishiki.colour.colour import srgb_encode
from nishiki.colour.sampling import SPECTRAL_ROWS, WAVELENGTHS_NM
from nishiki.errors import UserError, require
from nishiki.formats.banded_pictures import EnviWriter, ExrWriter, write_tiff
from nishiki.formats.coding import ROMM, icc_profile
from nishiki.formats.mesh_heading import faces, ply_heading
from nishiki.formats.textured_surface import heading, vertices
from nishiki.optional_formats.reflectance_tables import write_merl
from nishiki.render.display import normals_as_colours
from nishiki.stages.export import mitsuba_paint, relight
from nishiki.stages.export.iiif import write_iiif
from nishiki.stages.export.look import PaintingSurface
from nishiki.stages.export.registry import software, write_formats, write_gltf, write_mtlx, write_usd
from nishiki.stages.export.scene import ExportedScene, reliefs
from nishiki.threads import strips

UP = np.array([0.0, 0.0, 1.0])
GLOSS = {"beta": "beta", "gamma": "gamma", "index": "refractive_index", "transmission": "transmission"}
Texture = Callable[[slice], np.ndarray]
"""Some rows of a texture, of the picture's columns."""


def write_mitsuba(context: Context, scene: ExportedScene) -> dict:
    """Write the folder `mitsuba`; return the omitted parts of the model."""
    folder = context.output.path("exports/mitsuba/scene.json").parent
    textures = model_textures(scene)
    header = {f"nishiki.{name}": text for name, text in context.stamp.items()}
    for name, read in textures.items():
        channels = "Y" if name == "regions" else "RGB"
        with ExrWriter(folder / f"{name}.exr", channels, *scene.shape, header) as exr:
            for rows in scene.bands():
                exr.write(read(rows).reshape(-1, scene.shape[1], len(channels)))
    count = write_relief(folder, context, scene)
    gloss = (getattr(scene.gloss, name).tolist() for name in GLOSS.values())
    facts = {
        "rows": scene.shape[0],
        "columns": scene.shape[1],
        "width": scene.shape[1] * scene.pitch,
        "height": scene.shape[0] * scene.pitch,
        "unit": scene.unit,
        "textures": list(textures),
        "shadows": scene.casts_shadows,
        "gloss": {"regions": [dict(zip(GLOSS, each, strict=True)) for each in zip(*gloss, strict=True)]},
        "stamp": dict(context.stamp),
    }
    (folder / "scene.json").write_text(json.dumps(facts, indent=1) + "\n")
    (folder / "nishiki_paint.py").write_text(Path(mitsuba_paint.__file__).read_text(encoding="utf-8"))
    clipped = sum(int(np.count_nonzero(scene.srgb(rows) < 0)) for rows in scene.bands())
    return {"vertices": count, "clipped": clipped / (3 * scene.shape[0] * scene.shape[1])}


def model_textures(scene: ExportedScene) -> dict[str, Texture]:
    """Return the textures of `nishiki_paint.py`, by name."""
    textures: dict[str, Texture] = {"albedo": scene.srgb, "normals": scene.shading_normals, "shading": scene.body_terms}
    if not scene.casts_shadows:
        textures["directional"] = lambda rows: np.pad(require(scene.shading(rows))[..., 3:], ((0, 0), (0, 0), (0, 1)))
    if scene.gloss.beta.any():
        textures["slopes"] = scene.slopes
    if len(scene.gloss.beta) > 1:
        textures["regions"] = scene.regions
    return textures


def write_relief(folder: Path, context: Context, scene: ExportedScene) -> int:
    """Write relief.ply, the displaced plane with its texture coordinates, and flat.ply; return the count of vertices.

    Their normals are those of the plane: the model takes those of the faces.
    """
    most = context.settings.mesh_vertices
    counts = np.sum([(len(band.places), len(band.triangles)) for band in reliefs(scene, most, colours=None)], axis=0)
    with open(folder / "relief.ply", "wb") as file:
        file.write(heading(*counts))
        for band in reliefs(scene, most, colours=None):
            file.write(vertices(band.places, np.broadcast_to(UP, band.places.shape), band.texture))
        for band in reliefs(scene, most, colours=None):
            file.write(faces(band.triangles))
    corners = np.array([[0, 0], [1, 0], [0, 1], [1, 1]], float)
    size = np.array([scene.shape[1], scene.shape[0]]) * scene.pitch
    places = np.column_stack([(corners - 0.5) * size * [1, -1], np.zeros(4)])
    flat = heading(4, 2) + vertices(places, np.tile(UP, (4, 1)), corners) + faces(np.array([[0, 2, 1], [1, 2, 3]]))
    (folder / "flat.ply").write_bytes(flat)
    return int(counts[0])


AXES = "x right, y up, z out of the surface towards the camera; row 0 is the top"


def write_normals(context: Context, scene: ExportedScene) -> dict:
    """Write `normals.tif` and `normals.exr`; return the angular error of 16 bits."""
    down = context.settings.normals_y == "down"
    convention = (
        f"Unit normals, {'DirectX (y down)' if down else 'OpenGL (y up)'}: value = (n + 1) / 2 * 65535 of x right, "
        f"y {'down' if down else 'up'}, z out of the surface towards the camera; 0, 0, 0: no estimate. Linear data, no "
        "colour."
    )
    path = context.output.path
    largest = squares = count = 0.0
    header = {**{f"nishiki.{name}": text for name, text in context.stamp.items()}, "comments": f"Unit normals, {AXES}"}

    def bands(exr: ExrWriter) -> Iterator[np.ndarray]:
        nonlocal largest, squares, count
        for rows in scene.bands():
            normals = scene.normals(rows)
            coded = normals_as_colours(normals)
            exr.write(normals)
            # the angle between each normal and its 16-bit code is what the format loses
            known = coded.any(axis=-1)
            exact, read = normals[known].astype(np.float64), coded[known] / 65535 * 2 - 1
            across = np.linalg.norm(np.cross(exact, read), axis=-1)
            angles = np.degrees(np.arctan2(across, np.sum(exact * read, axis=-1)))
            largest = max(largest, float(angles.max(initial=0)))
            squares, count = squares + float(np.sum(angles**2)), count + angles.size
            if down:
                coded[..., 1] = np.where(known, 65535 - coded[..., 1], 0)
            yield coded

    with ExrWriter(path("exports/normals.exr"), ("N.X", "N.Y", "N.Z"), *scene.shape, header) as exr:
        write_tiff(
            path("exports/normals.tif"),
            bands(exr),
            (*scene.shape, 3),
            description=f"{convention} {format_stamp(context)}",
            software=software(context),
            pitch_mm=scene.pitch_mm,
        )
    return {"largest_deg": largest, "rms_deg": (squares / count) ** 0.5 if count else 0.0}


def format_stamp(context: Context) -> str:
    """Format the stamp of an artifact in words."""
    return "; ".join(f"nishiki.{name}={text}" for name, text in context.stamp.items())


VERTEX = np.dtype([("place", "<f4", 3), ("normal", "<f4", 3), ("colour", "u1", 3)])


def write_height(context: Context, scene: ExportedScene) -> dict:
    """Write `height.tif` and `height.ply`."""
    path = context.output.path
    description = (
        f"Height in {scene.unit}, towards the camera; NaN: none. Integrated from normals: parts that do not touch have "
        f"each its own zero. {format_stamp(context)}"
    )
    write_tiff(
        path("exports/height.tif"),
        (scene.height(rows).astype(np.float32) for rows in scene.bands()),
        (*scene.shape, 1),
        description=description,
        software=software(context),
        pitch_mm=scene.pitch_mm,
        nodata="nan",
    )
    step, places, triangles = write_ply(context, scene)
    return {"pixels_a_vertex": step * step, "vertices": places, "faces": triangles}


def write_ply(context: Context, scene: ExportedScene) -> tuple[int, int, int]:
    """Write the mesh row by row; return pixels along the side of a vertex, vertices, faces."""
    most = context.settings.mesh_vertices
    step = counted = corners = 0
    for relief in reliefs(scene, most, colours=None):
        step, counted, corners = relief.step, counted + len(relief.places), corners + len(relief.triangles)
    comments = [f"nishiki.{name} {text}" for name, text in context.stamp.items()]
    comments.append(f"unit {scene.unit}; x right, y up, z towards the camera; origin: middle of the picture")
    properties = [f"float {axis}" for axis in ("x", "y", "z", "nx", "ny", "nz")]
    properties += [f"uchar {name}" for name in ("red", "green", "blue")]
    colours = scene.to_srgb()
    with open(context.output.path("exports/height.ply"), "wb") as file:
        file.write(ply_heading(counted, corners, properties, comments).encode("ascii", "replace"))
        for relief in reliefs(scene, most, colours=colours):
            points = np.empty(len(relief.places), VERTEX)
            points["place"], points["normal"] = relief.places, relief.normals
            points["colour"] = np.floor(255 * srgb_encode(relief.colours) + 0.5)
            file.write(points.tobytes())
        for relief in reliefs(scene, most, colours=None):
            file.write(faces(relief.triangles))
    return step, counted, corners


def write_albedo(context: Context, scene: ExportedScene) -> dict:
    """Write `albedo.tif`; return the share of its samples outside the colour space."""
    matrix, how = scene.to_xyz_d50()
    matrix = np.linalg.inv(ROMM.to_xyz()) @ matrix
    description = (
        f"Diffuse colour of the surface under D50, relative to a perfect white diffuser, without shading and gloss; "
        f"0, 0, 0 where there is no estimate. {ROMM.name}, from {how}. {format_stamp(context)}"
    )
    clipped = count = 0

    def bands() -> Iterator[np.ndarray]:
        nonlocal clipped, count
        for rows in scene.bands():
            known = scene.read_known(rows)[..., None]
            linear = np.where(known, np.nan_to_num(scene.coefficients(rows)) @ matrix.T, 0)
            clipped += int(np.count_nonzero((linear < 0) | (linear > 1)))
            count += 3 * int(np.count_nonzero(known))
            yield np.floor(65535 * np.clip(linear, 0, 1) ** (1 / ROMM.gamma) + 0.5).astype(np.uint16)

    write_tiff(
        context.output.path("exports/albedo.tif"),
        bands(),
        (*scene.shape, 3),
        description=description,
        software=software(context),
        pitch_mm=scene.pitch_mm,
        icc=icc_profile(ROMM),
    )
    return {"clipped": clipped / max(count, 1), "colour_from": how}


REC_709 = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290)


def write_spectral(context: Context, scene: ExportedScene) -> dict:
    """Write `spectra.exr`, and `spectra.img` with its `spectra.hdr`."""
    basis = scene.basis
    if basis is None:
        raise UserError(
            "export: spectral needs spectra, which this scene has none of. Remedy: give the capture spectra of camera "
            "and lamp, or leave spectral out of export.formats"
        )
    to_rgb = scene.to_srgb().T
    path = context.output.path
    # bands of a reflective picture: T, the wavelength with a decimal comma, its unit
    names = ["T." + f"{wavelength:.6f}nm".replace(".", ",") for wavelength in WAVELENGTHS_NM]
    header: dict[str, str | float | Sequence[float]] = {
        "spectralLayoutVersion": "1.0",
        "chromaticities": REC_709,
        "comments": "Reflectance relative to a perfect white diffuser; R, G, B: the same under D65 for looking",
        **{f"nishiki.{name}": text for name, text in context.stamp.items()},
    }
    outside = count = 0
    with (
        ExrWriter(path("exports/spectra.exr"), [*names, "R", "G", "B"], *scene.shape, header) as exr,
        EnviWriter(
            path("exports/spectra.img"),
            scene.shape,
            WAVELENGTHS_NM,
            description=f"Reflectance relative to a perfect white diffuser, 0: no estimate. {format_stamp(context)}",
            pitch_mm=scene.pitch_mm,
        ) as envi,
    ):
        for rows in strips(scene.shape[0], SPECTRAL_ROWS):
            known = scene.read_known(rows)[..., None]
            coefficients = np.where(known, np.nan_to_num(scene.coefficients(rows)), 0)
            spectra = (coefficients @ basis).astype(np.float32)
            exr.write(np.concatenate([spectra, coefficients @ to_rgb], axis=-1))
            envi.write(spectra)
            outside += int(np.count_nonzero((spectra < 0) | (spectra > 1)))
            count += spectra.shape[-1] * int(np.count_nonzero(known))
    return {"outside": outside / max(count, 1)}


OF_MAPS = {
    "normals": write_normals,
    "height": write_height,
    "albedo": write_albedo,
    "relight": relight.write,
    "spectral": write_spectral,
    "merl": write_merl,
    "iiif": write_iiif,
    "mitsuba": write_mitsuba,
}
OF_A_SURFACE = {"gltf": write_gltf, "usd": write_usd, "materialx": write_mtlx}
"""Formats with common textures and material; the others are written band by band."""


def run(context: Context) -> dict:
    """Write every format that the settings name."""
    scene = ExportedScene(context.inputs)
    surface = PaintingSurface(context, scene)
    maps_of = {name: partial(write, context, scene) for name, write in OF_MAPS.items()}
    return write_formats(
        context, maps_of | {name: partial(write, context, surface) for name, write in OF_A_SURFACE.items()}
    )
