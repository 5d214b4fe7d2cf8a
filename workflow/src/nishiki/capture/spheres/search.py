"""Search mirror balls in photographs under moving lamps, and keep and draw what was found.

On a ball that mirrors, every lamp has a small highlight of its own. A pixel there is bright in one photograph or in few
and dark in all others, so what the room reflects, the ground and matt surfaces drop out by the rank of each pixel's
values over time. A ball is a place near which most photographs have such a highlight, at places that differ.

How well lamps explain the photographs of a scene: Lambert's law on blocks of pixels beside the mirror spheres.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from nishiki.capture.spheres.optics import LampImage, SphereCamera, outline_points
from nishiki.capture.spheres.outline import Circle, Outline
from nishiki.capture.taking import SATURATED, channel_names, full_scale_of, read_grey
from nishiki.errors import UserError
from nishiki.formats.images import read_codes, read_header
from nishiki.threads import in_threads

MARGIN = 1.65  # of the radius: half the side of the crop around a sphere
LEAST_LAMPS = 4  # that must be measured, photographs with a highlight on a ball

Crop = tuple[tuple[slice, slice], np.ndarray]
"""Rows and columns of the photographs, and their light there (n, rows, columns)."""


@dataclass(frozen=True)
class SphereInput:
    """Input of a measurement on spheres."""

    photographs: Sequence[Path]  # one a lamp
    # sequence of (row, column, radius): circles in pixels to a quarter of the radius; empty: spheres are searched
    seeds: Sequence[tuple[float, float, float]] = ()
    mask: Path | None = None  # picture that is non-zero on the spheres
    count: int | None = None  # number of spheres that must be found; None: as many as there are
    # focal length in pixels; infinite: seen from afar; None: from Exif or the agreement of the spheres
    focal_px: float | None = None
    radius_mm: float | None = None  # of every sphere
    object_height_mm: float = 0.0  # of the object's surface above the plane on which the spheres lie
    board: Sequence[Path] = ()  # photographs of a flat board in the object's plane, one a lamp in the same order
    compare: Path | None = None  # a lights file


@dataclass
class Findings:
    """Intermediate results; filled step by step, so that a failure can be drawn."""

    mean: np.ndarray  # (rows, columns) float32: of all photographs, reduced, and the brightest of them
    brightest: np.ndarray  # (rows, columns) float32
    factor: float  # pixels of a photograph in a pixel of these
    camera: SphereCamera
    outlines: list[Outline] = field(default_factory=list)  # one a sphere
    # list of (picture, (column, row)): brightest of all photographs around each sphere, and the crop's corner
    crops: list[tuple[np.ndarray, tuple[int, int]]] = field(default_factory=list)
    # by (photograph, sphere); None where there is none
    highlights: dict[tuple[int, int], LampImage | None] = field(default_factory=dict)
    # list of (Circle, str): circles that were examined and why they are no mirror spheres
    rejected: list[tuple[Circle, str]] = field(default_factory=list)
    # reason by the name of each photograph whose lamp cannot be measured
    left_out: dict[str, str] = field(default_factory=dict)


class SpheresError(UserError):
    """No lamps could be measured; `findings` holds the results up to the failure."""

    def __init__(self, text: str, findings: Findings) -> None:
        super().__init__(text)
        self.findings = findings


def read_light(path: Path) -> np.ndarray:
    """Read the light (rows, columns) float32 of a photograph, 1 at full scale; of a JPEG, the square of its codes."""
    header = read_header(path)
    if header.kind != "jpeg":
        return read_grey(path) / np.float32(full_scale_of(path))
    light = read_codes(path, channel_names(header), header=header, luma=True)[..., 0] / np.float32(255)
    return light * light


def crop_around(circle: Sequence[float], shape: tuple[int, int]) -> tuple[slice, slice]:
    """Compute the rows and columns of the crop that holds a circle (column, row, radius) and its surroundings."""
    column, row, radius = circle[:3]
    reach = MARGIN * radius
    return (
        slice(max(0, int(row - reach)), min(shape[0], int(row + reach) + 2)),
        slice(max(0, int(column - reach)), min(shape[1], int(column + reach) + 2)),
    )


def cut_crop(crop: tuple[slice, slice], read: list[Crop]) -> np.ndarray | None:
    """Cut a crop (n, rows, columns) from one of those that were read; None where none contains it."""
    for outer, stack in read:
        if all(o.start <= c.start and c.stop <= o.stop for o, c in zip(outer, crop, strict=True)):
            rows, columns = (slice(c.start - o.start, c.stop - o.start) for o, c in zip(outer, crop, strict=True))
            return stack[:, rows, columns]
    return None


def corner_of(crop: tuple[slice, slice]) -> tuple[int, int]:
    """Return the column and the row of a crop's first pixel."""
    return crop[1].start, crop[0].start


