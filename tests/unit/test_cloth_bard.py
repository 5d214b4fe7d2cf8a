"""The paper's law: its limits, its tables, and the facets' law beside them."""

import numpy as np
import pytest
from benchmarks.cloth_references import ScaledBard
from hypothesis import given, settings
from hypothesis import strategies as st

from nishiki.brdf.cloth.normal_incidence import (
    GreatCircleBard,
    LinearBard,
    amplitude,
    great_circle_view,
    linear_view,
    stretched_angle,
)
from nishiki.brdf.torrance_sparrow import fresnel

HALF_PI = np.pi / 2
THETAS_DEG = np.array([0, 15, 30, 45, 60, 75])
RATIOS = {  # Takeda et al., tables 1 to 3: measured peak reflectance over that of normal incidence
    "incidence plane": [1, 1.409, 1.670, 2.033, 4.841, 20.403],
    "cloth plane": [1, 1.060, 1.323, 1.996, 4.008, 10.493],
    "inclined plane": [1, 0.975, 1.301, 2.087, 4.765, 17.045],
}
REFLECTANCES = {  # the reflectances that those ratios were made of
    "incidence plane": [0.213, 0.301, 0.356, 0.434, 1.033, 4.354],
    "cloth plane": [0.452, 0.479, 0.597, 0.901, 1.809, 4.737],
    "inclined plane": [0.266, 0.259, 0.346, 0.555, 1.267, 4.531],
}
TABLE_4 = [  # azimuth of the peak predicted and measured, degrees, its printed error; then reflectance likewise
    (230, 230, 0, 0.466, 0.452, 0.030),
    (310, 300, 0.033, 0.461, 0.484, 0.048),
    (220, 215, 0.023, 0.508, 0.481, 0.057),
    (335, 320, 0.047, 0.445, 0.330, 0.349),
    (180, 180, 0, 0.625, 0.433, 0.445),
    (360, 350, 0.029, 0.499, 0.277, 0.801),
]


def direction(theta, phi):
    theta, phi = np.broadcast_arrays(theta, phi)
    return np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=-1)


def table(nt=31, around=72):
    theta, phi = np.meshgrid(np.linspace(0, HALF_PI, nt), np.arange(around) * 2 * np.pi / around, indexing="ij")
    return (0.05 + np.exp(-((np.tan(0.5 * theta) / 0.3) ** 2) * (1 + np.cos(phi) ** 2)))[..., None]


def test_angles_are_stretched_as_printed():
    assert stretched_angle(0.3, 0.0) == pytest.approx(0.3)
    assert stretched_angle(HALF_PI - 0.7, 0.7) == pytest.approx(HALF_PI)
    assert stretched_angle(np.pi, 0.7) == pytest.approx(np.pi)
    assert stretched_angle(0.2, 0.7) == pytest.approx(HALF_PI / (HALF_PI - 0.7) * 0.2)
    assert stretched_angle(1.5, 0.7) == pytest.approx((HALF_PI * 1.5 + np.pi * 0.7) / (HALF_PI + 0.7))
    assert stretched_angle(0.4, HALF_PI) == pytest.approx((0.4 + np.pi) / 2)
    assert stretched_angle(0.0, 0.7) == 0


@settings(max_examples=100, deadline=None)
@given(st.floats(0, HALF_PI), st.floats(0, 2 * np.pi), st.floats(0, HALF_PI), st.floats(0, 2 * np.pi))
def test_exact_views_are_unit_on_the_great_circle_and_above(theta_i, phi_i, theta_r, phi_r):
    incident, outgoing = direction(theta_i, phi_i), direction(theta_r, phi_r)
    view = great_circle_view(incident, outgoing)
    assert np.linalg.norm(view) == pytest.approx(1, abs=1e-12)
    assert view[2] >= -1e-9
    if theta_i > 1e-6:
        mirror = -incident[:2] / np.linalg.norm(incident[:2])
        plane = np.cross([*mirror, 0], outgoing)
        assert abs(plane @ view) < 1e-9
        beta, turned = (np.arccos(np.clip(np.r_[mirror, 0] @ v, -1, 1)) for v in (outgoing, view))
        assert turned == pytest.approx(stretched_angle(beta, theta_i), abs=1e-6)


