"""Gloss of a scene: the histogram as a monoid, recovery from data of the model, noisy normals, outliers, baseline."""

from types import SimpleNamespace

import numpy as np
import pytest
from captures import make_capture
from published_fits import brightest_light_samples, fit_brightest_light, histogram_of, thin

from nishiki.artifacts.maps import MapWriter
from nishiki.brdf.gloss_profile import GlossProfile, SpecularHistogram, fit_gloss
from nishiki.brdf.torrance_sparrow import attenuation, half_vector_geometry, specular, transmittance
from nishiki.capture.folder import load_capture
from nishiki.errors import UserError
from nishiki.observations.plane import Observations
from nishiki.observations.plane_store import write_observations
from nishiki.photometric.flags import NO_ESTIMATE
from nishiki.progress import Progress
from nishiki.stages.brdf import BrdfSettings
from nishiki.stages.brdf.painting import fit_regions, gather
from nishiki.stages.ingest import IngestSettings
from nishiki.stages.painting_maps import PaintingMaps

VIEW = np.array([0.0, 0.0, 1.0])
INDEX = 1.45


def unit(v):
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def relief(rows=90, columns=110, slope=0.5):
    y, x = np.mgrid[0:rows, 0:columns] / rows
    return unit(np.dstack([slope * np.sin(9 * x + 3 * y), slope * np.cos(7 * y - 2 * x), np.ones_like(x)]))


def ring():
    angles = [(0.05, 0.0), (0.3, 0.0), *((0.7, p) for p in (1.0, 2.1, 3.1, 4.2, 5.2))]
    return np.array([[np.sin(t) * np.cos(p), np.sin(t) * np.sin(p), np.cos(t)] for t, p in angles])


def photographs(normals, lights, *, beta, gamma, noise=0.0, seed=0):
    albedo = 0.3 + 0.2 * np.sin(np.arange(normals.shape[1]) / 7) * np.ones(normals.shape[:2])
    diffuse = albedo * np.maximum((normals @ lights.T).transpose(2, 0, 1), 0)
    gloss = specular(normals[None], lights[:, None, None], VIEW, beta=beta, gamma=gamma, refractive_index=INDEX)
    return diffuse + gloss + noise * np.random.default_rng(seed).normal(size=diffuse.shape), albedo


def under(transmission):
    """Return a body below a surface that takes this share of a dielectric's loss."""
    return GlossProfile(np.zeros(1), np.ones(1), INDEX, transmission)


def maps_in(folder):
    """The maps of a painting of which there are normals alone."""
    return PaintingMaps({"normals": SimpleNamespace(folder=folder)})


def joint(transmission):
    """Return what `normals` says of a finish that it fitted together with its gloss."""
    return {"joint": True, "gloss_transmission": transmission}


def test_a_tile_equals_its_samples():
    normals, lights = relief(), ring()
    observations, albedo = photographs(normals, lights, beta=20.0, gamma=0.2)
    geometry = half_vector_geometry(normals[None], lights[:, None, None], VIEW)
    factor = attenuation(geometry, INDEX)
    residual = observations - albedo * np.maximum(geometry.cos_i, 0)
    tile = histogram_of(observations, normals, albedo, lights).profile(reject=np.inf)
    plain = SpecularHistogram.empty().add_samples(geometry.phi, residual, factor).profile(reject=np.inf)
    strong = plain.weight > 1e-3 * plain.weight.max()
    assert abs(tile.count.sum() - plain.count.sum()) < 10  # a float32 normal may change the side of a horizon
    np.testing.assert_allclose(tile.value[strong], plain.value[strong], rtol=1e-2)
    # and the rows against plain sums
    total = np.sum(factor**2)
    assert plain.weight.sum() == pytest.approx(total, rel=1e-12)
    assert np.sum(plain.weight * plain.value) == pytest.approx(np.sum((factor * residual)[factor > 0]), rel=1e-9)


def test_parts_of_a_picture_add_up():
    normals, lights = relief(), ring()
    observations, albedo = photographs(normals, lights, beta=5.0, gamma=0.1, noise=0.01)
    whole = histogram_of(observations, normals, albedo, lights)
    parts = [
        histogram_of(observations[:, part], normals[part], albedo[part], lights)
        for part in (slice(40, None), slice(0, 40))
    ]
    for name in ("weights", "values", "rows"):
        total = sum(getattr(part, name) for part in parts)
        np.testing.assert_allclose(total, getattr(whole, name), rtol=1e-9, atol=1e-12)


