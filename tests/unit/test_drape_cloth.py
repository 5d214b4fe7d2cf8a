"""The falling cloth: rests on its support, keeps its length, does not pass through itself, is the same every time."""

import numpy as np
import pytest

from nishiki.errors import UserError
from nishiki.render.cloth.cloth import Cloth, Support, drape, refined
from nishiki.render.cloth.cloth_kernels import distance_to_support, keep_length, keep_shape, keep_straight

SMALL = {"levels": (17, 33), "seconds": (1.2, 0.4)}


@pytest.fixture(scope="module", params=["ball", "table"])
def fallen(request):
    support = Support("ball", 0.16, 0.46) if request.param == "ball" else Support("table", 0.24, 0.42)
    return support, drape(support, Cloth(), **SMALL)


def test_the_cloth_rests(fallen):
    support, draped = fallen
    points = draped.points.reshape(-1, 3)
    kind = 0 if support.kind == "ball" else 1
    away = [distance_to_support(*p, kind, support.radius, support.top, support.edge)[0] for p in points]
    assert min(away) > 0.0019
    assert points[:, 1].min() > 0.0019
    assert draped.settled < 0.05
    assert draped.strain < 0.04
    assert draped.nearest > 0.4
    assert np.isfinite(points).all()
    # It hangs: its rim is well below its middle, which stays on top.
    middle = draped.points[16, 16]
    assert abs(middle[1] - support.top) < 0.02
    assert draped.points[0, 0, 1] < 0.5 * support.top


def test_the_same_every_time(fallen):
    support, draped = fallen
    again = drape(support, Cloth(), **SMALL)
    assert np.array_equal(again.points, draped.points)


def test_a_heavier_cloth_is_not_wider():
    stiff = drape(Support(), Cloth(bend=3e-3), **SMALL).points
    soft = drape(Support(), Cloth(bend=2e-5), **SMALL).points
    assert np.linalg.norm(stiff[0, 0, ::2]) > np.linalg.norm(soft[0, 0, ::2])


def test_distances_to_the_supports():
    rng = np.random.default_rng(0)
    # Ball: known in closed form.
    for p in rng.normal(size=(50, 3)):
        found = distance_to_support(*p, 0, 0.4, 0.5, 0.1)
        away = p - [0, 0.1, 0]
        assert found[0] == pytest.approx(np.linalg.norm(away) - 0.4)
        assert np.allclose(found[1:], away / np.linalg.norm(away))
    # Table: the gradient of the distance is the normal, of unit length, wherever it is smooth.
    for p in rng.normal(size=(200, 3)) * [0.5, 0.3, 0.5] + [0, 0.4, 0]:
        here = distance_to_support(*p, 1, 0.4, 0.5, 0.1)
        steps = 1e-6 * np.eye(3)
        slope = [distance_to_support(*(p + s), 1, 0.4, 0.5, 0.1)[0] - here[0] for s in steps]
        over, above = np.hypot(p[0], p[2]) - 0.3, p[1] - 0.4
        if min(abs(over), abs(above), abs(over - above)) > 1e-3:
            assert np.allclose(np.array(slope) / 1e-6, here[1:], atol=1e-4)
    assert distance_to_support(0.0, 0.7, 0.0, 1, 0.4, 0.5, 0.1)[0] == pytest.approx(0.2)
    assert distance_to_support(0.6, 0.2, 0.0, 1, 0.4, 0.5, 0.1)[0] == pytest.approx(0.2)


def test_constraints_move_points_to_where_they_hold():
    x = np.zeros((2, 1, 3))
    x[1, 0] = [0, 3, 4]
    keep_length(x, 0, 0, 1, 0, 1.0, 0.0)
    assert np.linalg.norm(x[1, 0] - x[0, 0]) == pytest.approx(1.0)
    assert np.allclose(x.sum(axis=0), [0, 3, 4])
    y = np.random.default_rng(1).normal(size=(3, 1, 3))
    total = y.sum(axis=0).copy()
    keep_straight(y, 0, 0, 1, 0, 2, 0, 0.0)
    assert np.allclose(y[0] - 2 * y[1] + y[2], 0)
    assert np.allclose(y.sum(axis=0), total)


def test_a_flat_sheet_at_rest_stays():
    u, v = np.meshgrid(np.arange(6.0), np.arange(6.0), indexing="ij")
    x = np.stack([u, 0 * u, v], axis=2)
    moved = x.copy()
    keep_shape(moved, 1.0, 0.0, 0.0, 0.0)
    assert np.allclose(moved, x, atol=1e-12)


def test_refining_keeps_the_points():
    coarse = np.random.default_rng(2).normal(size=(9, 9, 3))
    assert np.allclose(refined(coarse, 17)[::2, ::2], coarse, atol=1e-12)


@pytest.mark.parametrize(
    ("support", "cloth", "more", "words"),
    [
        (Support("chair"), Cloth(), {}, "ball or table"),
        (Support(radius=-1), Cloth(), {}, "above 0"),
        (Support(), Cloth(side=float("nan")), {}, "above 0"),
        (Support(), Cloth(bend=-1), {}, "0 or more"),
        (Support(), Cloth(), {"levels": (33, 17)}, "rising"),
    ],
)
def test_what_cannot_fall_is_named(support, cloth, more, words):
    with pytest.raises(UserError, match=words):
        drape(support, cloth, **{**SMALL, **more})
