"""Cloth pictures: pictures of the cloth, draped and on cylinders, under its lamps and in its dyes."""

from pathlib import Path

import numpy as np

from nishiki.artifacts.stage import Context
from nishiki.errors import UserError
from nishiki.render.cloth.drape import read_drape
from nishiki.render.cloth.dyes import dyed
from nishiki.render.cloth.frame import ClothPicture
from nishiki.render.cloth.mesh_store import read_surface
from nishiki.render.cloth.models import ClothModels
from nishiki.render.cloth.scene import Brdf, Surface
from nishiki.render.cloth.sheet import sheet
from nishiki.render.cloth.studio import Lighting, linear_colour, studio, tubes, turning
from nishiki.render.cloth.tangent import from_direction, from_texture
from nishiki.render.display import DisplayImage, developed, exposure_for
from nishiki.render.output import write_exr, write_png, write_video
from nishiki.stages.cloth_render.declaration import ClothRenderSettings

FINEST_SIDE = 193
"""Points along a side of the drawn cloth, half as many again as the shipped surface has."""
BRIGHTEST = 0.95
"""Share of the display's white that the bright parts of the pictures may reach."""
AXES = {"x": (1, 0, 0), "y": (0, 1, 0), "z": (0, 0, 1)}


def run(context: Context) -> dict:
    """Write every picture that the settings name."""
    settings = context.settings
    models = ClothModels(context.inputs["cloth_brdf"].folder)
    brdf = models.brdf(settings.region or models.regions[0], settings.model or None)
    surface, shape = surface_of(settings)
    view = settings.view
    place = {"elevation": np.radians(view.elevation_deg), "azimuth": np.radians(view.azimuth_deg)}
    size = {"rows": view.rows, "columns": view.columns, "distance": view.distance}
    stage = studio([surface], lights_of(settings), **place, **size, **room(settings))
    cloths = dyed(brdf, {name: linear_colour(colour) for name, colour in settings.dyes.items()})
    named, takes = {}, []
    if settings.as_measured:
        named |= {"drape": len(takes)}
        takes.append(stage.take(brdf))
        for k, name in enumerate(settings.lights):
            named[f"drape-light-{name}"] = len(takes)
            takes.append(stage.take(brdf, tuple(float(k == other) for other in range(len(settings.lights)))))
    for name, cloth in cloths.items():
        named[f"drape-dye-{name}"] = len(takes)
        takes.append(stage.take(cloth))
    context.progress.tell(f"{len(takes)} pictures of {view.columns} x {view.rows} pixels")
    made = stage.render(takes, supersampling=settings.supersampling, shadows=settings.shadows) if takes else []
    exposure = exposed(settings, [made[k] for name, k in named.items() if not name.startswith("drape-light-")])
    pictures = {name: save(context, name, made[k], exposure) for name, k in named.items()}
    if settings.swatches:
        context.progress.tell("cylinders")
        pictures |= swatches(context, brdf, cloths)
    video, notes = film(context, surface, next(iter(cloths.values()), brdf))
    return {
        "region": settings.region or models.regions[0],
        "model": settings.model or models.default,
        "surface": shape,
        "exposure": exposure,
        "pictures": pictures,
        "video": video,
        "notes": notes,
    }


def exposed(settings: ClothRenderSettings, pictures: list[ClothPicture]) -> float:
    """The factor of the PNG pictures: a white sheet that faces the brightest lamp is white, so that a black cloth stays
    black; less where the bright parts of the cloth would then exceed the display's white."""
    if settings.exposure != "auto":
        return settings.exposure
    sheet = max((lamp.intensity for lamp in settings.lights.values()), default=0.0) + settings.around
    brightest = exposure_for([(picture.linear[picture.coverage > 0.5], BRIGHTEST) for picture in pictures])
    return min(1.0 / sheet, brightest) if sheet > 0 else brightest


def shown(settings: ClothRenderSettings, picture: ClothPicture, exposure: float) -> DisplayImage:
    """The PNG picture, over white."""
    soft = settings.tone == "soft"
    return developed(picture.linear, picture.coverage, exposure=exposure, soft=soft, background=1.0)


