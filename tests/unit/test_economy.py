"""Decisions by measured criteria: what they keep and what they drop, on scenes that no fitted model has made."""

import numpy as np
import pytest

from nishiki.colour.colour import illuminant
from nishiki.colour.estimate import estimate_spectra, fit_estimator
from nishiki.colour.sampling import WAVELENGTHS_NM, channel_weights
from nishiki.colour.training import synthetic_reflectances
from nishiki.goniometry.table import ReflectanceSet
from nishiki.model_selection.decision import Decision, decide_gloss, economy, unseen_gain
from nishiki.model_selection.lights import (
    FEWEST,
    WORTH,
    LightSample,
    measured_choice,
    moved_deg,
    not_worth,
    spread_order,
    static_choice,
)
from nishiki.model_selection.sufficient import measured_choice as choose_views
from nishiki.model_selection.sufficient import (
    model_suffices,
    normal_order,
    output_bases,
    principal_bases,
    summarise_residual,
    with_normal_rows,
)
from nishiki.model_selection.sufficient import static_choice as static_views
from nishiki.photometric.light_selection import select_diffuse
from nishiki.photometric.solve import estimate_normals

VIEW = np.array([0.0, 0.0, 1.0])


def hemisphere(count, *, lowest=0.3):
    """Directions on a Fibonacci spiral over the upper hemisphere, (count, 3)."""
    z = 1 - (1 - lowest) * (np.arange(count) + 0.5) / count
    turn = np.arange(count) * np.pi * (3 - np.sqrt(5))
    return np.stack([np.sqrt(1 - z * z) * np.cos(turn), np.sqrt(1 - z * z) * np.sin(turn), z], axis=1)


def tilted(count, rng, *, spread=0.25):
    """Unit normals about the view, (count, 3)."""
    normals = VIEW + spread * rng.standard_normal((count, 3)) * [1, 1, 0]
    return normals / np.linalg.norm(normals, axis=1, keepdims=True)


def ggx(normals, lights, roughness):
    """Reflected radiance of GGX facets of a dielectric, view along z (Walter et al. 2007; not what is fitted here)."""
    half = lights + VIEW
    half = half / np.linalg.norm(half, axis=1, keepdims=True)
    nh, nl, nv = normals @ half.T, np.maximum(normals @ lights.T, 0), np.maximum(normals @ VIEW, 1e-3)[:, None]
    a2 = roughness**4
    d = a2 / (np.pi * (nh * nh * (a2 - 1) + 1) ** 2)

    def masking(cosine):
        return 2 * cosine / (cosine + np.sqrt(a2 + (1 - a2) * cosine**2) + 1e-12)

    vh = np.maximum(half @ VIEW, 0)
    fresnel = 0.034 + 0.966 * (1 - vh) ** 5
    return np.where(nl > 0, np.pi * d * fresnel * masking(nl) * masking(nv) / (4 * nv), 0)


# Evenly spread choices -----------------------------------------------------------------------------------------------


def test_order_of_choices_is_nested_complete_and_as_even_as_promised():
    directions = hemisphere(40)
    order = spread_order(directions)
    assert sorted(order) == list(range(40))
    for count in (4, 9, 17):
        chosen = directions[spread_order(directions)[:count]]
        reach = np.linalg.norm(directions[:, None] - chosen[None], axis=-1).min(axis=1).max()
        apart = np.linalg.norm(chosen[:, None] - chosen[None], axis=-1)[~np.eye(count, dtype=bool)].min()
        assert reach <= apart + 1e-9  # farthest points: nothing is farther from the choice than its members are apart
    assert set(spread_order(directions)[:9]) <= set(spread_order(directions)[:17])


def test_order_is_slow_farthest_point_search():
    directions = hemisphere(15)[np.random.default_rng(1).permutation(15)]
    order = [int(np.argmin(np.linalg.norm(directions - directions.mean(axis=0), axis=1)))]
    while len(order) < 15:
        far = [min(np.linalg.norm(d - directions[k]) for k in order) for d in directions]
        order.append(int(np.argmax(far)))
    assert list(spread_order(directions)) == order


# Lights --------------------------------------------------------------------------------------------------------------


def solve(observations, directions, valid):
    usable = select_diffuse(observations, directions, valid=valid).usable
    return usable, estimate_normals(observations, directions, usable=usable, valid=valid)


