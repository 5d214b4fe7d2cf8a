"""Rasteriser, charts, atlas and texels on triangles that have no area and views that hardly see."""

from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import strategies as st
from stability.cases import case, worst_over
from turned_cameras import turn

from nishiki.atlas.atlas import build_atlas
from nishiki.atlas.charts import make_charts, probe_spacing, turning
from nishiki.atlas.quality import (
    atlas_picture,
    sampling_density,
    stretch_percentiles,
    texels_per_pixel,
    texels_per_unit,
)
from nishiki.atlas.surface import object_pixels, pixel_places, sample_view, texel_points, texel_triangles
from nishiki.geometry.camera import Camera
from nishiki.geometry.mesh import Mesh
from nishiki.geometry.visibility import rasterise

UP, FRONT = np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0])
IDENTITY = Camera("flat", np.diag([1.0, 1.0, 1.0]), np.eye(3), np.array([0.0, 0.0, 1.0]), 24, 32)


def laid_out(mesh, cameras, size=16):
    charts = make_charts(mesh, up=UP, front=FRONT, spacing=probe_spacing(mesh, cameras, texels_per_pixel=1.0))
    density = sampling_density(mesh, charts.plane, cameras, percentile=90)
    scale = texels_per_unit(density, charts.plane, charts.chart, texels_per_pixel=1.0)
    return charts, build_atlas(charts.plane, charts.chart, scale, size=size)


def body(seed=0):
    """A closed surface with triangles of many shapes."""
    from scipy.spatial import ConvexHull

    points = np.random.default_rng(seed).normal(size=(60, 3))
    points *= 0.7 / np.linalg.norm(points, axis=1, keepdims=True)
    hull = ConvexHull(points)
    a, b, c = (points[hull.simplices[:, k]] for k in range(3))
    out = np.einsum("ij,ij->i", np.cross(b - a, c - a), hull.equations[:, :3]) < 0
    return points, np.where(out[:, None], hull.simplices[:, ::-1], hull.simplices)


def inside_exactly(corners, column, row):
    """Whether a pixel centre lies within a triangle, in exact rationals; None within 1e-9 px of its border."""
    points = [(Fraction(float(x)), Fraction(float(y))) for x, y in corners]
    (ax, ay), (bx, by), (cx, cy) = points
    if (bx - ax) * (cy - ay) - (by - ay) * (cx - ax) < 0:
        points = points[::-1]
    heights = []
    for k in range(3):
        (ax, ay), (bx, by) = points[k], points[(k + 1) % 3]
        length = Fraction(float(np.hypot(float(bx - ax), float(by - ay))) or 1.0)
        heights.append(((bx - ax) * (row - ay) - (by - ay) * (column - ax)) / length)
    if min(heights) < -1e-9:
        return False
    return True if min(heights) > 1e-9 else None


def _needle(ax, ay, bx, by, thin):
    """Pixels where the raster of one needle and exact arithmetic differ; depth 1, so that pixels are coordinates."""
    across = np.array([ay - by, bx - ax])
    length = np.hypot(*across) or 1.0
    corners = np.array([[ax, ay], [bx, by], [(ax + bx) / 2, (ay + by) / 2] + thin * across / length])
    mesh = Mesh.of(np.column_stack([corners, np.zeros(3)]), np.array([[0, 1, 2]]))
    shown = rasterise(mesh, IDENTITY).triangle >= 0
    projected = IDENTITY.project(mesh.vertices)[0]
    wrong = 0
    for row in range(IDENTITY.rows):
        for column in range(IDENTITY.columns):
            exact = inside_exactly(projected, column, row)
            wrong += exact is not None and exact != shown[row, column]
    return float(wrong)


@pytest.mark.slow
@case(
    "Needles thinner than any pixel",
    hazard="edge functions of a triangle 1e-12 px wide are all rounding",
    treatment="an edge is evaluated from the same corner by both of its triangles",
    reference="exact rationals, at every pixel centre more than 1e-9 px off the border",
    bound=0,
    unit="pixels",
    outcome="the exact pixels",
)
def test_needles_in_the_raster():
    place = st.one_of(st.integers(-3, 35).map(float), st.floats(-3, 35))
    return worst_over(_needle, place, place, place, place, st.sampled_from([1e-12, 1e-6, 1e-2, 0.3, 5.0]), examples=12)


