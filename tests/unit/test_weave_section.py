"""The weave sections: masking in closed form against visibility found by casting rays over the explicit profile."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from weave_rays import brute_force, masking

from nishiki.weave.section import WarpSection, WeftSection


def random_section(rng):
    a = rng.uniform(0.02, 1.55)
    flank, radius = (0.0 if rng.random() < 0.05 else 10 ** rng.uniform(-2, 1)), 10 ** rng.uniform(-1.5, 1)
    if rng.random() < 0.5:
        return WarpSection(a, flank, radius, 0.0 if rng.random() < 0.2 else 10 ** rng.uniform(-2, 1.5))
    return WeftSection(
        a, flank, radius, int(rng.integers(1, 9)), np.pi / 2 if rng.random() < 0.7 else rng.uniform(0.1, 1.5)
    )


def random_angle(rng, section):
    """Even, grazing to 1e-4, or on either side of the angle at which a flank turns away."""
    kind = rng.random()
    if kind < 0.5:
        return rng.uniform(0, np.pi / 2)
    if kind < 0.8:
        return np.pi / 2 - 10 ** rng.uniform(-4, -0.5)
    return np.clip(np.pi / 2 - section.theta_a + rng.choice([-1, 1]) * 10 ** rng.uniform(-4, -2), 0, np.pi / 2 - 1e-4)


@pytest.mark.slow
def test_masking_is_brute_force_visibility_at_1000_random_geometries_and_angles():
    rng = np.random.default_rng(20)
    worst = 0.0
    for _ in range(1000):
        section = random_section(rng)
        theta = random_angle(rng, section)
        found, expected = float(masking(section, theta)), brute_force(section, theta)
        worst = max(worst, abs(found - expected))
        assert abs(found - expected) < 1e-6, (section, theta, found, expected)
    assert worst < 1e-8


def test_reference_sees_through_a_hole_and_is_blind_behind_a_wall():
    ridge = WarpSection(np.pi / 4, 1.0, 0.0)  # saw teeth of 45 degrees
    assert brute_force(ridge, 0.0) == pytest.approx(1, abs=1e-12)
    assert brute_force(ridge, np.pi / 4 - 1e-4) == pytest.approx(1, abs=1e-9)
    t = np.deg2rad(30)  # the ray from one ridge meets the next flank at height s sin 45 = ...
    hidden = np.sin(np.pi / 4 - t) / np.sin(np.pi / 4 + t)
    assert brute_force(ridge, np.pi / 2 - t) == pytest.approx((1 - hidden) / 2, abs=1e-9)


# --- properties ---

sections = st.one_of(
    st.builds(
        WarpSection,
        st.floats(0.001, 1.57),
        st.floats(0, 1e6),
        st.floats(1e-6, 1e6),
        st.floats(0, 1e6),
    ),
    st.builds(
        WeftSection,
        st.floats(0.001, 1.57),
        st.floats(0, 1e6),
        st.floats(1e-6, 1e6),
        st.floats(1, 50),
        st.floats(0.01, np.pi / 2),
    ),
)
ANGLES = np.concatenate([np.linspace(0, np.pi / 2, 400), np.pi / 2 - np.geomspace(1e-15, 1e-2, 60)])


@settings(max_examples=300, deadline=None)
@given(sections)
def test_masking_is_one_from_above_and_never_rises(section):
    theta = np.sort(ANGLES)
    g = masking(section, theta)
    assert g[0] == pytest.approx(1, abs=1e-12)
    assert np.all((g >= 0) & (g <= 1))
    assert np.max(np.diff(g)) < 1e-9
    assert np.array_equal(g, masking(section, -theta))
    assert masking(section, np.pi / 2 + 0.01) == 0


@settings(max_examples=100, deadline=None)
@given(sections)
def test_masking_is_continuous_except_where_a_flank_turns_away(section):
    """The only step is 2 l / length at theta_r = pi/2 - theta_a; two near angles elsewhere differ by little.

    G is continuous, not Lipschitz: its slope is infinite at 90 degrees (t2 = 2 arcsin sqrt), and steep behind it where
    l is large against r. Steps are therefore looked for by halving an interval 50 times.
    """
    low, high = np.linspace(0, np.pi / 2, 60)[:-1], np.linspace(0, np.pi / 2, 60)[1:]
    edge = np.pi / 2 - section.theta_a
    for _ in range(50):
        middle = 0.5 * (low + high)
        g = masking(section, np.stack([low, middle, high]))
        left = g[0] - g[1] > g[1] - g[2]
        low, high = np.where(left, low, middle), np.where(left, middle, high)
    step = masking(section, low) - masking(section, high)
    there = (low - 1e-12 <= edge) & (edge <= high + 1e-12)
    expected = np.where(there, 2 * section.l / section.length, 0.0)
    assert np.max(np.abs(step - expected)) < 1e-4, (section, low[np.argmax(np.abs(step - expected))])


def test_known_values():
    """Flank at 45 degrees, all lengths 1, by hand; and the contact formula as it is usually written."""
    section = WarpSection(np.pi / 4, 1.0, 1.0, 2.0)
    arc = np.pi / 4
    assert section.length == pytest.approx(4 + 4 * arc + 2)
    assert section.period == pytest.approx(8 * np.sqrt(0.5) + 2)
    assert section.height == pytest.approx(1.0)
    t = np.deg2rad(20)
    shade = (np.sin(arc - t) + 1 - np.cos(arc - t)) / np.sin(arc + t)
    assert masking(section, np.pi / 2 - t) == pytest.approx((2 * (1 - shade) + 2 * arc + 2 * t + 2) / section.length)
    assert masking(section, np.pi / 2) == pytest.approx(2 / section.length)
    theta = np.linspace(0, 1.5, 7)
    row, single = WeftSection(0.5, 1.0, 1.0, 4), WeftSection(0.5, 1.0, 1.0, 1)
    contacts = masking(row, theta) * row.length - masking(single, theta) * single.length
    expected = 3 * ((np.pi / 2 - theta) + theta + np.arcsin(2 * np.cos(theta) - 1))
    np.testing.assert_allclose(contacts, expected, atol=1e-12)


def test_the_printed_length_of_a_contact_would_not_give_one_from_above():
    """2 a' for a contact (as printed) against the arcs that it shows from above, pi r'."""
    section = WeftSection(0.9, 0.4, 1.0, 4)
    printed = 4 * (section.l + section.r * section.theta_a) * 1.0 + 3 * 2 * section.r * section.theta_a
    assert section.length / printed > 1.1
    assert masking(section, 0.0) == 1


@settings(max_examples=50, deadline=None)
@given(sections, st.floats(1e-3, 1e3))
def test_lengths_matter_only_by_their_ratios(section, factor):
    np.testing.assert_allclose(masking(section.scale(factor), ANGLES), masking(section, ANGLES), atol=1e-9)


# --- profile ---


@pytest.mark.parametrize(
    "section", [WarpSection(0.6, 0.7, 1.3, 2.0), WeftSection(1.1, 0.3, 0.8, 4), WeftSection(0.4, 0, 1, 3, 0.7)]
)
def test_profile_has_the_section_s_length_period_and_unit_normals(section):
    points, normals = section.profile(20000)
    steps = np.hypot(*np.diff(points, axis=0).T)
    assert steps.sum() == pytest.approx(section.length, rel=1e-7)
    assert points[0] == pytest.approx([0, 0])
    assert points[-1] == pytest.approx([section.period, 0], abs=1e-9 * section.period)
    np.testing.assert_allclose(np.hypot(*normals.T), 1, atol=1e-12)
    across = np.diff(points, axis=0) / np.maximum(steps, 1e-12)[:, None]
    middle = 0.5 * (normals[1:] + normals[:-1])
    smooth = np.hypot(*(normals[1:] - normals[:-1]).T) < 0.01
    assert np.max(np.abs(np.sum(across * middle, axis=1))[smooth & (steps > 1e-9)]) < 1e-5
    assert points[:, 1].max() == pytest.approx(section.height, rel=1e-6)
