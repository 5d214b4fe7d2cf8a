"""Find a lamp beside the camera, and the normals of a mesh, by the shading and the gloss of an object that turns.

    I = K_d D(cos(theta_i)) + sum_k G_k exp(-alpha^2 / (2 s_k^2)) / cos(theta_r)

K_d of each texel; for the whole object one curve D, near Lambert's line, and one sum of Gaussian lobes.  Between two
rims that it sees a visual hull is flat, so that its normals are off by more than its places.  The normals of the
vertices, from which those of the texels are interpolated, are found by Gauss-Newton steps of sparse least squares over
all observations, in which neighbouring vertices turn alike; K_d is eliminated.  Places stay.  (R. J. Woodham,
Photometric method for determining surface orientation from multiple images, Optical Engineering 19, 1980.)

Curve and lobes are those at the normals of the mesh, which are off to all sides: with Lambert's line in place of D, or
with a curve that follows the turned normals, all normals of a rough matt body turn along the axis by some 15 degrees.
"""

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from nishiki.brdf.slopes import GRAZING
from nishiki.brdf.texels.model import ENVIRONMENT, POINT, CaptureLamps, ViewLamp
from nishiki.brdf.texels.texel_fit import Sample
from nishiki.geometry.camera import Camera
from nishiki.geometry.mesh import Mesh, compute_tangents, measure_tilts, tilt_normals

if TYPE_CHECKING:
    from scipy import sparse

LOBES = np.array([0.08, 0.14, 0.22, 0.35])  # radians: s_k
CURVE = np.linspace(0, 1, 11)  # cos(theta_i) between which D is linear
BENT, PULL = 0.05, 1e-4  # of the information: how much D's bends and its distance from Lambert's line count
STRAIGHT = 1e4  # a weight of bends that leaves D a straight line, which light between parts of the object lifts
STEEP = 0.25  # cos(theta_r) below which an observation counts less and less
DARK = 0.5  # of the median value, added to a value for its scale: shadows and noise do not count without bound
ROUNDS = 8  # of K_d, lobes and robust weights in turn
OUTLIER = 3.0  # robust standard deviations from which an observation counts a quarter
NOISE = 0.04  # of the scale: deviation of an observation, what the model lacks and neighbours share included, at least
ROUGHNESS = np.radians(20)  # deviation of the turns of neighbouring vertices
TURNS = 4  # of the normals
LARGEST_TURN = 0.15  # radians, of one round
FIRST_STEP, LAST_STEP = 0.04, 0.003  # of the search for the lamp's place, in distances of the camera
MOST_BESIDE = 0.5  # distances of the camera; light from all around draws the search farther than any lamp beside it
LEAST_BESIDE_GAIN = 0.1  # of the residual that a lamp beside the camera has to take off
EVEN = 0.005  # of the scale: smaller deviations, as under light from all around, tell no place
WORST = 0.15  # of the scale: larger residuals, of shadows, count as this one
FEWEST = 20  # texels


