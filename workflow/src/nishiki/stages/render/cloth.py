"""Cloth pictures: pictures of the cloth, draped and on cylinders, under its lamps and in its dyes."""

from collections.abc import Mapping

import numpy as np

from nishiki.artifacts.stage import Context
from nishiki.render.cloth.frame import ClothPicture
from nishiki.render.cloth.models import ClothModels, dyed
from nishiki.render.cloth.scene import Brdf, Surface
from nishiki.render.cloth.studio import Viewpoint, linear_colour, studio, tubes, turning
from nishiki.render.display import DisplayImage, developed, exposure_for
from nishiki.render.output import write_exr, write_png, write_video
from nishiki.stages.render import ClothRenderSettings
from nishiki.stages.render.draping import draped_cloth, lights_of, room

BRIGHTEST = 0.95
"""Share of the display's white that the bright parts of the pictures may reach."""


def run(context: Context) -> dict:
    """Write every picture that the settings name."""
    settings = context.settings
    models = ClothModels(context.inputs["cloth_brdf"].folder)
    brdf = models.brdf(settings.region or models.regions[0], settings.model or None)
    draped = draped_cloth(settings)
    surface = draped.surface
    view = settings.view
    elevation, azimuth = np.radians((view.elevation_deg, view.azimuth_deg))
    place = Viewpoint(elevation, azimuth, view.distance, view.rows, view.columns)
    stage = studio([surface], lights_of(settings), place, **room(settings))
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
        "surface": draped.about,
        "exposure": exposure,
        "pictures": pictures,
        "video": video,
        "notes": notes,
    }


def exposed(settings: ClothRenderSettings, pictures: list[ClothPicture]) -> float:
    """Return the factor of the PNG pictures, at which a white sheet that faces the brightest lamp is white.

    A black cloth stays black; less where the bright parts of the cloth would then exceed the display's white.
    """
    if settings.exposure != "auto":
        return settings.exposure
    sheet = max((lamp.intensity for lamp in settings.lights.values()), default=0.0) + settings.around
    brightest = exposure_for([(picture.linear[picture.coverage > 0.5], BRIGHTEST) for picture in pictures])
    return min(1.0 / sheet, brightest) if sheet > 0 else brightest


def shown(settings: ClothRenderSettings, picture: ClothPicture, exposure: float) -> DisplayImage:
    """Return the PNG picture, over white."""
    soft = settings.tone == "soft"
    return developed(picture.linear, picture.coverage, exposure=exposure, soft=soft, background=1.0)


def swatches(context: Context, brdf: Brdf, cloths: Mapping[str, Brdf]) -> dict:
    """Cylinders: warp upright, oblique and around, as measured or in the first dye."""
    settings = context.settings
    columns, rows = settings.view.columns, round(settings.view.columns * 0.62)
    view = Viewpoint(np.radians(12), 0.0, 2.6, rows, columns)
    stage = studio(tubes(), lights_of(settings), view, margin=1.1, **room(settings))
    chosen = brdf if settings.as_measured else next(iter(cloths.values()), brdf)
    made = stage.render([stage.take(chosen)], supersampling=settings.supersampling, shadows=settings.shadows)
    return {"cylinders": save(context, "cylinders", made[0], exposed(settings, made))}


def save(context: Context, name: str, picture: ClothPicture, exposure: float) -> dict:
    """Write linear EXR and 8-bit PNG; return what the PNG could not show."""
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
    """Film the cloth; return what was written, and notes."""
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
    view = settings.view

    elevation, azimuth = np.radians((view.elevation_deg, view.azimuth_deg))
    place = Viewpoint(elevation, azimuth, view.distance, rows, block.columns)
    stage = studio([surface], lights_of(settings), place, wall=False, **room(settings))
    exposure = None
    for angle in turning(block.frames):
        now = stage.turned(angle) if block.moves == "turn" else stage.lit_from(angle)
        picture = now.render([now.take(brdf)], supersampling=block.supersampling, shadows=settings.shadows)[0]
        exposure = exposure or exposed(settings, [picture])
        yield shown(settings, picture, exposure).pixels
