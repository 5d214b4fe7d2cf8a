"""Fit the residual of the reflection model to the photographs, and code it."""

import json
import math
from dataclasses import asdict, replace
from functools import partial

import numpy as np

from nishiki.artifacts.stage import Context
from nishiki.atlas.store import Texels
from nishiki.brdf.texels.model import CaptureLamps
from nishiki.brdf.texels.parameters import ParameterMaps
from nishiki.codec.allocate import (
    LARGEST_DB,
    SLOPE,
    EncodedObject,
    Pilot,
    RatePoint,
    find_step,
    one_pass,
    pilot,
    point_of,
    psnr,
    slope_of,
)
from nishiki.codec.compact import cost_of
from nishiki.codec.design import Design
from nishiki.codec.pictures import SIDE, PictureSource, attach_strayed, pack_strayed
from nishiki.codec.solve import Pursuit
from nishiki.codec.store import FRAME, frame_bytes, write_residual
from nishiki.codec.tile_code import CodedScene, Effort, Pixels, TileMaps, TileSurface, model_of, see
from nishiki.colour.colour import encode
from nishiki.errors import UserError
from nishiki.evaluate.object_photographs import Photographs
from nishiki.geometry.camera import Camera, load_cameras
from nishiki.geometry.mesh import Mesh
from nishiki.geometry.placement import outline_of, remove_specks
from nishiki.model_selection.decision import economy
from nishiki.model_selection.sufficient import Left, decide_residual, model_suffices, summarise_residual
from nishiki.stages.residual import ResidualSettings
from nishiki.threads import threads

SAMPLE_TILES = 24  # that decide whether the model suffices
SEARCH_TILES = 16  # on which the step is sought before the first pass over all
SEARCH_TOLERANCE = 0.05  # of the logarithm of the bytes; samples of that size miss it by 2 to 14 %
SEARCH_SHARE = 0.25  # of the tiles: with fewer in all, a search on some saves nothing
FIRST_STEP = 0.08  # of the quantiser, from which the search sets out
PARAMETER_SHARE = 1.2  # parameter steps against those of equal effect on pictures
COARSER = 5
"""Factor on the step of parameters beside pictures: finer ones took bytes that served captured views better."""
SEARCH_VIEWS = 6  # on which the step of pictures is sought
UNSURE_DB = 1.0  # of the quality found on them
LATER_DB = 0.5  # that passes after the first add at most at equal bytes; .2 to .4 were measured
BYTES_DB = 3.5  # that a factor e of the bytes adds; 3.0 to 4.3 were measured
RIM = 2  # pixels by which pictures of the surface are carried on
DECIBELS = 20 / math.log(10)  # of a factor e in amplitude