@dataclass(frozen=True)
class ShadedTexels:
    """Observations (n,) of texels under known lamps: number of the texel, value (mean of the channels), view.

    towards, facing, half (n, 3): unit directions to lamp and camera, and their bisector; strength (n,): fall-off.
    """

    texel: np.ndarray
    values: np.ndarray
    view: np.ndarray
    towards: np.ndarray
    facing: np.ndarray
    half: np.ndarray
    strength: np.ndarray
    scale: np.ndarray

    @classmethod
    def of(cls, sample: Sample, centres: np.ndarray, lamps: list[ViewLamp]) -> "ShadedTexels":
        """Gather what is visible and finite; centres (M, 3), lamps: of point or distant form, one an observation."""
        mean = sample.values.mean(axis=-1)
        texel, view = np.nonzero(sample.visible & np.isfinite(mean))
        values, places = mean[texel, view].astype(float), sample.positions[texel].astype(float)
        towards = np.array([lamp.vector for lamp in lamps], float)[view]
        near = np.array([lamp.form == POINT for lamp in lamps])[view]
        towards = np.where(near[:, None], towards - places, towards)
        distance = np.linalg.norm(towards, axis=1)
        reference = np.array([lamp.reference for lamp in lamps])[view]
        strength = np.where(near & (reference > 0), (reference / distance) ** 2, 1.0)
        towards, facing = towards / distance[:, None], _unit(np.asarray(centres, float)[view] - places)
        level = float(np.median(values)) if values.size else 1.0
        scale = np.maximum(values, 0) + DARK * max(level, 1e-30)
        return cls(texel, values, view, towards, facing, _unit(towards + facing), strength, scale)

    def keep(self, chosen: np.ndarray) -> "ShadedTexels":
        """Return some of the observations."""
        return ShadedTexels(*(values[chosen] for values in vars(self).values()))

    def compute_angles(self, normals: np.ndarray) -> tuple[np.ndarray, ...]:
        """Compute cos(theta_i) (n,), fall-off where lit (n,), lobes (n, lobes), weights (n,) and alpha (n,)."""
        normal = normals[self.texel]
        cos_i, cos_r = _dot(normal, self.towards), _dot(normal, self.facing)
        alpha = np.arccos(np.clip(_dot(normal, self.half), -1, 1))
        lit = self.strength * ((cos_i > 0) & (cos_r > 0))
        lobes = np.exp(-((alpha[:, None] / LOBES) ** 2) / 2) * (lit / np.maximum(cos_r, GRAZING))[:, None]
        return np.clip(cos_i, 0, 1), lit, lobes, np.clip(cos_r / STEEP, 0, 1) * (lit > 0), alpha


@dataclass(frozen=True)
class Shading:
    """An object's common reflection: D (knots,) at CURVE, 1 at the end, and gloss (lobes,) G."""

    curve: np.ndarray = field(default_factory=CURVE.copy)
    gloss: np.ndarray = field(default_factory=lambda: np.zeros(len(LOBES)))


@dataclass(frozen=True)
class ShadingFit:
    """kd (texels,) under a shading; deviation (n,) in scales, weights (n,), their robust standard deviation."""

    shading: Shading
    kd: np.ndarray
    deviation: np.ndarray
    weights: np.ndarray
    spread: float


def fit_shading(
    seen: ShadedTexels, normals: np.ndarray, shading: Shading | None = None, *, bent: float = BENT
) -> ShadingFit:
    """Fit K_d of each texel at texels' normals (texels, 3), robustly; curve and lobes too where none are given."""
    from scipy.optimize import nnls

    cosine, lit, lobes, weights, _ = seen.compute_angles(normals)
    robust, counted, held = np.ones_like(lit), weights > 0, shading is not None
    shading, near = shading or Shading(), np.maximum(1 - np.abs(cosine[:, None] - CURVE) / CURVE[1], 0)
    bends = np.zeros((len(CURVE) - 2, len(CURVE) + len(LOBES)))
    for knot in range(len(bends)):
        bends[knot, knot : knot + 3] = 1, -2, 1
    unit = float(np.median(seen.scale)) if counted.size else 1.0
    for _ in range(ROUNDS):
        diffuse, trust = (near @ shading.curve) * lit, weights * robust
        # K_d of each texel by weighted least squares; 0 where nothing is lit
        above = np.bincount(seen.texel, trust * diffuse * (seen.values - lobes @ shading.gloss), len(normals))
        below = np.bincount(seen.texel, trust * diffuse**2, len(normals))
        kd = np.maximum(above / np.where(below > 0, below, np.inf), 0)
        if not held:
            columns = (
                np.concatenate([near * (kd[seen.texel] * lit)[:, None], unit * lobes], axis=1) / seen.scale[:, None]
            )
            normal, right = columns.T @ (columns * trust[:, None]), columns.T @ (trust * seen.values / seen.scale)
            level = (np.trace(normal) + 1e-30) / len(normal)
            normal += level * (bent * bends.T @ bends + PULL * np.eye(len(normal)))
            right += level * PULL * np.concatenate([CURVE, np.zeros(len(LOBES))])
            factor = np.linalg.cholesky(normal)
            found = nnls(factor.T, np.linalg.solve(factor, right))[0]
            top = max(found[len(CURVE) - 1], 1e-30)
            shading, kd = Shading(found[: len(CURVE)] / top, unit * found[len(CURVE) :]), kd * top
            diffuse = (near @ shading.curve) * lit
        deviation = (seen.values - kd[seen.texel] * diffuse - lobes @ shading.gloss) / seen.scale
        spread = 1.4826 * float(np.median(np.abs(deviation[counted]))) if counted.any() else 0.0
        robust = 1 / (1 + (deviation / max(OUTLIER * spread, 1e-30)) ** 2) ** 2
    return ShadingFit(shading, kd, deviation, weights * robust, spread)


