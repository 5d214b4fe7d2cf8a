"""Separate the object from the background in a photograph.

The background's colours are learnt from the border of the picture. Where a colour goes darker without changing its
hue (a shadow on a coloured cloth) it is still background. The outline runs where
the object covers half a pixel.
"""

from dataclasses import dataclass

import numpy as np


def nearest_colour(lab, centres, inverses, lowest, out):
    """Lower `out` (n,) to the smallest Mahalanobis distance of colours lab (n, 3) float32 to clusters.

    centres (k, 3), inverses (k, 3, 3), lowest (k,) float64: a cluster's colour may be scaled by lowest to 1, by the
    factor that fits best.
    """
    for centre, inverse, least in zip(centres, inverses, lowest, strict=True):
        root = np.linalg.cholesky(inverse).astype(np.float32)
        colours, middle = lab @ root, np.float32(centre) @ root
        if least < 1:
            middle = np.clip(colours @ middle / (middle @ middle), np.float32(least), np.float32(1))[:, None] * middle
        x, y, z = np.square(colours - middle).T
        np.minimum(out, np.sqrt(x + y + z), out=out)


BORDER = 0.06
"""Width of the border that is taken for background, of the picture's shorter side."""
CLUSTERS = 8  # colours of a background
NEAR = 1.5
"""Distance (in spreads of the background) below which a hole is background."""
LOWEST_LEVEL, HIGHEST_LEVEL = 1.5, 6.0
REACH_PX = 2
HALF = 127  # largest cover of the background
DARKEST_RIM = 0.1
"""Smallest share of the light a little further inside to which the object's rim is taken to darken."""
RIM_ROOT = 0.5  # square root of the rim's depth, pixels
ROUND, ROUND_VARIANCE = 0.5, 0.05
"""Slope expected, of that of a round part whose rim is black, and the variance of roots that it counts for."""
SHADOW = 0.55
"""Cube root of the smallest share of the light that a shadow leaves."""
WORKING_PIXELS = 1_000_000
"""Larger pictures are segmented at a coarser scale, then refined along the outline only."""


@dataclass(frozen=True)
class Silhouette:
    """The silhouette of one picture."""

    mask: np.ndarray  # (rows, columns) bool
    cover: np.ndarray  # (rows, columns) uint8, share of each pixel that the object covers, 255: all
    # median colour difference of the outline's two sides, in spreads of the background (below 2 the outline is a guess)
    separation: float
    parts: int  # connected parts kept
    dropped: np.ndarray  # (rows, columns) bool, small parts that were removed: dust, or the object cut off by a shadow
    holes: int  # pixels of background visible through the object


def inside_of(silhouette: np.ndarray) -> np.ndarray:
    """Find the pixels (rows, columns) bool inside a silhouette, of bool (inside) or uint8 (cover)."""
    return silhouette > HALF if silhouette.dtype == np.uint8 else silhouette


def display(linear: np.ndarray) -> np.ndarray:
    """Convert linear values (rows, columns, channels) to an sRGB picture (rows, columns, 3) uint8.

    Bright parts are just below white; channels beyond three are dropped, one is repeated.
    """
    from nishiki.colour.colour import encode

    channels = linear[..., :3] if linear.shape[-1] >= 3 else linear[..., :1].repeat(3, axis=-1)
    white = float(np.percentile(channels[::4, ::4], 99.5)) or 1.0
    scale = 1.0 / max(white, 1e-9)
    return np.round(255 * encode(np.clip(channels * scale, 0, 1).astype(np.float32), "srgb")).astype(np.uint8)


