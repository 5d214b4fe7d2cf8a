"""The paper's counting: texels of every patch over the views, and the error against the share of coefficients kept.

Nothing is quantised or entropy coded here, parameters and mesh are not counted: this is the domain of the published
figures (Miyazaki et al. 2007, figures 11 to 14). What a picture costs and how good it is, see `residual_pictures`.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from time import perf_counter

import numpy as np
from eigen_texture import eigen_patch, kept_components
from texel_domain import keep_by_pursuit, keep_largest

from nishiki.atlas.store import Texels
from nishiki.brdf.texels.model import CaptureLamps
from nishiki.brdf.texels.parameters import ParameterMaps
from nishiki.codec.allocate import principal_channels
from nishiki.codec.design import arc_views, extent_of, view_matrix
from nishiki.codec.tile_code import TileSurface, predict_texels
from nishiki.codec.transform import Block, plane_transform
from nishiki.colour.colour import encode

SHARES = (0.5, 0.05, 0.02)
DEFAULT = "bior4.4"


@dataclass(frozen=True)
class Stack:
    """One patch: captured and model (channels, lights, views, T, T) float32 in the capture's encoding, zero where not
    visible; visible (lights, views, T, T) bool; inside (T, T) bool."""

    captured: np.ndarray
    model: np.ndarray
    visible: np.ndarray
    inside: np.ndarray


def stacks(
    texels: Texels, parameters: ParameterMaps, lighting: CaptureLamps, component: str, every: int
) -> Iterator[Stack]:
    """Every patch, or every so-manieth, with its model."""
    lights, views = len(texels.lights), len(texels.views)
    cameras = list(texels.cameras)
    lamps = [lighting.lamp(cameras[v], light) for light in range(lights) for v in range(views)]
    centres = np.array([cameras[v].centre for _ in range(lights) for v in range(views)])
    for tile in range(0, texels.tiles, every):
        positions, normals, inside = texels.geometry(tile)
        visible = texels.visible(tile) & inside
        maps = parameters.read(tile)
        model = predict_texels(
            maps.kd, maps.ks, maps.sigma, TileSurface(positions, normals, inside), centres, lamps, texels.encoding,
            component=component,
        )  # fmt: skip
        captured = np.moveaxis(encode(texels.read(component, tile), texels.encoding), -1, 0)
        shape = (captured.shape[0], lights, views, *captured.shape[-2:])
        seen = visible.reshape(shape[1:])
        yield Stack(
            (captured.reshape(shape) * seen).astype(np.float32), (model.reshape(shape) * seen).astype(np.float32),
            seen, inside,
        )  # fmt: skip


@dataclass(frozen=True)
class Method:
    """model: whether the model is taken off first; views: the transform along the views; wavelet, levels: of the
    patch's plane; colour: whether the channels are decorrelated; pursued: whether the coefficients are chosen and
    solved for as the coder does, in blocks of the views and texels that it codes; else the largest of all views are
    kept, with zeros where nothing is visible."""

    name: str
    model: bool
    wavelet: str = DEFAULT
    levels: int = 4
    views: str = "db2"
    colour: bool = True
    pursued: bool = True


METHODS = (
    Method("wavelet_texture", True),
    Method("wavelet_texture_paper", True, "db2", 3, "db2", colour=False, pursued=False),
    Method("wavelet_texture_db2", True, "db2"),
    Method("image_based", False),
    Method("image_based_paper", False, "db2", 3, "db2", colour=False, pursued=False),
    Method("wavelet_2d", False, views="none"),
    Method("wavelet_2d_paper", False, "db2", 3, "none", colour=False, pursued=False),
)


def psnr(error: float, count: int) -> float:
    """Decibels below full scale of a sum of squares over `count` samples."""
    return float(-10 * np.log10(max(error / count, 1e-30)))


def cropped(patch: Stack, full_turn: bool) -> Stack:
    """The views and the rectangle of texels that the coder would code."""
    seen = patch.visible.any(axis=(0, 2, 3))
    extent = extent_of(seen, patch.inside, full_turn=full_turn, arcs=True)
    views = arc_views(extent.start, extent.length, len(seen))
    return Stack(
        *(values[:, :, views][..., *extent.texels] for values in (patch.captured, patch.model)),
        patch.visible[:, views][..., *extent.texels],
        patch.inside[extent.texels],
    )


def wavelets(patches: list[Stack], method: Method, full_turn: bool = True) -> Iterator[dict]:
    """Rows of one wavelet method at every share, counted of all and of the visible samples."""
    counts = list(budgets(patches))
    channels, lights = patches[0].captured.shape[:2]
    patches = [cropped(patch, full_turn) if method.pursued else patch for patch in patches]
    residuals = [patch.captured - patch.model if method.model else patch.captured for patch in patches]
    mix = np.eye(channels)
    if method.colour:
        moments = sum(np.einsum("clvij,dlvij->cd", r, r, dtype=np.float64) for r in residuals)
        mix = principal_channels(moments)
    residuals = [np.tensordot(mix, r, 1).astype(np.float32) for r in residuals]
    blocks = [
        Block(
            plane_transform(method.wavelet, *patch.inside.shape, method.levels),
            view_matrix(method.views, patch.visible.shape[1]),
            view_matrix("cosine", lights),
        )
        for patch in patches
    ]
    visible = [patch.visible for patch in patches]
    keep = keep_by_pursuit if method.pursued else partial(keep_largest, rounds=0)
    for counted, share, count in counts:
        start = perf_counter()
        kept = keep(residuals, visible, blocks, count=count)
        middle = perf_counter()
        for block, coefficients in zip(blocks, kept.coefficients, strict=True):
            block.inverse(coefficients)
        yield row(method.name, counted, share, psnr(kept.error, samples(patches)[1]), middle - start, middle)


def row(method: str, counted: str, share: float, decibels: float, encode_s: float, since: float) -> dict:
    """One JSON line of the texel domain; `since`: when decoding began."""
    return {
        "domain": "texels",
        "method": method,
        "counted": counted,
        "kept": share,
        "psnr_db": round(decibels, 2),
        "encode_s": round(encode_s, 3),
        "decode_s": round(perf_counter() - since, 3),
    }


def samples(patches: list[Stack]) -> tuple[int, int]:
    """Numbers of samples (texels x observations x channels): all of the surface, and the visible ones."""
    channels, lights, views = patches[0].captured.shape[:3]
    every = sum(int(patch.inside.sum()) for patch in patches) * lights * views * channels
    return every, sum(int(patch.visible.sum()) for patch in patches) * channels


def budgets(patches: list[Stack]) -> Iterator[tuple[str, float, int]]:
    """How many coefficients each share allows, counted of all samples as the paper does, and of the visible ones."""
    every, visible = samples(patches)
    for share in SHARES:
        yield "all", share, round(every * share)
        yield "visible", share, round(visible * share)


def eigen(patches: list[Stack]) -> Iterator[dict]:
    """Eigen-texture (no reflection model), one number stored counted as one coefficient kept."""
    channels = patches[0].captured.shape[0]
    start = perf_counter()
    tables, masks = [], []
    for patch in patches:
        count = patch.visible.shape[0] * patch.visible.shape[1]
        values = np.moveaxis(patch.captured, 0, -1).reshape(count, -1, channels)[:, patch.inside.ravel()]
        tables.append(values[:, None])
        masks.append(patch.visible.reshape(count, -1)[:, patch.inside.ravel()][:, None])
    found = [eigen_patch(table, mask, components=6) for table, mask in zip(tables, masks, strict=True)]
    spent = perf_counter() - start
    for counted, share, budget in budgets(patches):
        chosen, error, middle = kept_components(found, budget), 0.0, perf_counter()
        for patch, number, table, mask in zip(found, chosen, tables, masks, strict=True):
            difference = patch.decode(number).reshape(table.shape) - table
            error += float(np.sum(difference[mask] ** 2))
        yield row("eigen_texture", counted, share, psnr(error, samples(patches)[1]), spent, middle)


def model_only(patches: list[Stack]) -> dict:
    """The reflection model alone."""
    error = sum(float(np.sum((p.captured - p.model).astype(np.float64) ** 2)) for p in patches)
    return row("model_only", "all", 0.0, psnr(error, samples(patches)[1]), 0.0, perf_counter())


def curves(
    texels: Texels, parameters: ParameterMaps, lighting: CaptureLamps, component: str = "total", *, every: int = 1
) -> Iterator[dict]:
    """All rows of the texel domain of one component; every: of so many patches one."""
    patches = [patch for patch in stacks(texels, parameters, lighting, component, every) if patch.visible.any()]
    yield {**model_only(patches), "patches": len(patches)}
    for method in METHODS:
        yield from wavelets(patches, method, bool(texels.full_turn))
    yield from eigen(patches)
