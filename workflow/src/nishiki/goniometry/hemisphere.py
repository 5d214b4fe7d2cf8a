"""Complete the normal-incidence reflectance to the hemisphere: symmetry, interpolation, measured and missing parts.

A surface has the same BRDF with light and view exchanged (Helmholtz; von Helmholtz, Handbuch der physiologischen Optik,
1867), and sends back no more light than it gets. Values that are weighted by a cosine, angles that are counted from
another direction, and values in per cent violate one or the other.
"""

from collections.abc import Iterable
from dataclasses import asdict, dataclass, replace

import numpy as np

from nishiki.errors import UserError, require
from nishiki.goniometry.directions import IMAGES, Symmetry, angles, disc, images, reduce_pairs, unit
from nishiki.goniometry.interpolation import SmoothingSpline, fit_spline
from nishiki.goniometry.table import BasicReflectance, ReflectanceSet

PROBES = 4000  # even directions
REACH = np.radians(7.5)  # a view stands for directions this near


@dataclass(frozen=True)
class IncidenceCoverage:
    """The coverage of one direction of light."""

    theta_deg: float  # theta_deg, phi_deg: of the light (phi 0 along the normal)
    phi_deg: float
    rows: np.ndarray  # indices of its measurements
    views: int  # how many
    unusable: int  # of these, in the region where most are
    covered: float  # share of the hemisphere's solid angle within 7.5 degrees of a usable view or its mirror image
    gap_deg: float  # from the worst direction of the hemisphere to the nearest view
    steepest_deg: float  # greatest theta_r

    def as_dict(self) -> dict:
        """Return plain values for JSON, without the rows."""
        values = asdict(self)
        del values["rows"]
        return values


def coverage(measured: ReflectanceSet) -> tuple[IncidenceCoverage, ...]:
    """Measure the coverage of each direction of light, by theta and then phi, in degrees rounded to 0.1."""
    theta, phi = np.degrees(angles(measured.incident))
    along = measured.normal_incidence
    key = np.column_stack([np.where(along, 0.0, np.round(theta, 1)), np.where(along, 0.0, np.round(phi, 1) % 360)])
    lights, group = np.unique(key, axis=0, return_inverse=True)
    group = group.ravel()
    return tuple(_of(measured, light, np.flatnonzero(group == i)) for i, light in enumerate(lights))


def cover(views: np.ndarray, same: Iterable[np.ndarray]) -> tuple[float, float]:
    """Return the share of the hemisphere within REACH of a view (n, 3) or its images, and the widest gap in radians."""
    from scipy.spatial import cKDTree

    tree = cKDTree(np.concatenate([views @ image.T for image in same]))
    distance = 2 * np.arcsin(np.minimum(tree.query(spread(PROBES))[0] / 2, 1.0))
    return float((distance < REACH).mean()), float(distance.max())


def _of(measured: ReflectanceSet, light: np.ndarray, rows: np.ndarray) -> IncidenceCoverage:
    good = rows[measured.valid[rows].all(axis=1)]
    lit = unit(*np.radians(light))
    # only images that leave the light where it is show the same measurement again
    same = [m for m in images(measured.symmetry) if np.allclose(m @ lit, lit, atol=1e-6)]
    covered, gap = cover(measured.outgoing[good], same) if len(good) else (0.0, np.pi / 2)
    steepest = angles(measured.outgoing[rows])[0].max()
    unusable = int((~measured.valid[rows]).sum(axis=0).max())
    numbers = (float(light[0]), float(light[1]))
    return IncidenceCoverage(
        *numbers, rows, len(rows), unusable, covered, float(np.degrees(gap)), float(np.degrees(steepest))
    )


def spread(count: int) -> np.ndarray:
    """Spread unit vectors (count, 3) over the upper hemisphere, each for the same solid angle (Fibonacci lattice)."""
    i = np.arange(count) + 0.5
    return unit(np.arccos(1 - i / count), np.pi * (1 + np.sqrt(5)) * i)


