"""Sweeps: advice derived from the figures."""

import pytest
from refusals import expect_facts

from nishiki.sweep.front import VariantPoint, advice, share


def point(name, time, loss, spread=0.02):
    return VariantPoint(name, time, time * (1 - spread), time * (1 + spread), loss)


DEFAULT = point("default", 10.0, 4.4)


def said(*others, paper=None, higher=False, unit="°"):
    return advice([DEFAULT, *others], DEFAULT, paper=paper, unit=unit, higher=higher, axis="time")


def test_on_the_front_with_a_faster_and_a_better_neighbour():
    lines = said(
        point("quick", 5.0, 4.5), point("quicker", 2.0, 6.0), point("slow", 20.0, 4.2), point("bad", 30.0, 9.0)
    )
    assert len(lines) == 4
    for line, facts in zip(
        lines, (("default",), ("quick", "0.1°"), ("quicker", "1.6°"), ("slow", "0.2°")), strict=True
    ):
        expect_facts(line, *facts)


def test_nothing_better():
    lines = said(point("bad", 30.0, 9.0))
    assert len(lines) == 2
    assert not [line for line in lines if "bad" in line]


def test_off_the_front_says_what_is_ahead():
    lines = said(point("ahead", 5.0, 4.0))
    assert len(lines) == 1
    expect_facts(lines[0], "default", "ahead", "0.4°")


def test_off_the_front_still_says_what_else_saves_time_or_errs_less():
    lines = said(point("ahead", 9.0, 4.3, spread=0.01), point("quick", 2.0, 5.0), point("best", 40.0, 3.9))
    expect_facts(lines[1], "quick", "0.6°")
    expect_facts(lines[2], "best", 4, "0.5°")


def test_within_the_spread_is_said():
    (line,) = said(point("same", 9.9, 4.4))
    expect_facts(line, "default", "same")


def test_a_saving_within_the_spread_is_not_advised():
    wide = VariantPoint("wide", 8.0, 5.0, 11.0, 4.5)
    assert not [line for line in said(wide) if "wide" in line]


def test_more_is_better_is_said_the_other_way_round():
    default, quick = point("default", 10.0, -40.0), point("quick", 5.0, -39.0)
    lines = advice([default, quick], default, paper=quick, unit="dB", higher=True, axis="CPU time")
    assert len([line for line in lines if "quick" in line and "1 dB" in line]) == 2


@pytest.mark.parametrize(
    ("ratio", "text"),
    [
        (0.51, "half"),
        (0.34, "third"),
        (0.62, "0.62"),
        (1.02, "same"),
        (1.96, "twice"),
        (3.14159, "3.1"),
        (12.4, "12"),
    ],
)
def test_shares_in_words(ratio, text):
    expect_facts(share(ratio, "time"), text, "time")
