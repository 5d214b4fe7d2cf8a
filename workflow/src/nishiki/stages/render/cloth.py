"""Cloth pictures: pictures of the cloth, draped and on cylinders, under its lamps and in its dyes."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from nishiki.artifacts.stage import Context
from nishiki.errors import UserError
from nishiki.geometry.mesh import Mesh
from nishiki.render.cloth.models import ClothModels, apply_dyes
from nishiki.render.cloth.scene import Brdf, Surface
from nishiki.render.cloth.studio import ClothPicture, Lighting, Studio, Viewpoint, linear_colour, studio, tubes, turning
from nishiki.render.cloth.surfaces import from_direction, from_texture, read_drape, read_surface, sheet
from nishiki.render.display import DisplayImage, develop, exposure_for, write_exr, write_png, write_video
from nishiki.stages.render import ClothRenderSettings, SurfaceFile

FINEST_SIDE = 193
"""Points along a side of the drawn cloth, 1.5 times as many as the shipped surface has."""
AXES = {"x": (1, 0, 0), "y": (0, 1, 0), "z": (0, 0, 1)}


@dataclass(frozen=True)
class DrapedCloth:
    """A draped surface; uv (v, 2): texture coordinates, u along the weft, or None; about: notes for the report."""

    surface: Surface
    uv: np.ndarray | None
    about: dict


def draped_cloth(settings: ClothRenderSettings) -> DrapedCloth:
    """Return the cloth over the ball, or the surface of the file."""
    if settings.mesh is not None:
        return surface_from_file(settings.mesh)
    side = min(FINEST_SIDE, max(settings.view.rows, settings.view.columns) + 1)  # no more points than pixels
    surface, uv = sheet(read_drape(), side=side)
    return DrapedCloth(surface, uv, {"kind": "ball", **_sizes(surface.mesh)})


def surface_from_file(wanted: SurfaceFile) -> DrapedCloth:
    """Return the surface of a file, with its weft. UserError where it cannot be used."""
    read = read_surface(Path(wanted.file), sha256=wanted.sha256, smooth=wanted.smooth)
    mesh, turn, uv = read.mesh, np.radians(wanted.turned_deg), None
    if wanted.weft == "texture":
        if read.uv is None:
            raise UserError(
                f"{wanted.file}: expected texture coordinates, one pair a vertex, found none. Remedy: set "
                "mesh.weft to x, y or z, the axis along which the weft is laid on"
            )
        field = from_texture(mesh.vertices, mesh.triangles, mesh.normals, read.uv, turn=turn)
        uv = read.uv if turn == 0 else None
    else:
        axis = np.array(AXES[wanted.weft], float)
        field = from_direction(mesh.vertices, mesh.triangles, mesh.normals, axis, turn=turn)
    about = {"transported": int(field.filled.sum()), "arbitrary": field.arbitrary, "sha256": read.sha256}
    return DrapedCloth(Surface(mesh, field.weft), uv, {"kind": "file", **_sizes(mesh), **about})


def _sizes(mesh: Mesh) -> dict:
    return {"vertices": len(mesh.vertices), "triangles": len(mesh.triangles)}


def lights_of(settings: ClothRenderSettings) -> list[Lighting]:
    """Return the lamps."""
    lights = []
    for lamp in settings.lights.values():
        red, green, blue = (lamp.intensity * value for value in linear_colour(lamp.colour))
        elevation, azimuth, radius = np.radians((lamp.elevation_deg, lamp.azimuth_deg, lamp.radius_deg))
        lights.append(Lighting(elevation, azimuth, (red, green, blue), radius))
    return lights


def room(settings: ClothRenderSettings) -> dict:
    """Return the ambient light, and the paper."""
    return {"level": settings.around, "reflectance": settings.paper}


def in_view(settings: ClothRenderSettings, surface: Surface, rows: int, columns: int, *, wall: bool = True) -> Studio:
    """Return the surface under its lamps, before the camera of the settings."""
    elevation, azimuth = np.radians((settings.view.elevation_deg, settings.view.azimuth_deg))
    place = Viewpoint(elevation, azimuth, settings.view.distance, rows, columns)
    return studio([surface], lights_of(settings), place, wall=wall, **room(settings))


BRIGHTEST = 0.95
"""Share of the display's white for the bright parts of the pictures, at most."""