def test_normal_incidence_is_the_identity():
    rng = np.random.default_rng(0)
    views = direction(np.arccos(rng.uniform(0, 1, 50)), rng.uniform(0, 2 * np.pi, 50))
    normal = np.array([0.0, 0.0, 1.0])
    assert np.allclose(great_circle_view(normal, views), views, atol=1e-12)
    assert np.array_equal(linear_view(normal, views), views)
    law = GreatCircleBard.of(table())
    assert np.allclose(law.evaluate(normal, views), law.basic(views), rtol=1e-9)


def test_the_mirror_direction_comes_from_the_normal():
    for view in (great_circle_view, linear_view):
        assert np.allclose(view(direction(0.6, 0.4), direction(0.6, 0.4 + np.pi)), [0, 0, 1], atol=1e-12)


def test_linear_form_is_exact_in_the_plane_of_incidence_on_the_mirror_side():
    incident = direction(0.5, HALF_PI)
    views = direction(np.linspace(0.05, 1.5, 20), -HALF_PI)
    assert np.allclose(linear_view(incident, views), great_circle_view(incident, views), atol=1e-12)
    aside = direction(1.0, 0.3)
    assert not np.allclose(linear_view(incident, aside), great_circle_view(incident, aside), atol=1e-3)


def test_limits_are_finite():
    grazing = direction(HALF_PI - 1e-9, 0.0)
    views = np.concatenate([direction(np.linspace(0, HALF_PI, 9), 0.0), direction(np.linspace(0, HALF_PI, 9), np.pi)])
    for law in (LinearBard.of(table()), GreatCircleBard.of(table())):
        for incident in (grazing, direction(0.3, 0.0), np.array([0.0, 0.0, 1.0])):
            value = law.evaluate(incident, views)
            assert np.all(np.isfinite(value))
            assert np.all(value >= 0)
    on_mirror = great_circle_view(direction(0.5, 0.0), direction(HALF_PI, np.pi))
    assert np.allclose(on_mirror, direction(HALF_PI, np.pi), atol=1e-12)
    assert amplitude(direction(HALF_PI, 0.0)) == pytest.approx(1 / np.cos(np.radians(89)) ** 2)


def test_diffuse_part_is_kept_out_of_the_law():
    law = GreatCircleBard.of(table(), diffuse=0.05)
    incident, outgoing = direction(0.9, 0.2), direction(0.4, 2.0)
    whole = GreatCircleBard.of(table() - 0.05)
    assert law.evaluate(incident, outgoing) == pytest.approx(0.05 + whole.evaluate(incident, outgoing), rel=1e-6)


def test_best_factors_are_found():
    truth = GreatCircleBard.of(table())
    views = direction(np.linspace(0.1, 1.4, 40), np.linspace(0, 6, 40))
    incident = np.concatenate([np.tile(direction(t, 0.3), (40, 1)) for t in (0.4, 0.9)])
    outgoing = np.concatenate([views, views])
    measured = np.concatenate(
        [f * truth.basic(great_circle_view(i, views)) for f, i in ((1.3, incident[0]), (2.5, incident[-1]))]
    )
    groups = [(incident[0], np.arange(40)), (incident[-1], np.arange(40, 80))]
    scaled = ScaledBard.fit(table(), groups, outgoing, measured, np.ones(80))
    assert scaled.factors == pytest.approx([1.3, 2.5])
    assert np.allclose(scaled.evaluate(incident, outgoing), measured)


