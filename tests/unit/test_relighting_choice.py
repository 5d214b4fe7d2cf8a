"""What predicts lamps best: captured lamps left out, synthetic scenes of each kind."""

import numpy as np

from nishiki.brdf.gloss_profile import GlossProfile
from nishiki.model_selection.relighting import (
    ERRORS,
    MARGIN,
    CandidateFit,
    RelightingSample,
    choose_model,
    joint_fit_counts,
    left_out_errors,
    select_surrounded,
)
from nishiki.observations.plane import Parcel
from nishiki.stages.normals import NormalsSettings
from nishiki.stages.normals.parcel import relit, solve

PIXELS = 300


def lamps(count=40, widest=1.0, seed=1):
    rng = np.random.default_rng(seed)
    lights = np.column_stack([rng.uniform(-widest, widest, (count, 2)), np.ones(count)])
    return lights / np.linalg.norm(lights, axis=1, keepdims=True)


def piece(lights, factor=1.0, scale=1.0):
    """A matt scene in 8-bit steps; factor: (lights, pixels) on its light, scale: of the parcel."""
    rng = np.random.default_rng(2)
    normals = rng.normal(size=(PIXELS, 3)) * [0.3, 0.3, 0] + [0, 0, 1]
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    light = np.maximum(lights @ normals.T, 0) * factor
    values = light[..., None] * rng.uniform(0.2, 0.8, (PIXELS, 3))
    values = np.float32(np.round(values * 255) / 255 / scale)[:, None]
    seen = np.ones((len(lights), 1, PIXELS), bool)
    parcel = Parcel(slice(0, 1), slice(0, PIXELS), lights, np.full(len(lights), scale, np.float32))
    return RelightingSample(values, seen, seen, parcel)


def fit(sampled):
    maps = solve(sampled.observations, sampled.usable, sampled.valid, sampled.parcel, NormalsSettings())
    return {
        name: CandidateFit(maps | relit(sampled.observations, sampled.valid, sampled.parcel, maps, name))
        for name in ("plain", "directional")
    }


def test_a_matt_scene_stays_plain():
    model, decision = choose_model(left_out_errors([piece(lamps())], fit))
    assert model == "plain"
    assert decision.measured < decision.limit
    assert "relighting" in decision.as_dict()


def test_shadows_from_one_side_ask_for_the_directional_terms():
    lights = lamps()
    side = np.random.default_rng(3).uniform(-1, 1, (PIXELS, 2))
    shaded = np.where(lights[:, :2] @ side.T > -0.15, 1.0, 0.15)
    model, decision = choose_model(left_out_errors([piece(lights, shaded)], fit))
    assert model == "directional"
    assert decision.measured > decision.limit


def test_lamps_of_unlike_strength_do_not_ask_for_them():
    lights = lamps(12, widest=0.4)
    strengths = np.random.default_rng(5).uniform(0.5, 1.5, (12, 1))
    assert choose_model(left_out_errors([piece(lights, strengths)], fit))[0] == "plain"


def test_errors_are_those_of_the_left_out_lamps():
    """A lamp is never among those that predict it; the exact prediction of one lamp has no error, in any unit."""
    lights = lamps(10)
    sampled = piece(lights, scale=2.0)
    fits = []

    def flat(kept):
        fits.append(kept.parcel.directions)
        shape = kept.valid.shape[1:]
        reflectance = np.zeros((*shape, 3), np.float32)
        maps = {
            "normals": np.tile(np.float32([0, 0, 1]), (*shape, 1)),
            "reflectance": reflectance,
            "flags": np.zeros(shape, np.uint8),
        }
        matt = GlossProfile(np.zeros(1), np.ones(1), transmission=0.0)
        left_out = np.setdiff1d(np.arange(10), [int(np.argmin(np.abs(lights - d).sum(1))) for d in fits[-1]])
        first = left_out[0]
        exact = sampled.observations[first] * 2.0 / lights[first, 2]
        return {"black": CandidateFit(maps, matt), "first": CandidateFit(maps | {"reflectance": exact}, matt)}

    errors = left_out_errors([sampled], flat)
    assert [len(kept) for kept in fits] == [8] * 5
    assert (errors["black"] > 1).all()
    np.testing.assert_allclose(errors["first"][:5], 0, atol=0.01)
    assert (errors["first"][5:] > 0.1).all()


def test_lamps_outside_of_the_others_do_not_count():
    around = np.arange(9) * 2 * np.pi / 9
    ring = np.column_stack([0.7 * np.cos(around), 0.7 * np.sin(around), np.full(9, 0.714)])
    assert select_surrounded(ring).all()
    inner = ring * [0.5, 0.5, 1]
    far = np.array([[0.0, 0.95, 0.31]])
    lights = np.concatenate([ring, inner, far])
    assert np.flatnonzero(~select_surrounded(lights)).tolist() == [18]
    few = np.concatenate([ring[:3], far])  # nearly all are outside: then all count
    assert select_surrounded(few).all()


def test_the_margin_and_the_scatter_of_the_lamps():
    plain = np.full(20, 2.0)
    one_lamp = plain - np.eye(20)[0] * 10
    for directional, model in (
        (plain * (1 - 1.2 * MARGIN), "directional"),
        (plain * (1 - 0.8 * MARGIN), "plain"),
        (one_lamp, "plain"),
    ):
        assert choose_model({"plain": plain, "directional": directional})[0] == model
    assert 0.5 < ERRORS * 10 / 20  # the gain of that one lamp is large enough, its standard error larger


def test_the_joint_fit_has_to_predict_lamps_better():
    """A small gain under every lamp counts, a large one under a single lamp does not, nor outweighs it a loss."""
    lamps_error = 2 + np.sin(np.arange(12.0))
    single = np.where(np.arange(12) == 4, 0.5, 1.0)
    for factor, counts in ((0.97 + 0.01 * single, True), (single, False), (1.0, False), (1.05, False)):
        assert joint_fit_counts({"normals": lamps_error, "joint": lamps_error * factor}) is counts
    near_mirror = np.where(np.arange(12) == 4, 30.0, lamps_error)
    assert joint_fit_counts({"normals": near_mirror, "joint": 0.7 * near_mirror})