def segment(picture: np.ndarray, *, background: str = "auto") -> Silhouette:
    """Find the silhouette of the object in picture (rows, columns, 3) uint8 sRGB.

    background: what is behind it: 'dark', 'bright', 'blue', 'green', or 'auto' for whatever the border shows.
    """
    import cv2

    shrink = min(1.0, np.sqrt(WORKING_PIXELS / (picture.shape[0] * picture.shape[1])))
    small = picture
    if shrink < 1:
        size = (round(picture.shape[1] * shrink), round(picture.shape[0] * shrink))
        small = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
    colours = background_colours(small, background)
    distance = background_distance(small, colours)
    mask, _, dropped, _ = tidy(cv2.GaussianBlur(distance, (0, 0), 0.8) > best_level(distance), distance)
    cover = cover_of(small, mask)
    mask, parts, crumbs, holes = tidy(cover > HALF, distance)
    dropped, separation = dropped | crumbs, _separation(mask, distance)
    if shrink < 1:
        dropped = cv2.resize(dropped.astype(np.uint8), picture.shape[1::-1], interpolation=cv2.INTER_NEAREST) > 0
        soft = cv2.resize(mask.astype(np.float32), picture.shape[1::-1], interpolation=cv2.INTER_LINEAR)
        cover = cover_of(picture, soft > 0.5, reach=int(np.ceil((REACH_PX + 1) / shrink)))
        mask = cover > HALF
    cover = np.where(mask == (cover > HALF), cover, mask * np.uint8(255))
    return Silhouette(mask, cover, separation, parts, dropped & ~mask, holes)


