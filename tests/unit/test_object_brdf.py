"""The fit of a whole object: of the model itself, of another one, and where nothing can be known."""

from dataclasses import replace

import numpy as np
import pytest

from nishiki.brdf.texels.environment import settle
from nishiki.brdf.texels.model import CaptureLamps, predict
from nishiki.brdf.texels.object_fit import PULLS, fit_lambert, fit_object
from nishiki.brdf.texels.parameters import Parameters, TexelFlag
from nishiki.brdf.texels.shading import find_lamp
from nishiki.brdf.texels.texel_fit import CaptureViews, Sample, Tile, lambert
from nishiki.formats.stored import channel_bits
from nishiki.geometry.camera import Camera

VIEWS, SIZE, RADIUS, DISTANCE = 36, 24, 50.0, 600.0
BEHIND = 0.15  # cos(theta_r) below which a texel is not seen


def ring(views=VIEWS):
    """Cameras on a circle around the y axis, a little above the object, looking at its centre."""
    cameras = []
    for k in range(views):
        turn = 2 * np.pi * k / views
        back = np.array([np.sin(turn), 0.25, np.cos(turn)])
        back /= np.linalg.norm(back)
        right = np.cross([0.0, 1, 0], back)
        right /= np.linalg.norm(right)
        down = -np.cross(back, right)
        rotation = np.stack([right, down, -back])
        centre = DISTANCE * back
        intrinsics = np.array([[900.0, 0, 99.5], [0, 900, 99.5], [0, 0, 1]])
        cameras.append(Camera(f"v{k}", intrinsics, rotation, -rotation @ centre, 200, 200))
    return cameras


def capture(lighting, encoding="linear", cameras=None):
    cameras = ring() if cameras is None else cameras
    return CaptureViews(np.array([c.centre for c in cameras]), [lighting.lamp(c) for c in cameras], encoding)


def patch(number, patches=6):
    """Texels of one of six patches side by side around the equator of a sphere: positions, normals."""
    longitude = 2 * np.pi * (number + np.linspace(0, 1, SIZE)) / patches
    latitude = np.linspace(0.6, -0.6, SIZE)[:, None]
    normals = np.stack(
        [np.sin(longitude) * np.cos(latitude), np.sin(latitude) + 0 * longitude, np.cos(longitude) * np.cos(latitude)],
        axis=-1,
    )
    return RADIUS * normals, normals


def colours(positions):
    """A texture: albedo between 0.15 and 0.85."""
    x, y, z = np.moveaxis(positions, -1, 0)
    waves = [np.sin(0.35 * x + 0.2 * y), np.sin(0.25 * y - 0.3 * z + 1), np.cos(0.4 * z + 0.15 * x)]
    return 0.5 + 0.35 * np.stack(waves, axis=-1)


def angles(positions, normals, centre, place):
    """cos theta_i, cos theta_r, alpha, all (T, T): written out from the definitions in float64."""

    def unit(vectors):
        return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)

    to_lamp, to_camera = unit(place - positions), unit(centre - positions)
    cos_i, cos_r = (np.sum(normals * v, axis=-1) for v in (to_lamp, to_camera))
    half = unit(to_lamp + to_camera)
    return cos_i, cos_r, np.arccos(np.clip(np.sum(normals * half, axis=-1), -1, 1)), half


def scene(reflect, *, noise=0.0, lamp=(60.0, 150.0, 0.0), seed=0, albedo=colours):
    """{tile: Tile} of a sphere whose points reflect(positions, kd, cos_i, cos_r, alpha) under a lamp at the camera."""
    rng = np.random.default_rng(seed)
    lighting = CaptureLamps("position", (lamp,))
    cameras = ring()
    tiles = {}
    for number in range(6):
        positions, normals = patch(number)
        kd = albedo(positions)
        values = np.zeros((VIEWS, SIZE, SIZE, 3), np.float32)
        visible = np.zeros((VIEWS, SIZE, SIZE), bool)
        for o, camera in enumerate(cameras):
            place = camera.centre + camera.rotation.T @ (np.array(lamp) * [1, -1, -1])
            cos_i, cos_r, alpha, _ = angles(positions, normals, camera.centre, place)
            seen = (cos_r > BEHIND) & (cos_i > 0)
            radiance = reflect(positions, kd, np.maximum(cos_i, 1e-6), np.maximum(cos_r, BEHIND), alpha)
            radiance = radiance + noise * rng.normal(size=radiance.shape)
            visible[o], values[o] = seen, np.where(seen[..., None], radiance, 0)
        tiles[number] = Tile(values, visible, positions.astype(np.float32), normals.astype(np.float32),
                             np.ones((SIZE, SIZE), bool))  # fmt: skip
    return tiles, lighting


