"""Parameters of an object without gloss: Lambert's term alone, in one pass over its texels."""

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from nishiki.brdf.texels import texel_fit
from nishiki.brdf.texels.fill import fill
from nishiki.brdf.texels.object_fit import DEFAULT_SIGMA, ObjectFit
from nishiki.brdf.texels.parameters import Parameters, TexelFlag
from nishiki.brdf.texels.tile import Capture, Tile


def fit_lambert(
    read: Callable[[int], Tile],
    tiles: Iterable[int],
    capture: Capture,
    write: Callable[[int, Parameters], None],
    *,
    threads: int = 1,
) -> ObjectFit:
    """Fit all tiles, as `object_fit.fit_object` does: K_d by weighted least squares (Miyazaki et al. 2007, section
    3.1), K_s = 0, one sigma.

    Of tiles with components the total is fitted: without gloss it is the diffuse one.
    """
    tiles = list(tiles)

    def finish(number: int) -> tuple[np.ndarray, float, int]:
        tile = read(number).joined
        parameters = lambert_tile(tile, capture)
        write(number, parameters)
        inside = (parameters.flags & TexelFlag.OUTSIDE) == 0
        counted = [int(np.sum(inside & ((parameters.flags & bit) != 0))) for bit in (TexelFlag.UNSEEN, TexelFlag.ONCE)]
        return np.array([int(inside.sum()), *counted]), *capture.squares(parameters, tile)

    with ThreadPoolExecutor(max(threads, 1)) as pool:
        finished = list(pool.map(finish, tiles))
    counts = sum((counted for counted, _, _ in finished), np.zeros(3, np.int64))
    squares, samples = (sum(tile_sums[k] for tile_sums in finished) for k in (1, 2))
    texels = int(counts[0])
    return ObjectFit(
        texels=texels,
        samples=samples,
        psnr_db=-10 * float(np.log10(max(squares / samples, 1e-30))) if samples else None,
        highlight_share=0.0,
        filled_share=0.0,
        unseen_share=float(counts[1]) / max(texels, 1),
        once_share=float(counts[2]) / max(texels, 1),
        median_sigma=None,
        scatter_log_sigma=0.0,
        scatter_ks=0.0,
        noise=float(np.sqrt(squares / samples)) if samples else 0.0,
    )


def lambert_tile(tile: Tile, capture: Capture) -> Parameters:
    """Parameters of one tile; K_d of texels that nothing shows comes from their neighbours."""
    total, _ = capture.observe(tile)
    shape, channels = tile.inside.shape, tile.values.shape[-1]
    kd = np.zeros((tile.inside.size, channels), np.float32)
    kd[total.texel] = texel_fit.lambert(total)
    flags = np.full(tile.inside.size, TexelFlag.UNSEEN | TexelFlag.NO_HIGHLIGHT, np.uint8)
    flags[total.texel] = TexelFlag.NO_HIGHLIGHT | np.where(total.seen < 2, TexelFlag.ONCE, 0)
    flags[~tile.inside.ravel()] = TexelFlag.OUTSIDE
    flags = flags.reshape(shape)
    known = (flags & (TexelFlag.OUTSIDE | TexelFlag.UNSEEN)) == 0
    filled = fill(kd.reshape(*shape, channels), known)
    return Parameters(filled, np.zeros_like(filled), np.full(shape, DEFAULT_SIGMA, np.float32), flags)
