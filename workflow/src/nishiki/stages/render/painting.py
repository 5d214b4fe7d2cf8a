"""Render: pictures of a painting under any light and from any view, and films of a moving light or a moving eye."""

import dataclasses
import math
from collections.abc import Iterable, Iterator
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from nishiki.artifacts.artifact import Artifact
from nishiki.artifacts.maps import Maps, shrink
from nishiki.artifacts.stage import Context
from nishiki.capture.tables import read_curves
from nishiki.colour.colour import illuminant as cie_illuminant
from nishiki.colour.sampling import resample
from nishiki.errors import require
from nishiki.render import display
from nishiki.render.plane.frame import Rendering, render
from nishiki.render.plane.kernel import UNUSABLE
from nishiki.render.plane.scene import Ambient, Light, PlaneScene, View
from nishiki.render.plane.shade import cast_shadows
from nishiki.stages.painting_maps import PaintingMaps
from nishiki.stages.render import LightSettings, PictureSettings, RenderSettings, SequenceSettings, ViewSettings

AMBIENT = PictureSettings.model_fields["ambient"].default  # of films, as of pictures


def run(context: Context) -> dict:
    """Make every picture and sequence that the settings name."""
    settings = context.settings
    maps = PaintingMaps(context.inputs)
    crowd = math.prod(maps.shape) / (1e6 * settings.most_megapixels)
    block = 1 if crowd <= 1 else math.ceil(math.sqrt(2 * crowd))  # larger maps: two gigabytes of memory are enough
    scene = load_scene(context.inputs, cast_shadows=settings.cast_shadows, block=block)
    lights = [light for picture in settings.pictures for light in picture.lights]
    spectra = {}
    for name in {item.illuminant for item in (*lights, *settings.sequences)}:
        if name.lower().endswith(".csv"):
            curves = read_curves(Path(name), label=name)
            spectra[name] = resample(curves.wavelengths_nm, curves.values.T, name=name)[0]
        else:
            spectra[name] = cie_illuminant(name)
    coarse = f"a pixel of frontal pictures is the mean of {block} x {block} pixels of the maps (render.most_megapixels)"
    pictures, notes = {}, [coarse] if block > 1 else []
    for picture in context.progress.over(settings.pictures, "picture"):
        made = paint(scene, picture, spectra, settings)
        pictures[picture.name] = save(context, picture, made)
    for sequence in settings.sequences:
        written, exposure = film(context, scene, sequence, spectra)
        pictures[sequence.name] = {"frames": written.frames, "file": written.path.name, "exposure": exposure}
        notes += [written.note] if written.note else []
    if settings.export_normals:
        normals = maps.mean_normals(maps.normals, block)
        display.write_normals_png(context.output.path("normals.png"), normals, stamp=context.stamp)
        display.write_normals_exr(context.output.path("normals.exr"), normals, stamp=context.stamp)
    return {
        "pictures": pictures,
        "notes": notes,
        "pixels_averaged": block * block,
        "spectral": scene.basis is not None,
        "cast_shadows": scene.height is not None,
        "balanced_by_object": scene.basis is None and not is_bounded(context),
    }


def load_scene(inputs: dict[str, Artifact], *, cast_shadows: bool, block: int = 1) -> PlaneScene:
    """Return the maps of the upstream artifacts; spectra where there are some, camera channels otherwise.

    block: side of the squares of pixels over which the maps are averaged as they are read. Slopes that differ inside a
    square widen its gloss.
    """
    maps = PaintingMaps(inputs)
    fields: dict[str, Any] = {}
    if maps.terms:
        fields["shading"] = maps.mean(partial(maps.maps.read, "shading"), block)
    if maps.heights and cast_shadows and maps.casts_shadows:
        fields["height"] = shrink(maps.height, maps.shape, block)
    if maps.glossy:
        fields |= {"gloss": maps.gloss, "slopes": maps.block_slopes(block)}
        if maps.labels:
            labels = shrink(partial(maps.labels.read, "labels"), maps.shape, block, "middle")
            fields["labels"] = labels.astype(np.uint8)
    return PlaneScene(
        normals=maps.mean_normals(maps.shading_normals, block),
        coefficients=maps.mean(maps.display_colours, block),
        basis=maps.basis,
        pitch=maps.pitch * block,
        **fields,
    )


def paint(
    scene: PlaneScene, picture: PictureSettings, spectra: dict[str, np.ndarray], settings: RenderSettings
) -> Rendering:
    """Return one picture in linear XYZ."""
    lights = [distant_lamp(light, spectra[light.illuminant]) for light in picture.lights]
    view = view_of(picture.view, scene)
    ambient = Ambient(spectrum=lights[0].spectrum, level=picture.ambient) if lights else Ambient(level=picture.ambient)
    return render(scene, lights, view, ambient=ambient, samples=(settings.supersampling, 1024))