def simplified(sigma=0.15, ks=(0.3, 0.25, 0.2)):
    def reflect(_, kd, cos_i, cos_r, alpha):
        lobe = (1 + alpha**2 / (4 * sigma**2)) ** -2 / cos_r
        return kd * cos_i[..., None] + np.array(ks) * lobe[..., None]

    return reflect


def ggx(roughness=0.3, specular=0.04, bounce=0.03):
    """Trowbridge-Reitz with Smith's masking, and light from the neighbours: another model than the fitted one."""

    def reflect(positions, kd, cos_i, cos_r, alpha):
        a2 = (roughness * (1 + 0.3 * np.sin(positions[..., 1] / 10))) ** 4
        d = a2 / (np.cos(alpha) ** 2 * (a2 - 1) + 1) ** 2
        g = np.ones_like(d)
        for cosine in (cos_i, cos_r):
            g = g / (cosine + np.sqrt(a2 + (1 - a2) * cosine**2))
        gloss = specular * d * g * cos_i
        return kd * (cos_i + bounce)[..., None] + gloss[..., None]

    return reflect


def fitted(tiles, lighting, *, encoding="linear", **options):
    found = {}
    report = fit_object(tiles.__getitem__, tiles, capture(lighting, encoding), found.__setitem__, **options)
    return found, report


def test_the_model_itself_is_recovered():
    tiles, lighting = scene(simplified())
    found, report = fitted(tiles, lighting)
    assert report.texels == 6 * SIZE * SIZE
    assert report.median_sigma == pytest.approx(0.15, rel=2e-3)
    assert report.psnr_db > 60
    for number, parameters in found.items():
        told = (parameters.flags & TexelFlag.KS_UNCONSTRAINED) == 0
        assert told.mean() > 0.2
        kd = colours(patch(number)[0])
        assert np.median(abs(parameters.kd - kd)) < 2e-3
        assert np.median(abs(parameters.ks - [0.3, 0.25, 0.2])) < 0.01


def test_texels_whose_width_ends_at_its_bound_are_counted():
    """Facets that scatter by 0.5 radians, beyond the widths that are tried."""
    inside = fitted(*scene(simplified()))[1]
    wide = fitted(*scene(simplified(sigma=0.5, ks=(0.3, 0.3, 0.3))))[1]
    assert inside.at_bound_share < 0.01
    assert wide.at_bound_share > 0.2