def measure_misfit(sample: Sample, centres: np.ndarray, lamps: list[ViewLamp]) -> float:
    """Measure the mean deviation, in scales, from a straight D and common lobes at the sample's normals."""
    seen = ShadedTexels.of(sample, centres, lamps)
    fit, weights = fit_shading(seen, sample.normals, bent=STRAIGHT), seen.compute_angles(sample.normals)[3]
    return float(np.average(np.minimum(np.abs(fit.deviation), WORST), weights=weights)) if weights.any() else 0.0


def find_lamp(sample: Sample, cameras: list[Camera], of: np.ndarray, *, falloff: bool) -> tuple[float, float, float]:
    """Find the place (x, y, 0) of a lamp beside the camera, in the lamp frame and the world's unit.

    cameras: of the light's observations `of`.  A pattern search for the place with the smallest residual.  Shading
    tells how far the lamp stands to the side, along the turn; how high it stands only highlights tell.  0 0 0 where no
    place takes LEAST_BESIDE_GAIN off the residual of a lamp at the camera, or the best one lies beyond MOST_BESIDE.
    """
    nowhere = (0.0, 0.0, 0.0)
    sample = replace(sample, values=sample.values[:, of], visible=sample.visible[:, of])
    if len(sample.positions) < FEWEST or not np.any(sample.visible[..., None] * np.nan_to_num(sample.values)):
        return nowhere
    centres, middle = np.array([camera.centre for camera in cameras]), sample.positions.mean(axis=0)
    distance = float(np.linalg.norm(cameras[0].centre - middle))

    def residual(place: np.ndarray) -> float:
        lighting = CaptureLamps("position", ((*place.tolist(), 0.0),), reference=distance if falloff else 0.0)
        return measure_misfit(sample, centres, [lighting.lamp(camera) for camera in cameras])

    place, step = np.zeros(2), FIRST_STEP * distance
    first = best = residual(place)
    while step > LAST_STEP * distance and np.hypot(*place) <= MOST_BESIDE * distance:
        for move in step * np.array([(1, 0), (-1, 0), (0, 1), (0, -1)]):
            if (tried := residual(place + move)) < best:
                best, place = tried, place + move
                break
        else:
            step /= 2
    x, y = place.tolist()
    beside = np.hypot(x, y) <= MOST_BESIDE * distance and best + EVEN < (1 - LEAST_BESIDE_GAIN) * (first + EVEN)
    return (x, y, 0.0) if beside else nowhere


