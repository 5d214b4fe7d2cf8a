"""Sweeps: advice derived from the figures."""

import pytest

from nishiki.sweep.front import Point, advice, share


def point(name, time, loss, spread=0.02):
    return Point(name, time, time * (1 - spread), time * (1 + spread), loss)


DEFAULT = point("default", 10.0, 4.4)


def said(*others, paper=None, higher=False, unit="°"):
    return advice([DEFAULT, *others], DEFAULT, paper=paper, unit=unit, higher=higher, axis="time")


def test_on_the_front_with_a_faster_and_a_better_neighbour():
    lines = said(
        point("quick", 5.0, 4.5), point("quicker", 2.0, 6.0), point("slow", 20.0, 4.2), point("bad", 30.0, 9.0)
    )
    assert lines == [
        "The default (default) is on the front: no variant is both faster and better.",
        "To save time: quick: half the time for 0.1° more.",
        "To save time: quicker: a fifth of the time for 1.6° more.",
        "For less error: slow: twice the time and 0.2° less.",
    ]


def test_nothing_better():
    assert said(point("bad", 30.0, 9.0)) == [
        "The default (default) is on the front: no variant is both faster and better.",
        "No variant is better at any price.",
    ]


def test_off_the_front_says_what_is_ahead():
    lines = said(point("ahead", 5.0, 4.0))
    assert lines == [
        "The default (default) is not on the front. At least as fast and better: ahead (half the time and 0.4° less)."
    ]


def test_off_the_front_still_says_what_else_saves_time_or_errs_less():
    lines = said(point("ahead", 9.0, 4.3, spread=0.01), point("quick", 2.0, 5.0), point("best", 40.0, 3.9))
    assert lines[1:] == [
        "To save time: quick: a fifth of the time for 0.6° more.",
        "For less error: best: 4 times the time and 0.5° less.",
    ]


def test_within_the_spread_is_said():
    (line,) = said(point("same", 9.9, 4.4))
    assert "on the front within the spread" in line
    assert "same (the same time for the same error)" in line


def test_a_saving_within_the_spread_is_not_advised():
    wide = Point("wide", 8.0, 5.0, 11.0, 4.5)
    assert not [line for line in said(wide) if "To save time" in line]


def test_more_is_better_is_said_the_other_way_round():
    default, quick = point("default", 10.0, -40.0), point("quick", 5.0, -39.0)
    lines = advice([default, quick], default, paper=quick, unit="dB", higher=True, axis="CPU time")
    assert "To save time: quick: half the CPU time for 1 dB less." in lines
    assert lines[-1] == "The paper's method (quick): half the CPU time for 1 dB less."


@pytest.mark.parametrize(
    ("ratio", "text"),
    [
        (0.51, "half the time"),
        (0.34, "a third of the time"),
        (0.62, "0.62 times the time"),
        (1.02, "the same time"),
        (1.96, "twice the time"),
        (3.14159, "3.1 times the time"),
        (12.4, "12 times the time"),
    ],
)
def test_shares_in_words(ratio, text):
    assert share(ratio, "time") == text