def run(context: Context) -> dict:
    """Write every picture that the settings name."""
    settings = context.settings
    models = ClothModels(context.inputs["cloth_brdf"].folder)
    brdf = models.brdf(settings.region or models.regions[0], settings.model or None)
    draped = draped_cloth(settings)
    surface, view = draped.surface, settings.view
    stage = in_view(settings, surface, view.rows, view.columns)
    cloths = apply_dyes(brdf, {name: linear_colour(colour) for name, colour in settings.dyes.items()})
    takes = {}
    if settings.as_measured:
        takes["drape"] = stage.take(brdf)
        for k, name in enumerate(settings.lights):
            alone = tuple(float(k == other) for other in range(len(settings.lights)))
            takes[f"drape-light-{name}"] = stage.take(brdf, alone)
    takes |= {f"drape-dye-{name}": stage.take(cloth) for name, cloth in cloths.items()}
    context.progress.tell(f"{len(takes)} pictures of {view.columns} x {view.rows} pixels")
    rendered = (
        stage.render(list(takes.values()), supersampling=settings.supersampling, shadows=settings.shadows)
        if takes
        else []
    )
    made = dict(zip(takes, rendered, strict=True))
    exposure = choose_exposure(settings, [each for name, each in made.items() if not name.startswith("drape-light-")])
    pictures = {name: save(context, name, picture, exposure) for name, picture in made.items()}
    if settings.swatches:
        context.progress.tell("cylinders")
        pictures |= swatches(context, brdf, cloths)
    video, notes = film(context, surface, next(iter(cloths.values()), brdf))
    return {
        "region": settings.region or models.regions[0],
        "model": settings.model or models.default,
        "surface": draped.about,
        "exposure": exposure,
        "pictures": pictures,
        "video": video,
        "notes": notes,
    }


def choose_exposure(settings: ClothRenderSettings, pictures: list[ClothPicture]) -> float:
    """Compute the factor of the PNG pictures at which a white sheet facing the brightest lamp is white.

    A black cloth stays black; less where the bright parts of the cloth would then exceed the display's white.
    """
    if settings.exposure != "auto":
        return settings.exposure
    sheet = max((lamp.intensity for lamp in settings.lights.values()), default=0.0) + settings.around
    brightest = exposure_for([(picture.linear[picture.coverage > 0.5], BRIGHTEST) for picture in pictures])
    return min(1.0 / sheet, brightest) if sheet > 0 else brightest


def develop_picture(settings: ClothRenderSettings, picture: ClothPicture, exposure: float) -> DisplayImage:
    """Return the PNG picture, over white."""
    soft = settings.tone == "soft"
    return develop(picture.linear, picture.coverage, exposure=exposure, soft=soft, background=1.0)


def swatches(context: Context, brdf: Brdf, cloths: Mapping[str, Brdf]) -> dict:
    """Render cylinders: warp upright, oblique and around, as measured or in the first dye."""
    settings = context.settings
    columns, rows = settings.view.columns, round(settings.view.columns * 0.62)
    view = Viewpoint(np.radians(12), 0.0, 2.6, rows, columns)
    stage = studio(tubes(), lights_of(settings), view, margin=1.1, **room(settings))
    chosen = brdf if settings.as_measured else next(iter(cloths.values()), brdf)
    made = stage.render([stage.take(chosen)], supersampling=settings.supersampling, shadows=settings.shadows)
    return {"cylinders": save(context, "cylinders", made[0], choose_exposure(settings, made))}


def save(context: Context, name: str, picture: ClothPicture, exposure: float) -> dict:
    """Write linear EXR and 8-bit PNG; return the losses of the PNG."""
    path, settings = context.output.path, context.settings
    write_exr(path(f"{name}.exr"), picture.linear, stamp=context.stamp, colours="srgb", coverage=picture.coverage)
    image = develop_picture(settings, picture, exposure)
    write_png(path(f"{name}.png"), image.pixels, stamp=context.stamp)
    return {
        "samples": picture.samples,
        "evaluated": picture.evaluated,
        "above_white": image.clipped_high,
        "bent_normals": picture.bent,
        "shadowed": picture.shadowed,
        "brightest": float(picture.linear.max()),
    }


def film(context: Context, surface: Surface, brdf: Brdf) -> tuple[dict, list[str]]:
    """Film the cloth; return the result, and notes."""
    block = context.settings.film
    if block is None:
        return {}, []
    frames = context.progress.through(frames_of(context, surface, brdf), block.frames, "frame")
    written = write_video(
        context.output.path("film.mp4"), frames, frames_per_second=block.frames_per_second, stamp=context.stamp
    )
    return {"frames": written.frames, "file": written.path.name}, [written.note] if written.note else []


def frames_of(context: Context, surface: Surface, brdf: Brdf):
    """Yield frames (rows, columns, 3) uint8; a turn of the cloth is one of camera and lamps about it."""
    settings, block = context.settings, context.settings.film
    rows = round(block.columns * settings.view.rows / settings.view.columns)
    rows += rows % 2
    stage = in_view(settings, surface, rows, block.columns, wall=False)
    exposure = None
    for angle in turning(block.frames):
        now = stage.turn(angle) if block.moves == "turn" else stage.lit_from(angle)
        picture = now.render([now.take(brdf)], supersampling=block.supersampling, shadows=settings.shadows)[0]
        exposure = exposure or choose_exposure(settings, [picture])
        yield develop_picture(settings, picture, exposure).pixels