def test_views_left_out_choose_how_freely_gloss_varies():
    """One gloss under wrong normals, which move highlights, and two finishes in squares of four texels."""

    def squares(positions, kd, cos_i, cos_r, alpha):
        i, j = np.meshgrid(np.arange(SIZE) // 4, np.arange(SIZE) // 4, indexing="ij")
        dull = (i + j) % 2 == 1
        lobe = np.where(dull, 0.1, 0.3) * np.exp(-(alpha**2) / (2 * np.where(dull, 0.4, 0.12) ** 2)) / cos_r
        return kd * cos_i[..., None] + lobe[..., None]

    tiles, lighting = scene(simplified(), noise=0.002)
    for number, tile in tiles.items():
        bumps = 0.06 * np.sin(np.array([0.9, 0.7, 0.8]) * tile.positions[..., [1, 2, 0]])
        normals = tile.normals + bumps.astype(np.float32)
        normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
        tiles[number] = replace(tile, normals=normals)
    assert fitted(tiles, lighting)[1].pull >= 8
    assert fitted(*scene(squares, noise=0.002))[1].pull <= 1
    # among views left out of the whole fit, whichever they are, others are hidden
    for first in range(3):
        kept = np.arange(VIEWS)[:, None, None] % 3 != first
        fewer = {number: replace(tile, visible=tile.visible & kept) for number, tile in tiles.items()}
        assert fitted(fewer, lighting)[1].pull >= 8


@pytest.mark.parametrize("views", range(7))
def test_few_views_of_one_tile_are_fitted(views):
    tiles, lighting = scene(simplified(), noise=0.002)
    few = replace(tiles[0], visible=tiles[0].visible & (np.arange(VIEWS)[:, None, None] < views))
    found, report = fitted({0: few}, lighting)
    assert all(np.isfinite(getattr(found[0], name)).all() for name in ("kd", "ks", "sigma"))
    if views < 3:  # no view lies between two others
        assert report.pull == PULLS[0]


@pytest.mark.parametrize(("noise", "least_db"), [(0.0, 43), (0.003, 42)])
def test_another_material_is_predicted_in_views_that_no_fit_saw(noise, least_db):
    """Lobes of each texel by itself explain their own views better, 47 and 45 dB, and these worse, 38.6 and 38.3."""
    tiles, lighting = scene(ggx(), noise=noise)
    hidden = (np.arange(VIEWS) % 3 == 1)[:, None, None]
    found, _ = fitted({n: replace(tile, visible=tile.visible & ~hidden) for n, tile in tiles.items()}, lighting)
    parts = [
        capture(lighting).squares(found[n], replace(tile, visible=tile.visible & hidden)) for n, tile in tiles.items()
    ]
    squares, count = np.sum(parts, axis=0)
    assert -10 * np.log10(squares / count) > least_db


@pytest.mark.parametrize("roughness", [0.28, 0.33])
def test_saturated_highlights_bring_views_nearer_that_no_fit_saw(roughness):
    """The photographs end at 0.9, and their highlights above, whose red does so first, on a body that is nearly red.

    Hidden views are judged with their values cut there.
    """

    def reddish(positions):
        return np.array([0.8, 0.3, 0.3]) * (1 + 0.1 * np.sin(0.3 * positions))

    tiles, lighting = scene(ggx(roughness=roughness, specular=0.06), albedo=reddish)
    hidden, errors = np.arange(VIEWS) % 3 == 1, {}

    def ends(tile):
        return np.bitwise_or.reduce((tile.values > 0.9) * channel_bits(3), axis=-1)

    full = {n: t.visible & (ends(t) > 0) for n, t in tiles.items()}
    assert 0.01 < np.mean([f[t.visible].mean() for f, t in zip(full.values(), tiles.values(), strict=True)]) < 0.1
    for told in (False, True):
        cut = {
            n: replace(
                t,
                visible=t.visible & ~full[n] & ~hidden[:, None, None],
                values=np.minimum(t.values, np.float32(0.9)),
                saturated=(ends(t) * (full[n] & ~hidden[:, None, None]) if told else None),
            )
            for n, t in tiles.items()
        }
        found, _ = fitted(cut, lighting)
        squares = []
        for n, t in tiles.items():
            for view in np.flatnonzero(hidden):
                seen = t.visible[view]
                difference = sum(capture(lighting).predict(found[n], t, int(view), seen)).clip(None, 0.9)
                squares.append(((difference - t.values[view][seen].clip(None, 0.9)) ** 2).ravel())
        errors[told] = -10 * np.log10(np.concatenate(squares).mean())
    assert errors[True] > errors[False] + 1
    for n, parameters in found.items():  # the body follows from what is not saturated
        assert np.median(np.abs(parameters.kd - reddish(tiles[n].positions))) < 0.05


def test_without_gloss_the_body_never_follows_from_saturated_values():
    tiles, lighting = scene(simplified(0.15, (0.6, 0.6, 0.6)))
    tile = tiles[0]
    full = tile.visible & (tile.values.max(axis=-1) > 0.8)
    assert full.any()
    valid = replace(tile, visible=tile.visible & ~full)
    bodies = []
    for each in (valid, replace(valid, saturated=full * np.uint8(7))):
        fit_lambert(lambda _, each=each: each, [0], capture(lighting), lambda _, fitted: bodies.append(fitted.kd))
    np.testing.assert_allclose(*bodies, rtol=1e-5)
    full[:, :2, :2] = tile.visible[:, :2, :2]  # in all views
    never = replace(tile, visible=tile.visible & ~full, saturated=full * np.uint8(1))
    fit_lambert(lambda _: never, [0], capture(lighting), lambda _, fitted: bodies.append(fitted))
    assert (bodies[-1].flags[:2, :2] & TexelFlag.UNSEEN).all()
    assert (bodies[-1].kd[:2, :2] > 0.1).all()  # of the neighbours


def test_the_lobe_is_worth_decibels():
    tiles, lighting = scene(ggx(), noise=0.003)
    _, report = fitted(tiles, lighting)
    squares, count = 0.0, 0
    for tile in tiles.values():
        made = capture(lighting)
        total, _ = made.observe(tile)
        kd = np.zeros((SIZE * SIZE, 3), np.float32)
        kd[total.texel] = lambert(total)
        shape = (SIZE, SIZE, 3)
        matt = Parameters(kd.reshape(shape), np.zeros(shape, np.float32), np.full(shape[:2], 0.2, np.float32),
                          np.zeros(shape[:2], np.uint8))  # fmt: skip
        part = made.squares(matt, tile)
        squares, count = squares + part[0], count + part[1]
    assert report.psnr_db > -10 * np.log10(squares / count) + 6


def test_components_give_the_same_parameters():
    gloss, matt = simplified(), simplified(ks=(0, 0, 0))
    total, lighting = scene(gloss)
    diffuse, _ = scene(matt)
    apart = {
        n: Tile(diffuse[n].values, t.visible, t.positions, t.normals, t.inside, t.values - diffuse[n].values)
        for n, t in total.items()
    }
    found, report = fitted(apart, lighting)
    together, _ = fitted(total, lighting)
    assert report.psnr_db > 60
    for n in found:
        seen = (found[n].flags & TexelFlag.NO_HIGHLIGHT) == 0
        np.testing.assert_allclose(found[n].kd, together[n].kd, atol=2e-3)
        np.testing.assert_allclose(found[n].ks[seen], together[n].ks[seen], atol=0.02)


def test_unseen_texels_are_flagged_and_filled_smoothly():
    tiles, lighting = scene(simplified(), noise=0.002)
    tile = tiles[2]
    tile.visible[:, 5:15, 6:16] = False
    tile.values[:, 5:15, 6:16] = 0
    tile.visible[1:, 20, 20] = False
    tile.inside[:, :3] = False
    tiles[4].visible[:] = False
    tiles[1].values[:, 8:12, 8:12] = np.nan  # saturated in every view
    found, report = fitted(tiles, lighting)
    np.testing.assert_allclose(found[1].ks[8:12, 8:12].mean(axis=(0, 1)), found[1].ks[6].mean(axis=0), rtol=0.3)
    flags = found[2].flags
    assert np.all((flags[5:15, 6:16] & TexelFlag.UNSEEN) != 0)
    assert np.all(flags[:, :3] == TexelFlag.OUTSIDE)
    assert np.all((found[4].flags & TexelFlag.UNSEEN) != 0)
    assert report.unseen_share == pytest.approx((116 + SIZE * SIZE) / (6 * SIZE * SIZE - 3 * SIZE), abs=0.01)
    for parameters in found.values():
        for array in (parameters.kd, parameters.ks, parameters.sigma):
            assert np.isfinite(array).all()
            assert (array >= 0).all()
    hole = found[2].kd[4:16, 5:17]
    assert np.abs(np.diff(hole, n=2, axis=0)).max() < 0.2
    assert np.ptp(found[4].kd) == 0
    assert np.median(abs(found[4].ks - [0.3, 0.25, 0.2])) < 0.05


def test_nothing_seen_at_all():
    tiles, lighting = scene(simplified())
    for tile in tiles.values():
        tile.visible[:] = False
    found, report = fitted(tiles, lighting)
    assert report.psnr_db is None
    assert report.unseen_share == 1
    for parameters in found.values():
        assert np.all(parameters.kd == 0)
        assert np.all(parameters.ks == 0)
        assert np.all(parameters.sigma > 0)


def test_threads_and_order_do_not_change_the_result():
    tiles, lighting = scene(ggx(), noise=0.003)
    one, two = (fitted(tiles, lighting, threads=k)[0] for k in (1, 3))
    for n in tiles:
        for name in ("kd", "ks", "sigma", "flags"):
            np.testing.assert_array_equal(getattr(one[n], name), getattr(two[n], name))


@pytest.mark.parametrize("scale", [2.0**-20, 2.0**20])
def test_radiometric_scale_does_not_matter(scale):
    tiles, lighting = scene(ggx(), noise=0.003)
    scaled = {
        n: Tile(t.values * np.float32(scale), t.visible, t.positions, t.normals, t.inside) for n, t in tiles.items()
    }
    one, two = fitted(tiles, lighting)[0], fitted(scaled, lighting)[0]
    for n in tiles:
        np.testing.assert_allclose(two[n].kd / scale, one[n].kd, atol=1e-5)
        np.testing.assert_allclose(two[n].sigma, one[n].sigma, rtol=1e-4)


@pytest.mark.parametrize("place", [(0.0, 0.0), (0.4, -0.1), (-0.3, 0.25)])
def test_a_lamp_beside_the_camera_is_found_by_shading_and_gloss(place):
    """Within a fortieth of the camera's distance, with cast shadows and noise; a lamp at the camera stays there."""
    rng, cameras = np.random.default_rng(5), ring()
    normals = rng.normal(size=(700, 3)).astype(np.float32)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    kd = rng.uniform(0.1, 0.8, (700, 3)).astype(np.float32)
    lighting = CaptureLamps("position", ((place[0] * DISTANCE / 4, place[1] * DISTANCE / 4, 0.0),))
    values, visible = np.zeros((700, len(cameras), 3), np.float32), np.zeros((700, len(cameras)), bool)
    for k, camera in enumerate(cameras):
        lamp = lighting.lamp(camera)
        parts = predict(kd, np.full_like(kd, 0.2), np.full(700, 0.12), normals, normals, camera.centre, lamp)
        values[:, k] = sum(parts)
        visible[:, k] = (normals * (camera.centre - normals)).sum(axis=1) > 0.2 * DISTANCE
    values[rng.random(visible.shape) < 0.03] = 0
    values += rng.normal(0, 0.005, values.shape).astype(np.float32)
    sample = Sample(normals, normals, values, visible, np.arange(len(normals)))
    found = find_lamp(sample, cameras, np.arange(len(cameras)), falloff=False)
    if not any(place):
        assert found == (0.0, 0.0, 0.0)
    assert np.abs(np.array(found) - lighting.vectors[0]).max() < DISTANCE / 40
    stated, of = CaptureLamps("camera", ((0.0, 0.0, 0.0),)), np.zeros(len(cameras), int)
    degrees = np.degrees(np.arctan(np.hypot(*place) / 4))
    for encoding in ("linear", "srgb"):
        report = settle(stated, sample, cameras, of, falloff="inverse_square", encoding=encoding)[1]
        assert report.get("beside_camera_deg", [0]) == pytest.approx([degrees], abs=1.5)


def test_light_from_all_around_is_no_lamp_beside_the_camera():
    rng, cameras = np.random.default_rng(5), ring()
    normals = rng.normal(size=(300, 3)).astype(np.float32)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    values = np.repeat(rng.uniform(0.1, 0.8, (300, 1, 3)), len(cameras), axis=1).astype(np.float32)
    visible = np.stack([(normals * (c.centre - normals)).sum(axis=1) > 0.2 * DISTANCE for c in cameras], axis=1)
    sample = Sample(normals, normals, values, visible, np.arange(len(normals)))
    lighting, report = settle(
        CaptureLamps("camera", ((0.0, 0.0, 0.0),)), sample, cameras, np.zeros(len(cameras), int), falloff="none"
    )
    assert lighting.kind == "camera"
    assert "beside_camera_deg" not in report
