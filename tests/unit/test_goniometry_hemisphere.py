"""The hemisphere of normal incidence: directions, symmetry, grid, interpolation of scattered views, coverage."""

import numpy as np
import pytest
from goniometer_captures import cloth, quarter_views
from hypothesis import given, settings
from hypothesis import strategies as st
from refusals import refused
from scipy.interpolate import BSpline, LinearNDInterpolator
from scipy.interpolate import NearestNDInterpolator as Nearest

from nishiki.errors import UserError
from nishiki.goniometry.directions import angles, between, departure, disc, images, reduce_pairs, unit
from nishiki.goniometry.hemisphere import (
    choose_symmetry,
    complete,
    coverage,
    directional_albedo,
    gather_views,
    grid_axes,
    interpolate,
    solid_angles,
    spread,
    within_hull,
)
from nishiki.goniometry.interpolation import MARGIN, coefficients, evaluate, fit_spline, symmetric_kernel, trend_terms
from nishiki.goniometry.table import BasicReflectance, Reflectances, ReflectanceSet, write_reflectances
from nishiki.stages.goniometer_samples import OUTPUTS
from nishiki.stages.goniometer_samples.run import coverage_plot

NORMAL = np.array([0.0, 0.0, 1.0])
FOLDS = {name: images(name)[:, [0, 1], [0, 1]] for name in ("quarter", "half", "none")}


def views(step_theta=6, step_phi=10, steepest=84):
    degrees = [(t, p) for t in np.arange(0, steepest + 1, step_theta) for p in np.arange(0, 91, step_phi)]
    theta, phi = np.radians(np.array(degrees, float)).T
    return unit(theta, phi)


def normal_set(outgoing, values, **known):
    return ReflectanceSet.of(np.tile(NORMAL, (len(outgoing), 1)), outgoing, values, **known)


def lobe(outgoing):
    return cloth(np.broadcast_to(NORMAL, outgoing.shape), outgoing)


@given(st.floats(0, np.pi / 2), st.floats(-7, 7))
def test_angles_are_those_of_the_unit_vector(theta, phi):
    d = unit(theta, phi)
    assert np.linalg.norm(d) == pytest.approx(1, abs=1e-15)
    back = angles(d)
    assert back[0] == pytest.approx(theta, abs=1e-15)
    assert between(unit(*back), d) < 1e-15
    assert 0 <= back[1] < 2 * np.pi


@given(st.floats(0, 3.14), st.floats(-3, 3))
def test_angle_between_keeps_small_and_large_ones(angle, phi):
    axis = unit(1.0, phi)
    other = np.cross(axis, NORMAL)
    other /= np.linalg.norm(other)
    assert between(axis, np.cos(angle) * axis + np.sin(angle) * other) == pytest.approx(angle, rel=1e-6, abs=1e-15)


def test_disc_has_no_seam():
    np.testing.assert_allclose(disc(unit(np.pi / 2, [0, np.pi / 2])), [[1, 0], [0, 1]], atol=1e-15)
    assert np.abs(disc(unit(0.3, 1e-9)) - disc(unit(0.3, 2 * np.pi - 1e-9))).max() < 1e-8
    assert np.abs(disc(unit(1e-9, 1.0)) - disc(unit(1e-9, 4.0))).max() < 2e-9


@pytest.mark.parametrize("symmetry", ["quarter", "half", "none"])
def test_one_representative_for_each_set_of_images(symmetry):
    rng = np.random.default_rng(3)
    incident, outgoing = (spread(400)[rng.permutation(400)] for _ in range(2))
    incident[:50] = NORMAL
    incident[50:100, 0], incident[100:150, 1] = 0.0, 0.0
    incident /= np.linalg.norm(incident, axis=1, keepdims=True)
    first = reduce_pairs(incident, outgoing, symmetry)
    for image in images(symmetry):
        again = reduce_pairs(incident @ image.T, outgoing @ image.T, symmetry)
        np.testing.assert_allclose(again[0], first[0], atol=1e-15)
        np.testing.assert_allclose(again[1], first[1], atol=1e-15)
    same = [
        any(np.allclose(i @ m.T, a) and np.allclose(o @ m.T, b) for m in images(symmetry))
        for i, o, a, b in zip(incident, outgoing, *first, strict=True)
    ]
    assert all(same)


