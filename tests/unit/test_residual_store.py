"""The whole path on a small object: pixels to bytes to pictures; targets, determinism, damage, held-out views."""

import json
from dataclasses import replace

import numpy as np
import pytest
from refusals import refused
from residual_source import SphereSource, scene_of
from turned_sphere import tiles_of_sphere

from nishiki.codec.allocate import EncodedObject, Pilot, find_step, one_pass, over, pilot, point_of, psnr, slope_of
from nishiki.codec.design import Design
from nishiki.codec.solve import Footprints, Pursuit
from nishiki.codec.store import STORE, Residual, frame_bytes, pack_object, unpack_head, write_residual
from nishiki.codec.tile_code import Effort, Pixels, Typical, decode_residual, predict_texels
from nishiki.errors import UserError
from nishiki.stages.residual import ResidualSettings
from nishiki.stages.residual.run import goal_of

VIEWS = 12
EFFORT = Effort(pursuit=Pursuit(rounds=4, inner=4), refinements=8)


@pytest.fixture(scope="module")
def sphere():
    return tiles_of_sphere(views=VIEWS, pixels=40, size=24, around=6, high=2, sub=2)[:4]


def design(**changes):
    values = {"tile_size": 24, "views": VIEWS, "lights": 1, "channels": 3, "full_turn": True, "encoding": "linear"}
    return Design(**{**values, **changes})


def encoded(tiles, *, step=0.03, without=(), threads=2, **changes):
    source, scene = SphereSource(tiles, without=without, encoding=changes.get("encoding", "linear")), scene_of(VIEWS)
    found = pilot(source, scene, design(**changes), EFFORT, threads=threads)
    return one_pass(source, scene, found.at_step(step), EFFORT, threads=threads), source, scene


def squared_error(residual, source, scene, *, level=0, encoding="linear"):
    total, count = 0.0, 0
    for tile in range(source.tiles):
        kd, ks, sigma = residual.parameters(tile)
        texels = np.moveaxis(residual.decode(tile, level=level), -1, 0)
        if residual.design.model:
            surface = source.surface(tile)
            texels = texels + predict_texels(kd, ks, sigma, surface, scene.centres, scene.lamps, encoding)
        pixels = source.pixels(tile)
        feet = Footprints.of(pixels.observation, pixels.s, pixels.t, (VIEWS, source.size, source.size))
        left = feet.look_up(np.ascontiguousarray(texels)) - pixels.values.T[:, feet.order]
        total, count = total + float(np.sum(left.astype(float) ** 2)), count + left.size
    return total, count


@pytest.mark.slow
@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"encoding": "srgb"},
        {"model": False},
        {"wavelet": "bior4.4", "mirrored": True, "view_transform": "none", "arcs": False},
    ],
)
def test_pictures_of_the_decoder_are_those_of_the_encoder(sphere, tmp_path, changes):
    result, source, scene = encoded(sphere, **changes)
    parts = write_residual(tmp_path, result, stamp={"scene": "s"}, report={})
    stored = sum(p.stat().st_size for p in (tmp_path / STORE).rglob("*") if p.is_file())
    assert parts["total"] == stored == sum(v for k, v in parts.items() if k != "total")
    residual = Residual(tmp_path)
    total, count = squared_error(residual, source, scene, encoding=changes.get("encoding", "linear"))
    assert count == result.pixels * 3
    assert total == pytest.approx(result.error, rel=2e-3)
    assert result.error < 0.9 * result.model_error
    coarse, _ = squared_error(residual, source, scene, level=1, encoding=changes.get("encoding", "linear"))
    assert total < coarse
    assert Design.from_dict(json.loads(json.dumps(residual.design.as_dict()))) == residual.design


def test_the_model_pays(sphere):
    with_model, without = encoded(sphere, step=0.04)[0], encoded(sphere, step=0.04, model=False)[0]
    better = psnr(with_model.error, with_model.pixels * 3) - psnr(without.error, without.pixels * 3)
    saved = np.log2(without.bytes / with_model.bytes)
    assert better + 3 * saved > 0.5


def test_bytes_do_not_depend_on_threads_or_order(sphere):
    one, many = encoded(sphere, threads=1)[0], encoded(sphere, threads=3)[0]
    assert pack_object(one) == pack_object(many)


def test_a_held_out_view_is_not_spoilt_by_the_residual_that_fills_it(sphere, tmp_path):
    result, _, scene = encoded(sphere, step=0.01, without=(3,))
    write_residual(tmp_path, result, stamp={}, report={})
    residual = Residual(tmp_path)
    errors = np.zeros(2)
    for number, tile in enumerate(sphere):
        mine = tile.observation == 3
        if not mine.any():
            continue
        model = predict_texels(
            *residual.parameters(number), SphereSource(sphere).surface(number), scene.centres, scene.lamps, "linear"
        )
        feet = Footprints.of(tile.observation[mine], tile.s[mine], tile.t[mine], (VIEWS, 24, 24))
        values = tile.values[mine].T[:, feet.order]
        for k, texels in enumerate((model, model + np.moveaxis(residual.decode(number), -1, 0))):
            errors[k] += np.sum((feet.look_up(np.ascontiguousarray(texels)) - values) ** 2)
    assert errors[1] < 1.15 * errors[0]


