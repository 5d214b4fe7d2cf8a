"""Object_render: pictures of the decoded object from captured views and between them, and a video of it turning."""

import numpy as np

from nishiki.artifacts.stage import Context
from nishiki.errors import UserError
from nishiki.render import display
from nishiki.render.object.pixels import coverage
from nishiki.render.object.renderer import DecodedObject, ObjectRenderer, frames
from nishiki.render.object.shots import FreeLamp, FreeLighting, ObjectPicture, Shot
from nishiki.stages.render import ObjectRenderSettings


def run(context: Context) -> dict:
    """Write every picture that the settings name."""
    settings = context.settings
    decoded = DecodedObject.open(context.inputs)
    without = decoded.numbers(settings.hold_out)
    renderer = decoded.renderer(without=without, level=settings.level, own_lamps=own_lamps(settings))
    lights = decoded.light_weights(settings.lights)
    named = stills(decoded, renderer, settings)
    shots = [shot.lit_by(lights) for _, shot in named]
    reports = {}
    pictures = context.progress.through(renderer.render(shots), len(shots), "picture")
    for (name, shot), picture in zip(named, pictures, strict=True):
        reports[name] = save(context, renderer, name, shot, picture)
    video, notes = film(context, renderer, lights)
    turn = renderer.turn
    return {
        "pictures": reports,
        "video": video,
        "notes": notes,
        "views_left_out": sorted(settings.hold_out),
        "turn": {
            "axis": turn.axis.tolist(),
            "span_deg": float(np.degrees(turn.length)),
            "closed": turn.closed,
            "axis_deviation_deg": turn.deviation_deg,
        },
    }


def own_lamps(settings: ObjectRenderSettings) -> FreeLighting | None:
    """Return the lamps of the settings; None where those of the capture light the object."""
    if not settings.lamps:
        for name in ("around", "shadows", "shadow_rays"):
            if getattr(settings, name) != ObjectRenderSettings.model_fields[name].default:
                raise UserError(
                    f"object_render: `{name}` is set without `lamps`, and goes with lamps of one's own alone. "
                    f"Remedy: name a lamp (intensity 0 for light from all around alone), or remove `{name}`"
                )
        return None
    if settings.lights:
        raise UserError(
            "object_render: expected weights of captured lights (`lights`) or lamps of one's own (`lamps`), "
            "found both. Remedy: remove one of them"
        )
    lamps = tuple(
        FreeLamp(
            np.radians(lamp.azimuth_deg),
            np.radians(lamp.elevation_deg),
            lamp.intensity,
            np.radians(lamp.radius_deg),
            lamp.distance,
        )
        for lamp in settings.lamps.values()
    )
    return FreeLighting(lamps, settings.around, settings.shadows, settings.shadow_rays)


def stills(decoded: DecodedObject, renderer: ObjectRenderer, settings: ObjectRenderSettings) -> list[tuple[str, Shot]]:
    """Return (file name, shot) of every still picture."""
    count = len(decoded.views)
    if isinstance(settings.views, int):
        chosen = sorted({k * count // max(1, settings.views) for k in range(min(settings.views, count))})
    else:
        chosen = [decoded.number(name) for name in settings.views]
    named = []
    for view in chosen:
        left_out = view in renderer.without
        shot = renderer.predicted(view) if left_out else renderer.captured(view)
        named.append((f"view-{decoded.views[view]}" + "-predicted" * left_out, shot))
    gaps = count if renderer.turn.closed else count - 1
    for k in range(min(settings.between, gaps)):
        view = k * gaps // settings.between
        following = decoded.views[(view + 1) % count]
        named.append((f"between-{decoded.views[view]}-{following}", renderer.between(view, 0.5)))
    names = [name for name, _ in named]
    if len(set(names)) < len(names):
        raise UserError("object_render: a view is named twice in `views`. Remedy: name each once")
    return named


def save(context: Context, renderer: ObjectRenderer, name: str, shot: Shot, picture: ObjectPicture) -> dict:
    """Write linear EXR with alpha, 8-bit PNG, and normals and depth where requested."""
    settings, stamp = context.settings, context.stamp
    alpha = np.where(picture.reached, coverage(renderer.mesh, shot.camera), 0).astype(np.float32)
    linear = display.three_channels(picture.linear)
    path = context.output.path
    display.write_exr(path(f"{name}.exr"), linear, stamp=stamp, colours="srgb", coverage=alpha)
    image = display.develop(linear * alpha[..., None], alpha, background=settings.background)
    display.write_png(path(f"{name}.png"), image.pixels, stamp=stamp)
    if settings.export_normals:
        normals = renderer.normals(picture, shot.camera)
        display.write_normals_png(path(f"{name}-normals.png"), normals, stamp=stamp)
        display.write_normals_exr(path(f"{name}-normals.exr"), normals, stamp=stamp)
        np.save(path(f"{name}-depth.npy"), np.where(picture.covered, picture.depth, np.float32(0)))
    return {
        "pixels": int(np.count_nonzero(picture.covered)),
        "clipped_fraction": image.clipped_high,
        "views": [renderer.cameras[view].name for view in shot.views.views],
    }


def film(context: Context, renderer: ObjectRenderer, lights: tuple[tuple[int, float], ...]) -> tuple[dict, list[str]]:
    """Film the object turning; return the result, and notes."""
    settings = context.settings
    if settings.film is None:
        return {}, []
    made = frames(
        renderer,
        frames_per_step=settings.film.frames_per_step,
        columns=settings.film.columns,
        supersampling=settings.film.supersampling,
        lights=lights,
        background=settings.background,
    )
    written = display.write_video(
        context.output.path("turn.mp4"), made, frames_per_second=settings.film.frames_per_second, stamp=context.stamp
    )
    return {"frames": written.frames, "file": written.path.name}, [written.note] if written.note else []