def read_crops(photographs: Sequence[Path], crops: Sequence[tuple[slice, slice]]) -> list[np.ndarray]:
    """Read each photograph once, and cut the light (n, rows, columns) float32 of all photographs in each crop."""

    def cut(path: Path) -> list[np.ndarray]:
        light = read_light(path)
        return [light[crop].copy() for crop in crops]

    cuts = list(in_threads(cut, photographs, 2))
    return [np.array([each[k] for each in cuts]) for k in range(len(crops))]


GREEN, RED, GREY = (90, 220, 90), (255, 90, 40), (150, 150, 150)


def draw_findings(findings: Findings) -> np.ndarray:
    """Draw the brightest of all photographs (rows, columns, 3) uint8, reduced.

    Green: outlines of spheres, with their numbers; red: highlights; grey: examined circles that are none.
    """
    import cv2

    scale = min(1.0, SEARCH_SIDE / max(findings.brightest.shape))
    codes = cv2.resize(display_codes(findings.brightest), None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    factor = scale / findings.factor

    def place(points: np.ndarray) -> np.ndarray:
        return np.round(((points + 0.5) * factor - 0.5) * 16).astype(np.int32)

    for circle, _ in findings.rejected:
        rim = outline_points(np.array(circle[:3]), SphereCamera.of(*findings.brightest.shape))
        cv2.polylines(codes, [place(rim).reshape(-1, 1, 2)], True, GREY, 1, cv2.LINE_AA, 4)
    for k, outline in enumerate(findings.outlines):
        rim = outline_points(outline.parameters, findings.camera)
        cv2.polylines(codes, [place(rim).reshape(-1, 1, 2)], True, GREEN, 1, cv2.LINE_AA, 4)
        corner = tuple(int(v) for v in place(rim.max(axis=0)) // 16)
        cv2.putText(codes, str(k + 1), corner, cv2.FONT_HERSHEY_SIMPLEX, 0.5, GREEN, 1, cv2.LINE_AA)
    for highlight in findings.highlights.values():
        if highlight is not None:
            cv2.drawMarker(codes, tuple(int(v) for v in place(highlight.pixel) // 16), RED, cv2.MARKER_CROSS, 5, 1)
    return codes


def draw_sphere(findings: Findings, sphere: int, side: int = 480) -> np.ndarray:
    """Draw the brightest of all photographs around one sphere, with its outline and highlights: (.., .., 3) uint8."""
    import cv2

    brightest, corner = findings.crops[sphere]
    zoom = max(1, int(np.ceil(side / max(brightest.shape))))
    codes = cv2.resize(display_codes(brightest), None, fx=zoom, fy=zoom, interpolation=cv2.INTER_NEAREST)

    def place(points: np.ndarray) -> np.ndarray:
        return np.round(((np.atleast_2d(points) - corner + 0.5) * zoom - 0.5) * 16).astype(np.int32)

    curve = place(outline_points(findings.outlines[sphere].parameters, findings.camera))
    cv2.polylines(codes, [curve.reshape(-1, 1, 2)], True, GREEN, 1, cv2.LINE_AA, 4)
    for (_, k), highlight in findings.highlights.items():
        if k == sphere and highlight is not None:
            column, row = place(highlight.pixel)[0]
            cv2.drawMarker(codes, (int(column / 16), int(row / 16)), RED, cv2.MARKER_CROSS, 9, 1)
    return codes


def display_codes(light: np.ndarray) -> np.ndarray:
    """Convert light to grey codes (rows, columns, 3) uint8, brightened by a square root."""
    top = float(np.percentile(light, 99.8)) or 1.0
    return np.repeat((255 * np.sqrt(np.clip(light / top, 0, 1))).astype(np.uint8)[..., None], 3, axis=2)


SEARCH_SIDE = 1200.0  # pixels of the longer side of the reduced photographs, and of the picture on the page
SEARCH_PIXELS = 6e7  # of all reduced photographs together, which bounds the memory
LIT_SHARE = 0.2  # of the photographs that may be bright at a pixel of a mirror
LEAST_PEAK = 0.15  # of the brightest moving highlight, and of the median peak on a ball: below there is none
LEAST_SHARE = 0.5  # of the photographs that must have a highlight on a ball, and a lamp that is measured
BLUR = 0.7  # pixels; below, noise of single pixels makes highlights


@dataclass(frozen=True)
class Cluster:
    """Moving highlights near one place, one a photograph."""

    score: float  # share of the photographs with a highlight, less a tenth for each further highlight a photograph
    # (2,): of the smallest circle around the highlights (column, row), in pixels of the whole photographs
    centre: np.ndarray
    radius: float  # of that circle
    places: dict[int, np.ndarray]  # highlight (2,) by the photograph's number


@dataclass(frozen=True)
class Overview:
    """Reduced photographs: `stack` (n, rows, columns) float32, linear in light, 1 at full scale; pixels a pixel."""

    stack: np.ndarray
    factor: float


def read_overview(photographs: Sequence[Path], read: Callable[[Path], np.ndarray]) -> Overview:
    """Read all photographs reduced; `read` returns the light (rows, columns) of one."""
    import cv2

    first = read(photographs[0])
    factor = max(1.0, max(first.shape) / SEARCH_SIDE, (len(photographs) * first.size / SEARCH_PIXELS) ** 0.5)
    size = (round(first.shape[1] / factor), round(first.shape[0] / factor))
    reduced = in_threads(lambda path: cv2.resize(read(path), size, interpolation=cv2.INTER_AREA), photographs, 2)
    return Overview(np.array(list(reduced)), first.shape[1] / size[0])


def subtract_surroundings(stack: np.ndarray) -> np.ndarray:
    """Subtract from photographs (n, rows, columns) the light common to several lamps; negative where darker."""
    # A photograph may have been taken twice, or show another lamp as well.
    rank = len(stack) - 1 - max(2 if len(stack) >= 6 else 1, int(LIT_SHARE * len(stack)))
    rest = np.empty_like(stack)
    for top in range(0, stack.shape[1], 64):
        rows = slice(top, top + 64)
        rest[:, rows] = stack[:, rows] - np.partition(stack[:, rows], rank, axis=0)[rank]
    return rest


def find_moving_highlights(stack: np.ndarray) -> list[np.ndarray]:
    """Find small bright places that occur in few photographs: (m, 3) column, row and peak for each photograph."""
    import cv2

    smooth = np.array([cv2.GaussianBlur(picture, (0, 0), BLUR) for picture in stack])
    rest = np.maximum(subtract_surroundings(smooth), 0)
    least = LEAST_PEAK * rest.max()
    found = []
    for picture, own in zip(smooth, rest, strict=True):
        peak = (own >= cv2.dilate(own, np.ones((5, 5), np.uint8))) & (own > least) & (own > 0.5 * picture)
        # Compact: twice the mean of its surroundings at one of two scales.
        small, large = (own > times * cv2.blur(own, (side, side)) for side, times in ((13, 2.0), (33, 2.5)))
        row, column = np.nonzero(peak & (small | large))
        found.append(np.column_stack([column, row, own[row, column]]).astype(float))
    return found


def cluster_highlights(found: list[np.ndarray], overview: Overview) -> list[Cluster]:
    """Find discs in which most photographs have a highlight, the best first; none overlaps a better one."""
    import cv2

    shape, count = overview.stack.shape[1:], len(found)
    half = ((shape[0] + 1) // 2, (shape[1] + 1) // 2)
    distance, density = np.full((count, *half), 1e6, np.float32), np.zeros(half, np.float32)
    for i, places in enumerate(found):
        if len(places):
            column, row = (places[:, :2] / 2).astype(int).T
            free = np.ones(half, np.uint8)
            free[row, column] = 0
            np.add.at(density, (row, column), 1)
            distance[i] = 2 * cv2.distanceTransform(free, cv2.DIST_L2, 5)
    seeds = []
    radius = 4.0
    while radius < 0.35 * min(shape):
        side = 2 * int(radius / 2) + 1
        present = (distance <= radius).sum(axis=0).astype(np.float32)
        disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side)).astype(np.float32)
        crowd = cv2.filter2D(density, -1, disc, borderType=cv2.BORDER_CONSTANT) / np.maximum(present, 1)
        score = present / count - 0.1 * np.maximum(0, crowd - 1)
        smooth = cv2.GaussianBlur(score, (0, 0), max(1.0, side / 6))
        best = (present >= max(LEAST_LAMPS, LEAST_SHARE * count)) & (score > LEAST_SHARE - 0.05)
        best &= smooth >= cv2.dilate(smooth, np.ones((side, side), np.uint8))
        seeds += [(float(score[y, x]), radius, np.array([2.0 * x, 2.0 * y])) for y, x in np.argwhere(best)]
        radius *= 1.3
    clusters = []
    for score, radius, centre in seeds:
        cluster = _gather(found, score, centre, radius, overview.factor)
        if cluster is not None and cluster.radius > 2 * overview.factor:
            clusters.append(cluster)
    clusters.sort(key=lambda each: -each.score)
    chosen: list[Cluster] = []
    for each in clusters:
        if all(np.linalg.norm(each.centre - other.centre) > max(each.radius, other.radius) for other in chosen):
            chosen.append(each)
    return chosen


def _gather(found: list[np.ndarray], score: float, centre: np.ndarray, radius: float, factor: float) -> Cluster | None:
    """Collect the strongest highlight of each photograph near a place, and refine the place by them."""
    import cv2

    places: dict[int, np.ndarray] = {}
    for _ in range(4):
        places = {}
        for i, highlights in enumerate(found):
            near = highlights[np.linalg.norm(highlights[:, :2] - centre, axis=1) <= 1.3 * radius]
            if len(near):
                places[i] = near[np.argmax(near[:, 2]), :2]
        if len(places) < LEAST_LAMPS:
            return None
        middle, reach = cv2.minEnclosingCircle(np.array(list(places.values()), np.float32))
        centre, radius = np.array(middle), max(reach, 2.0)
    return Cluster(
        score, (centre + 0.5) * factor - 0.5, radius * factor, {i: (p + 0.5) * factor - 0.5 for i, p in places.items()}
    )


BLOCK = 8  # pixels of the side of a block
LEAST_BLOCKS = 40  # of the picture
DARK = 0.05  # of the bright blocks: darker ones tell nothing
SHADOW = 0.1  # of a block's brightest photograph: below it may lie in shadow
TRIALS = 59  # orders of the lamps that are tried
MOST_RESIDUAL = 0.3  # relative
MOST_CHANCE = 0.05  # probability
LEAST_Z = 0.2  # of normals whose slopes count


@dataclass(frozen=True)
class SceneFit:
    """Agreement of lamps with a scene."""

    residual: float  # share of the squared light that Lambert's law leaves
    by_chance: float  # share of random orders of the lamps that leave as little
    # angle of the mean slope: a surface that returns to its height at the edge of the photograph is level on average
    tilt_deg: float

    @property
    def agrees(self) -> bool:
        """Return whether the lamps explain the scene, and no other order of them does so."""
        return self.residual < MOST_RESIDUAL and self.by_chance < MOST_CHANCE


def bright_blocks(stack: np.ndarray, free: np.ndarray) -> np.ndarray | None:
    """Average the light (n, blocks) of bright blocks beside the spheres; None where they are few.

    stack (n, rows, columns): light of the photographs, 1 at full scale; free (rows, columns): pixels of the scene.
    """
    rows, columns = (side // BLOCK for side in free.shape)

    def split(picture: np.ndarray) -> np.ndarray:
        return picture[..., : rows * BLOCK, : columns * BLOCK].reshape(-1, rows, BLOCK, columns, BLOCK)

    light = split(stack).mean(axis=(2, 4))[:, np.all(split(free), axis=(2, 4))[0]]
    brightest = light.max(axis=0) if light.size else np.zeros(0)
    if len(brightest) >= LEAST_BLOCKS:
        light = light[:, (brightest > DARK * np.percentile(brightest, 99)) & (brightest < SATURATED)]
    return light if light.shape[1] >= LEAST_BLOCKS else None


def residual_of(light: np.ndarray, directions: np.ndarray) -> float:
    """Compute the share of the squared light of blocks (n, blocks) that Lambert's law does not explain.

    A turn of all lamps does not change it.
    """
    shares = light / np.linalg.norm(light, axis=0)
    across = np.linalg.qr(directions)[0]
    return float(1 - ((across.T @ shares) ** 2).sum() / shares.shape[1])


def fit_scene(light: np.ndarray | None, directions: np.ndarray) -> SceneFit | None:
    """Fit normals to blocks (n, blocks) of a scene under distant lamps (n, 3); None without blocks."""
    if light is None or len(directions) < 4:
        return None
    random = np.random.default_rng(0)
    residual = residual_of(light, directions)
    others = [residual_of(light, random.permutation(directions)) for _ in range(TRIALS)]
    used = light > SHADOW * light.max(axis=0)
    matrix = np.einsum("nb,ni,nj->bij", used, directions, directions) + 1e-6 * np.eye(3)
    normals = np.linalg.solve(matrix, np.einsum("nb,nb,ni->bi", used, light, directions)[..., None])[..., 0]
    normals /= np.maximum(np.linalg.norm(normals, axis=1), 1e-12)[:, None]
    slopes = normals[:, :2] / np.maximum(normals[:, 2:], LEAST_Z)
    return SceneFit(
        residual,
        float(np.mean([other <= residual for other in others])),
        float(np.degrees(np.arctan(np.linalg.norm(slopes.mean(axis=0))))),
    )