def test_departure_from_symmetry_is_reported():
    outgoing = np.concatenate([views() @ m.T for m in images("quarter")])
    incident = np.tile(NORMAL, (len(outgoing), 1))
    clean = lobe(outgoing)
    assert departure(incident, outgoing, clean, "quarter")[0] < 1e-12
    assert departure(incident, outgoing, clean, "none") == (0.0, 0)
    noisy = clean * np.exp(0.05 * np.random.default_rng(1).standard_normal(clean.shape))
    apart, count = departure(incident, outgoing, noisy, "quarter")
    assert apart == pytest.approx(0.05, rel=0.1)
    assert count == len(outgoing)
    assert departure(incident[:1], outgoing[5:6], clean[5:6], "quarter") == (0.0, 0)


def test_grid_spline_is_the_tensor_product_of_b_splines():
    """Against scipy's own B-splines, and exactly the values at the nodes."""
    theta, phi = grid_axes(9)
    values = lobe(unit(theta[:, None], phi[None, :]))
    spline = coefficients(values)
    nodes = evaluate(spline, unit(theta[:, None], phi[None, :]))
    np.testing.assert_allclose(nodes, values, rtol=1e-12)
    outgoing = spread(300)
    t, p = angles(outgoing)
    rows, columns = t / theta[1], p / phi[1]

    def basis(places, count):
        knots = np.arange(-MARGIN - 2, count + MARGIN + 2)
        return BSpline.design_matrix(places, knots.astype(float), 3).toarray()[:, : count + 2 * MARGIN]

    direct = np.einsum("ir,ic,rck->ik", basis(rows, len(theta)), basis(columns, len(phi)), spline)
    np.testing.assert_allclose(evaluate(spline, outgoing), np.exp(direct), rtol=1e-12)


def test_grid_spline_is_smooth_over_pole_and_seam_and_zero_below():
    theta, phi = grid_axes(6)
    spline = coefficients(lobe(unit(theta[:, None], phi[None, :])))
    for centre, across in ((NORMAL, unit(np.pi / 2, 0.7)), (unit(0.8, 0.0), unit(np.pi / 2, np.pi / 2))):
        line = centre + np.linspace(-1e-3, 1e-3, 9)[:, None] * across
        values = np.log(evaluate(spline, line / np.linalg.norm(line, axis=1, keepdims=True)))[:, 0]
        steps = np.diff(values)
        assert np.abs(np.diff(steps)).max() < 1e-5  # no kink: a jump of the slope would show at once
        assert np.abs(steps).max() < 0.01
    assert (evaluate(spline, np.array([[0.0, 0.6, -0.8], [1.0, 0.0, -1e-12]])) == 0).all()
    assert np.isfinite(evaluate(spline, np.array([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]))).all()


def test_grid_spline_survives_zeros_and_refuses_what_has_no_pole():
    theta, phi = grid_axes(6)
    values = np.ones((len(theta), len(phi), 1))
    values[8:] = 0
    out = evaluate(coefficients(values), spread(500))
    assert np.isfinite(out).all()
    assert (out > 0).all()
    for shape in ((4, 8, 1), (9, 9, 1), (9, 6, 1)):
        with refused(ValueError, by="coefficients"):
            coefficients(np.ones(shape))


