"""Cameras, meshes and hulls at the edges: bad scales, degenerate triangles, views that tell nothing."""

from fractions import Fraction

import mpmath
import numpy as np
from hypothesis import strategies as st
from stability.cases import case, powers_of_ten, relative, worst_over
from turned_cameras import COLUMNS, ROWS, sphere, turn

from nishiki.errors import UserError
from nishiki.geometry.camera import Camera, cameras_of_matrices
from nishiki.geometry.cleaning import clean
from nishiki.geometry.hull import carve, signed_distance
from nishiki.geometry.mesh import Mesh
from nishiki.geometry.placement import agreement
from nishiki.geometry.pose import Sight, estimate_pose
from nishiki.geometry.silhouettes import segment
from nishiki.geometry.surface import (
    decimate,
    distances,
    fewest_triangles,
    point_to_triangle,
    shape_of,
    smooth_outline_steps,
)
from nishiki.geometry.turn import turn_of
from nishiki.geometry.visibility import rasterise


def globe(rings: int = 8, sectors: int = 12, radius: float = 0.7) -> tuple[np.ndarray, np.ndarray]:
    """A closed sphere of triangles."""
    theta = np.pi * np.arange(1, rings) / rings
    phi = 2 * np.pi * np.arange(sectors) / sectors
    middle = [[np.sin(t) * np.cos(p), np.sin(t) * np.sin(p), np.cos(t)] for t in theta for p in phi]
    vertices = radius * np.array([[0, 0, 1.0], *middle, [0, 0, -1.0]])
    last, triangles = len(vertices) - 1, []
    for k in range(sectors):
        m = (k + 1) % sectors
        triangles += [(0, 1 + k, 1 + m), (last, last - sectors + m, last - sectors + k)]
        for r in range(rings - 2):
            a, b = 1 + r * sectors, 1 + (r + 1) * sectors
            triangles += [(a + k, b + k, b + m), (a + k, b + m, a + m)]
    return vertices, np.array(triangles)


def scaled_camera(camera: Camera, scale: float) -> Camera:
    return Camera(camera.name, camera.intrinsics, camera.rotation, camera.translation * scale, ROWS, COLUMNS)


def exact_pixel(matrix, point):
    """Pixel and sign of the depth of a rational 3 x 4 matrix and point, exactly."""
    rows = [
        sum(Fraction(float(a)) * Fraction(float(b)) for a, b in zip(row, [*point, 1.0], strict=True)) for row in matrix
    ]
    return [float(rows[0] / rows[2]), float(rows[1] / rows[2])]


@case(
    "Projection matrices at any scale and sign",
    hazard="determinants and norms of matrices from 1e-150 to 1e150 under- or overflow",
    treatment="the matrix is divided by its third row's length first, then decomposed",
    reference="projection in exact rationals",
    bound=1e-9,
    unit="px",
    outcome="the same camera",
)
def test_matrices_at_any_scale():
    camera = turn(1)[0]
    points = np.random.default_rng(0).uniform(-0.7, 0.7, (4, 3))

    def measure(exponent, sign):
        matrix = camera.matrix * (sign * 10.0**exponent)
        found = Camera.from_matrix("v", matrix, rows=ROWS, columns=COLUMNS)
        pixels, depth = found.project(points)
        exact = np.array([exact_pixel(matrix, point) for point in points])
        return np.abs(pixels - exact).max() if (depth > 0).all() else np.inf

    return worst_over(measure, st.floats(-150, 150), st.sampled_from([-1.0, 1.0]), examples=60)


@case(
    "Matrices that are no camera's",
    hazard="singular or empty matrices, NaN, parallel projection",
    treatment="condition of the left 3 x 3 part, and finiteness, before anything is divided",
    bound=0,
    unit="matrices that passed of 8",
    outcome="exit status 2 that names the view",
)
def test_matrices_that_are_no_camera():
    good = turn(1)[0].matrix
    bad = [np.zeros((3, 4)), np.full((3, 4), np.nan), np.ones((3, 4)), good[:, :3], np.full((3, 4), np.inf)]
    flat, far, twice = good.copy(), good.copy(), good.copy()
    flat[2, :3], far[:, :3], twice[1] = 0, 0, good[0]
    passed = 0
    for matrix in (*bad, flat, far, twice):
        try:
            with np.errstate(all="ignore"):
                Camera.from_matrix("v", matrix, rows=ROWS, columns=COLUMNS)
            passed += 1
        except UserError:
            continue
    return passed