def test_every_flipped_bit_is_noticed(sphere, tmp_path):
    result, source, scene = encoded(sphere, step=0.05)
    write_residual(tmp_path, result, stamp={"scene": "s"}, report={})
    expected = squared_error(Residual(tmp_path), source, scene)
    rng = np.random.default_rng(0)
    files = sorted(p for p in (tmp_path / STORE).rglob("*") if p.is_file())
    noticed = 0
    for trial in range(60):
        path = files[trial % len(files)]
        sound = path.read_bytes()
        damaged = bytearray(sound)
        damaged[rng.integers(len(sound))] ^= 1 << rng.integers(8)
        path.write_bytes(bytes(damaged))
        with pytest.raises(UserError, match="damaged"):
            squared_error(Residual(tmp_path), source, scene)
        noticed += 1
        path.write_bytes(sound)
    assert noticed == 60
    assert squared_error(Residual(tmp_path), source, scene) == expected


def test_missing_stores_are_reported(tmp_path):
    with refused(UserError, "residual.json"):
        Residual(tmp_path)
    with refused(UserError, "NWT1", "nons"):
        unpack_head(b"nonsense")


def test_nothing_is_stored_where_the_model_suffices(sphere, tmp_path):
    result, _, _ = encoded(sphere, step=30.0)
    write_residual(tmp_path, result, stamp={}, report={})
    residual = Residual(tmp_path)
    assert all(residual.empty(tile) for tile in range(residual.tiles))
    assert residual.bytes["residual"] == 0
    assert not residual.decode(0).any()
    assert residual.stream_bytes(1)[1] == 0


@pytest.mark.slow
def test_search_meets_its_target(sphere):
    source, scene = SphereSource(sphere), scene_of(VIEWS)
    found = pilot(source, scene, design(), EFFORT, threads=2)

    def run(step, earlier):
        return one_pass(source, scene, found.at_step(step), EFFORT, threads=2, earlier=earlier)

    def miss(point):
        return np.log(point.bytes / 9000)

    reached = find_step(run, miss, start=0.02, tolerance=0.03, passes=8)
    assert reached.bytes == pytest.approx(9000, rel=0.03)
    assert point_of(reached).bytes in [point.bytes for point in reached.curve]
    quality = find_step(run, lambda p: (p.psnr_db - 34) / 8.6859, start=0.02, tolerance=0.02, passes=8)
    assert point_of(quality).psnr_db == pytest.approx(34, abs=0.2)


@pytest.mark.slow
def test_a_pass_that_goes_on_from_another_is_better_at_equal_bytes(sphere):
    source, scene = SphereSource(sphere), scene_of(VIEWS)
    found = pilot(source, scene, design(), EFFORT, threads=2)
    coarser = one_pass(source, scene, found.at_step(0.022), EFFORT, threads=2)
    before, cold = point_of(coarser), point_of(one_pass(source, scene, found.at_step(0.02), EFFORT, threads=2))
    resumed = point_of(one_pass(source, scene, found.at_step(0.02), EFFORT, threads=2, earlier=coarser))
    slope = (cold.psnr_db - before.psnr_db) / np.log(cold.bytes / before.bytes)
    assert resumed.psnr_db > cold.psnr_db + slope * np.log(resumed.bytes / cold.bytes)


def test_a_sample_of_tiles_stands_for_all(sphere):
    source, scene = SphereSource(sphere), scene_of(VIEWS)
    found = pilot(source, scene, design(), EFFORT, threads=1)
    assert found.sample(100) == list(range(source.tiles))
    tiles = found.sample(2)
    assert len(tiles) == 2
    order = np.argsort(-found.energy)
    assert set(tiles) == {int(order[1]), int(order[3])}
    some, every = (one_pass(source, scene, found.at_step(0.03), EFFORT, threads=1, tiles=t) for t in (tiles, None))
    assert (len(some.streams), len(every.streams)) == (2, source.tiles)
    assert some.extents == [every.extents[t] for t in tiles]
    assert point_of(some, 0.5).kept == 2 * some.kept
    start = some.bytes - some.bytes_of_tiles
    assert point_of(some, 0.5).bytes == start + 2 * some.bytes_of_tiles


def test_slopes_come_from_passes_that_are_apart():
    assert slope_of([0.08], [0.5], -2.0) == -2.0
    assert slope_of([0.08, 0.081], [0.5, 0.7], -2.0) == -2.0
    assert slope_of([0.08, 0.04, 0.0401], [-0.5, 0.2, 0.1], -2.0) == pytest.approx(0.6 / np.log(0.0401 / 0.08))
    assert slope_of([0.08, 0.04], [0.1, 0.1]) == -0.02


