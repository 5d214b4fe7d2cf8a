"""Code one tile from pixels to integers, and decode integers to texels.

A picture is a bilinear look-up among texels, each encode(I_d + I_s) plus its residual; so the model is evaluated and
encoded at the texels too. A tile's reflection parameters are solved for and coded first, then the residual against
the model of the decoded ones.

K_d and K_s enter the model linearly. Values fitted to point-sampled texels are blurred twice by interpolation; here
they are corrected until the *picture* of the model is right, through the renderer's own look-up. That is where most of
the texture goes, once instead of once a view.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial

import numpy as np

from nishiki.brdf.slopes import GRAZING
from nishiki.brdf.texels.model import ViewLamp, facet_lobe, factors, predict
from nishiki.codec.design import Design, Extent, extent_of
from nishiki.codec.rate import expected_bits, quantise
from nishiki.codec.solve import Footprints, Operator, Pursuit, curvatures, pursue, samples_of, solve
from nishiki.codec.transform import Block
from nishiki.colour.colour import encode, encoding_slope


@dataclass(frozen=True)
class TileSurface:
    """Geometry of a tile: positions, normals (T, T, 3) float32 in the object's frame, inside (T, T) bool."""

    positions: np.ndarray
    normals: np.ndarray
    inside: np.ndarray


def predict_texels(
    kd: np.ndarray,
    ks: np.ndarray,
    sigma: np.ndarray,
    surface: TileSurface,
    centres: np.ndarray,
    lamps: Sequence[ViewLamp],
    encoding: str,
) -> np.ndarray:
    """Compute encode(model) (C, observations, T, T) float32 of kd, ks (T, T, C), sigma (T, T), per camera and lamp.

    centres (observations, 3).
    """
    out = np.empty((kd.shape[-1], len(lamps), *sigma.shape), np.float32)
    for o, (centre, lamp) in enumerate(zip(centres, lamps, strict=True)):
        parts = predict(kd, ks, sigma, surface.positions, surface.normals, centre, lamp)
        out[:, o] = np.moveaxis(encode(sum(parts), encoding), -1, 0)
    return out


WIDTH_FLOOR = 1e-3  # radians
PRIOR = 0.1
"""Weight of the fitted K_s in its refinement, in largest weights of K_d: pixels on a lobe's flank tell little of it."""
GLOSS_WEIGHT = 0.3
"""Least weight of a texel in the coding of K_s and sigma, in typical ones: other views show its highlight."""


@dataclass(frozen=True)
class TileMaps:
    """A tile's maps: kd, ks (T, T, C) float32, sigma (T, T) float32, radians.

    As weights: the squared effect of changes on the pictures, per unit of K_d, of K_s and of log sigma.
    """

    kd: np.ndarray
    ks: np.ndarray
    sigma: np.ndarray


@dataclass(frozen=True)
class Factors:
    """The model apart from its parameters, in each observation."""

    # (C, M, rows, columns) multiplies K_d; strength times the lobe at squared_angle, both (M, rows, columns),
    # multiplies K_s
    irradiance: np.ndarray
    strength: np.ndarray
    squared_angle: np.ndarray

    def lobe(self, sigma: np.ndarray) -> np.ndarray:
        """Compute the factor (M, rows, columns) of K_s."""
        return self.strength * facet_lobe(self.squared_angle, sigma.astype(np.float32))


def model_factors(channels: int, surface: TileSurface, centres, lamps: Sequence[ViewLamp]) -> Factors:
    """Compute a tile's factors for every observation."""
    shape = surface.inside.shape
    irradiance = np.empty((channels, len(lamps), *shape), np.float32)
    strength, squared_angle = np.empty((2, len(lamps), *shape), np.float32)
    for o, (centre, lamp) in enumerate(zip(centres, lamps, strict=True)):
        body, angles = factors(surface.positions, surface.normals, centre, lamp, channels)
        irradiance[:, o] = np.moveaxis(body, -1, 0)
        strength[o] = angles[..., 0] / np.maximum(angles[..., 1], np.float32(GRAZING))
        squared_angle[o] = angles[..., 2]
    return Factors(*(np.nan_to_num(part) for part in (irradiance, strength, squared_angle)))


def refine(
    maps: TileMaps,
    factors: Factors,
    feet: Footprints,
    values: np.ndarray,
    encoding: str,
    *,
    iterations: int,
    gloss: bool = True,
    usable: np.ndarray | None = None,
) -> TileMaps:
    """Find the K_d and K_s whose picture is nearest to pixel values (C, n) in the capture's encoding.

    Accelerated gradient with each texel's own step; K_d, K_s stay at 0 or above. Texels that no pixel sees stay as
    given, and so does sigma: a width that follows every pixel's noise costs more than it explains. K_s is held by PRIOR
    to the given one, which follows from many texels. gloss: whether K_s moves. usable (n,) bool: pixels that count;
    None: all.
    """
    weights, sigma = texel_weights(maps, factors, feet, encoding), np.clip(maps.sigma, WIDTH_FLOOR, np.float32(1e3))
    lobe = factors.lobe(sigma)
    by_kd, by_ks, *held = (np.moveaxis(each, -1, 0) for each in (weights.kd, weights.ks, maps.kd, maps.ks))
    body = float(by_kd.max(initial=0))
    prior = np.float32(PRIOR * body)
    paces = _pace(by_kd, body), _pace(by_ks, max(body, float(by_ks.max(initial=0))), prior) * np.float32(gloss)
    held = ahead = [each.astype(np.float32) for each in held]
    given, momentum = held[1], 1.0
    for _ in range(iterations):
        linear = factors.irradiance * ahead[0][:, None] + lobe[None] * ahead[1][:, None]
        left = values - feet.look_up(encode(linear, encoding))
        if usable is not None:
            left[:, ~usable] = 0
        back = feet.spread(left)
        if encoding != "linear":
            back *= encoding_slope(linear, encoding)
        # the downhill directions of half the squared error of the pictures
        downhill = np.sum(back * factors.irradiance, axis=1), np.einsum("comn,omn->cmn", back, lobe)
        downhill[1][...] -= prior * (ahead[1] - given)
        new = [np.maximum(at + pace * slope, 0) for at, pace, slope in zip(ahead, paces, downhill, strict=True)]
        following = (1 + np.sqrt(1 + 4 * momentum**2)) / 2
        ahead = [n + np.float32((momentum - 1) / following) * (n - h) for n, h in zip(new, held, strict=True)]
        held, momentum = new, following
    return TileMaps(np.moveaxis(held[0], 0, -1), np.moveaxis(held[1], 0, -1), sigma)