@pytest.mark.parametrize("symmetry", ["quarter", "half", "none"])
def test_spline_has_the_symmetry_and_its_left_out_errors_are_real(symmetry):
    """Leaving a point out and solving again, at the same smoothing, gives the error that was foretold."""
    rng = np.random.default_rng(2)
    points = rng.uniform(0 if symmetry == "quarter" else -0.7, 0.7, (25, 2))
    logs = np.column_stack([np.sin(3 * points[:, 0] ** 2), points[:, 1] ** 2]) + 0.05 * rng.standard_normal((25, 2))
    sigma = rng.uniform(0.01, 0.1, 25)
    folds = FOLDS[symmetry]
    fit = fit_spline(points, logs, sigma, folds)
    places = rng.uniform(-0.7, 0.7, (40, 2))
    for fold in folds:
        np.testing.assert_allclose(fit(places * fold), fit(places), atol=1e-12)
    weight = (sigma**2 + 0.01**2) / np.mean(sigma**2 + 0.01**2)
    whole = symmetric_kernel(points, points, folds)
    scaled = whole / np.sqrt(weight[:, None] * weight)
    trend = trend_terms(points, folds)
    basis = np.linalg.qr(trend / np.sqrt(weight)[:, None], mode="complete")[0][:, trend.shape[1] :]
    factor = fit.smoothing * np.linalg.eigvalsh(basis.T @ scaled @ basis)[-1]
    for out in (0, 7, 24):
        kept = np.arange(25) != out
        k, t = whole[np.ix_(kept, kept)] + factor * np.diag(weight[kept]), trend[kept]
        terms = t.shape[1]
        system = np.block([[k, t], [t.T, np.zeros((terms, terms))]])
        solution = np.linalg.solve(system, np.concatenate([logs[kept], np.zeros((terms, 2))]))
        predicted = whole[out, kept] @ solution[:-terms] + trend[out] @ solution[-terms:]
        np.testing.assert_allclose(fit.left_out[out], logs[out] - predicted, rtol=1e-6, atol=1e-9)


def test_spline_smooths_noise_and_keeps_what_is_exact():
    outgoing = views()
    values = lobe(outgoing)
    points, logs, *_ = gather_views(disc(outgoing), values, np.zeros_like(values))
    exact = fit_spline(points, logs, np.zeros(len(points)), FOLDS["quarter"])
    np.testing.assert_allclose(exact(points), logs, atol=1e-4)
    assert exact.smoothing <= 1e-9
    noisy = logs + 0.05 * np.random.default_rng(0).standard_normal(logs.shape)
    smooth = fit_spline(points, noisy, np.full(len(points), 0.05), FOLDS["quarter"])
    error = np.sqrt(((smooth(points) - logs) ** 2).mean())
    assert error < 0.03  # less than the noise
    assert smooth.smoothing > 1e-8


def test_the_quarter_gives_the_hemisphere():
    outgoing = views()
    measured, found = complete(normal_set(outgoing, lobe(outgoing)), grid_deg=3)
    basic = measured.basic
    assert basic.values.shape == (1, 31, 120, 3)
    true = lobe(unit(basic.theta[:, None], basic.phi[None, :]))
    inside = basic.theta < np.radians(84)
    error = np.abs(np.log(basic.values[0] / true))[inside]
    assert np.sqrt((error**2).mean()) < 0.01
    values = basic.values[0]
    np.testing.assert_allclose(values, values[:, -np.arange(120)], rtol=1e-9)  # mirror plane through weft and normal
    np.testing.assert_allclose(values, values[:, (60 - np.arange(120)) % 120], rtol=1e-9)
    assert (values > 0).all()
    assert (values[0] == values[0, 0]).all()
    assert found.points == (141,)
    probes = spread(2000)
    probes = probes[probes[:, 2] > np.cos(np.radians(84))]
    assert np.abs(np.log(basic.evaluate(probes) / lobe(probes))).mean() < 0.03


def test_measured_interpolated_and_extrapolated_are_marked():
    measured, found = complete(normal_set(views(steepest=60), lobe(views(steepest=60))), grid_deg=3)
    basic = measured.basic
    steep = np.degrees(basic.theta)
    assert basic.measured[0].all()
    assert basic.measured[2, 0]  # 6 degrees, along the weft
    assert not basic.measured[1, 7]  # 3 degrees: between the views
    assert not basic.measured[steep > 64].any()
    assert basic.extrapolated[steep > 62].all()
    assert not basic.extrapolated[steep < 59].any()
    assert not (basic.extrapolated & basic.measured).any()
    edge = basic.values[0, 20]  # 60 degrees
    np.testing.assert_allclose(basic.values[0, 25:], np.broadcast_to(edge, (6, 120, 3)), rtol=0.05)
    assert found.extrapolated == pytest.approx(0.5, abs=0.05)  # the sphere beyond 60 degrees: cos 60
    assert solid_angles(basic).sum() == pytest.approx(1)