def run(context: Context) -> dict:
    """Refine the parameters, find the step for the target, store the pass that meets it."""
    settings = context.settings
    inputs, texels = context.inputs, Texels(context.inputs["texels"].folder)
    cameras, reflection = load_cameras(inputs["cameras"].path("cameras.json")), inputs["object_brdf"]
    mesh, fitted = Mesh.load(reflection.path("mesh.npz")), json.loads(reflection.path("object_brdf.json").read_text())
    texels.turn_normals(mesh)
    # what a renderer needs beside the residual
    others = cost_of(mesh, texels.atlas.chart, cameras, fitted["lighting"], {}).parts
    source = ArtifactSource(texels, ParameterMaps(reflection.folder), settings)
    lamps = CaptureLamps.from_dict(fitted["lighting"])
    pairs = [(camera, light) for light in range(len(texels.lights)) for camera in texels.cameras]
    scene = CodedScene(np.array([camera.centre for camera, _ in pairs]), [lamps.lamp(*pair) for pair in pairs])
    pursuit = Pursuit(rounds=settings.rounds)
    effort = Effort(pursuit=pursuit, refinements=settings.refinements, gloss=fitted["specular"])
    workers = threads()
    design = Design(  # what settings and capture determine before anything is measured
        tile_size=texels.size,
        views=len(texels.views),
        lights=len(texels.lights),
        channels=texels.channels,
        full_turn=bool(texels.full_turn),
        encoding=texels.encoding,
        wavelet=settings.wavelet,
        levels=settings.levels,
        view_transform=settings.view_transform,
        arcs=settings.arcs,
        model=settings.model,
    )
    piloted = pilot(source, scene, design, effort, threads=workers, progress=context.progress)
    counts = source.counts()

    left = left_by_model(source, scene, piloted)
    decision = decide_residual(left, settings.target, settings.amount, settings.sufficient)
    context.progress.tell(str(decision))
    alone = settings.sufficient == "auto" and model_suffices(left, settings.target, settings.amount)
    parameters_alone = replace(effort, pursuit=replace(effort.pursuit, rounds=0))

    def run_pass(
        step: float, earlier: EncodedObject | None = None, tiles: list[int] | None = None, *, spent: Effort = effort
    ) -> EncodedObject:
        found = piloted.at_step(step, parameter_share=PARAMETER_SHARE)
        progress = context.progress
        return one_pass(source, scene, found, spent, threads=workers, progress=progress, tiles=tiles, earlier=earlier)

    pictures = None
    if alone and settings.target != "psnr":
        encoded = run_pass(left.step, spent=parameters_alone)
    else:
        goal = goal_of(settings, counts, others, texels.tiles)
        miss = partial(miss_target, goal=goal, target=settings.target)
        start, slope, expected = FIRST_STEP, SLOPE, None
        if settings.passes > 1 and count_seen(piloted) * SEARCH_SHARE >= SEARCH_TILES:
            start, slope, expected = search_step(run_pass, miss, piloted, SEARCH_TILES, (start, settings.passes))
        coarse, by_bytes = None, not alone and settings.target != "psnr"
        photographed = picture_source(context, texels, source.kept) if by_bytes else None
        if photographed is not None:
            parts, sums = zip(*(strayed_parts(mesh, *view, photographed) for view in enumerate(cameras)), strict=True)
            strayed, missed = pack_strayed(parts), np.sum(sums, axis=0)
            expected = rate_over_outlines(expected, missed)
            most = rate_over_outlines(LARGEST_DB, missed) if expected is None else expected
            coarse, room = run_pass(COARSER * start, spent=parameters_alone), math.exp(goal) - sum(map(len, strayed))
            pictures = code_pictures(
                (photographed, scene, design, effort), settings, start, room - coarse.bytes, expected
            )
        encoded, alike = coarse, expected  # decibels of texels of as many bytes
        if pictures is None or point_of(pictures).psnr_db < most + UNSURE_DB:

            def rate(point: RatePoint) -> float:
                """Estimate the decibels over the outlines at the target's bytes."""
                return rate_over_outlines(point.psnr_db, missed) - BYTES_DB * miss(point)

            def compete(point: RatePoint) -> bool:
                return pictures is None or rate(point) > point_of(pictures).psnr_db - LATER_DB

            encoded = find_step(run_pass, miss, start=start, slope=slope, passes=settings.passes, compete=compete)
            alike = None if pictures is None else rate(point_of(encoded))
            if alike is not None and point_of(pictures).psnr_db > alike:
                encoded, alike = coarse, max(alike, expected or 0)  # a first pass is not all that texels reach
            else:
                pictures = None
    figures: dict = {**diagnostics(encoded, counts), "pictures": None}
    if pictures is not None:
        coded, curve = point_of(pictures), [replace(p, bytes=p.bytes + encoded.bytes) for p in pictures.curve]
        figures["curve"], pictures = [asdict(point) for point in curve], attach_strayed(pictures, strayed)
        figures |= {"psnr_db": coded.psnr_db, "pictures": asdict(coded) | {"equal_bytes_psnr_db": alike}}
    parts = write_residual(context.output.folder, encoded, pictures, stamp=context.stamp, report=figures)
    bits = 8 * parts["total"] / max(1, counts["pixels"])
    stored = {f"residual_{name}": size for name, size in parts.items() if name != "total"}
    everything = {**others, **stored, "total": sum(others.values()) + parts["total"]}
    return {
        **figures,
        "bytes": parts,
        "renderer_bytes": everything,
        "bits_per_pixel": bits,
        "economy": economy(decision),
    }