def light_sample(lights, noise, *, roughness=None, pixels=300, seed=3):
    rng = np.random.default_rng(seed)
    normals, albedo = tilted(pixels, rng), rng.uniform(0.3, 0.8, pixels)
    values = albedo[:, None] * np.maximum(normals @ lights.T, 0)
    if roughness is not None:
        values = values + ggx(normals, lights, roughness)
    values = values + noise * rng.standard_normal(values.shape)
    observations = values.T.astype(np.float32)[:, None]
    return LightSample(observations, np.ones(observations.shape, bool), lights)


@pytest.mark.parametrize(("noise", "expected"), [(0.001, "least"), (0.02, "some"), (0.2, "all")])
def test_lights_follow_the_noise(noise, expected):
    lights = hemisphere(90)
    rows, decision = measured_choice(lights, [light_sample(lights, noise)], solve)
    if expected == "least":
        assert len(rows) == FEWEST
    elif expected == "some":
        assert FEWEST < len(rows) < 90
    else:
        assert len(rows) == 90
    assert (decision.measured <= decision.limit) == (len(rows) < 90)


def test_the_loss_that_is_stated_holds_for_pixels_that_did_not_decide():
    lights = hemisphere(90)
    rows, decision = measured_choice(lights, [light_sample(lights, 0.01, roughness=0.35)], solve)
    assert len(rows) < 90
    others = [light_sample(lights, 0.01, roughness=0.35, pixels=500, seed=11)]
    full = [solve(s.observations, s.directions, s.valid) for s in others]
    assert moved_deg(rows, others, full, solve) <= 1.3 * decision.limit