def refine_normals(
    mesh: Mesh, sample: Sample, triangles: np.ndarray, centres: np.ndarray, lamps: list[ViewLamp]
) -> tuple[Mesh, tuple[float, float] | None]:
    """Find the normals of a mesh by the shading of its photographs.

    triangles (n,): of the sample's texels; centres (M, 3) and lamps: of the observations, light by light.

    Returns
    -------
    Mesh
        With the normals that were found, or as it is.
    tuple of float or None
        Mean deviation of hidden views, as a share of their values, with the normals of the mesh and with those that the
        other views give; of three views in a row the middle one is hidden, under all lights.  None where nothing is
        found: the light is a fitted irradiance, which tells too little, or few texels or views are seen.
    """
    if any(lamp.form == ENVIRONMENT for lamp in lamps) or len(sample.positions) < FEWEST:
        return mesh, None
    seen, mixing = ShadedTexels.of(sample, centres, lamps), _interpolation(mesh, sample.positions, triangles)
    camera = seen.view % len(np.unique(centres, axis=0))
    hidden = np.isin(camera, np.unique(camera)[1::3])
    if not hidden.any():
        return mesh, None
    tried = mesh.normals.astype(float), _turn(mesh, seen.keep(~hidden), mixing)
    before, after = (_predict_hidden(seen.keep(~hidden), seen.keep(hidden), _unit(mixing @ each)) for each in tried)
    turned = replace(mesh, normals=_turn(mesh, seen, mixing).astype(np.float32))
    return tilt_normals(mesh.vertices, mesh.triangles, measure_tilts(turned)), (before, after)


def _predict_hidden(seen: ShadedTexels, hidden: ShadedTexels, normals: np.ndarray) -> float:
    """Compute the mean deviation, in scales, of hidden observations from the model of the others."""
    fit = fit_shading(seen, normals)
    cosine, lit, lobes, weights, _ = hidden.compute_angles(normals)
    weights *= np.isin(hidden.texel, seen.texel)
    diffuse = fit.kd[hidden.texel] * np.interp(cosine, CURVE, fit.shading.curve) * lit
    off = np.abs(hidden.values - diffuse - lobes @ fit.shading.gloss) / hidden.scale
    return float(np.average(np.minimum(off, WORST), weights=weights)) if weights.any() else 0.0


def _turn(mesh: Mesh, seen: ShadedTexels, mixing: "sparse.csr_matrix") -> np.ndarray:
    """Compute the vertices' unit normals (v, 3) by TURNS steps of Gauss-Newton; mixing (texels, v) interpolates."""
    from scipy import sparse
    from scipy.sparse.linalg import cg

    first = mesh.normals.astype(float)
    normals, edges = first.copy(), np.unique(np.sort(mesh.triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)), axis=0)
    count = len(normals)
    ends = sparse.csr_matrix((np.ones(len(edges)), (np.arange(len(edges)), edges[:, 0])), (len(edges), count))
    ends -= sparse.csr_matrix((np.ones(len(edges)), (np.arange(len(edges)), edges[:, 1])), (len(edges), count))
    differences, spread_out = (sparse.kron(matrix, sparse.eye(3), "csr") for matrix in (ends, mixing))
    shading = fit_shading(seen, _unit(mixing @ normals)).shading
    for _ in range(TURNS):
        at_texels = _unit(mixing @ normals)
        information, pull = _compute_pull(seen, at_texels, shading)
        plane = _place_blocks(compute_tangents(normals).swapaxes(1, 2))
        across = _place_blocks(compute_tangents(at_texels))
        to_texels, rough = (across @ spread_out @ plane).tocsr(), (differences @ plane).tocsr() / ROUGHNESS
        system = to_texels.T @ _place_blocks(information) @ to_texels + rough.T @ rough + 1e-3 * sparse.eye(2 * count)
        right = to_texels.T @ pull.ravel() - rough.T @ (differences @ (normals - first).ravel()) / ROUGHNESS
        nearly = sparse.diags_array(1 / system.diagonal())
        turns = cg(sparse.csr_matrix(system), right, rtol=1e-8, M=nearly)[0].reshape(count, 2)
        turns *= np.minimum(1, LARGEST_TURN / np.maximum(np.linalg.norm(turns, axis=1), 1e-30))[:, None]
        normals = _unit(normals + np.einsum("vk,vki->vi", turns, compute_tangents(normals)))
    return normals