@case(
    "A surface cut into needles",
    hazard="gaps and doubled pixels along edges shared by needles",
    treatment="a pixel centre on an edge belongs to one of its two triangles",
    reference="every pixel of the square once",
    bound=0,
    unit="pixels not shown once",
    outcome="no gap, no doubling",
)
def test_a_fan_of_needles():
    wrong = 0
    for count in (3, 50, 300):
        for hub in ((15.5, 11.5), (16.0, 12.0), (1e-9, 1e-9)):
            step = np.linspace(0, 1, count + 1)[:-1, None]
            square = np.array([[0, 0], [31, 0], [31, 23], [0, 23]])
            rim = np.concatenate([square[k] + step * (square[(k + 1) % 4] - square[k]) for k in range(4)])
            points = np.vstack([[hub], rim])
            n = len(rim)
            faces = np.column_stack([np.zeros(n, int), 1 + np.arange(n), 1 + (np.arange(n) + 1) % n])
            mesh = Mesh.of(np.column_stack([points, np.zeros(n + 1)]), faces)
            total = np.zeros((24, 32), int)
            shown = rasterise(mesh, IDENTITY).triangle
            for k in np.unique(shown[shown >= 0]):
                one = Mesh.of(mesh.vertices, mesh.triangles[k : k + 1])
                total += rasterise(one, IDENTITY).triangle >= 0
            inner = (slice(1, 23), slice(1, 31))
            wrong += int((shown[inner] < 0).sum()) + int((total[inner] > 1).sum())
    return wrong


@case(
    "Charts and texels of a mesh with degenerate triangles",
    hazard="no normal, no area, no density: 0/0 in charts, in texels per unit and in the points behind texels",
    treatment="such triangles get no chart unless they join one, no density, and no texel asks them for a direction",
    reference="the charts of the sound triangles",
    bound=0,
    unit="wrong outcomes",
    outcome="finite atlas, positions and unit normals; the sound triangles keep their places",
)
def test_texels_of_degenerate_triangles():
    wrong = 0
    vertices, triangles = body()
    cameras = turn(6)
    n = len(vertices)
    odd = np.vstack([vertices, [[0, 0, 3.0]], vertices[:1] + 1e-15, [(vertices[3] + vertices[4]) / 2]])
    bad = [(n, n, n), (0, n + 1, 5), (3, 4, n + 2), (7, 7, 8)]
    for faces in (triangles, np.vstack([triangles, bad]), np.array(bad)):
        mesh = Mesh.of(odd, faces)
        charts, atlas = laid_out(mesh, cameras)
        nearest = texel_triangles(atlas)
        positions, normals, inside = texel_points(mesh, atlas, nearest, slice(None))
        for values in (atlas.corners, atlas.texels_per_unit, positions, normals, charts.plane[charts.chart >= 0]):
            wrong += not np.isfinite(values).all()
        wrong += inside.any() and np.abs(np.linalg.norm(normals[inside], axis=-1) - 1).max() > 1e-5
        wrong += (charts.chart[: len(triangles)] < 0).any() and len(faces) > 4
        for camera in cameras[:2]:
            raster = rasterise(mesh, camera)
            places = pixel_places(atlas, raster, object_pixels(mesh, camera, raster, None))
            wrong += not (np.isfinite(places.s).all() and np.isfinite(places.t).all())
            per_pixel = texels_per_pixel(mesh, atlas, camera, raster.triangle[raster.triangle >= 0])
            wrong += per_pixel is not None and not np.isfinite(per_pixel)
        wrong += not np.isfinite([v for v in stretch_percentiles(mesh, atlas) if v is not None]).all()
    return wrong


def _sized(exponent):
    s = 10.0**exponent
    vertices, triangles = body(3)
    found = []
    for scale in (1.0, s):
        cameras = [replace(c, translation=c.translation * scale) for c in turn(6)]
        mesh = Mesh.of(vertices * scale, triangles)
        charts, atlas = laid_out(mesh, cameras)
        nearest = texel_triangles(atlas)
        positions, _, inside = texel_points(mesh, atlas, nearest, slice(None))
        raster = rasterise(mesh, cameras[0])
        found.append((charts.chart, atlas.tiles, positions / scale, inside, raster.triangle))
    (chart, tiles, places, inside, shown), (chart1, tiles1, places1, inside1, shown1) = found
    if tiles != tiles1 or (chart != chart1).any() or (inside != inside1).mean() > 0.01 or (shown != shown1).any():
        return np.inf
    both = inside & inside1
    return float(np.abs(places - places1)[both].max())