def picture_source(context: Context, texels: Texels, kept: np.ndarray) -> PictureSource | None:
    """Return the photographs within the outlines as tiles, without held-out views; None where outlines are missing."""
    photographs, views = Photographs(context.inputs), len(texels.views)
    outlines = {view: photographs.silhouette(view) for view in np.flatnonzero(kept[:views]).tolist()}
    if any(outline is None for outline in outlines.values()):
        return None

    def read(view: int) -> tuple[np.ndarray, np.ndarray]:
        linear, coded = [], outlines[view]
        for light in range(len(texels.lights)):
            picture, valid = photographs.read(view, light)
            coded = coded & (valid | np.isfinite(picture).all(axis=-1) & (picture > 0).any(axis=-1))
            linear.append(picture)
        return encode(np.nan_to_num(np.array(linear)), texels.encoding).astype(np.float32), coded

    return PictureSource(read, tuple(outlines), views, photographs.views.shape, texels.channels)


def strayed_parts(
    mesh: Mesh, view: int, camera: Camera, photographed: PictureSource
) -> tuple[np.ndarray, tuple[int, int, float]]:
    """Select (rows, columns) bool: a view's outline RIM pixels beyond the surface, the surface one pixel beyond it.

    Also return the number of the outline's pixels, of those beyond the surface, which texels leave black, and the sum
    of their squared codes (means of lights and channels).
    """
    import cv2

    if view not in photographed.views:
        return np.zeros(photographed.shape, bool), (0, 0, 0.0)
    values, inside = photographed.read(view)
    surface, outline = (each.astype(np.uint8) for each in (outline_of(mesh, camera), inside))
    missed = inside & (cv2.dilate(surface, np.ones((2 * RIM + 1, 2 * RIM + 1), np.uint8)) == 0)
    bare = (surface > 0) & (cv2.dilate(outline, np.ones((3, 3), np.uint8)) == 0)
    strayed = remove_specks(missed | bare)
    squares = float(np.square(values[:, missed]).mean(axis=(0, 2)).sum()) if missed.any() else 0.0
    return strayed, (int(inside.sum()), int(missed.sum()), squares)


def rate_over_outlines(decibels: float | None, missed: np.ndarray) -> float | None:
    """Convert decibels over the pixels of texels to those over the outlines; missed: sums of `strayed_parts`."""
    pixels, beyond, squares = missed
    if decibels is None or not beyond:
        return decibels
    return psnr(((pixels - beyond) * 10 ** (-decibels / 10) + squares) / pixels, 1)


def code_pictures(
    coder: tuple[PictureSource, CodedScene, Design, Effort], settings: ResidualSettings, start: float, room: float,
    expected: float | None,
) -> EncodedObject | None:  # fmt: skip
    """Code the captured views as pictures in `room` bytes; None where texels are expected to be more accurate.

    start: the step to begin with; expected: decibels that texels alone reach over the pixels that they cover, if known.
    """
    (photographed, scene, design, effort), room = coder, room - FRAME
    if room <= 0:
        return None
    plain = replace(design, tile_size=SIDE, model=False)
    piloted = pilot(photographed, scene, plain, effort, threads=threads())

    def run_pass(step: float, earlier: EncodedObject | None, tiles: list[int] | None = None) -> EncodedObject:
        found = piloted.at_step(step)
        return one_pass(photographed, scene, found, effort, threads=threads(), tiles=tiles, earlier=earlier)

    miss, passes = partial(miss_target, goal=math.log(room), target="bytes"), settings.passes
    start, slope, decibels = search_step(run_pass, miss, piloted, SEARCH_VIEWS, (start, passes))
    if expected is not None and decibels < expected - UNSURE_DB:
        return None
    return find_step(run_pass, miss, start=start, passes=passes, slope=slope)


