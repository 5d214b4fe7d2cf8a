"""The interface of the cloth's reflection models: known values, reciprocity, albedo, files."""

import numpy as np
import pytest
from benchmarks.cloth_peers import AshikhminShirley, Ggx, Ward
from exact_dye import exact_dye
from hypothesis import given, settings
from hypothesis import strategies as st
from refusals import refused

from nishiki.brdf.cloth.interface import (
    directional_albedo,
    halves,
    hemisphere,
    incidences,
    prediction_error,
    reciprocity_error,
)
from nishiki.brdf.cloth.store import load_brdf, save_brdf
from nishiki.errors import UserError
from nishiki.goniometry.directions import angles

GREY = {"diffuse": np.array([0.1]), "specular": np.array([1.0])}
BLACK = {"diffuse": np.zeros(1), "specular": np.ones(1)}
PEERS = [
    Ward(**GREY, alpha_x=0.2, alpha_y=0.5),
    AshikhminShirley(**GREY, exponent_x=20.0, exponent_y=4.0, reflectance=0.05),
    Ggx(**GREY, alpha_x=0.2, alpha_y=0.5, refractive_index=1.5),
]


def direction(theta_deg, phi_deg):
    t, p = np.radians(theta_deg), np.radians(phi_deg)
    return np.stack([np.sin(t) * np.cos(p), np.sin(t) * np.sin(p), np.cos(t) + 0 * p], axis=-1)


@pytest.mark.parametrize("brdf", PEERS, ids=lambda b: b.KIND)
def test_peers_are_reciprocal_finite_and_dark_below_the_horizon(brdf):
    assert reciprocity_error(brdf) < 1e-12
    assert np.all(brdf.evaluate(direction(30, 20), direction([91, 120, 180], 40)) == 0)
    assert np.all(brdf.evaluate(direction([91, 120, 180], 40), direction(30, 20)) == 0)
    grazing = brdf.evaluate(direction([89.9999, 90.0 - 1e-9], 0), direction([89.9999, 90.0 - 1e-9], 180))
    assert np.all(np.isfinite(grazing))
    assert brdf.evaluate(direction([10, 20], 0)[:, None], direction([1, 2, 3], 5)[None]).shape == (2, 3, 1)


@settings(max_examples=60, deadline=None)
@given(
    st.floats(1e-3, 10), st.floats(1e-3, 10), st.floats(0, np.pi / 2), st.floats(0, np.pi / 2), st.floats(-np.pi, np.pi)
)
def test_peers_stay_finite_over_extreme_shapes(ax, ay, theta_i, theta_r, phi):
    incident = np.array([np.sin(theta_i), 0, np.cos(theta_i)])
    outgoing = np.array([np.sin(theta_r) * np.cos(phi), np.sin(theta_r) * np.sin(phi), np.cos(theta_r)])
    for brdf in (Ward(**GREY, alpha_x=ax, alpha_y=ay), Ggx(**GREY, alpha_x=ax, alpha_y=ay, refractive_index=1.5)):
        value = brdf.evaluate(incident, outgoing)
        assert np.all(np.isfinite(value))
        assert np.all(value >= 0)


def test_ggx_equals_the_textbook_form():
    brdf, (ax, ay) = Ggx(**BLACK, alpha_x=0.3, alpha_y=0.6, refractive_index=1.0 + 1e6), (0.3, 0.6)
    i, o = direction(35, 10), direction(50, 140)
    h = (i + o) / np.linalg.norm(i + o)
    tan2 = ((h[0] / ax) ** 2 + (h[1] / ay) ** 2) / h[2] ** 2
    d = 1 / (np.pi * ax * ay * h[2] ** 4 * (1 + tan2) ** 2)

    def shadow(w):
        return (-1 + np.sqrt(1 + ((ax * w[0]) ** 2 + (ay * w[1]) ** 2) / w[2] ** 2)) / 2

    expected = d / (1 + shadow(i) + shadow(o)) / (4 * i[2] * o[2])
    assert brdf.evaluate(i, o)[0] == pytest.approx(expected, rel=1e-5)


def test_ggx_weak_white_furnace_is_one():
    """With masking of the light alone, the facets lit of a direction carry its whole projected area."""
    views, projected = hemisphere(200, 400)
    rough = Ggx(**BLACK, alpha_x=0.05, alpha_y=0.1, refractive_index=1e6)
    incident = direction(20, 30)
    g = halves(incident, views)
    masked = rough.lobe(g, incident, views)
    spread_i, spread_o = rough._spread(incident), rough._spread(views)
    only_incident = masked * (g.cos_i * spread_o + g.cos_r * spread_i) / (g.cos_r * (g.cos_i + spread_i))
    assert projected @ only_incident == pytest.approx(1, abs=1e-2)  # what goes below the horizon is the rest