@case(
    "Points at, behind and just before the camera",
    hazard="1/depth at 0, below 0, at 1e-300: infinite pixels, 0 * infinity with a zero skew",
    treatment="such points have no pixel; their triangles show nowhere and hide nothing",
    bound=0,
    unit="wrong pixels",
    outcome="finite depth, counted as behind; the rest of the mesh as without them",
)
def test_points_at_the_camera():
    wrong = 0
    vertices, triangles = globe()
    for distortion in ((0.0,) * 5, (-0.3, 0.1, 0.01, -0.01, 0.05)):
        camera = turn(1, distortion=distortion)[0]
        alone = rasterise(Mesh.of(vertices, triangles), camera)
        c = camera.centre
        for depth in (0.0, -1.0, 1e-300, 1e-30, -1e-300, 1e-12):
            near = c + depth * camera.rotation[2] + 1e-3 * camera.rotation[0]
            with np.errstate(all="raise", under="ignore"):
                pixels, found = camera.project(near[None])
            wrong += not np.isfinite(found).all() or not np.isfinite(pixels).all()
            more = np.vstack([vertices, [c, near, near + camera.rotation[1]]])
            mesh = Mesh.of(more, np.vstack([triangles, [[len(more) - 3, len(more) - 2, len(more) - 1]]]))
            raster = rasterise(mesh, camera)
            wrong += int((raster.triangle != alone.triangle).sum())
    return wrong


@case(
    "Cameras of an object from a micrometre to a kilometre",
    hazard="thresholds and tolerances that are not relative to the size",
    treatment="points about their mean, of unit size; box, grid and decimation in units of the scene",
    reference="the same at scale 1",
    bound=1e-6,
    unit="of the size",
    outcome="equivariant: circle of the cameras, point in sight, hull, distances, triangles",
)
def test_equivariance_of_size():
    cameras = turn(8)
    masks = [sphere(camera) for camera in cameras]
    hull = carve(masks, cameras, cells=24)
    vertices, triangles = globe(16, 24)
    vertices = vertices * np.random.default_rng(4).uniform(0.98, 1.02, (len(vertices), 1))  # no two collapses alike
    mesh = Mesh.of(vertices, triangles)
    plain = (
        np.array(
            [
                *turn_of(np.array([c.centre for c in cameras])).centre,
                turn_of(np.array([c.centre for c in cameras])).radius,
            ]
        ),
        cameras_of_matrices({c.name: c.matrix for c in cameras}, rows=ROWS, columns=COLUMNS).target,
        shape_of(hull.mesh),
        distances(2 * vertices, mesh),
        fewest_triangles(mesh, cameras, deviation_px=1.0, rounds=3).mesh,
    )

    def measure(exponent):
        s = float(10.0**exponent)
        moved = [scaled_camera(camera, s) for camera in cameras]
        around = turn_of(np.array([c.centre for c in moved]))
        target = cameras_of_matrices({c.name: c.matrix for c in moved}, rows=ROWS, columns=COLUMNS).target
        shape = shape_of(carve(masks, moved, cells=24).mesh)
        body = Mesh.of(vertices * s, triangles)
        light = fewest_triangles(body, moved, deviation_px=1.0, rounds=3).mesh
        same = len(light.triangles) == len(plain[4].triangles) and shape.watertight
        errors = [
            relative(np.array([*around.centre, around.radius]) / s, plain[0]),
            np.abs(target / s - plain[1]).max(),
            abs(shape.volume / s**3 / plain[2].volume - 1),
            relative(distances(2 * vertices * s, body) / s, plain[3]),
        ]
        return max(errors) if same else np.inf

    return worst_over(measure, st.sampled_from([-9.0, -6.0, -3.0, 3.0, 6.0, 9.0]), examples=6)


