"""Residual: what the reflection model leaves of the photographs, solved for in the pictures and coded."""

import json
import math
from dataclasses import replace

import numpy as np

from nishiki.artifacts.stage import Context
from nishiki.atlas.store import Texels
from nishiki.brdf.texels.lighting import Lighting
from nishiki.brdf.texels.store import ParameterMaps
from nishiki.codec.allocate import EncodedObject, Pilot, Point, find_step, one_pass, pilot, psnr
from nishiki.codec.design import Design
from nishiki.codec.parameters import Maps
from nishiki.codec.prediction import Surface
from nishiki.codec.pursuit import Pursuit
from nishiki.codec.store import write_residual
from nishiki.codec.tile_code import CodedScene, Effort, Pixels, model_of, see
from nishiki.colour.encoding import encode
from nishiki.model_selection.decision import economy
from nishiki.model_selection.sufficient import Left, decided, model_suffices, what_is_left
from nishiki.stages.residual.declaration import ResidualSettings
from nishiki.threads import threads

SAMPLE_TILES = 24  # that decide whether the model suffices


def run(context: Context) -> dict:
    """Refine the parameters, find the step for the target, store the pass that meets it."""
    settings = context.settings
    texels = Texels(context.inputs["texels"].folder)
    reflection = context.inputs["object_brdf"].folder
    source = ArtifactSource(texels, ParameterMaps(reflection), settings)
    fitted = json.loads((reflection / "object_brdf.json").read_text())
    scene = scene_of(texels, fitted["lighting"])
    effort = Effort(
        pursuit=Pursuit(rounds=settings.rounds, inner=settings.inner),
        price=settings.price,
        refinements=settings.refinements,
        threshold=settings.threshold,
        gloss=fitted["specular"],
    )
    design, workers = design_of(texels, source.components, settings), threads()
    piloted = pilot(source, scene, design, effort, threads=workers, progress=context.progress)
    counts = source.counts()

    left = left_by_model(source, scene, piloted)
    decision = decided(left, settings.target, settings.amount, settings.sufficient)
    context.progress.tell(str(decision))
    alone = settings.sufficient == "auto" and model_suffices(left, settings.target, settings.amount)
    if alone:
        effort = replace(effort, pursuit=replace(effort.pursuit, rounds=0))

    def run_pass(step: float) -> EncodedObject:
        return one_pass(
            source,
            scene,
            piloted,
            effort,
            step,
            threads=workers,
            progress=context.progress,
            parameter_share=settings.parameter_share,
        )

    encoded = run_pass(left.step) if alone and settings.target != "psnr" else search(run_pass, settings, counts)
    figures = diagnostics(encoded, counts)
    parts = write_residual(context.output.folder, encoded, stamp=context.stamp, report=figures)
    bits = 8 * parts["total"] / max(1, counts["pixels"])
    return {**figures, "bytes": parts, "bits_per_pixel": bits, "economy": economy(decision)}