def test_half_turn_symmetry_keeps_the_diagonal_of_a_twill():
    def twill(o):
        u, v = (o[..., 0] + o[..., 1]) / 2**0.5, (o[..., 0] - o[..., 1]) / 2**0.5
        return (0.05 + np.exp(-((u / 0.5) ** 2) - (v / 0.2) ** 2))[..., None]

    theta, phi = np.meshgrid(np.radians(np.arange(0, 85, 6.0)), np.radians(np.arange(0, 180, 10.0)))
    outgoing = unit(theta.ravel(), phi.ravel())
    basic = complete(normal_set(outgoing, twill(outgoing), symmetry="half"))[0].basic
    nodes = unit(basic.theta[:, None], basic.phi[None, :])
    near = basic.theta < np.radians(80)
    np.testing.assert_allclose(basic.values[0][near], twill(nodes)[near], rtol=0.1)
    assert basic.values[0, 10, 15, 0] > 3 * basic.values[0, 10, 45, 0]


@pytest.mark.parametrize("noise", [0.002, 0.03])
@pytest.mark.parametrize(("slant", "lean", "expected"), [(0, 0, "quarter"), (0.04, 0, "half"), (0, 0.04, "none")])
def test_the_symmetry_that_predicts_the_views_is_chosen(slant, lean, expected, noise):
    """Asymmetries of 4 % under noise far below them; at 3 % of noise two mirrors may stand for them."""
    theta, phi = np.meshgrid(np.radians(np.arange(6, 85, 6.0)), np.radians(np.arange(0, 360, 10.0)))
    outgoing = unit(theta.ravel(), phi.ravel())
    skew = 1 + slant * outgoing[:, :1] * outgoing[:, 1:2] * 4 + lean * outgoing[:, :1] * 2
    noisy = 1 + noise * np.random.default_rng(3).standard_normal((len(outgoing), 3))
    errors = choose_symmetry(normal_set(outgoing, lobe(outgoing) * skew * noisy, symmetry="unknown"))
    assert set(errors) == {"quarter", "half", "none"}
    assert next(iter(errors)) in ({expected} if noise < 0.01 else {expected, "quarter"})
    few = normal_set(outgoing[:5], lobe(outgoing[:5]), symmetry="unknown")
    assert choose_symmetry(few) == {}


@pytest.mark.parametrize("azimuth", [0, 45])
def test_symmetries_that_views_in_one_plane_cannot_tell_have_no_error(azimuth):
    theta, phi = np.meshgrid(np.radians(np.arange(6, 85, 6.0)), np.radians([azimuth, azimuth + 180]))
    outgoing = unit(theta.ravel(), phi.ravel())
    errors = choose_symmetry(normal_set(outgoing, lobe(outgoing), symmetry="unknown"))
    assert "none" not in errors
    assert np.isfinite(list(errors.values())).all()


def test_a_quarter_alone_is_taken_for_symmetric():
    outgoing = unit(*np.radians(np.array(quarter_views())).T)
    assert next(iter(choose_symmetry(normal_set(outgoing, lobe(outgoing), symmetry="unknown")))) == "quarter"


@settings(max_examples=25, deadline=None)
@given(scale=st.floats(1e-12, 1e12), seed=st.integers(0, 999), spreads=st.floats(0, 3))
def test_any_scale_and_any_positive_values(scale, seed, spreads):
    """Equivariant over 24 orders of magnitude, positive and finite whatever the data."""
    rng = np.random.default_rng(seed)
    outgoing = spread(40) * np.sign(rng.uniform(-1, 1, (40, 1))) ** [[1, 1, 0]]
    values = np.exp(spreads * rng.standard_normal((40, 1)))
    noise = 0.1 * values * rng.uniform(0, 1, values.shape)
    one = interpolate(outgoing, values, noise, grid_deg=9)
    other = interpolate(outgoing, scale * values, scale * noise, grid_deg=9)
    assert np.isfinite(one.basic.values).all()
    assert (one.basic.values > 0).all()
    np.testing.assert_allclose(other.basic.values, scale * one.basic.values, rtol=1e-6)