@case(
    "A small object far from the cameras",
    hazard="the box of the object is a linear program whose tolerance is relative to the cameras' distance",
    treatment="the program is solved again about the box that it found, in units of that box",
    reference="the box of the same silhouettes seen from near",
    bound=1e-3,
    unit="of the object",
    outcome="the same box at distances of 1e3 to 1e5",
)
def test_a_small_object_far_away():
    worst, near = 0.0, None
    for distance in (1e3, 1e4, 1e5):
        cameras = turn(8, distance=distance, focal=260.0 * distance / 5)
        box = carve([sphere(camera) for camera in cameras], cameras, cells=16).box
        near = box if near is None else near
        worst = max(worst, np.abs(box - near).max())
    return worst


@case(
    "Degenerate triangles in a mesh",
    hazard="zero area, repeated corners, needles, doubled and crowded triangles, touching cones, unused vertices",
    treatment="`clean`: what has no direction is left out and counted, relative to its own size",
    reference="the mesh without them",
    bound=0,
    unit="triangles and vertices that differ",
    outcome="the same sound surface; every kind counted",
)
def test_degenerate_triangles():
    vertices, triangles = globe()
    wrong = 0
    for s in (1e-9, 1.0, 1e9):
        v, t = vertices * s, triangles
        sound, none = clean(v, t)
        n = len(v)
        extra = np.vstack([v[5:6], v[3:4] * (1 + 1e-16), [[7 * s, 0, 0]], (v[4:5] + v[5:6]) / 2])
        bad = [(3, 3, 4), (4, 4, 4), (n, 5, 6), (4, 5, n + 3), t[0], t[0][[1, 0, 2]], (n + 1, 3, 8)]
        mesh, found = clean(np.vstack([v, extra]), np.vstack([t, bad]))
        wrong += len(mesh.triangles) != len(sound.triangles)
        wrong += not np.array_equal(np.sort(mesh.vertices, axis=0), np.sort(sound.vertices, axis=0))
        wrong += found.degenerate != 5 or found.duplicates != 2 or found.unreferenced != 1 or none.degenerate != 0
        wrong += not np.isfinite(mesh.normals).all() or not shape_of(mesh).watertight
    return wrong


@case(
    "A mesh of nothing but degenerate triangles",
    hazard="an empty mesh that goes on",
    treatment="refused",
    bound=0,
    unit="meshes that passed of 4",
    outcome="exit status 2 in the stage: look at the mesh file",
)
def test_nothing_but_degenerate():
    passed = 0
    line = np.outer(np.arange(6.0), [1, 2, 3])
    for vertices, triangles in (
        (line, [(0, 1, 2), (3, 4, 5)]),
        (np.zeros((3, 3)), [(0, 1, 2)]),
        (line, np.zeros((0, 3), int)),
        (line + 1e9, [(0, 1, 2)]),
    ):
        try:
            clean(vertices, np.array(triangles, int))
            passed += 1
        except ValueError:
            continue
    return passed


def exact_distance(p, a, b, c):
    """Distance of a point to a triangle in 50 digits, by all regions."""
    with mpmath.workdps(50):
        p, a, b, c = (mpmath.matrix([mpmath.mpf(float(x)) for x in v]) for v in (p, a, b, c))

        def dot(x, y):
            return sum(x[k] * y[k] for k in range(3))

        best = None
        for s, e in ((a, b), (b, c), (c, a)):
            along = e - s
            length = dot(along, along)
            t = min(max(dot(p - s, along) / length, 0), 1) if length else mpmath.mpf(0)
            d = p - s - t * along
            best = dot(d, d) if best is None else min(best, dot(d, d))
        u, v, w = b - a, c - a, p - a
        uu, uv, vv, wu, wv = dot(u, u), dot(u, v), dot(v, v), dot(w, u), dot(w, v)
        det = uu * vv - uv * uv
        if det > 0:
            x, y = (vv * wu - uv * wv) / det, (uu * wv - uv * wu) / det
            if x >= 0 and y >= 0 and x + y <= 1:
                d = w - x * u - y * v
                best = min(best, dot(d, d))
        return float(mpmath.sqrt(best))