SAME = 0.02  # distance of unit vectors up to which two directions are one, about a degree
APART = 0.1  # by which a pair differs from itself exchanged, else it tells nothing
FEWEST_PAIRS = 4  # from which their disagreement tells something
GRAZING = np.cos(np.radians(80.5))  # beyond it instruments disagree with themselves
NODES = 2000  # directions over which the light that is sent back is summed
PAIR_REACH = np.radians(15.0)  # a view stands for directions this near
FEWEST_VIEWS, LEAST_COVERED = 12, 0.7  # of one direction of light whose reflected light is summed
STEEPEST = np.cos(np.radians(72.0))  # grazing light is not: few views hold most of what it sends back
OBLIQUE = np.cos(np.radians(20.0))


def reciprocity(
    incident: np.ndarray, outgoing: np.ndarray, values: np.ndarray, symmetry: Symmetry
) -> tuple[float | None, int]:
    """Compare pairs that differ by the exchange of light and view: mean of |ln ratio|; and count the pairs.

    Parameters
    ----------
    incident, outgoing : ndarray
        Unit vectors (n, 3).
    values : ndarray
        Reflectances (n, channels), above 0.
    symmetry : str
        A key of `symmetry.IMAGES`.
    """
    from scipy.spatial import cKDTree

    steep = (incident[:, 2] > GRAZING) & (outgoing[:, 2] > GRAZING)
    incident, outgoing, values = incident[steep], outgoing[steep], values[steep]
    if not len(values):
        return None, 0
    tree, found = cKDTree(np.hstack([incident, outgoing])), []
    for image in images(symmetry):
        exchanged = np.hstack([outgoing @ image.T, incident @ image.T])
        distance, other = tree.query(exchanged, distance_upper_bound=SAME)
        place = np.flatnonzero(np.isfinite(distance))
        other = other[place]
        apart = np.linalg.norm(incident[place] - incident[other], axis=1)
        apart += np.linalg.norm(outgoing[place] - outgoing[other], axis=1)
        found.append(np.column_stack([place, other])[apart > APART])
    pairs = np.unique(np.sort(np.concatenate(found), axis=1), axis=0)
    if not len(pairs):
        return None, 0
    logs = np.log(values)
    return float(np.abs(logs[pairs[:, 0]] - logs[pairs[:, 1]]).mean()), len(pairs)


def typical_albedo(incident: np.ndarray, outgoing: np.ndarray, values: np.ndarray, symmetry: Symmetry) -> float | None:
    """Compute the share of the light that is sent back, in the brightest channel, median over the lights' directions.

    A direction of light counts where its views leave little of the hemisphere open; each part of the hemisphere has the
    value of the nearest view. None where no direction of light does. Arguments as of `reciprocity`.
    """
    from scipy.spatial import cKDTree

    nodes, shares = spread(NODES), []
    lights, group = np.unique(np.round(incident, 3), axis=0, return_inverse=True)
    for i, light in enumerate(lights):
        rows = np.flatnonzero(group.ravel() == i)
        if len(rows) < FEWEST_VIEWS or light[2] < STEEPEST:
            continue
        same = [image for image in images(symmetry) if np.allclose(image @ light, light, atol=2e-3)]
        distance, place = cKDTree(np.concatenate([outgoing[rows] @ image.T for image in same])).query(nodes)
        near = distance <= 2 * np.sin(PAIR_REACH / 2)
        if (near * nodes[:, 2]).sum() < LEAST_COVERED * nodes[:, 2].sum():
            continue
        light_back = values[rows][place % len(rows)] * (near * nodes[:, 2] * (2 * np.pi / NODES))[:, None]
        shares.append(light_back.sum(axis=0).max())
    return float(np.median(shares)) if shares else None