def test_ward_albedo_is_at_most_its_strength():
    brdf = Ward(**BLACK, alpha_x=0.15, alpha_y=0.4)
    albedo = directional_albedo(brdf, direction(np.array([0.0, 30, 60, 80, 89]), 25), thetas=80, phis=160)
    assert np.all(albedo < 1)
    assert albedo[0, 0] == pytest.approx(1, abs=0.1)


def test_ashikhmin_shirley_at_normal_incidence():
    brdf = AshikhminShirley(**BLACK, exponent_x=30.0, exponent_y=30.0, reflectance=0.04)
    value = brdf.evaluate(direction(0, 0), direction(40, 70))[0]
    fresnel = 0.04 + 0.96 * (1 - np.cos(np.radians(20))) ** 5
    expected = 31 / (8 * np.pi) * np.cos(np.radians(20)) ** 30 / np.cos(np.radians(20)) * fresnel
    assert value == pytest.approx(expected, rel=1e-12)


def test_hemisphere_integrates_the_projected_solid_angle():
    directions, projected = hemisphere(16, 32)
    assert projected.sum() == pytest.approx(np.pi, rel=1e-12)
    assert projected @ directions[:, 2] ** 2 == pytest.approx(np.pi / 2, rel=1e-12)
    assert np.allclose(projected @ directions[:, :2], 0)


def test_dye_keeps_energy_and_reciprocity():
    black = Ggx(**BLACK, alpha_x=0.3, alpha_y=0.6, refractive_index=1.5)
    dyed = exact_dye(black, [1.0, 0.5, 0.0])
    incident = direction(np.array([0.0, 40, 70]), 30)
    gloss, whole = directional_albedo(black, incident), directional_albedo(dyed, incident)
    assert reciprocity_error(dyed) < 1e-12
    assert np.allclose(whole, gloss + (1 - gloss) * [1.0, 0.5, 0.0], atol=4e-3)
    assert whole.max() < 1.004  # linear interpolation of the gloss' albedo


@pytest.mark.parametrize("brdf", PEERS, ids=lambda b: b.KIND)
def test_files_give_the_same_model_and_the_same_bytes(brdf, tmp_path):
    save_brdf(tmp_path / "a.npz", brdf)
    save_brdf(tmp_path / "b.npz", brdf)
    again = load_brdf(tmp_path / "a.npz")
    assert type(again) is type(brdf)
    assert again == pytest.approx(brdf)
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()


def test_files_that_are_none_are_named(tmp_path):
    (tmp_path / "bad.npz").write_text("nothing")
    with pytest.raises(UserError, match=r"bad\.npz"):
        load_brdf(tmp_path / "bad.npz")
    np.savez(tmp_path / "other.npz", a=1)
    with refused(UserError, "'a'"):
        load_brdf(tmp_path / "other.npz")
    np.savez(tmp_path / "kind.npz", kind="velvet")
    with pytest.raises(UserError, match="velvet"):
        load_brdf(tmp_path / "kind.npz")
    np.savez(tmp_path / "parts.npz", kind="yarns", spacing_ratio=1.0)
    with pytest.raises(UserError, match=r"parts\.npz"):
        load_brdf(tmp_path / "parts.npz")


def test_prediction_error_known_values():
    outgoing = direction(np.array([0.0, 60.0]), 0)
    error = prediction_error(outgoing, np.array([1.0, 2.0]), np.array([1.5, 2.0]))
    assert error.rms_rel == pytest.approx(np.sqrt(0.25 / (1 + 0.5 * 4)))
    assert error.peak_direction == pytest.approx(0, abs=1e-12)
    assert error.peak_value == pytest.approx(0)
    moved = prediction_error(outgoing, np.array([1.0, 2.0]), np.array([3.0, 2.0]))
    assert np.degrees(moved.peak_direction) == pytest.approx(60)
    assert moved.peak_value == pytest.approx(0.5)


def test_incidences_are_grouped():
    incident = np.concatenate([direction(np.zeros(3), np.array([0.0, 90, 180])), direction(np.full(4, 30.0), 90)])
    groups = incidences(incident)
    assert [len(rows) for _, _, rows in groups] == [3, 4]
    assert np.degrees(groups[1][0]) == pytest.approx(30)
    assert np.degrees(groups[1][1]) == pytest.approx(90)


def test_angles():
    assert angles(direction(1e-9, 0))[0] == pytest.approx(np.radians(1e-9), rel=1e-9)
    assert angles(direction(50, -10))[1] == pytest.approx(np.radians(350))