def test_regions_and_unusable_samples():
    normals, lights = relief(), ring()
    observations, albedo = photographs(normals, lights, beta=5.0, gamma=0.1)
    regions = np.zeros(albedo.shape, int)
    regions[:, 50:], regions[:10] = 1, -1
    other = photographs(normals, lights, beta=50.0, gamma=0.3)[0]
    mixed = np.where(regions == 1, other, observations)
    mixed[:, 20:30] = np.nan
    histogram = histogram_of(mixed, normals, albedo, lights, regions=regions)
    for region, (beta, gamma) in enumerate(((5, 0.1), (50, 0.3))):
        profile = histogram.profile(region=region)
        expected = beta * np.exp2(-((profile.phi / gamma) ** 2))
        np.testing.assert_allclose(profile.value, expected, rtol=0.01, atol=0.01 * beta)


def test_outliers_are_fenced_off():
    rng = np.random.default_rng(4)
    normals, lights = relief(), ring()
    observations, albedo = photographs(normals, lights, beta=30.0, gamma=0.1, noise=0.002)
    observations[rng.uniform(size=observations.shape) < 0.05] = 0  # unseen cast shadow
    observations[rng.uniform(size=observations.shape) < 0.02] += 0.3
    histogram = histogram_of(observations, normals, albedo, lights)
    fenced, every = histogram.profile(), histogram.profile(reject=np.inf)
    core = (fenced.phi > 0.02) & (fenced.phi < 0.1)
    truth = 30 * np.exp2(-((fenced.phi[core] / 0.1) ** 2))
    error, unfenced = (np.median(np.abs(each.value[core] / truth - 1)) for each in (fenced, every))
    assert error < 0.02
    assert unfenced > 2 * error
    assert 0.05 < np.average(fenced.rejected, weights=fenced.weight) < 0.09


def test_a_surface_without_contrast_has_no_gloss():
    with pytest.raises(UserError, match="contrast"):
        SpecularHistogram.empty(refractive_index=1.0)


def test_a_lobe_at_the_bound_is_no_fit():
    """Some bright samples beside the mirror direction: a lobe of the least width would hold all of the strength."""
    phi = np.abs(np.random.default_rng(2).normal(0, 0.2, 20_000))
    spike, broad = np.where(phi < 0.004, 5.0, 0.0), 2.0 * np.exp2(-((phi / 0.2) ** 2))
    for value in (spike, spike + broad):
        profile = fit_gloss(SpecularHistogram.empty().add_samples(phi, 0.04 * value, np.full(phi.size, 0.04)))
        assert profile.beta[0] == 0
        assert profile.value(0.2) == pytest.approx(broad.max() / 2 * (value is not spike), abs=0.1)


@pytest.mark.parametrize(("reflectance", "unit"), [(0.4, 1.0), (4e7, 1e8), (2e-6, 1e-5), (0.0, 1.0)])
def test_the_stage_tells_outliers_in_the_unit_of_the_observations(tmp_path, reflectance, unit):
    """Without a white board observations have any unit; cells that end at 10^6 of another one hold outliers and
    highlights together, and the strength came out 1.7 times too large."""
    write_observations(
        load_capture(make_capture(tmp_path / "c", rows=24, columns=32)), tmp_path, settings=IngestSettings()
    )
    frames = Observations(tmp_path)
    out = MapWriter(tmp_path, rows=24, columns=32, band_rows=frames.band_rows, stamp={})
    out.write("normals", np.broadcast_to(np.array([0, 0, 1], np.float32), (24, 32, 3)))
    out.write("flags", np.zeros((24, 32), np.uint8))
    out.write("reflectance", np.full((24, 32, 3), reflectance, np.float32))
    out.write("sigma", np.full((24, 32), 0.01, np.float32))
    context = SimpleNamespace(settings=BrdfSettings(), progress=Progress("scene/brdf"))
    histogram = gather(
        context,
        frames,
        maps_in(tmp_path),
        None,
        np.array([True]),
        [{"joint": False}],
    )
    assert histogram.value_unit == unit
    assert histogram.rows[0, :, 2].sum() > 0