def forward_shine(incident: np.ndarray, outgoing: np.ndarray, values: np.ndarray) -> float | None:
    """Compute the rank correlation of reflectance and the half vector's cosine in oblique light, -1 to 1, or None.

    Surfaces shine where the half vector is near the normal. Arguments as of `reciprocity`.
    """
    rows = (incident[:, 2] < OBLIQUE) & (outgoing[:, 2] < OBLIQUE)
    if rows.sum() < FEWEST_VIEWS:
        return None
    half = incident[rows] + outgoing[rows]
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    ranks = [np.argsort(np.argsort(each)) for each in (np.round(half[:, 2], 6), np.log(values[rows]).mean(axis=1))]
    return float(np.corrcoef(*ranks)[0, 1])


def turned_views(incident: np.ndarray, outgoing: np.ndarray, turn: float) -> np.ndarray:
    """Return views (n, 3) whose azimuth was counted from that of the light, plus `turn` in radians."""
    theta, phi = angles(outgoing)
    return unit(theta, phi + np.where(incident[:, 2] < 1 - 1e-4, angles(incident)[1] + turn, 0.0))


MOST_POINTS = 1500  # of one eigenvalue problem; more views are averaged over small cells
WITHIN = 0.75  # of the grid's step, a little more than half its diagonal: a view that near measures the node
FEWEST = 6  # views
ALL_ROUND = 0.9  # of the directions that images reach, from which the views themselves lie all round
LESS = 0.05  # of the error of left-out views, by which it falls for yarns that differ a little, whatever the weave


@dataclass(frozen=True)
class Interpolation:
    """The interpolation of a hemisphere."""

    basic: BasicReflectance  # the grid
    # (regions,): relative error of the views, each predicted from the others, as the root mean square of the logarithm
    left_out: tuple[float, ...]
    smoothing: tuple[float, ...]  # (regions,): chosen by it
    points: tuple[int, ...]  # (regions,): views of the reduced hemisphere that entered
    measured: float  # measured, extrapolated: shares of the hemisphere's solid angle
    extrapolated: float


def complete(measured: ReflectanceSet, *, grid_deg: float = 3.0) -> tuple[ReflectanceSet, Interpolation]:
    """Fill in `basic` of a set from the views at normal incidence. UserError where they are too few."""
    rows = np.flatnonzero(measured.normal_incidence)
    chosen = [rows[measured.valid[rows, r] & positive(measured.values[rows, r])] for r in range(len(measured.regions))]
    for name, usable in zip(measured.regions, chosen, strict=True):
        if len(usable) < FEWEST:
            raise UserError(
                f"region '{name}': expected {FEWEST} usable views at normal incidence (theta_i below "
                f"{measured.normal_deg:g} degrees), found {len(usable)}. Remedy: photograph the cloth lit along its "
                "normal from more directions, raise normal_deg, or set interpolation to none"
            )
    parts = [
        interpolate(
            measured.outgoing[usable],
            measured.values[usable, r],
            measured.noise[usable, r],
            symmetry=measured.symmetry,
            grid_deg=grid_deg,
        )
        for r, usable in enumerate(chosen)
    ]
    first = parts[0].basic
    basic = BasicReflectance(
        first.theta,
        first.phi,
        np.concatenate([part.basic.values for part in parts]),
        np.all([part.basic.measured for part in parts], axis=0),
        np.any([require(part.basic.extrapolated) for part in parts], axis=0),
    )
    weights = solid_angles(basic)
    interpolation = Interpolation(
        basic,
        tuple(part.left_out[0] for part in parts),
        tuple(part.smoothing[0] for part in parts),
        tuple(part.points[0] for part in parts),
        float((weights * basic.measured).sum()),
        float((weights * basic.extrapolated).sum()),
    )
    return replace(measured.take(slice(None)), basic=basic), interpolation  # whatever subclass it came in


def positive(values: np.ndarray) -> np.ndarray:
    """Find reflectances (n, channels) that have a logarithm in every channel: (n,) bool."""
    return (np.isfinite(values) & (values > 0)).all(axis=-1)


