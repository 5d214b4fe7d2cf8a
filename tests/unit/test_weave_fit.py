"""The weave fit: recovery of what made the data, intervals, identifiable combinations; readings against quadrature."""

import json

import numpy as np
import pytest
from refusals import refused
from scipy.integrate import quad
from weave_rays import along, cast, lengths_of, masking, pieces_of

from nishiki.errors import UserError
from nishiki.goniometry.table import ReflectanceSet
from nishiki.weave.fit import WeaveModel, fit_weave, make_plane, planes_of
from nishiki.weave.model import lobe, lobe_integral, pieces
from nishiki.weave.section import WarpSection, WeftSection
from nishiki.weave.store import describe, read_yarns, write_weave

THETA = np.radians(np.arange(0.0, 88.0, 3.0))
CLOTHS = {
    "plain": WeaveModel(
        WeftSection(0.75, 0.3, 0.5, 1),
        WarpSection(0.75, 0.3, 0.5, 0.4),
        0.4,
        0.3,
        1.5,
        np.array([2.0]),
        np.array([0.08]),
    ),
    "twill": WeaveModel(
        WeftSection(0.6, 0.4, 0.5, 2),
        WarpSection(0.5, 0.6, 0.4, 1.2),
        0.35,
        0.2,
        1.5,
        np.array([4.0]),
        np.array([0.05]),
    ),
    "satin": WeaveModel(
        WeftSection(0.9, 0.2, 0.5, 4),
        WarpSection(0.4, 0.5, 0.6, 3.0),
        0.5,
        0.15,
        1.5,
        np.array([6.0]),
        np.array([0.03]),
    ),
}


def of_reading(model: WeaveModel, reading: str) -> WeaveModel:
    values = {name: getattr(model, name) for name in model.__dataclass_fields__}
    values["weft"], values["warp"] = (s.scale(1 / s.period) for s in (model.weft, model.warp))
    return WeaveModel(**{**values, "reading": reading})


def measured(model: WeaveModel, *, noise: float = 0.0, seed: int = 0, relative_error: float = 0.02):
    rng = np.random.default_rng(seed)
    planes = []
    for name in ("weft", "warp"):
        clean = model.predict(name, THETA)
        noisy = clean * (1 + noise * rng.standard_normal(clean.shape))
        planes.append(make_plane(THETA, noisy, relative_error=noise or relative_error))
    return planes


# --- the readings ---


def test_paper_reading_is_equation_15():
    model = CLOTHS["satin"]
    f0 = 0.04
    for name, section, width in (("weft", model.weft, model.a_weft), ("warp", model.warp, model.a_warp)):
        d = np.exp(-((THETA / 2) ** 2) / width**2)
        fresnel = f0 + (1 - f0) * (1 - np.cos(THETA / 2)) ** 5
        g = masking(section, THETA)
        expected = model.k_s * (d * fresnel * g / np.cos(THETA))[:, None] + model.k_d * g[:, None]
        np.testing.assert_allclose(model.predict(name, THETA), expected, rtol=1e-12)