def left_by_model(source: "ArtifactSource", scene: CodedScene, piloted: Pilot) -> Left:
    """Compute the residual of the model alone in the pictures, on tiles in even steps."""
    design, tiles = piloted.design, []
    there = [tile for tile in range(source.tiles) if piloted.refined[tile] is not None]
    if not design.model:
        return Left(0.0, 1.0, 0)
    for tile in there[:: max(1, len(there) // SAMPLE_TILES)]:
        pixels = source.pixels(tile)
        seen = see(pixels, source.surface(tile), design)
        left = seen.values - seen.feet.look_up(model_of(piloted.refined[tile].maps, seen, scene, design))
        order = seen.feet.order[seen.usable]
        tiles.append((left[:, seen.usable], pixels.observation[order], pixels.s[order], pixels.t[order]))
    return summarise_residual(tiles)


class ArtifactSource:
    """Tiles of the texels and reflection artifacts, without held-out views."""

    def __init__(self, texels: Texels, parameters: ParameterMaps, settings: ResidualSettings):
        self.texels, self.parameters = texels, parameters
        self.tiles = texels.tiles
        without = set(settings.hold_out) | set(texels.hold_out)
        self.kept = np.array([view not in without for _ in texels.lights for view in texels.views])

    def pixels(self, tile: int) -> Pixels:
        """Return object pixels of a tile, in the capture's encoding."""
        # states of a polariser saturate one by one: what their sum would have been is not known
        found = self.texels.samples("total", tile, saturated=tuple(self.texels.components) == ("total",))
        kept = self.kept[found.observation]
        values = encode(found.values[kept], self.texels.encoding).astype(np.float32)
        return Pixels(found.observation[kept], found.s[kept], found.t[kept], values, ~found.valid[kept])

    def surface(self, tile: int) -> TileSurface:
        """Return geometry of a tile."""
        return TileSurface(*self.texels.geometry(tile))

    def maps(self, tile: int) -> TileMaps:
        """Return parameters as fitted by the reflection stage."""
        fitted = self.parameters.read(tile)
        return TileMaps(fitted.kd, fitted.ks, fitted.sigma)

    def counts(self) -> dict[str, int]:
        """Count pixels: object pixels coded; visible, samples: visible and all texel samples, channels counted."""
        pixels, visible = 0, 0
        for tile in range(self.tiles):
            pixels += len(self.pixels(tile).s)
            visible += int(np.count_nonzero(self.texels.visible(tile)[self.kept]))
        channels, every = self.texels.channels, self.tiles * self.texels.size**2 * len(self.kept)
        return {"pixels": pixels, "visible": visible * channels, "samples": every * channels}


def goal_of(settings: ResidualSettings, counts: dict[str, int], others: dict[str, int], tiles: int) -> float:
    """Convert the target to the units of `measured`; UserError for a total that the other parts exceed."""
    if settings.target == "psnr":
        return settings.amount / DECIBELS
    amounts = {
        "bits_per_pixel": settings.amount * counts["pixels"] / 8,
        "bytes": settings.amount,
        "total_bytes": settings.amount - sum(others.values()) - frame_bytes(tiles),
    }
    if amounts[settings.target] <= 0:
        sizes = ", ".join(f"{name} {size}" for name, size in others.items())
        raise UserError(
            f"residual.amount: expected a total above {sum(others.values()) + frame_bytes(tiles)} bytes, found "
            f"{settings.amount:.0f}; without any residual the object takes {sizes}, header and index "
            f"{frame_bytes(tiles)}. Remedy: a larger amount, or fewer triangles (mesh.deviation_px)"
        )
    return math.log(max(1.0, amounts[settings.target]))


def miss_target(point: RatePoint, goal: float, target: str) -> float:
    """Return the quantity of the target, a number that falls with the step, less its goal."""
    return (point.psnr_db / DECIBELS if target == "psnr" else math.log(max(1, point.bytes))) - goal


def count_seen(piloted: Pilot) -> int:
    """Count the tiles that any pixel sees."""
    return sum(refined is not None for refined in piloted.refined)


def search_step(run_pass, miss, piloted: Pilot, count: int, effort: tuple[float, int]) -> tuple[float, float, float]:
    """Find the step for the first pass over all tiles on `count` of them, the slope of the target, their decibels.

    effort: the step to begin with, and the most passes.
    """
    (start, passes), tiles = effort, piloted.sample(count)
    sampled = find_step(
        lambda step, earlier: run_pass(step, earlier, tiles), miss, start=start, passes=passes,
        tolerance=SEARCH_TOLERANCE, share=len(tiles) / count_seen(piloted),
    )  # fmt: skip
    slope = slope_of([point.step for point in sampled.curve], [miss(point) for point in sampled.curve])
    return sampled.design.step, slope, point_of(sampled).psnr_db


def diagnostics(encoded: EncodedObject, counts: dict[str, int]) -> dict:
    """Return figures of the stored pass; decibels over object pixels, full scale 1."""
    samples = encoded.pixels * encoded.design.channels
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
        "empty_tiles": sum(not any(len(s) for s in tile[1:]) for tile in encoded.streams),
        "curve": [asdict(point) for point in encoded.curve],
    }