@case(
    "Charts, atlas and raster of an object from a micrometre to a kilometre",
    hazard="areas of 1e-18, probes and densities in absolute units",
    treatment="everything is relative to the mesh or to a pixel",
    reference="the same at scale 1",
    bound=2e-3,
    unit="of the object's size",
    outcome="the same charts, tiles and pixels",
)
def test_equivariance_of_the_atlas():
    return worst_over(_sized, st.sampled_from([-6.0, -3.0, 3.0, 6.0]), examples=4)


@case(
    "Texels seen once, twice, never, and from the edge",
    hazard="1/cos of a grazing view in the depth tolerance; neighbours of the last row and column; NaN beside a pixel",
    treatment="grazing texels are not visible; a neighbour without weight is not read",
    reference="the picture itself at whole pixels",
    bound=1e-6,
    outcome="values finite, 0 where not visible",
)
def test_texels_at_the_edge_of_a_view():
    camera = IDENTITY
    rows, columns = camera.rows, camera.columns
    grid = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), axis=-1).astype(float)
    positions = np.concatenate([grid, np.zeros((rows, columns, 1))], axis=-1).astype(np.float32)
    normals = np.zeros_like(positions)
    normals[..., 2] = -1.0
    picture = np.random.default_rng(0).uniform(0, 1, (rows, columns, 2)).astype(np.float32)
    usable = np.ones((rows, columns), bool)
    usable[5, 7], usable[10:12, :] = False, False
    picture[~usable] = np.nan
    depth = np.where(usable, np.float32(1), np.float32(np.inf))
    (found,) = sample_view(
        positions,
        normals,
        np.ones((rows, columns), bool),
        camera=camera,
        depth=depth,
        pictures=[picture],
        grazing_deg=89.9,
    )
    if not np.isfinite(found.values).all() or found.values[~found.visible].any() or (found.visible & ~usable).any():
        return np.inf
    tilted = np.broadcast_to([1.0, 0.0, 1e-9], normals.shape).astype(np.float32)
    (edge_on,) = sample_view(
        positions, tilted, np.ones((rows, columns), bool), camera=camera, depth=depth, pictures=[picture]
    )
    (nothing,) = sample_view(
        positions,
        normals,
        np.zeros((rows, columns), bool),
        camera=camera,
        depth=depth,
        pictures=[picture],
    )
    if not np.isfinite(edge_on.values).all() or nothing.visible.any() or found.visible.mean() < 0.8:
        return np.inf
    return float(np.abs(found.values - picture)[found.visible].max())


@case(
    "Mean colours of texels that no view shows",
    hazard="0/0 in the mean colour of a texel",
    treatment="unseen texels are NaN in memory only, and grey in the picture",
    bound=0,
    unit="wrong pictures",
    outcome="no NaN reaches a file",
)
def test_pictures_of_unseen_texels():
    vertices, triangles = body()
    mesh, cameras = Mesh.of(vertices, triangles), turn(3)
    _, atlas = laid_out(mesh, cameras)
    shape = (atlas.tiles, atlas.size, atlas.size, 3)
    wrong = 0
    for texels in (np.full(shape, np.nan, np.float32), np.ones(shape, np.float32)):
        picture = atlas_picture(atlas, texels)
        shown = np.nan_to_num(picture)
        wrong += picture.ndim != 3 or not np.isfinite(shown).all()
    return wrong


@case(
    "Cameras that all look down, in one place, or one alone",
    hazard="no axis across the pictures, no middle between views",
    treatment="another axis is taken where one vanishes",
    bound=1e-9,
    unit="departure from orthonormal",
    outcome="unit, perpendicular axes; a positive probe spacing",
)
def test_axes_of_few_cameras():
    vertices, triangles = body()
    mesh, worst = Mesh.of(vertices, triangles), 0.0
    down = Camera("d", np.diag([200.0, 200, 1]), np.diag([1.0, -1, -1]), np.array([0, 0, 4.0]), 40, 40)
    upside = replace(down, rotation=np.diag([-1.0, 1, -1]))
    away = replace(down, translation=np.array([0, 0, -9.0]))
    for cameras in ([down], [down, upside], [down] * 3, turn(1), turn(2), [away], turn(4)):
        up, front = turning(cameras)
        spacing = probe_spacing(mesh, cameras, texels_per_pixel=1.0)
        worst = max(worst, abs(np.linalg.norm(up) - 1), abs(np.linalg.norm(front) - 1), abs(up @ front))
        worst = worst if np.isfinite(spacing) and spacing > 0 else np.inf
    return worst