@case(
    "Distance to needles and to triangles without area",
    hazard="normals and feet of triangles whose height is 1e-12 of their length",
    treatment="the nearest of plane and edges; without an area the edges alone",
    reference="mpmath, 50 digits",
    bound=1e-7,
    unit="of the longest length",
    outcome="never NaN; exact to rounding",
)
def test_distance_to_needles():
    def measure(height, along, x, y, z, scale):
        corners = scale * np.array([[0, 0, 0], [1, 0, 0], [along, height, 0]])
        point = scale * np.array([x, y, z])
        found = point_to_triangle(point[None], corners[None])[0]
        return abs(found - exact_distance(point, *corners)) / (scale * max(1.0, np.abs([x, y, z]).max()))

    number = st.floats(-2, 2)
    heights = st.one_of(st.just(0.0), powers_of_ten(-15, 0))
    return worst_over(measure, heights, number, number, number, number, powers_of_ten(-9, 9), examples=120)


@case(
    "Correspondences that determine no camera",
    hazard="on a line, in one point, too few, NaN, flat and seen from afar, pixels that belong to other points",
    treatment="spread, count, finiteness and a second solution are looked at before a pose is believed",
    bound=0,
    unit="sights that passed of 16",
    outcome="exit status 2 that names the view and what to pick",
)
def test_correspondences_without_a_camera():
    camera = turn(1)[0]
    rng = np.random.default_rng(2)
    spread = rng.uniform(-0.6, 0.6, (8, 3))
    line = np.outer(np.linspace(-0.5, 0.5, 8), [1.0, 0.2, 0.1])
    flat = np.column_stack([rng.uniform(-0.02, 0.02, (5, 2)), np.zeros(5)])
    bad = spread.copy()
    bad[3, 1] = np.nan
    sights = [(line, None), (np.zeros((8, 3)), None), (spread[:3], None), (bad, None), (flat, 0.5)]
    wrong = 0
    for points, noise in sights:
        pixels = camera.project(np.nan_to_num(points))[0]
        wrong += passes(camera, points, pixels + (rng.normal(0, noise, pixels.shape) if noise else 0))
    pixels = camera.project(spread)[0]
    wrong += sum(passes(camera, spread, rng.uniform(0, 100, pixels.shape)) for _ in range(10))
    wrong += passes(camera, spread, np.full(pixels.shape, 50.0))
    return wrong


def passes(camera, points, pixels):
    try:
        estimate_pose(Sight("v", points, pixels), camera.intrinsics, rows=ROWS, columns=COLUMNS, outlier_px=2.0)
        return True
    except UserError:
        return False


@case(
    "Pose from points of any unit, far from the origin",
    hazard="normal equations of points at 1e9 or 1e-9, or moved by 1000 times their size",
    treatment="points about their mean, of unit size",
    reference="the true camera",
    bound=1e-4,
    unit="px",
    outcome="the same pose",
)
def test_pose_at_any_scale():
    camera = turn(1)[0]
    points = np.random.default_rng(1).uniform(-0.6, 0.6, (12, 3))
    pixels = camera.project(points)[0]

    def measure(exponent, offset):
        s = 10.0**exponent
        moved = s * (points + offset * np.array([1.0, -0.5, 0.25]))
        found = estimate_pose(
            Sight("v", moved, pixels), camera.intrinsics, rows=ROWS, columns=COLUMNS, outlier_px=2.0
        ).camera
        return np.abs(found.project(moved)[0] - pixels).max()

    return worst_over(measure, st.floats(-9, 9), st.sampled_from([0.0, 10.0, 1000.0]), examples=12)


@case(
    "Circle of the cameras from few or useless views",
    hazard="one, two or equal centres, centres on a line",
    treatment="no circle is claimed",
    bound=0,
    unit="wrong outcomes of 6",
    outcome="none; three views give one",
)
def test_circle_from_few_views():
    centres = np.array([c.centre for c in turn(3)])
    useless = [
        centres[:1],
        centres[:2],
        np.repeat(centres[:1], 5, axis=0),
        np.outer(np.arange(4.0), [1, 2, 3]),
        centres[:0],
    ]
    return sum(turn_of(each) is not None for each in useless) + (turn_of(centres) is None)