def interpolate(
    outgoing: np.ndarray,
    values: np.ndarray,
    noise: np.ndarray,
    *,
    symmetry: Symmetry = "quarter",
    grid_deg: float = 3.0,
) -> Interpolation:
    """Interpolate BRDF values (n, channels) > 0 at views (n, 3), light along the normal, on one region's regular grid.

    Logarithms are interpolated on the azimuthal equidistant disc, where neither the pole nor the azimuth has a seam,
    by a kernel that has the symmetry; so the result is positive, smooth and symmetric. Beyond the outermost views
    (seen from their centre) the value at the edge is kept. noise (n, channels): standard deviations, 0 where unknown.
    Views with a value that is not above 0 and finite are left out; UserError where too few are left.
    """
    from scipy.spatial import cKDTree

    usable = positive(values)
    outgoing, values, noise = outgoing[usable], values[usable], noise[usable]
    if not len(outgoing):
        raise UserError("the views at normal incidence: expected reflectances above 0, found none; see their exposure")
    theta, phi = grid_axes(grid_deg)
    nodes = unit(theta[:, None], phi[None, :])
    places = disc(nodes).reshape(-1, 2)
    try:
        predict, left_out = _fit(outgoing, values, noise, symmetry)
        views = reduce_pairs(np.tile([0.0, 0.0, 1.0], (len(outgoing), 1)), outgoing, symmetry)[1]
        inside = within_hull(places, np.concatenate([predict.points * fold for fold in predict.folds]))
    except ValueError as e:
        raise UserError(
            f"the views at normal incidence cannot be interpolated ({e}). Remedy: photograph views in several azimuths"
        ) from None
    grid = np.exp(predict(inside)).reshape(*nodes.shape[:2], values.shape[1])
    grid[0] = grid[0].mean(axis=0)
    tree = cKDTree(np.concatenate([views @ image.T for image in images(symmetry)]))
    measured = tree.query(nodes)[0] <= 2 * np.sin(WITHIN * theta[1] / 2)  # a view or one of its images is near the node
    beyond = (np.linalg.norm(inside - places, axis=1) > 1e-6).reshape(nodes.shape[:2])
    basic = BasicReflectance(theta, phi, grid[None], measured, beyond & ~measured)
    weights = solid_angles(basic)
    shares = float((weights * basic.measured).sum()), float((weights * basic.extrapolated).sum())
    return Interpolation(basic, (left_out,), (predict.smoothing,), (len(predict.points),), *shares)


def choose_symmetry(measured: ReflectanceSet) -> dict[Symmetry, float]:
    """Predict each view at normal incidence from the views at other places, under every symmetry.

    A symmetry that the cloth has predicts better, for its images are views too; one that it has not puts views of
    different reflectance in one place. Views of one quarter can tell nothing of the others: a symmetry takes part where
    the views and their images lie as widely as with two mirror planes.

    Returns
    -------
    dict of str to float
        Relative error of the views, as the root mean square of the logarithm over all regions, by the keys of
        `directions.IMAGES`, the choice first: the most symmetric of those as good as the best. Without those for which
        the views are too few or lie in one line; empty where they are too few for any.
    """
    along = measured.outgoing[measured.normal_incidence]
    widely = {name: cover(along, images(name))[0] if len(along) else 0.0 for name in IMAGES}
    errors: dict[Symmetry, list[float]] = {name: [] for name in IMAGES if widely[name] > ALL_ROUND * widely["quarter"]}
    for r in range(len(measured.regions)):
        usable = measured.normal_incidence & measured.valid[:, r] & positive(measured.values[:, r])
        if usable.sum() < FEWEST:
            return {}
        for name, found in errors.items():
            part = measured.outgoing[usable], measured.values[usable, r], measured.noise[usable, r]
            try:
                found.append(_fit(*part, name)[1])
            except ValueError:  # too few places, or all in one line
                found.append(np.inf)
    means = [(name, float(np.sqrt(np.mean(np.square(found))))) for name, found in errors.items()]
    means = [entry for entry in means if np.isfinite(entry[1])]
    most = (1 + LESS) * min((error for _, error in means), default=0.0)
    return dict(sorted(means, key=lambda entry: entry[1] > most))