def test_few_lights_and_small_scenes_are_left_alone():
    lights = hemisphere(20)
    assert measured_choice(lights, [light_sample(lights, 0.01)], solve)[1] is None
    assert not_worth(96, WORTH // 96 + 1) is None
    assert not_worth(96, WORTH // 97).decision == "all 96 lights"
    assert static_choice(lights, 30)[1] is None
    assert len(static_choice(lights, 7)[0]) == 7


# Gloss of a plane ----------------------------------------------------------------------------------------------------


def finish(gain, share=0.5):
    return {"share": share, "gloss_gain_de00": gain}


def test_gloss_is_dropped_with_its_loss_and_kept_where_it_predicts():
    dropped = decide_gloss([finish(-0.2, 1.0)], np.array([False]), "auto")
    assert dropped.measured == pytest.approx(-0.2)
    assert dropped.measured < dropped.limit
    part = decide_gloss([finish(0.8), finish(-0.2)], np.array([True, False]), "auto")
    assert part.measured == pytest.approx(0.3)
    assert "1 of 2" in part.decision
    assert decide_gloss([finish(None)], np.array([True]), "auto").measured is None
    assert decide_gloss([finish(0.8)], np.array([False]), "drop").criterion == "set"


# Gloss of an object --------------------------------------------------------------------------------------------------


def turned(gloss, *, noise=0.01, texels=400, views=36, seed=7):
    """Texels seen from a circle of cameras with a fixed lamp above; gloss: strength of a GGX lobe."""
    rng = np.random.default_rng(seed)
    turn = 2 * np.pi * np.arange(views) / views
    cameras = np.stack([np.sin(turn), 0.2 + 0 * turn, np.cos(turn)], axis=1)
    cameras /= np.linalg.norm(cameras, axis=1, keepdims=True)
    lamp = cameras + np.array([0.2, 0.6, 0.0])
    lamp /= np.linalg.norm(lamp, axis=1, keepdims=True)
    normals = rng.standard_normal((texels, 3)) * [1, 0.4, 1]
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    half = cameras + lamp
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    diffuse, facing = np.maximum(normals @ lamp.T, 0), normals @ cameras.T
    alpha = np.arccos(np.clip(normals @ half.T, -1, 1))
    lobe = 0.06**2 / (np.cos(alpha) ** 2 * (0.06 - 1) + 1) ** 2
    albedo = rng.uniform(0.1, 0.8, (texels, 1, 3))
    seen = facing > 0.15
    values = albedo * diffuse[..., None] + gloss * (lobe * (diffuse > 0) / np.maximum(facing, 0.15))[..., None]
    values = values + noise * rng.standard_normal(values.shape)
    attenuation = np.where(diffuse > 0, 1 / np.maximum(facing, 0.15), 0)
    return values, diffuse, attenuation, alpha, np.where(seen, facing, 0)


def test_glossy_object_keeps_and_matt_object_drops():
    assert unseen_gain(*turned(20.0)).keep
    matt = unseen_gain(*turned(0.0))
    assert not matt.keep
    assert matt.gain_db < 0.05


def test_object_without_texels_keeps():
    assert unseen_gain(*(values[:10] for values in turned(0.0))).keep


# Bases ---------------------------------------------------------------------------------------------------------------


def bell(centre, width):
    return np.exp(-0.5 * ((WAVELENGTHS_NM - centre) / width) ** 2)


CAMERAS = {
    "colour": np.stack([bell(600, 35), bell(540, 40), bell(450, 28)]),
    "nearly equal": np.stack([bell(560, 80), bell(555, 80), bell(550, 80)]),
    "six": np.stack([bell(centre, 22) for centre in (420, 470, 520, 570, 620, 670)]),
}
TRAINING = synthetic_reflectances(400)


def bases_of(camera, lamp):
    found = []

    def rule(estimates, mean_square):
        found.append(output_bases(estimates, mean_square))
        return found[-1].count

    estimator = fit_estimator(TRAINING, lamp, CAMERAS[camera], bases=rule, centres=64)
    assert len(estimator.basis) == found[0].count
    return found[0], estimator


def test_bases_follow_camera_and_lamp():
    colour, nearly, six = (bases_of(camera, illuminant("A"))[0] for camera in CAMERAS)
    line = bases_of("nearly equal", bell(589, 3) + 1e-4)[0]
    assert line.count < nearly.count < colour.count < six.count
    assert all(found.loss <= 0.002 for found in (colour, nearly, line))


def test_bases_that_are_left_out_change_spectra_by_what_is_stated():
    found, few = bases_of("colour", illuminant("A"))
    many = fit_estimator(TRAINING, illuminant("A"), CAMERAS["colour"], bases=16, centres=64)
    spectra = synthetic_reflectances(300, seed=99)
    responses = spectra @ channel_weights(illuminant("A"), CAMERAS["colour"]).T
    errors = [np.sqrt(np.mean((estimate_spectra(responses, e).spectra() - spectra) ** 2)) for e in (few, many)]
    assert errors[0] <= errors[1] * (1 + 5 * found.loss + 0.002)


def test_principal_bases_fall_with_noise_amplification():
    lamp = illuminant("A")
    ordinary = principal_bases(TRAINING, channel_weights(lamp, CAMERAS["colour"]), noise=0.005)
    nearly = principal_bases(TRAINING, channel_weights(lamp, CAMERAS["nearly equal"]), noise=0.005)
    assert ordinary.count == 3
    assert nearly.count < 3


# Views of a cloth ----------------------------------------------------------------------------------------------------


def cloth(sharp, count=200, noise=0.0):
    """A cloth lit along its normal (and a few oblique pairs); sharp: width of its highlight, sine of the angle."""
    views = hemisphere(count, lowest=0.1)
    oblique = hemisphere(6, lowest=0.6)[1:]
    values = 0.05 + 0.4 * np.exp(-((views[:, 0] / sharp) ** 2)) * np.exp(-((views[:, 1] / 0.8) ** 2))
    values = values * (1 + noise * np.random.default_rng(2).standard_normal(count))
    incident = np.concatenate([np.tile(VIEW, (count, 1)), oblique])
    outgoing = np.concatenate([views, oblique[::-1]])
    return ReflectanceSet.of(incident, outgoing, np.concatenate([values, np.full(len(oblique), 0.1)]))


def test_views_follow_how_fast_the_reflectance_changes():
    made = {"grid_deg": 6.0}
    smooth, sharp = (choose_views(cloth(width), **made) for width in (0.6, 0.08))
    assert smooth[1].measured <= smooth[1].limit
    assert len(smooth[0]) < 150
    assert sharp[0] is None or len(sharp[0]) > len(smooth[0])


def test_rows_keep_their_numbers_and_oblique_pairs_stay():
    measured = cloth(0.5)
    rows, decision = static_views(measured, 40)
    fewer = with_normal_rows(measured, rows)
    assert decision.as_dict()["measurements"]["decision"].startswith("40 of 200")
    assert set(np.flatnonzero(fewer.valid[:, 0] & fewer.normal_incidence)) == set(rows)
    assert fewer.valid[200:].all()
    assert static_views(measured, 400) == (None, None)
    assert len(set(normal_order(measured))) == 200


# What a model leaves -------------------------------------------------------------------------------------------------


def left_over(structure, noise, *, seed=1):
    rng = np.random.default_rng(seed)
    s, t = (grid.ravel() + rng.uniform(-0.3, 0.3, 900) for grid in np.mgrid[:30, :30].astype(float))
    observation = np.repeat(np.arange(4), 900)
    s, t = np.tile(s, 4), np.tile(t, 4)
    pattern = structure * np.sin(0.5 * s) * np.sin(0.4 * t)
    return (pattern + noise * rng.standard_normal((3, 3600))).astype(np.float32), observation, s, t


def test_noise_is_no_structure_and_structure_is_reported():
    noise, both, pattern = (summarise_residual([left_over(*of)]) for of in ((0, 0.01), (0.02, 0.01), (0.02, 1e-4)))
    assert noise.structure < 0.05
    assert 0.3 < both.structure < 0.7  # the pattern's energy is half of all
    assert pattern.structure > 0.85
    assert model_suffices(noise, "bits_per_pixel", 0.5)
    assert not model_suffices(both, "bits_per_pixel", 0.5)


def test_consistent_texture_is_structure_even_if_rough():
    rng = np.random.default_rng(4)
    _, observation, s, t = left_over(0, 0)
    rough = np.tile(rng.standard_normal(900), 4)  # white over the surface, the same in every picture
    left = (rough + 0.3 * rng.standard_normal((3, 3600))).astype(np.float32)
    assert summarise_residual([(left, observation, s, t)]).structure > 0.5


def test_a_psnr_that_the_model_reaches_needs_no_residual():
    left = summarise_residual([left_over(0.02, 0.01)])
    assert model_suffices(left, "psnr", left.psnr_db - 1)
    assert not model_suffices(left, "psnr", left.psnr_db + 1)
    assert not model_suffices(summarise_residual([]), "psnr", 10)


# Telling -------------------------------------------------------------------------------------------------------------


def test_decisions_are_told_in_one_line_and_in_plain_values():
    decision = Decision(
        "lights", "40 of 96 lights", "angle, degrees", 0.123456789, 0.2, "little", "normals.lights: all"
    )
    block = economy(decision, None)
    assert block["lights"]["measured"] == 0.123457
    assert "\n" not in str(decision)
    assert "0.1235, limit 0.2" in str(decision)
    assert economy(None) == {}


# Measured ------------------------------------------------------------------------------------------------------------


@pytest.mark.data
def test_evenly_spread_lights_of_a_measured_object(data):
    """DiLiGenT cat: half of the lights, evenly spread, cost less than 0.2 degrees against the true normals."""
    import cv2

    folder = data / "diligent_cat"
    mask = cv2.imread(str(folder / "mask.png"), cv2.IMREAD_GRAYSCALE) > 0
    pick = np.flatnonzero(mask.ravel())[::15]
    lights = np.loadtxt(folder / "light_directions.txt")
    strength = np.loadtxt(folder / "light_intensities.txt")
    stack = np.empty((96, 1, pick.size), np.float32)
    for k in range(96):
        raw = cv2.imread(str(folder / f"{k + 1:03d}.png"), cv2.IMREAD_UNCHANGED).reshape(-1, 3)[pick, ::-1]
        stack[k, 0] = (raw / 65535 / strength[k]).mean(axis=1)
    truth = np.load(folder / "normals_gt.npz")["normals"].reshape(-1, 3)[pick]

    def error(rows):
        found = solve(stack[rows], lights[rows], np.ones(stack[rows].shape, bool))[1].normals[0]
        return np.degrees(np.arccos(np.clip(np.sum(found * truth, axis=1), -1, 1))).mean()

    everything = error(np.arange(96))
    assert error(np.sort(spread_order(lights)[:48])) < everything + 0.2
    rows, decision = measured_choice(lights, [LightSample(stack, np.ones(stack.shape, bool), lights)], solve)
    assert error(rows) < everything + decision.limit