@case(
    "Silhouettes that are empty, full, or show one pixel",
    hazard="no outline: infinite distances, an empty or unbounded hull",
    treatment="empty and unbounded ones are refused with the view; distances are clipped to 1e6 px",
    bound=0,
    unit="wrong outcomes of 7",
    outcome="exit status 2, or a finite hull",
)
def test_silhouettes_without_an_outline():
    cameras = turn(6)
    masks = [sphere(camera) for camera in cameras]
    empty, full, one = np.zeros_like(masks[0]), np.ones_like(masks[0]), np.zeros_like(masks[0])
    one[60, 80] = True
    wrong = int(not np.isfinite(signed_distance(empty)).all()) + int(not np.isfinite(signed_distance(full)).all())
    for given in ([empty, *masks[1:]], [full] * 6, [None] * 6, [masks[0], *[None] * 5], [~masks[0], one, *masks[2:]]):
        try:
            hull = carve(given, cameras, cells=16)
            wrong += not np.isfinite(hull.mesh.vertices).all() or not len(hull.mesh.triangles)
            wrong += given[0] is not masks[0] and given[0] is empty
        except UserError:
            continue
    return wrong


@case(
    "Pictures without an object, or of nothing but noise",
    hazard="clusters of one colour, a border as large as the picture, percentiles of black",
    treatment="floors of the clusters' spread; an outline that is not there has a separation of 0",
    bound=0,
    unit="failures of 8",
    outcome="a mask of the picture's shape and a finite separation",
)
def test_pictures_without_an_object():
    rng = np.random.default_rng(0)
    failures = 0
    pictures = [np.full((40, 50, 3), code, np.uint8) for code in (0, 128, 255)]
    pictures += [rng.integers(0, 256, (40, 50, 3)).astype(np.uint8), np.zeros((5, 5, 3), np.uint8)]
    pictures += [np.zeros((1, 1, 3), np.uint8), np.zeros((3, 60, 3), np.uint8)]
    ramp = np.broadcast_to(np.arange(0, 250, 5, dtype=np.uint8)[None, :, None], (40, 50, 3)).copy()
    for picture in (*pictures, ramp):
        try:
            found = segment(picture)
            failures += found.mask.shape != picture.shape[:2] or not np.isfinite(found.separation)
        except (ValueError, IndexError, ArithmeticError, Warning):
            failures += 1
    return failures


@case(
    "Masks that agree in nothing",
    hazard="0/0 in the overlap of two empty masks",
    treatment="two empty masks agree",
    bound=0,
    unit="wrong values of 3",
    outcome="1, 0, 0",
)
def test_overlap_of_empty_masks():
    empty, full = np.zeros((3, 4), bool), np.ones((3, 4), bool)
    return int(agreement(empty, empty) != 1) + int(agreement(empty, full) != 0) + int(agreement(full, empty) != 0)


@case(
    "Decimation and smoothing of a mesh with needles",
    hazard="quadrics of flat neighbourhoods are singular; edges of length 0",
    treatment="collapses that would turn a triangle over are not made; movement is bounded in pixels",
    bound=0,
    unit="wrong outcomes of 9",
    outcome="finite, sound, never more triangles than asked",
)
def test_decimation_of_needles():
    wrong = 0
    rng = np.random.default_rng(5)
    flat = np.column_stack([rng.uniform(0, 1, (60, 2)), np.zeros(60)])
    from scipy.spatial import Delaunay

    plate = Delaunay(flat[:, :2]).simplices
    needles = flat * [1.0, 1e-7, 1.0]
    ball, faces = globe(12, 18)
    for vertices, triangles, closed in (
        (flat, plate, False),
        (needles, plate, False),
        (ball * [1, 1, 1e-6], faces, True),
    ):
        mesh, _ = clean(vertices, triangles)
        for wanted in (4, 20):
            light = decimate(mesh, wanted)
            wrong += not np.isfinite(light.vertices).all() or not np.isfinite(light.normals).all()
            wrong += len(light.triangles) > len(mesh.triangles)
        soft = smooth_outline_steps(mesh, turn(3), most_px=0.5)
        wrong += not np.isfinite(soft.vertices).all() or (closed and not shape_of(mesh).watertight)
    return wrong