def live_area(picture: np.ndarray) -> tuple[slice, slice]:
    """Find rows and columns of a picture without the black strips that some cameras leave along the edges.

    Where it is mostly black just within the widest strip, too, the background is black, and there are none.
    """
    bright = picture.max(axis=-1)
    limit = 0.15 * np.percentile(bright[::4, ::4], 90)
    within = bright[tuple(slice(size // 12, size - size // 12) for size in bright.shape)]
    if np.mean(np.concatenate([within[0], within[-1], within[:, 0], within[:, -1]]) < limit) > 0.5:
        return slice(0, len(bright)), slice(0, bright.shape[1])
    dead_rows = np.percentile(bright, 90, axis=1) < limit
    dead_columns = np.percentile(bright, 90, axis=0) < limit

    def span(dead: np.ndarray) -> slice:
        # Strips are narrow: a dark half of the picture is background, not a strip. argmin is 0 where all are dead.
        most = max(1, len(dead) // 12)
        return slice(int(np.argmin(dead[:most])), len(dead) - int(np.argmin(dead[::-1][:most])))

    return span(dead_rows), span(dead_columns)


def _lab(picture: np.ndarray) -> np.ndarray:
    """Convert to CIE L + 16, a, b (float32): proportional to the cube root of light, so that a shadow is a factor."""
    import cv2

    lab = cv2.cvtColor(picture.astype(np.float32) / 255, cv2.COLOR_RGB2LAB)
    lab[..., 0] += 16
    return lab


@dataclass(frozen=True)
class Colours:
    """Clusters of the background's colours."""

    centres: np.ndarray  # (n, 3), inverse covariances (n, 3, 3) in L + 16, a, b
    inverses: np.ndarray
    coloured: np.ndarray  # (n,) bool: far enough from grey to distinguish a shadow from a grey object
    area: tuple[slice, slice]  # live part of the picture


def background_colours(picture: np.ndarray, background: str) -> Colours:
    """Group the colours along a picture's border into few clusters; drop small ones (a corner of the object)."""
    import cv2

    area = live_area(picture)
    lab = _lab(picture[area])
    width = max(2, round(BORDER * min(lab.shape[:2])))
    ring = np.ones(lab.shape[:2], bool)
    ring[width:-width, width:-width] = False
    samples = lab[ring]
    fitting = _fits(samples, background)
    if fitting.sum() > 50:
        samples = samples[fitting]
    samples = np.ascontiguousarray(samples[:: max(1, len(samples) // 20000)])
    samples = np.repeat(samples, 2, axis=0) if len(samples) == 1 else samples  # one row is read as one column
    clusters = min(CLUSTERS, len(samples))
    cv2.setRNGSeed(1)
    stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 30, 0.1)
    _, labels, _ = cv2.kmeans(samples, clusters, None, stop, 2, cv2.KMEANS_PP_CENTERS)
    labels = labels.ravel()
    centres, inverses = [], []
    for k in range(clusters):
        mine = samples[labels == k]
        if len(mine) < 0.02 * len(samples):
            continue
        covariance = np.cov(mine.T) if len(mine) > 3 else np.zeros((3, 3))
        # Floors: 8-bit codes, video noise and the width of a cluster that k-means cut out of a gradient.
        covariance = 4 * covariance + np.diag([3.0, 2.0, 2.0]) ** 2
        centres.append(mine.mean(axis=0))
        inverses.append(np.linalg.inv(covariance))
    lightness, a, b = np.array(centres, np.float64).T
    return Colours(np.array(centres, np.float64), np.array(inverses), np.hypot(a, b) > 0.15 * lightness, area)


def _fits(samples: np.ndarray, background: str) -> np.ndarray:
    """Mark the border's colours (n, 3) that can be the named background."""
    light, a, b = samples.T
    named = {"dark": light < 61, "bright": light > 71, "blue": (b < -5) & (b < a), "green": (a < -5) & (a < b)}
    return named.get(background, np.ones(len(samples), bool))


def background_distance(picture: np.ndarray, colours: Colours) -> np.ndarray:
    """Compute the distance (rows, columns) float32 to the nearest background colour, in its spreads, up to 100.

    A coloured background may be in shadow: its colour is scaled down to 0.55 (a sixth of the light) where that fits.
    """
    lab = _lab(picture)
    nearest = np.full(lab.shape[:2], np.float32(100.0))
    lowest = np.where(colours.coloured, SHADOW, 1.0)
    nearest_colour(lab.reshape(-1, 3), colours.centres, colours.inverses, lowest, nearest.reshape(-1))
    rows, columns = colours.area
    nearest[: rows.start] = nearest[rows.stop :] = 0
    nearest[:, : columns.start] = nearest[:, columns.stop :] = 0
    return nearest


def best_level(distance: np.ndarray) -> float:
    """Find the distance, 1.5 to 6 spreads, at which the outline between background and object is steepest.

    Slopes are those of the distance's logarithm, so that neither side's scale counts.
    """
    import cv2

    smooth = np.log(cv2.GaussianBlur(np.minimum(distance, 30), (0, 0), 1.0) + 0.5)
    slope = np.hypot(cv2.Sobel(smooth, cv2.CV_32F, 1, 0), cv2.Sobel(smooth, cv2.CV_32F, 0, 1))
    levels = np.linspace(*np.log([LOWEST_LEVEL + 0.5, HIGHEST_LEVEL + 0.5]), 11)
    step = 0.5 * (levels[1] - levels[0])
    means = [slope[np.abs(smooth - level) < step] for level in levels]
    steepness = np.array([gradients.mean() if gradients.size > 20 else 0.0 for gradients in means])
    return float(np.exp(levels[int(np.argmax(steepness))]) - 0.5)


def cover_of(picture: np.ndarray, mask: np.ndarray, *, reach: int = REACH_PX) -> np.ndarray:
    """Compute the share of each pixel that the object covers, (rows, columns) uint8, 255: all.

    Lenses and video mix the colours of both sides over a few pixels, and a small share of the object suffices to look
    unlike the background. Within `reach` pixels of the outline the share is estimated from the colours of both sides.
    The background's is the mean a little further outside. The object's is carried on to the outline: a surface that
    turns away from a lamp beside the camera darkens as the square root of the depth d within the outline, so that
    a + b sqrt(d) is fitted a little further inside; a plain mean there would take the dark rim for background and put
    the outline too far inside. A thin part has no range of depths: there the fit is drawn to half of the slope with
    which the rim were black. Depths count from the outline, so this is done twice. Without an inside the mask stays.
    """
    from nishiki.colour.colour import decode

    cover = mask * np.uint8(255)
    if not mask.any():
        return cover
    rows, columns = (np.flatnonzero(mask.any(axis=axis)) for axis in (1, 0))
    area = tuple(slice(max(0, each[0] - 6 * reach), each[-1] + 1 + 6 * reach) for each in (rows, columns))
    light = decode(picture[area].astype(np.float32) / 255, "srgb")
    for _ in range(2):
        cover[area] = _estimate_cover(light, cover[area] > HALF, reach)
    return cover


def _estimate_cover(light: np.ndarray, mask: np.ndarray, reach: int) -> np.ndarray:
    """Make one step of `cover_of`, on linear light (rows, columns, 3)."""
    import cv2

    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1, 2 * reach + 1))
    solid = mask.astype(np.uint8)
    inner, outer = cv2.erode(solid, kernel), 1 - cv2.dilate(solid, kernel)
    root = inner * np.sqrt(cv2.distanceTransform(solid, cv2.DIST_L2, cv2.DIST_MASK_PRECISE))

    def around(values: np.ndarray) -> np.ndarray:
        return cv2.GaussianBlur(values.astype(np.float32), (0, 0), 1.5 * reach)

    inside, outside = around(inner), around(outer)
    known = (inner == 0) & (outer == 0) & (inside > 0.03) & (outside > 0.03)
    weight = inside[known, None]
    back = around(light * outer[..., None])[known] / outside[known, None]
    mean_root = around(root)[known, None] / weight
    variance = np.maximum(around(root * root)[known, None] / weight - mean_root**2, 0)
    mean = around(light * inner[..., None])[known] / weight
    slope = around(light * root[..., None])[known] / weight - mean_root * mean
    slope = (slope + ROUND_VARIANCE * ROUND * mean / mean_root) / (variance + ROUND_VARIANCE)
    at_rim = mean - slope * (mean_root - RIM_ROOT)
    across = mean - back
    square = np.einsum("nk,nk->n", across, across)
    apart = np.maximum(square, 1e-9)
    darkened = np.clip(np.einsum("nk,nk->n", at_rim - back, across) / apart, DARKEST_RIM, 1)
    cover = np.einsum("nk,nk->n", light[known] - back, across) / (apart * darkened)
    out = mask * np.uint8(255)
    out[known] = np.where(square > 1e-4, np.round(255 * np.clip(cover, 0, 1)), out[known])
    return out


def tidy(mask: np.ndarray, distance: np.ndarray) -> tuple[np.ndarray, int, np.ndarray, int]:
    """Keep the large parts of a mask, and fill its holes where they do not look like background.

    Parts below a fiftieth of the largest are dust on the background; a hole is real where at least four pixels of it
    have background colour in the median. Returns mask, parts, the mask of those dropped, pixels of holes left open.
    """
    import cv2

    count, labels, facts, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=4)
    if count < 2:
        return mask, 0, mask, 0
    areas = facts[1:, cv2.CC_STAT_AREA]
    kept = np.concatenate([[False], areas * 50 >= areas.max()])
    out, dropped = kept[labels], mask & ~kept[labels]
    count, labels, facts, _ = cv2.connectedComponentsWithStats((~out).astype(np.uint8), connectivity=4)
    rim = np.unique(np.concatenate([labels[0], labels[-1], labels[:, 0], labels[:, -1]]))
    open_pixels = 0
    for hole in set(range(1, count)) - set(rim.tolist()):
        here = labels == hole
        area = int(facts[hole, cv2.CC_STAT_AREA])
        if area >= 4 and np.median(distance[here]) < NEAR:
            open_pixels += area
        else:
            out[here] = True
    return out, int(kept.sum()), dropped, open_pixels


def _separation(mask: np.ndarray, distance: np.ndarray) -> float:
    import cv2

    kernel, solid = np.ones((5, 5), np.uint8), mask.astype(np.uint8)
    within, beyond = mask & (cv2.erode(solid, kernel) == 0), ~mask & (cv2.dilate(solid, kernel) > 0)
    if not within.any() or not beyond.any():
        return 0.0
    return float(np.median(distance[within]) - np.median(distance[beyond]))
