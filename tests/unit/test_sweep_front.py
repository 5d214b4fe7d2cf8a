"""Sweeps: the front of error against time, against the obvious definition."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from nishiki.sweep.front import VariantPoint, beaten_by, front

FEW = st.sampled_from([0.0, 0.5, 1.0, 1.5, 2.0])
ANY = st.floats(0, 1e6)


def point(time, loss, *, spread=0.0, name=""):
    return VariantPoint(name, time, time * (1 - spread), time * (1 + spread), loss)


def by_definition(points):
    """Points that no other one beats: at least as good in both, better in one."""
    return {
        k
        for k, a in enumerate(points)
        if not any(b.time <= a.time and b.loss <= a.loss and (b.time < a.time or b.loss < a.loss) for b in points)
    }


@given(st.lists(st.tuples(st.one_of(FEW, ANY), st.one_of(FEW, ANY)), max_size=40))
def test_front_is_what_its_definition_says(pairs):
    points = [point(*pair) for pair in pairs]
    found = front(points)
    assert set(found) == by_definition(points)
    assert len(found) == len(set(found))
    times = [points[k].time for k in found]
    assert times == sorted(times)


def test_a_large_front_takes_no_time():
    rng = np.random.default_rng(0)
    points = [point(*pair) for pair in rng.random((20_000, 2))]
    found = front(points)
    losses = [points[k].loss for k in found]
    assert losses == sorted(losses, reverse=True)
    assert points[found[-1]].loss == min(each.loss for each in points)


@pytest.mark.parametrize(
    ("other", "clear"),
    [
        (point(0.5, 1.0, spread=0.05), True),  # faster beyond the spread, equal error
        (point(0.99, 1.0, spread=0.05), False),  # faster within the spread, equal error
        (point(0.99, 0.995, spread=0.05), False),  # and half a per cent better
        (point(0.99, 0.9, spread=0.05), True),  # and a tenth better
    ],
)
def test_beaten_clearly_or_within_the_spread(other, clear):
    default = point(1.0, 1.0, spread=0.05)
    assert beaten_by(default, [other, point(2.0, 0.1), point(0.1, 2.0)]) == ([other], clear)


def test_nobody_beats_its_equal():
    assert beaten_by(point(1.0, 1.0), [point(1.0, 1.0)]) == ([], False)