def test_printed_ratios_follow_from_printed_reflectances():
    for plane, values in REFLECTANCES.items():
        assert np.allclose(np.array(values) / values[0], RATIOS[plane], rtol=4e-3)
    assert np.allclose(amplitude(direction(np.radians(THETAS_DEG), 0)), [1, 1.072, 1.333, 2, 4, 14.93], rtol=1e-3)


def test_table_4_error_columns_recomputed():
    for predicted, measured, printed, value, seen, printed_value in TABLE_4:
        assert abs(predicted / measured - 1) == pytest.approx(printed, abs=2e-3)
        assert abs(value / seen - 1) == pytest.approx(printed_value, abs=4e-3)


def ratios_of_facets(index, slope):
    """Peak ratios of facets at the paper's peaks: the half vector stays, so D does; F, masking and cosines change.

    The peaks lie at beta = pi/2 - theta_i, off the mirror axis -y by the tilt of the peak of normal incidence: 0, 87
    and 45 degrees.  Masking: Smith's for a bell of slopes, in GGX form, of light and view.
    """
    theta = np.radians(THETAS_DEG)
    incident = direction(theta, HALF_PI)

    def masking(w):
        tan = np.hypot(w[:, 0], w[:, 1]) / w[:, 2]
        return 2 / (1 + np.sqrt(1 + (slope * tan) ** 2))

    out = {}
    for plane, tilt in zip(RATIOS, (0.0, 87.0, 45.0), strict=True):
        off = direction(np.radians(tilt), 0.0)
        view = np.cos(theta)[:, None] * off + np.sin(theta)[:, None] * np.array([0, -1.0, 0])
        half = incident + view
        assert np.allclose(half / np.linalg.norm(half, axis=1)[:, None], half[0] / np.linalg.norm(half[0]), atol=1e-12)
        cos_d = np.linalg.norm(half, axis=1) / 2
        value = fresnel(cos_d, index) * masking(incident) * masking(view) / (incident[:, 2] * view[:, 2])
        out[plane] = value / value[0]
    return out


def test_facets_explain_the_printed_peaks_better_than_the_printed_law():
    """Two physical numbers for all three tables: n of polyester, and the slope of the weave's masking.

    The camera cannot stand where the lamp is: the paper's reflectance along the normal is interpolated, and table 1 is
    relative to it. Its level is therefore left open there (third number), as it is for the printed law.
    """
    from scipy.optimize import least_squares

    level = 1.2
    table_1 = "incidence plane"

    def errors(law, level):
        return {p: np.array(law[p]) * (level if p == table_1 else 1) / RATIOS[p] - 1 for p in RATIOS}

    def residual(x):
        found = errors(ratios_of_facets(1 + np.exp(x[0]), np.exp(x[1])), x[2])
        return np.concatenate([np.log1p(found[p][1:]) for p in RATIOS])

    fit = least_squares(residual, [-0.5, -0.5, level])
    index, slope, level = 1 + np.exp(fit.x[0]), np.exp(fit.x[1]), fit.x[2]
    assert 1.55 < index < 1.75  # polyester: 1.54 across and 1.72 along the fibre
    assert 0.6 < slope < 0.85
    new = errors(ratios_of_facets(index, slope), level)
    square = 1 / np.cos(np.radians(THETAS_DEG)) ** 2
    best = float(np.exp(np.mean(np.log(np.array(RATIOS[table_1])[1:] / square[1:]))))
    old = errors(dict.fromkeys(RATIOS, square), best)
    new, old = ({p: np.abs(e[p][1:]) for p in RATIOS} for e in (new, old))
    assert max(new["cloth plane"]) < 0.05
    assert max(new["inclined plane"]) < 0.09
    assert max(new[table_1]) < 0.12
    assert [max(old[p]) for p in RATIOS] == pytest.approx([0.23, 0.423, 0.161], abs=0.03)
    rms_new, rms_old = (np.sqrt(np.mean(np.concatenate(list(e.values())) ** 2)) for e in (new, old))
    assert rms_new < 0.065
    assert rms_old > 0.13