def _place_blocks(blocks: np.ndarray) -> "sparse.bsr_matrix":
    """Place blocks (n, a, b) along the diagonal of a matrix (n a, n b)."""
    from scipy import sparse

    return sparse.bsr_matrix((blocks, np.arange(len(blocks)), np.arange(len(blocks) + 1)))


def _compute_pull(seen: ShadedTexels, normals: np.ndarray, shading: Shading) -> tuple[np.ndarray, np.ndarray]:
    """Compute information (texels, 2, 2) and gradient (texels, 2) of each texel's normal along its two tangents."""
    fit, count = fit_shading(seen, normals, shading), len(normals)
    cosine, lit, lobes, _, alpha = seen.compute_angles(normals)
    plane = compute_tangents(normals)[seen.texel]
    to_lamp, to_camera, to_half = (
        np.einsum("nki,ni->nk", plane, each) for each in (seen.towards, seen.facing, seen.half)
    )
    cos_r = np.maximum(_dot(normals[seen.texel], seen.facing), GRAZING)
    slope = np.where(alpha > 1e-6, alpha / np.maximum(np.sin(alpha), 1e-6), 1)
    steps = np.diff(shading.curve) / np.diff(CURVE)  # the derivative of D, between knots
    steepness = steps[np.clip((cosine * len(steps)).astype(int), 0, len(steps) - 1)]
    bend = (fit.kd[seen.texel] * steepness * lit)[:, None] * to_lamp
    bend += (lobes @ (shading.gloss / LOBES**2) * slope)[:, None] * to_half
    bend -= (lobes @ shading.gloss / cos_r)[:, None] * to_camera
    bend, own = bend / seen.scale[:, None], np.interp(cosine, CURVE, shading.curve) * lit / seen.scale
    weights = fit.weights / max(fit.spread, NOISE) ** 2

    def total(values: np.ndarray) -> np.ndarray:
        return np.bincount(seen.texel, weights * values, count)

    square = total(own**2)
    share = np.where(square > 0, 1 / np.where(square > 0, square, 1), 0)
    along, rest = np.stack([total(own * bend[:, k]) for k in range(2)], axis=1), total(own * fit.deviation)
    products = [[total(bend[:, j] * bend[:, k]) for k in range(2)] for j in range(2)]
    information = np.moveaxis(np.array(products), -1, 0) - along[:, :, None] * along[:, None] * share[:, None, None]
    pull = np.stack([total(bend[:, k] * fit.deviation) for k in range(2)], axis=1) - along * (rest * share)[:, None]
    return information, pull


def _interpolation(mesh: Mesh, positions: np.ndarray, triangles: np.ndarray) -> "sparse.csr_matrix":
    """Compute the shares (n, v) of the vertices at points near their triangles (n,)."""
    from scipy import sparse

    corners = mesh.triangles[triangles]
    a, b, c = (mesh.vertices[corners[:, k]] for k in range(3))
    u, v, point = b - a, c - a, positions - a
    uu, uv, vv, up, vp = _dot(u, u), _dot(u, v), _dot(v, v), _dot(u, point), _dot(v, point)
    scale = 1 / np.maximum(uu * vv - uv**2, 1e-300)
    second, third = (up * vv - vp * uv) * scale, (vp * uu - up * uv) * scale
    shares = np.clip(np.stack([1 - second - third, second, third], axis=1), 0, 1)
    shares /= shares.sum(axis=1, keepdims=True)
    rows = np.repeat(np.arange(len(positions)), 3)
    return sparse.csr_matrix((shares.ravel(), (rows, corners.ravel())), (len(positions), len(mesh.vertices)))


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.einsum("ni,ni->n", a, b)


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-300)