def _fit(
    outgoing: np.ndarray, values: np.ndarray, noise: np.ndarray, symmetry: Symmetry
) -> tuple[SmoothingSpline, float]:
    """Fit the spline; return with it the error of the views, each predicted from those at other places."""
    views = reduce_pairs(np.tile([0.0, 0.0, 1.0], (len(outgoing), 1)), outgoing, symmetry)[1]
    points, logs, sigma, group = gather_views(disc(views), values, noise)
    predict = fit_spline(points, logs, sigma, images(symmetry)[:, [0, 1], [0, 1]])
    errors = predict.left_out[group] + np.log(values) - logs[group]
    return predict, float(np.sqrt(np.square(errors).mean()))


def grid_axes(grid_deg: float) -> tuple[np.ndarray, np.ndarray]:
    """Return theta, 0 to pi/2, and phi round the azimuth (even number, quarter symmetric), in steps near grid_deg."""
    steps = max(8, round(90 / grid_deg))
    return np.linspace(0, np.pi / 2, steps + 1), np.arange(4 * steps) * (np.pi / 2 / steps)


def gather_views(places: np.ndarray, values: np.ndarray, noise: np.ndarray) -> tuple[np.ndarray, ...]:
    """Average repeats of a place and, above MOST_POINTS, the views of small cells of the disc.

    Return points (m, 2), mean logarithms (m, channels), their standard deviation (m,), and the point of each view (n,).
    """
    logs = np.log(values)
    relative = (noise / values).mean(axis=1)
    group, cell = same_places(places), 0.002
    while group.max() >= MOST_POINTS:
        _, group = np.unique(np.floor(places / cell), axis=0, return_inverse=True)
        group, cell = group.ravel(), 1.5 * cell
    count = np.bincount(group).astype(np.float64)

    def mean(of: np.ndarray) -> np.ndarray:
        return np.bincount(group, of) / count

    points = np.column_stack([mean(places[:, k]) for k in (0, 1)])
    averaged = np.column_stack([mean(logs[:, k]) for k in range(logs.shape[1])])
    return points, averaged, np.sqrt(mean(relative**2) / count), group


def same_places(places: np.ndarray) -> np.ndarray:
    """Group places (n,): those nearer than a millionth of the disc's radius are one."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    pairs = cKDTree(places).query_pairs(1e-6, output_type="ndarray")
    links = coo_array((np.ones(len(pairs)), pairs.T), shape=(len(places), len(places)))
    return connected_components(links, directed=False)[1]


def within_hull(places: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Bring places (m, 2) outside of the convex hull of the points to its edge, towards its centre.

    ValueError where all points lie in one line.
    """
    from scipy.spatial import ConvexHull, QhullError

    try:
        hull = ConvexHull(points)
    except QhullError:
        raise ValueError("all of them lie in one plane") from None
    centre = points[hull.vertices].mean(axis=0)
    normals, offsets = hull.equations[:, :2], hull.equations[:, 2]
    outward = (places - centre) @ normals.T
    room = -(normals @ centre + offsets)  # > 0: from the centre to each edge
    reach = np.where(outward > 0, room / np.maximum(outward, 1e-300), np.inf).min(axis=1)
    return centre + (places - centre) * np.minimum(1.0, reach)[:, None]


def solid_angles(basic: BasicReflectance) -> np.ndarray:
    """Compute the share (nt, np) of the hemisphere's solid angle of each node; they add up to 1."""
    edges = np.concatenate([[0.0], (basic.theta[1:] + basic.theta[:-1]) / 2, [np.pi / 2]])
    band = np.cos(edges[:-1]) - np.cos(edges[1:])
    return np.repeat(band[:, None] / len(basic.phi), len(basic.phi), axis=1)


def directional_albedo(basic: BasicReflectance) -> np.ndarray:
    """Integrate rho cos(theta): the share (regions, channels) of the light along the normal that leaves the cloth.

    The midpoint rule over the grid's cells; above 1 is impossible and points to the white board's reflectance.
    """
    weights = 2 * np.pi * solid_angles(basic) * np.cos(basic.theta)[:, None]
    return np.einsum("tp,rtpc->rc", weights, basic.values)