def save(context: Context, picture: PictureSettings, made: Rendering) -> dict:
    """Write linear EXR and 8-bit sRGB PNG; return clipped and flagged parts of the PNG."""
    coverage = None if picture.view.kind == "frontal" else made.coverage
    display.write_exr(context.output.path(f"{picture.name}.exr"), made.xyz, stamp=context.stamp, coverage=coverage)
    exposure = picture.exposure
    if exposure == "auto":
        sheet = white_sheet(picture.lights, picture.ambient)
        exposure = display.adapted_exposure(
            made.xyz, seen=select_object(made), sheet=sheet, bounded=is_bounded(context)
        )
    shown = display.display_image(made.xyz, white=made.white_xyz, exposure=exposure)
    display.write_png(context.output.path(f"{picture.name}.png"), shown.pixels, stamp=context.stamp)
    return {
        "exposure": exposure,
        "clipped_fraction": float(shown.clipped_high),
        "flagged_pixels": int(np.count_nonzero(made.flags & UNUSABLE)),
    }


def is_bounded(context: Context) -> bool:
    """Check whether the light of the photographs is known, so that a black object stays dark."""
    return not Maps(context.inputs["normals"].folder).group.attrs.get("unbalanced")


def select_object(made: Rendering) -> np.ndarray:
    """Select pixels (rows, columns) of the picture that show the object."""
    return (made.coverage > 0.5) & ((made.flags & UNUSABLE) == 0)


def film(
    context: Context, scene: PlaneScene, sequence: SequenceSettings, spectra: dict[str, np.ndarray]
) -> tuple[display.VideoWritten, float]:
    """Film a moving light or a moving view; return its exposure."""
    view = film_view(sequence, scene)
    lamp = LightSettings(elevation_deg=sequence.elevation_deg)
    light = distant_lamp(lamp, spectra[sequence.illuminant])
    ambient = Ambient(spectrum=light.spectrum, level=AMBIENT)
    if sequence.moves == "light":
        # the last direction is a step before the first, so that a repeated film runs on without a stop
        turn = (lamp.model_copy(update={"azimuth_deg": 360 * k / sequence.frames}) for k in range(sequence.frames))
        frames = (render(scene, [distant_lamp(each, light.spectrum)], view, ambient=ambient) for each in turn)
    else:
        shadows = None if scene.height is None else cast_shadows(scene.height, [light], pitch=scene.pitch)
        views = orbit(view, sequence.frames)
        frames = (render(scene, [light], each, ambient=ambient, visibility=shadows) for each in views)
    first = next(frames)  # sets the exposure of all, so that the film does not flicker
    sheet = white_sheet([lamp], AMBIENT)
    exposure = display.adapted_exposure(first.xyz, seen=select_object(first), sheet=sheet, bounded=is_bounded(context))
    frames = chain([first], frames)
    pictures = (
        display.display_image(frame.xyz, white=frame.white_xyz, exposure=exposure).pixels
        for frame in context.progress.through(frames, sequence.frames, f"{sequence.name}: frame")
    )
    written = display.write_video(
        context.output.path(f"{sequence.name}.mp4"),
        pictures,
        frames_per_second=sequence.frames_per_second,
        stamp=context.stamp,
    )
    return written, exposure


SWING_RAD = np.radians(30)  # of the eye to each side in a film


def orbit(view: View, count: int) -> Iterator[View]:
    """Swing the eye of a view about the vertical axis through its target, `SWING_RAD` to each side and back.

    The eye follows a cosine, so that it slows down where it turns; the first view is the one furthest to the right.
    """
    target = np.asarray(view.target_mm, np.float64)
    dx, dy, dz = np.asarray(view.eye_mm, np.float64) - target
    for k in range(count):
        a = SWING_RAD * np.cos(2 * np.pi * k / count)
        swung = (dx * np.cos(a) + dz * np.sin(a), dy, dz * np.cos(a) - dx * np.sin(a))
        yield dataclasses.replace(view, eye_mm=tuple(target + swung))


LAMP_RADIUS_RAD = np.radians(0.75)
"""Angular radius of a lamp at the object: the soft edge of cast shadows."""
FIELD_OF_VIEW_MARGIN = 1.05  # around the painting
CENTRING_STEPS = 8  # of the camera's target; the middle of the object converges in a few
NEAREST = 1e-3  # depth of points beside or behind the eye, in lengths of the object
LONGER_SIDE, SHORTEST_SIDE = 1024, 16  # pixels of a picture whose size the settings leave open


def direction(elevation_deg: float, azimuth_deg: float) -> np.ndarray:
    """Compute the unit vector (3,) at an elevation above the object's plane, azimuth from x (right) towards y (up)."""
    elevation, azimuth = np.radians([elevation_deg, azimuth_deg])
    return np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])