def left_by_model(source: "ArtifactSource", scene: CodedScene, piloted: Pilot) -> Left:
    """What the model alone leaves of the pictures, on tiles in even steps."""
    design, tiles = piloted.design, []
    there = [tile for tile in range(source.tiles) if piloted.refined[tile] is not None]
    if not design.model:
        return Left(0.0, 1.0, 0)
    for tile in there[:: max(1, len(there) // SAMPLE_TILES)]:
        pixels = source.pixels(tile)
        seen = see(pixels, source.surface(tile), design)
        maps, order = piloted.refined[tile].maps, seen.feet.order
        for index, component in enumerate(design.components):
            left = seen.values[index] - seen.feet.look_up(model_of(maps, seen, scene, design, component))
            tiles.append((left, pixels.observation[order], pixels.s[order], pixels.t[order]))
    return what_is_left(tiles)


class ArtifactSource:
    """Tiles of the texels and reflection artifacts, without held-out views."""

    def __init__(self, texels: Texels, parameters: ParameterMaps, settings: ResidualSettings):
        self.texels, self.parameters = texels, parameters
        self.tiles = texels.tiles
        apart = settings.components == "auto" and {"diffuse", "specular"} <= set(texels.components)
        self.components = ("diffuse", "specular") if apart else ("total",)
        without = set(settings.hold_out) | set(texels.hold_out)
        self.kept = np.array([view not in without for _ in texels.lights for view in texels.views])

    def pixels(self, tile: int) -> Pixels:
        """Object pixels of a tile, in the capture's encoding."""
        parts = [self.texels.samples(component, tile) for component in self.components]
        kept = self.kept[parts[0].observation]
        values = tuple(encode(part.values[kept], self.texels.encoding).astype(np.float32) for part in parts)
        return Pixels(parts[0].observation[kept], parts[0].s[kept], parts[0].t[kept], values)

    def surface(self, tile: int) -> Surface:
        """Geometry of a tile."""
        return Surface(*self.texels.geometry(tile))

    def maps(self, tile: int) -> Maps:
        """Parameters as the reflection stage fitted them."""
        fitted = self.parameters.read(tile)
        return Maps(fitted.kd, fitted.ks, fitted.sigma)

    def counts(self) -> dict[str, int]:
        """pixels: object pixels coded; visible, samples: texel samples seen and in all, channels counted."""
        pixels, visible = 0, 0
        for tile in range(self.tiles):
            pixels += int(self.kept[self.texels.samples(self.components[0], tile).observation].sum())
            visible += int(np.count_nonzero(self.texels.visible(tile)[self.kept]))
        channels = channels_of(self.texels) * len(self.components)
        every = self.tiles * self.texels.size**2 * len(self.kept)
        return {"pixels": pixels, "visible": visible * channels, "samples": every * channels}


def channels_of(texels: Texels) -> int:
    """Number of channels of the store."""
    return texels.channels if isinstance(texels.channels, int) else len(texels.channels)


def scene_of(texels: Texels, lighting: dict) -> CodedScene:
    """Camera centres and lamps of every observation, light by light."""
    lamps = Lighting.from_dict(lighting)
    pairs = [(camera, light) for light in range(len(texels.lights)) for camera in texels.cameras]
    return CodedScene(
        np.array([camera.centre for camera, _ in pairs]), [lamps.lamp(camera, light) for camera, light in pairs]
    )


def design_of(texels: Texels, components: tuple[str, ...], settings: ResidualSettings) -> Design:
    """What the settings and the capture determine before anything is measured."""
    return Design(
        tile_size=texels.size,
        views=len(texels.views),
        lights=len(texels.lights),
        channels=channels_of(texels),
        full_turn=bool(texels.full_turn),
        encoding=texels.encoding,
        components=components,
        wavelet=settings.wavelet,
        levels=settings.levels,
        mirrored=settings.mirrored,
        view_transform=settings.view_transform,
        light_transform=settings.light_transform,
        arcs=settings.arcs,
        model=settings.model,
    )


def search(run_pass, settings: ResidualSettings, counts: dict[str, int]) -> EncodedObject:
    """The pass that meets the target."""
    if settings.target == "step":
        return find_step(run_pass, lambda point: 0.0, 0.0, start=settings.amount, tolerance=1.0, passes=1)
    goals = {
        "bits_per_pixel": settings.amount * counts["pixels"] / 8,
        "bytes": settings.amount,
        "kept": settings.amount * counts["visible"],
        "kept_of_all": settings.amount * counts["samples"],
    }

    def value(point: Point) -> float:
        if settings.target == "psnr":
            return point.psnr_db / 8.6859
        return math.log(max(1, point.kept if settings.target.startswith("kept") else point.bytes))

    goal = settings.amount / 8.6859 if settings.target == "psnr" else math.log(max(1.0, goals[settings.target]))
    return find_step(run_pass, value, goal, start=0.08, tolerance=settings.tolerance, passes=settings.passes)


def diagnostics(encoded: EncodedObject, counts: dict[str, int]) -> dict:
    """Figures of the pass that is stored; decibels over object pixels, full scale 1."""
    samples = encoded.pixels * encoded.design.channels
    empty = [not any(len(s) for s in tile[1:]) for tile in encoded.streams]
    return {
        "step": encoded.design.step,
        "parameter_steps": list(encoded.design.parameter_steps),
        "psnr_db": psnr(encoded.error, samples),
        "model_psnr_db": psnr(encoded.model_error, samples),
        "kept": encoded.kept,
        "kept_of_visible": encoded.kept / max(1, counts["visible"]),
        "kept_of_all": encoded.kept / max(1, counts["samples"]),
        "pixels": encoded.pixels,
        "tiles": len(encoded.streams),
        "empty_tiles": int(sum(empty)),
        "curve": [point.as_dict() for point in encoded.curve],
    }