def test_lobe_integral_is_quadrature():
    for low, high, width in ((-0.3, 0.8, 0.2), (0.0, 1.5, 0.05), (-2.0, 2.0, 0.7), (1.4, 1.9, 1.3)):
        inner = [x for x in (-np.pi / 2, 0.0, np.pi / 2) if low < x < high]
        expected = quad(lobe, low, high, args=(width,), points=inner or None, epsabs=1e-13)[0]
        assert lobe_integral(low, high, width) == pytest.approx(expected, rel=1e-8, abs=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("section", [CLOTHS["satin"].weft, CLOTHS["satin"].warp])
def test_pieces_are_the_sum_over_the_seen_profile(section):
    """Closed form against a dense sum over the explicit profile with the share that is seen found by rays."""
    cloth, period, radius = pieces_of(section)
    lengths = lengths_of(cloth, radius)
    width, samples = 0.3, 400
    for o in (0.9, -1.2, -0.4):
        sums = np.zeros(2)
        for own in range(len(cloth)):
            for u in (np.arange(samples) + 0.5) / samples:
                if not cast(cloth, period, radius, own, u, o):
                    continue
                _, _, nx, nz = along(cloth[own], radius, u)
                slope, part = np.arctan2(nx, nz), lengths[own] / samples
                sums[0] += part * lobe(0.5 * o - slope, width)
                sums[1] += part * np.cos(slope) * np.cos(o - slope)
        found = pieces(section.shape, width, o)
        np.testing.assert_allclose(np.array(found) * period, sums, atol=5e-3 * section.length)


# --- recovery ---


@pytest.mark.slow
@pytest.mark.parametrize("reading", ["paper", "shaded"])
@pytest.mark.parametrize("cloth", list(CLOTHS))
def test_recovery_without_noise_is_within_one_per_cent(cloth, reading):
    truth = of_reading(CLOTHS[cloth], reading)
    found = fit_weave(*measured(truth), reading=reading, contact=np.pi / 2, confidence=None)
    for name, value in truth.parameters().items():
        assert found.model.parameters()[name] == pytest.approx(value, rel=0.01), name
    assert max(found.rms_rel.values()) < 1e-6


@pytest.mark.slow
def test_recovery_with_the_contact_searched():
    truth = of_reading(CLOTHS["satin"], "shaded")
    truth = of_reading(WeaveModel(**{**truth.__dict__, "weft": WeftSection(0.8, 0.03, 0.1, 4, 1.0)}), "shaded")
    found = fit_weave(*measured(truth), contact=None, harness=5, confidence=None)
    for name, value in truth.parameters().items():
        assert found.model.parameters()[name] == pytest.approx(value, rel=0.01), name


@pytest.mark.slow
def test_with_noise_the_intervals_cover_the_truth():
    """95 % intervals of 9 noisy data sets: of 8 unknowns each, the truth lies within at least 85 % of them."""
    inside = total = 0
    for cloth in CLOTHS:
        truth = of_reading(CLOTHS[cloth], "paper")
        p = truth.parameters()
        known = {
            "theta_a_weft": p["theta_a_weft"],
            "theta_a_warp": p["theta_a_warp"],
            "a_weft": p["a_weft"],
            "a_warp": p["a_warp"],
            **{f"flank_{s}": share_of_flank(section) for s, section in (("weft", truth.weft), ("warp", truth.warp))},
            "flat_warp": truth.warp.m / truth.warp.length,
            "contacts_weft": (truth.weft.n - 1) * np.pi * truth.weft.r / truth.weft.length,
        }
        for seed in range(2):
            planes = measured(truth, noise=0.01, seed=seed)
            found = fit_weave(*planes, reading="paper", contact=np.pi / 2, confidence=0.95)
            for name, value in known.items():
                low, high = found.intervals[name]
                assert low <= high
                inside += low - 1e-9 <= value <= high + 1e-9
                total += 1
    assert total == 48
    assert inside >= 0.85 * total


def share_of_flank(section) -> float:
    return section.l / (section.l + section.r * section.theta_a)


def test_lengths_are_named_as_determined_up_to_scale_alone():
    truth = of_reading(CLOTHS["satin"], "paper")
    found = fit_weave(*measured(truth), reading="paper", contact=np.pi / 2, confidence=None).identifiability
    groups = {frozenset(product.split(" · ")) for product in found.free}
    assert groups == {frozenset({"l_weft", "r_weft"}), frozenset({"l_warp", "r_warp", "m_warp"})}
    together = [product for product in found.weak if "index" in product]
    assert together  # of index and k_s little more than the product of strength and F0 is seen
    assert all("k_s" in product for product in together)
    assert found.weak_error == sorted(found.weak_error, reverse=True)


def test_strengths_of_channels_share_one_geometry():
    base = of_reading(CLOTHS["twill"], "paper")
    truth = WeaveModel(**{**base.__dict__, "k_s": np.array([4.0, 3.0, 5.0]), "k_d": np.array([0.2, 0.05, 0.01])})
    found = fit_weave(*measured(truth), reading="paper", contact=np.pi / 2, confidence=None)
    np.testing.assert_allclose(found.model.k_s, truth.k_s, rtol=1e-3)
    np.testing.assert_allclose(found.model.k_d, truth.k_d, rtol=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("scale", [1e-9, 1e9])
def test_fit_is_equivariant_in_the_radiometric_scale(scale):
    truth = of_reading(CLOTHS["plain"], "paper")
    planes = measured(truth)
    bright = [make_plane(p.theta_r, p.values * scale) for p in planes]
    one, two = (fit_weave(*q, reading="paper", contact=np.pi / 2, confidence=None).model for q in (planes, bright))
    assert two.warp.as_dict() == pytest.approx(one.warp.as_dict(), rel=1e-5)
    np.testing.assert_allclose(two.k_s, one.k_s * scale, rtol=1e-5)


# --- planes, BRDF, store ---


def directions(plane: int, theta):
    out = np.zeros((len(theta), 3))
    out[:, plane], out[:, 2] = np.sin(theta), np.cos(theta)
    return out


def test_planes_are_found_among_other_directions():
    model = of_reading(CLOTHS["satin"], "paper")
    view = np.concatenate([directions(0, THETA), directions(1, -THETA), directions(0, THETA[2:]) @ rotation(30)])
    lamp = np.broadcast_to([0.0, 0.0, 1.0], view.shape)
    planes = (("weft", THETA), ("warp", -THETA), ("weft", THETA[2:]))  # what lies outside of both takes no part
    values = np.concatenate([model.predict(name, angles) for name, angles in planes])
    table = ReflectanceSet.of(lamp, view, values)
    weft, warp = planes_of(table)
    assert weft.measured
    assert THETA.size < weft.theta_r.size < THETA.size + 5  # those at the normal belong to both planes
    np.testing.assert_allclose(weft.mean, model.predict("weft", weft.theta_r)[:, 0], rtol=1e-12)
    np.testing.assert_allclose(warp.mean, model.predict("warp", warp.theta_r)[:, 0], rtol=1e-12)
    few = ReflectanceSet.of(lamp[65:], view[65:], values[65:])
    with refused(UserError, "0", by="_interpolate"):
        planes_of(few)


def rotation(degrees: float):
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])


def test_store_gives_back_the_model(tmp_path):
    truth = of_reading(CLOTHS["twill"], "paper")
    planes = measured(truth)
    fit = fit_weave(*planes, reading="paper", contact=np.pi / 2, confidence=None)
    write_weave(tmp_path, {"cloth": describe(fit, planes, weave="twill", harness=3)})
    stored = json.loads((tmp_path / "weave.json").read_text())["regions"]["cloth"]
    assert stored["weft"] == fit.model.weft.as_dict()
    assert stored["warp"] == fit.model.warp.as_dict()
    assert stored["k_s"] == pytest.approx(fit.model.k_s)
    curve = stored["curves"]["warp"]
    np.testing.assert_allclose(np.add(curve["gloss"], curve["body"]), curve["measured"], rtol=1e-5)
    assert read_yarns(tmp_path) is None
    with pytest.raises(UserError, match="region 'other'"):
        read_yarns(tmp_path, "other")


def test_too_few_views_are_refused():
    with refused(UserError, "8", by="make_plane"):
        make_plane(THETA[:5], np.ones(5))