def distant_lamp(settings: LightSettings, spectrum: np.ndarray) -> Light:
    """Return a distant lamp; spectrum (61,)."""
    towards = direction(settings.elevation_deg, settings.azimuth_deg)
    return Light(
        direction=tuple(towards), spectrum=spectrum, intensity=settings.intensity, angular_radius=LAMP_RADIUS_RAD
    )


def view_of(settings: ViewSettings, scene: PlaneScene) -> View:
    """Return the frontal view pixel by pixel, or a pinhole camera that frames the object.

    The object is where the maps have normals: a small one in a large frame is framed as if it were alone. Where the
    settings leave a side of the picture open, the picture has the proportions of the object as the eye sees it.
    """
    if settings.kind == "frontal":
        return View()
    edge = outline(scene)
    low, high = edge.min(axis=0), edge.max(axis=0)
    towards = direction(settings.elevation_deg, settings.azimuth_deg)
    up = (0.0, 1.0, 0.0) if abs(towards[1]) < 0.999 else (0.0, 0.0, 1.0)
    forward = -towards
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    above = np.cross(right, forward)
    target, length = (low + high) / 2, float((high - low).max())
    for _ in range(CENTRING_STEPS):
        eye = target + settings.distance * length * towards
        rays = edge - eye
        depth = np.maximum(rays @ forward, NEAREST * length)
        x, y = rays @ right / depth, rays @ above / depth
        middle = forward + right * (x.min() + x.max()) / 2 + above * (y.min() + y.max()) / 2
        if not middle[2] < 0:  # the horizon is in the picture
            break
        target = eye - middle * eye[2] / middle[2]
    eye = target + settings.distance * length * towards
    rays = edge - eye
    depth = np.maximum(rays @ forward, NEAREST * length)
    wide, tall = (float(np.abs(rays @ axis / depth).max()) for axis in (right, above))
    rows, columns = _picture_size(settings, tall / wide)
    field = 2 * np.arctan(FIELD_OF_VIEW_MARGIN * max(tall, wide * rows / columns))
    return View(
        eye_mm=tuple(eye), target_mm=tuple(target), up=up, field_of_view=float(field), rows=rows, columns=columns
    )


def outline(scene: PlaneScene) -> np.ndarray:
    """Compute (N, 3) outer corners of the first and last pixel with a normal in each row; z = 0, in the pitch's unit.

    All four corners of the maps where no pixel has one.
    """
    known = np.einsum("rci,rci->rc", scene.normals, scene.normals) > 0.5
    if not known.any():
        known = np.ones(scene.shape, bool)
    rows = np.flatnonzero(known.any(axis=1))
    first = known[rows].argmax(axis=1)
    last = known.shape[1] - 1 - known[rows, ::-1].argmax(axis=1)
    across = np.concatenate([first - 0.5, last + 0.5, first - 0.5, last + 0.5])
    down = np.concatenate([rows - 0.5, rows - 0.5, rows + 0.5, rows + 0.5])
    x = (across - (scene.shape[1] - 1) / 2) * scene.pitch
    y = ((scene.shape[0] - 1) / 2 - down) * scene.pitch
    return np.stack([x, y, np.zeros_like(x)], axis=1)


def _picture_size(settings: ViewSettings, proportion: float) -> tuple[int, int]:
    """Compute (rows, columns): as given; a missing side by the proportion (height over width) of the object."""
    rows, columns = settings.rows, settings.columns
    if rows is None and columns is None:
        rows, columns = (None, LONGER_SIDE) if proportion <= 1 else (LONGER_SIDE, None)
    if rows is not None:
        return rows, columns or min(max(round(rows / proportion), SHORTEST_SIDE), 16 * rows)
    across = require(columns)
    return min(max(round(across * proportion), SHORTEST_SIDE), 16 * across), across


def white_sheet(lights: Iterable[LightSettings], ambient: float) -> float:
    """Compute the luminance of a perfect white sheet in the plane of the object; 1: one that faces a lamp."""
    return ambient + sum(light.intensity * float(np.sin(np.radians(light.elevation_deg))) for light in lights)


def film_view(settings: SequenceSettings, scene: PlaneScene) -> View:
    """Return the view of a film: frontal at its width, or a pinhole camera at its elevation; even sides for H.264."""
    rows, columns = scene.shape
    width = min(settings.columns, columns) if settings.moves == "light" else settings.columns
    width += width % 2
    height = max(2, round(width * rows / columns / 2) * 2)
    if settings.moves == "light":
        return View(rows=height, columns=width)
    view = view_of(ViewSettings(kind="pinhole", elevation_deg=settings.elevation_deg, columns=width), scene)
    return dataclasses.replace(view, rows=view.rows + view.rows % 2)