def test_repeats_and_crowds_are_averaged():
    outgoing = np.repeat(views(), 3, axis=0)
    values = lobe(outgoing) * np.exp([0.1, 0.0, -0.1] * (len(outgoing) // 3))[:, None]
    points, logs, sigma, _ = gather_views(disc(outgoing), values, 0.03 * values)
    assert len(points) == 141  # ten azimuths at the pole are one
    apart = np.flatnonzero(np.linalg.norm(points, axis=1) > 0.1)[0]
    assert sigma[apart] == pytest.approx(0.03 / 3**0.5)
    crowd = spread(20000)
    points, logs, *_ = gather_views(disc(crowd), lobe(crowd), np.zeros((20000, 3)))
    assert 400 < len(points) <= 1500
    back = unit(np.hypot(*points.T) * np.pi / 2, np.arctan2(points[:, 1], points[:, 0]))
    np.testing.assert_allclose(logs, np.log(lobe(back)), atol=0.2)


def test_too_few_views_and_views_of_one_plane_are_refused():
    outgoing = views()
    with refused(UserError, 5):
        complete(normal_set(outgoing[30:35], lobe(outgoing[30:35])))
    plane = unit(np.radians(np.arange(0, 80, 5.0)), np.zeros(16))
    with refused(UserError, by="complete"):
        complete(normal_set(plane, lobe(plane)))
    oblique = ReflectanceSet.of(np.tile(unit(0.5, 0.0), (20, 1)), spread(20), np.ones(20))
    with refused(UserError, "0", by="complete"):
        complete(oblique)


def test_the_hull_lets_nothing_outside_through():
    points = np.array([[0.1, 0.1], [0.5, 0.1], [0.1, 0.6], [0.4, 0.5]])
    places = np.random.default_rng(0).uniform(-1, 1, (500, 2))
    moved = within_hull(places, points)
    from scipy.spatial import Delaunay

    mesh = Delaunay(points)
    centre = points.mean(axis=0)
    assert (mesh.find_simplex(centre + 0.999999 * (moved - centre)) >= 0).all()
    inside = mesh.find_simplex(places) >= 0
    np.testing.assert_allclose(moved[inside], places[inside])


def test_albedo_of_a_white_is_one():
    theta, phi = grid_axes(3)
    white = BasicReflectance(theta, phi, np.full((2, 31, 120, 1), 1 / np.pi), np.ones((31, 120), bool))
    np.testing.assert_allclose(directional_albedo(white), 1, atol=5e-4)


def test_coverage_counts_views_and_gaps():
    theta, phi = np.radians(np.array(quarter_views(polar=16, azimuth=19, steepest=88.0))).T
    outgoing = np.concatenate([unit(theta, phi), [unit(0.2, 4.0)]])
    incident = np.concatenate([np.tile(NORMAL, (len(theta), 1)), [unit(np.pi / 4, 0.0)]])
    measured = ReflectanceSet.of(incident, outgoing, np.ones(len(outgoing)))
    normal, oblique = coverage(measured)
    assert (normal.theta_deg, normal.phi_deg, normal.views) == (0, 0, 286)
    assert normal.covered == 1
    assert normal.gap_deg < 5
    assert (oblique.theta_deg, oblique.views) == (45, 1)
    assert oblique.covered == pytest.approx(2 * 2 * np.pi * (1 - np.cos(np.radians(7.5))) / (2 * np.pi), rel=0.1)
    alone = coverage(ReflectanceSet.of(incident, outgoing, np.ones(len(outgoing)), symmetry="none"))
    assert alone[0].covered == pytest.approx(0.25 + 0.75 * 0.1, abs=0.03)  # the quarter and a rim of 7.5 degrees
    drawing = coverage_plot(measured, (normal, oblique))
    assert drawing.startswith("<svg")
    assert drawing.count("<circle") == 2 * 3 + 4 * 286 + 2  # circles, the quarter's images, one view and its image
    many = coverage(ReflectanceSet.of(spread(60), spread(60), np.ones(60)))
    assert " 36 " in coverage_plot(ReflectanceSet.of(spread(60), spread(60), np.ones(60)), many)


def test_a_set_checks_its_arrays_and_takes_rows():
    good = ReflectanceSet.of(views() * 7.0, views(), lobe(views()), weave="satin")
    np.testing.assert_allclose(np.linalg.norm(good.incident, axis=1), 1)
    assert good.channels == ("red", "green", "blue")
    assert len(good.take(np.arange(5))) == 5
    assert good.take(good.normal_incidence).weave == "satin"
    assert good.normal_incidence.sum() == 10
    for bad in (views()[:3], np.zeros_like(views()), views()[:, :2]):
        with refused(ValueError):
            ReflectanceSet.of(bad, views(), lobe(views()))
    with pytest.raises(ValueError, match="finite"):
        ReflectanceSet.of(views(), views(), np.full(len(views()), np.nan))


def test_the_store_gives_back_what_it_was_given(tmp_path):
    measured, _ = complete(normal_set(views(), lobe(views()), weave="twill", symmetry="quarter"), grid_deg=9)
    write_reflectances(tmp_path, OUTPUTS, measured, more={"note": 1})
    again = Reflectances(tmp_path)
    for name in ("incident", "outgoing", "values", "noise", "valid"):
        np.testing.assert_array_equal(getattr(again, name), getattr(measured, name))
    assert (again.regions, again.channels, again.weave) == (measured.regions, measured.channels, "twill")
    np.testing.assert_array_equal(again.basic.evaluate(spread(50)), measured.basic.evaluate(spread(50)))
    assert again.details["note"] == 1
    assert complete(again, grid_deg=9)[0].basic.values.shape == (1, 11, 40, 3)
    (tmp_path / "reflectance.npz").write_bytes(b"no zip")
    with refused(UserError, "reflectance.npz"):
        Reflectances(tmp_path)
    with refused(UserError, "reflectance.json"):
        Reflectances(tmp_path / "nowhere")


@pytest.mark.slow
@pytest.mark.data
def test_on_measured_paints_the_spline_beats_triangles(data):
    """A third of the views of each incidence left out, of every measured table: error of the logarithm."""
    from nishiki.capture.goniometer_tables import read_table

    errors = []
    for path in sorted(data.glob("*/*.brdf")):
        table = read_table(path, path.name)
        mirror = np.array([[1.0, 1.0], [1.0, -1.0]])
        for theta in (10.0, 30.0):
            rows = np.flatnonzero((abs(table.incident_deg[:, 0] - theta) < 1) & (table.values > 0).all(axis=1))
            points, logs = disc(unit(*np.radians(table.outgoing_deg[rows]).T)), np.log(table.values[rows][:, 5::10])
            for seed in range(3):
                test = np.random.default_rng(seed).random(len(rows)) < 0.33
                known = np.zeros((~test).sum())
                spline = fit_spline(points[~test], logs[~test], known, mirror)(points[test]) - logs[test]
                places = np.concatenate([points[~test] * fold for fold in mirror])
                both = np.concatenate([logs[~test]] * 2)
                inside, nearest = (make(places, both)(points[test]) for make in (LinearNDInterpolator, Nearest))
                linear = np.where(np.isfinite(inside), inside, nearest) - logs[test]
                errors.append([np.sqrt((e**2).mean()) for e in (spline, linear)])
    spline, linear = np.median(np.array(errors).reshape(-1, 3, 2), axis=1).T
    assert len(spline) >= 4
    assert (spline < linear).all()
    assert spline.max() < 0.1