@pytest.mark.parametrize("power", [0.4, 1.1, 3.0])
def test_steps_are_found_whatever_the_slope(power):
    visited = []

    def run(step, earlier):
        assert earlier is None or earlier.design.step == visited[-1]
        visited.append(step)
        return EncodedObject(replace(design(), step=step), (), [], [], [], 1, step**power, 1.0, 0, [])

    found = find_step(
        run,
        lambda p: p.psnr_db / 4.343 + power * np.log(0.004 / 3 ** (1 / power)),
        start=0.08,
        tolerance=0.01,
        passes=12,
    )
    assert found.design.step == pytest.approx(0.004, rel=0.02 / power)
    assert len(visited) <= 7


def test_coded_texels_are_those_of_the_tile(sphere, tmp_path):
    result, _, _ = encoded(sphere)
    write_residual(tmp_path, result, stamp={}, report={})
    residual = Residual(tmp_path)
    for tile in range(residual.tiles):
        every, coded = residual.decode(tile), residual.decode_coded(tile)
        size = coded.values.nbytes + coded.observation.nbytes + coded.texel.nbytes
        assert size <= every.nbytes + 8 * (residual.size**2 + VIEWS) + 4 * 3 * sum(coded.values.shape[:2])
        for observation in range(VIEWS):
            for texel in range(0, residual.size**2, 7):
                value = coded.values[coded.observation[observation], coded.texel[texel]]
                np.testing.assert_array_equal(value, every[observation, texel // residual.size, texel % residual.size])
        extent = result.extents[tile]
        unseen = np.setdiff1d(np.arange(VIEWS), extent.observations(VIEWS, 1))
        assert not every[unseen].any()
        np.testing.assert_array_equal(
            every[np.ix_(extent.observations(VIEWS, 1), *(np.arange(residual.size)[part] for part in extent.texels))],
            np.moveaxis(decode_residual(result.integers[tile][1].full(), result.design, extent), 0, -1),
        )


def test_a_total_counts_every_part():
    counts, others = {"pixels": 1000, "visible": 300, "samples": 900}, {"mesh": 5000, "charts": 700}
    total = ResidualSettings(target="total_bytes", amount=20000)
    only = ResidualSettings(target="bytes", amount=20000 - 5700 - frame_bytes(100))
    assert goal_of(total, counts, others, 100) == pytest.approx(goal_of(only, counts, others, 100))
    with pytest.raises(UserError, match="mesh 5000, charts 700"):
        goal_of(ResidualSettings(target="total_bytes", amount=5700 + frame_bytes(100)), counts, others, 100)


def test_header_and_index_take_about_what_is_expected(sphere, tmp_path):
    result, _, _ = encoded(sphere)
    parts = write_residual(tmp_path, result, stamp={}, report={})
    size = sum(parts[name] for name in ("header", "index", "container"))
    assert size == pytest.approx(frame_bytes(len(sphere)), abs=500)


def test_parameter_steps_follow_the_weights():
    steps = Pilot([], design(), Typical((4.0, 0.0, 1.0), 1.0), np.zeros(0)).at_step(0.02).design
    assert steps.parameter_steps[0] == pytest.approx(0.01)
    assert all(np.isfinite(steps.parameter_steps))


def test_work_comes_back_in_order():
    assert list(over(lambda n: n * n, range(20), 3)) == [n * n for n in range(20)]
    assert psnr(0.0, 10) == 200.0


def test_saturated_pixels_are_coded(sphere):
    """White pixels that are stated as saturated are reproduced; parameters and colours are those without them."""

    class Glare(SphereSource):
        stated = True

        def pixels(self, tile):
            pixels = super().pixels(tile)
            white = np.arange(len(pixels.s)) % 40 == 3
            values = np.where(white[:, None], np.float32(1.5), pixels.values)
            return Pixels(pixels.observation, pixels.s, pixels.t, values, white if self.stated else None)

    source, scene = Glare(sphere), scene_of(VIEWS)
    stated = pilot(source, scene, design(), EFFORT, threads=1)
    clean = pilot(SphereSource(sphere), scene, design(), EFFORT, threads=1)
    source.stated = False
    mixed = pilot(source, scene, design(), EFFORT, threads=1)

    def away(found):
        return sum(np.abs(a.maps.kd - b.maps.kd).sum() for a, b in zip(found.refined, clean.refined, strict=True))

    assert away(stated) < 0.3 * away(mixed)
    source.stated = True
    coded = one_pass(source, scene, stated.at_step(0.01), EFFORT, threads=1)
    assert coded.pixels == sum(len(source.pixels(tile).s) for tile in range(source.tiles))
    assert coded.error < 0.05 * coded.model_error
