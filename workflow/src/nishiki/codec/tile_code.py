"""Code one tile from pixels to integers, and decode integers to texels."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial

import numpy as np

from nishiki.brdf.texels.model import ViewLamp
from nishiki.codec.design import Design, Extent, extent_of
from nishiki.codec.parameters import (
    TileMaps,
    TileSurface,
    decode_parameters,
    encode_parameters,
    model_factors,
    predict_texels,
    refine,
    texel_weights,
)
from nishiki.codec.rate import expected_bits, quantise
from nishiki.codec.solve import Footprints, Operator, Pursuit, curvatures, pursue, samples_of


@dataclass(frozen=True)
class Pixels:
    """The object pixels of one tile.

    observation (n,) int32, s, t (n,) float32, values (n, C) float32 in the capture's encoding; saturated
    (n,) bool: pixels that the residual reproduces but no parameter is fitted to (None: no pixel).
    """

    observation: np.ndarray
    s: np.ndarray
    t: np.ndarray
    values: np.ndarray
    saturated: np.ndarray | None = None


@dataclass(frozen=True)
class CodedScene:
    """The centres (M, 3) of the cameras and the lamps of every observation, light by light."""

    centres: np.ndarray
    lamps: Sequence[ViewLamp]


@dataclass(frozen=True)
class Effort:
    """The effort of coding."""

    pursuit: Pursuit = field(default_factory=Pursuit)  # of the residual's solver
    price: float = 0.05  # of a bit, in squared steps at a typical pixel
    refinements: int = 12  # of the parameters in the pictures
    threshold: float = 0.6  # of the parameters, in their steps
    dead_zone: float = 0.5  # of the residual, in steps
    rounding: float = 0.42  # fraction added before the whole part is taken
    gloss: bool = True  # whether K_s is moved in the pictures at all


@dataclass(frozen=True)
class Typical:
    """Values of typical texels of the object."""

    parameters: tuple[float, float, float]  # weights of kd, ks (mean over channels) and log sigma
    density: float  # mean weight that pixels give a texel


@dataclass(frozen=True)
class CodedTile:
    """A coded tile.

    parameters (C, 3, rows, columns) int32; residual (C, lights * views, rows, columns) int32; extent;
    pixels; error, model_error: sums of squares over pixels and channels of the decoded tile and of its model alone.
    """

    parameters: np.ndarray
    residual: np.ndarray
    extent: Extent
    pixels: int
    error: float
    model_error: float


@dataclass(frozen=True)
class Refined:
    """Parameters of a tile solved for in the pictures, and the effect of an error in them."""

    maps: TileMaps
    weights: TileMaps


@dataclass(frozen=True)
class Seen:
    """The pixels' view of a tile.

    Its extent, the observations of the block, the surface in the extent, footprints in the block, the pixel values (C,
    n), and usable (n,) bool: pixels that parameters are fitted to.
    """

    extent: Extent
    observations: np.ndarray
    surface: TileSurface
    feet: Footprints
    values: np.ndarray
    usable: np.ndarray


def see(pixels: Pixels, surface: TileSurface, design: Design) -> Seen | None:
    """Find the extent and sort the pixels; None where no pixel sees the tile."""
    seen = np.bincount(pixels.observation % design.views, minlength=design.views) > 0
    if not seen.any():
        return None
    used = surface.inside.copy()
    s, t = (np.clip(v.astype(int), 0, design.tile_size - 2) for v in (pixels.s, pixels.t))
    for i in (0, 1):
        for j in (0, 1):
            used[s + i, t + j] = True
    extent = extent_of(seen, used, full_turn=design.full_turn, arcs=design.arcs)
    observations = extent.observations(design.views, design.lights)
    place = np.full(design.lights * design.views, -1)
    place[observations] = np.arange(len(observations))
    shape = (len(observations), extent.rows, extent.columns)
    feet = Footprints.of(place[pixels.observation], pixels.s - extent.row, pixels.t - extent.column, shape)
    values = np.ascontiguousarray(pixels.values.T[:, feet.order], np.float32)
    cropped = TileSurface(*(a[extent.texels] for a in (surface.positions, surface.normals, surface.inside)))
    usable = np.ones(len(feet.order), bool) if pixels.saturated is None else ~pixels.saturated[feet.order]
    return Seen(extent, observations, cropped, feet, values, usable)


def refine_tile(seen: Seen, maps: TileMaps, scene: CodedScene, design: Design, effort: Effort) -> Refined:
    """Refine a tile's parameters so that the model's pictures are right; zero where the design has no model."""
    maps = TileMaps(*(np.nan_to_num(a[seen.extent.texels].astype(np.float32)) for a in (maps.kd, maps.ks, maps.sigma)))
    if not design.model:
        zero = np.zeros_like(maps.kd)
        return Refined(TileMaps(zero, zero, np.ones_like(maps.sigma)), TileMaps(zero, zero, zero[..., 0]))
    centres, lamps = scene.centres[seen.observations], [scene.lamps[o] for o in seen.observations]
    factors = model_factors(design.channels, seen.surface, centres, lamps)
    effort_of = {"iterations": effort.refinements, "gloss": effort.gloss, "usable": seen.usable}
    maps = refine(maps, factors, seen.feet, seen.values, design.encoding, **effort_of)
    return Refined(maps, texel_weights(maps, factors, seen.feet, design.encoding))


def encode_tile(
    seen: Seen,
    refined: Refined,
    scene: CodedScene,
    design: Design,
    effort: Effort,
    typical: Typical,
    start: np.ndarray | None = None,
) -> CodedTile:
    """Encode a tile as integers at the design's steps: parameters, then the residual against their decoded values.

    start: residual coefficients of an earlier solution at a similar step, to go on from.
    """
    parameters = np.zeros(design.parameter_shape(seen.extent), np.int32)
    maps = refined.maps
    if design.model:
        weights, arguments = refined.weights, (design, seen.extent, effort.threshold)
        parameters = encode_parameters(maps, weights, typical.parameters, *arguments)
        maps = decode_parameters(parameters, design, seen.extent)
    block = design.block(seen.extent)
    operator = Operator.of_pixels(seen.feet)
    curvature, price = curvatures(block, seen.feet.density()), effort.price * design.step**2 * typical.density
    bits = partial(expected_bits, step=design.step, levels=block.plane.levels)
    left = seen.values - seen.feet.look_up(model_of(maps, seen, scene, design)) if design.model else seen.values
    data = (design.mix() @ left).astype(np.float32)
    found = pursue(data, operator, block, curvature, price=price, bits=bits, effort=effort.pursuit, start=start)
    integers = quantise(found, design.step, dead_zone=effort.dead_zone, rounding=effort.rounding)
    after = data - operator.look(samples_of(block, (integers * np.float32(design.step)).astype(np.float32)))
    errors = [float(np.sum(a.astype(np.float64) ** 2)) for a in (after, data)]
    residual = integers.reshape(design.residual_shape(seen.extent))
    return CodedTile(parameters, residual, seen.extent, seen.values.shape[1], *errors)


def model_of(maps: TileMaps, seen: Seen, scene: CodedScene, design: Design) -> np.ndarray:
    """Predict the model's texels (C, observations, rows, columns) float32 in a block, in the capture's encoding."""
    lamps = [scene.lamps[o] for o in seen.observations]
    arguments = (seen.surface, scene.centres[seen.observations], lamps, design.encoding)
    return predict_texels(maps.kd, maps.ks, maps.sigma, *arguments)


def decode_residual(integers: np.ndarray, design: Design, extent: Extent) -> np.ndarray:
    """Decode integers to texels (C, lights * views, rows, columns) float32 of that shape."""
    coefficients = (integers * np.float32(design.step)).astype(np.float32).reshape(design.shape(extent))
    samples = samples_of(design.block(extent), coefficients)
    return np.tensordot(design.mix().T.astype(np.float32), samples, 1)