def texel_weights(maps: TileMaps, factors: Factors, feet: Footprints, encoding: str) -> TileMaps:
    """Bound the error's curvature at the given parameters by its diagonal, off-diagonal terms added."""
    density = feet.density()
    kd, ks = np.moveaxis(maps.kd, -1, 0), np.moveaxis(maps.ks, -1, 0)
    lobe = factors.lobe(maps.sigma)
    rise = encoding_slope(factors.irradiance * kd[:, None] + lobe[None] * ks[:, None], encoding) ** 2 * density[None]
    by_d = np.sum(rise * factors.irradiance**2, axis=1)
    by_s = np.sum(rise * lobe[None] ** 2, axis=1)
    ratio = factors.squared_angle / (4 * maps.sigma**2)
    bend = lobe * 4 * ratio / (1 + ratio)
    by_w = np.sum(rise * (bend[None] * ks[:, None]) ** 2, axis=(0, 1))
    return TileMaps(np.moveaxis(by_d, 0, -1), np.moveaxis(by_s, 0, -1), by_w)


def _pace(weight: np.ndarray, largest: float, prior: float = 0.0) -> np.ndarray:
    """Compute each texel's step: half the inverse curvature (two parameters share the data), 0 where nothing is seen.

    prior: curvature of a prior, added. largest: curvature below a fiftieth of which a texel moves no faster. Of K_s it
    is not below that of K_d: where no view comes near the highlight, K_s would grow by many powers of ten to explain
    what the model lacks.
    """
    return np.where(weight > 0, 1 / (2 * np.maximum(weight, max(0.02 * largest, 1e-20)) + prior), 0).astype(np.float32)


ITERATIONS = 60  # of the solver


def encode_parameters(
    maps: TileMaps, weights: TileMaps, typical: tuple[float, ...], design: Design, extent: Extent, threshold: float
):
    """Encode cropped maps: kd, ks, log sigma (channel 0) as multiples of their steps, (C, 3, rows, columns) int32.

    typical: weight of a typical texel for each group; texels weigh in with their own up to that, so that what the
    pictures do not show is filled with whatever is cheapest; those with a K_d by GLOSS_WEIGHT at least. threshold: in
    steps.
    """
    out = np.zeros(design.parameter_shape(extent), np.int32)
    block = Block(design.parameter_plane(extent), np.eye(1), np.eye(1))
    width = np.log(np.clip(maps.sigma, WIDTH_FLOOR, 1e3))
    quantities = np.moveaxis(maps.kd, -1, 0), np.moveaxis(maps.ks, -1, 0), width[None]
    groups = zip(quantities, (weights.kd, weights.ks, weights.sigma[..., None]), typical, strict=True)
    for group, (values, weight, usual) in enumerate(groups):
        mix, mean = design.parameter_mix(group), design.parameter_mean(group)
        planes = np.tensordot(mix, values - mean[:, None, None], 1).astype(np.float32)
        share = np.clip(weight.mean(axis=-1) / usual, 0, 1) if usual > 0 else np.zeros(weight.shape[:2])
        if group and usual > 0:
            share = np.where(weights.kd.max(axis=-1) > 0, np.maximum(share, GLOSS_WEIGHT), share)
        step = design.parameter_steps[group]
        root = np.sqrt(share.astype(np.float32))[None, None]
        weigh = partial(np.multiply, root)
        operator = Operator(weigh, weigh, float(share.max(initial=0)))
        shape, data = (len(planes), 1, 1, *planes.shape[1:]), planes[:, None] * root
        found = solve(data, operator, block, shape, threshold=threshold * step, iterations=ITERATIONS)
        out[: len(planes), group] = quantise(found, step)[:, 0, 0]
    return out


def decode_parameters(values: np.ndarray, design: Design, extent: Extent) -> TileMaps:
    """Decode cropped maps from integers (C, 3, rows, columns).

    K_d and K_s are held at 0 and above, sigma above 0.001 rad and below 1e3.
    """
    block = Block(design.parameter_plane(extent), np.eye(1), np.eye(1))
    planes = []
    for group in range(3):
        count = 1 if group == 2 else design.channels
        coefficients = (values[:count, group] * np.float32(design.parameter_steps[group])).astype(np.float32)
        samples = block.inverse(coefficients[:, None, None])[:, 0, 0]
        mixed = np.tensordot(design.parameter_mix(group).T, samples, 1) + design.parameter_mean(group)[:, None, None]
        planes.append(np.moveaxis(mixed, 0, -1).astype(np.float32))
    width = np.exp(np.clip(planes[2][..., 0], np.log(WIDTH_FLOOR), np.log(1e3)))
    return TileMaps(np.maximum(planes[0], 0), np.maximum(planes[1], 0), width)


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