def surface_of(settings: ClothRenderSettings) -> tuple[Surface, dict]:
    """The draped cloth, or the surface of the file, with its weft; and what is to be said of it."""
    if settings.mesh is not None:
        read = read_surface(Path(settings.mesh.file), sha256=settings.mesh.sha256, smooth=settings.mesh.smooth)
        mesh, turn = read.mesh, np.radians(settings.mesh.turned_deg)
        if settings.mesh.weft == "texture":
            if read.uv is None:
                raise UserError(
                    f"{settings.mesh.file}: expected texture coordinates, one pair a vertex, found none. Remedy: set "
                    "mesh.weft to x, y or z, the axis along which the weft is laid on"
                )
            field = from_texture(mesh.vertices, mesh.triangles, mesh.normals, read.uv, turn=turn)
        else:
            axis = np.array(AXES[settings.mesh.weft], float)
            field = from_direction(mesh.vertices, mesh.triangles, mesh.normals, axis, turn=turn)
        diagnostics = {"transported": int(field.filled.sum()), "arbitrary": field.arbitrary, "sha256": read.sha256}
        return Surface(mesh, field.weft), {"kind": "file", **sizes(mesh), **diagnostics}
    side = min(FINEST_SIDE, max(settings.view.rows, settings.view.columns) + 1)  # no more points than pixels
    surface, _ = sheet(read_drape(), side=side)
    return surface, {"kind": "ball", **sizes(surface.mesh)}


def sizes(mesh) -> dict:
    """Counts of a mesh."""
    return {"vertices": len(mesh.vertices), "triangles": len(mesh.triangles)}


def lights_of(settings: ClothRenderSettings) -> list[Lighting]:
    """The lamps."""
    return [
        Lighting(
            np.radians(lamp.elevation_deg),
            np.radians(lamp.azimuth_deg),
            tuple(lamp.intensity * value for value in linear_colour(lamp.colour)),
            np.radians(lamp.radius_deg),
        )
        for lamp in settings.lights.values()
    ]


def room(settings: ClothRenderSettings) -> dict:
    """Light from around, and the paper."""
    return {"level": settings.around, "reflectance": settings.paper}


def swatches(context: Context, brdf: Brdf, cloths: dict[str, Brdf]) -> dict:
    """Cylinders: warp upright, oblique and around, as measured or in the first dye."""
    settings = context.settings
    columns, rows = settings.view.columns, round(settings.view.columns * 0.62)
    stage = studio(
        tubes(), lights_of(settings), elevation=np.radians(12), azimuth=0.0, distance=2.6, rows=rows, columns=columns,
        margin=1.1, **room(settings),
    )  # fmt: skip
    chosen = brdf if settings.as_measured else next(iter(cloths.values()), brdf)
    made = stage.render([stage.take(chosen)], supersampling=settings.supersampling, shadows=settings.shadows)
    return {"cylinders": save(context, "cylinders", made[0], exposed(settings, made))}


def save(context: Context, name: str, picture: ClothPicture, exposure: float) -> dict:
    """Linear EXR and 8-bit PNG; what the PNG could not show."""
    path, settings = context.output.path, context.settings
    write_exr(path(f"{name}.exr"), picture.linear, stamp=context.stamp, colours="srgb", coverage=picture.coverage)
    image = shown(settings, picture, exposure)
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
    """The video: what was written, and notes."""
    block = context.settings.film
    if block is None:
        return {}, []
    frames = context.progress.through(frames_of(context, surface, brdf), block.frames, "frame")
    written = write_video(
        context.output.path("film.mp4"), frames, frames_per_second=block.frames_per_second, stamp=context.stamp
    )
    return {"frames": written.frames, "file": written.path.name}, [written.note] if written.note else []


def frames_of(context: Context, surface: Surface, brdf: Brdf):
    """Frames (rows, columns, 3) uint8; a turn of the cloth is one of camera and lamps about it."""
    settings, block = context.settings, context.settings.film
    rows = round(block.columns * settings.view.rows / settings.view.columns)
    rows += rows % 2
    view = settings.view

    stage = studio(
        [surface], lights_of(settings), elevation=np.radians(view.elevation_deg), azimuth=np.radians(view.azimuth_deg),
        distance=view.distance, rows=rows, columns=block.columns, wall=False, **room(settings),
    )  # fmt: skip
    exposure = None
    for angle in turning(block.frames):
        now = stage.turned(angle) if block.moves == "turn" else stage.lit_from(angle)
        picture = now.render([now.take(brdf)], supersampling=block.supersampling, shadows=settings.shadows)[0]
        exposure = exposure or exposed(settings, [picture])
        yield shown(settings, picture, exposure).pixels