def test_the_stage_leaves_out_pixels_of_a_capture_with_regions(tmp_path):
    """Labels are uint8, in which the -1 of a pixel left out was region 255."""
    capture = load_capture(make_capture(tmp_path / "c", rows=24, columns=32))
    write_observations(capture, tmp_path, settings=IngestSettings())
    frames = Observations(tmp_path)
    out = MapWriter(tmp_path, rows=24, columns=32, band_rows=frames.band_rows, stamp={})
    left_out = np.zeros((24, 32), np.uint8)
    left_out[:5] = NO_ESTIMATE
    out.write("normals", np.broadcast_to(np.array([0, 0, 1], np.float32), (24, 32, 3)))
    out.write("flags", left_out)
    out.write("reflectance", np.full((24, 32, 3), 0.4, np.float32))
    out.write("sigma", np.full((24, 32), 0.01, np.float32))
    context = SimpleNamespace(settings=BrdfSettings(), progress=Progress("scene/brdf"))
    labels = np.zeros((24, 32), np.uint8)
    labels[:, 16:] = 1
    two = gather(
        context,
        frames,
        maps_in(tmp_path),
        labels,
        np.array([True, True]),
        [joint(0.0), joint(1.0)],
    )
    lossless, lossy = (
        gather(
            context,
            frames,
            maps_in(tmp_path),
            None,
            np.array([True]),
            [joint(loss)],
        )
        for loss in (0.0, 1.0)
    )
    np.testing.assert_allclose(two.rows.sum(axis=0), lossless.rows[0], rtol=1e-6)
    assert not np.array_equal(two.values.sum(axis=0), lossless.values[0])  # the body of one region loses light
    assert not np.array_equal(two.values.sum(axis=0), lossy.values[0])
    assert (two.rows[:, :, 2].sum(axis=1) > 0).all()


def test_the_ladder_of_each_region_is_the_distribution_of_its_facets():
    """Tails of GGX, which one or two Gaussians of free width do not hold, below a surface that takes light away."""
    normals, lights = relief(), ring()
    geometry = half_vector_geometry(normals[None], lights[:, None, None], VIEW)

    def facets(phi):
        return 4.0 / (1 + (np.tan(np.minimum(phi, 1.5)) / 0.08) ** 2) ** 2

    albedo, region = np.full(normals.shape[:2], 0.4), np.zeros(normals.shape[:2], int)
    region[:, 70:] = 1
    cosine, view = np.maximum(geometry.cos_i, 0), normals[..., 2]
    body = albedo * cosine * transmittance(cosine, INDEX) * transmittance(view, INDEX)
    shine = np.where(region == 0, facets(geometry.phi) * attenuation(geometry, INDEX), 0)
    histogram = histogram_of(body + shine, normals, albedo, lights, regions=region, gloss=under(1.0))
    glossy, matt = fit_regions(histogram)
    phi = np.array([0.0, 0.03, 0.08, 0.16, 0.3])
    fitted = np.exp2(-((phi[:, None] / np.array(glossy["gamma"])) ** 2)) @ np.array(glossy["beta"])
    np.testing.assert_allclose(fitted, facets(phi), rtol=0.12, atol=0.01)
    assert max(matt["beta"]) < 1e-3
    assert glossy["beta"] == sorted(glossy["beta"], reverse=True)


def test_brightest_light_baseline():
    normals, lights = relief(), ring()
    observations, albedo = photographs(normals, lights, beta=20.0, gamma=0.15)
    fit = fit_brightest_light(observations, normals, albedo, lights, smoothing=0.0)
    assert fit.converged
    assert fit.beta == pytest.approx(20, rel=1e-3)
    assert fit.gamma == pytest.approx(0.15, rel=1e-3)
    phi, _, factor = brightest_light_samples(observations, normals, albedo, lights)
    assert phi.size <= albedo.size
    assert np.all(factor > 0)
    kept = thin(phi, bins=20, per_bin=10)
    assert np.all(np.histogram(phi[kept], bins=20, range=(0, phi.max()))[0] <= 11)
    steep = unit(np.dstack([np.full((4, 4), 2.0), np.zeros((4, 4)), np.ones((4, 4))]))
    assert brightest_light_samples(np.ones((7, 4, 4)), steep, np.ones((4, 4)), lights, smoothing=0.0)[0].size == 0
    assert not fit_brightest_light(np.ones((7, 4, 4)), steep, np.ones((4, 4)), lights, smoothing=0.0).converged
