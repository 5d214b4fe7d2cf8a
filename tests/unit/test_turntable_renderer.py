"""The renderer on a dome of known texels, against a slow one written out pixel by pixel."""

from dataclasses import replace
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from nishiki.brdf.texels.model import CaptureLamps, predict
from nishiki.codec.design import Extent
from nishiki.codec.pictures import pack_strayed
from nishiki.codec.store import CodedTexels
from nishiki.colour.colour import decode, encode
from nishiki.geometry.camera import Camera
from nishiki.geometry.mesh import Mesh
from nishiki.geometry.turn import rotation_matrix
from nishiki.geometry.visibility import interpolate, rasterise
from nishiki.render.object import renderer as module
from nishiki.render.object.renderer import ObjectRenderer

SIZE, ACROSS = 9, 3  # texels of a tile, tiles across the dome
TEXELS = (SIZE - 1) * ACROSS + 1


def height(x, y):
    return 0.4 * np.exp(-2 * (x * x + y * y))


def dome(count=24):
    """A dome over the square -1..1 as triangles."""
    x, y = np.meshgrid(np.linspace(-1, 1, count + 1), np.linspace(-1, 1, count + 1))
    vertices = np.stack([x, y, height(x, y)], axis=-1).reshape(-1, 3)
    a = (np.arange(count)[:, None] * (count + 1) + np.arange(count)).reshape(-1)
    triangles = np.concatenate([np.stack([a, a + 1, a + count + 2], 1), np.stack([a, a + count + 2, a + count + 1], 1)])
    return Mesh.of(vertices, triangles)


class DomeAtlas:
    """Texels on the square, cut into tiles that share their borders."""

    size = SIZE
    tiles = ACROSS * ACROSS

    def __init__(self, mesh):
        self.mesh = mesh

    def locate(self, triangle, barycentric):
        corners = self.mesh.vertices[self.mesh.triangles[triangle]]
        u, v = barycentric[..., :1].astype(float), barycentric[..., 1:].astype(float)
        points = u * corners[..., 0, :] + v * corners[..., 1, :] + (1 - u - v) * corners[..., 2, :]
        row, column = ((points[..., k] + 1) / 2 * (TEXELS - 1) for k in (1, 0))
        down, across = (np.minimum(p // (SIZE - 1), ACROSS - 1).astype(int) for p in (row, column))
        tile = np.where(triangle >= 0, down * ACROSS + across, -1).astype(np.int32)
        return tile, (row - down * (SIZE - 1)).astype(np.float32), (column - across * (SIZE - 1)).astype(np.float32)

    def geometry(self, tile):
        row, column = np.mgrid[:SIZE, :SIZE] + np.array([tile // ACROSS, tile % ACROSS])[:, None, None] * (SIZE - 1)
        x, y = 2 * column / (TEXELS - 1) - 1, 2 * row / (TEXELS - 1) - 1
        slope = -4 * height(x, y)
        normals = np.stack([-slope * x, -slope * y, np.ones_like(x)], axis=-1)
        normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
        positions = np.stack([x, y, height(x, y)], axis=-1)
        return positions.astype(np.float32), normals.astype(np.float32), np.ones((SIZE, SIZE), bool)


class DomeResidual:
    """Random parameters and residuals, continuous over the tiles' common borders; tile 4 stores nothing."""

    pictures, channels = None, 3

    def __init__(self, observations, *, scale=0.1):
        rng = np.random.default_rng(5)
        self.whole = (scale * rng.normal(size=(observations, TEXELS, TEXELS, 3))).astype(np.float32)
        middle = slice(SIZE - 1, 2 * SIZE - 1)
        self.whole[:, middle, middle] = 0
        self.kd = rng.uniform(0.2, 0.8, (TEXELS, TEXELS, 3)).astype(np.float32)
        self.ks = rng.uniform(0, 0.2, (TEXELS, TEXELS, 3)).astype(np.float32)
        self.sigma = rng.uniform(0.1, 0.3, (TEXELS, TEXELS)).astype(np.float32)
        self.decoded = []

    def cut(self, tile):
        first, second = tile // ACROSS * (SIZE - 1), tile % ACROSS * (SIZE - 1)
        return slice(first, first + SIZE), slice(second, second + SIZE)

    def parameters(self, tile):
        area = self.cut(tile)
        return self.kd[area], self.ks[area], self.sigma[area]

    def decode_coded(self, tile, *, level=0):
        self.decoded.append(tile)
        values = self.whole[(slice(None), *self.cut(tile))]
        values = values.reshape(len(values), -1, self.channels)
        return CodedTexels(values, np.arange(values.shape[0]), np.arange(values.shape[1]))

    def empty(self, tile):
        return tile == 4


def view(angle, rows=100, columns=110):
    """A camera that looks at the dome from a distance of 4, turned about the y axis."""
    rotation = np.diag([1.0, -1, -1]) @ rotation_matrix(np.array([0, -angle, 0]))
    intrinsics = np.array([[150.0, 0, columns / 2], [0, 150, rows / 2], [0, 0, 1]])
    return Camera(f"{angle:.3f}", intrinsics, rotation, np.array([0, 0, 4.0]), rows, columns)


LIGHTING = CaptureLamps("direction", ((0.0, 0.3, 1.0), (0.6, 0.0, 0.8)))
ANGLES = np.array([-0.3, -0.1, 0.1, 0.3])


def make(*, encoding="srgb", residual=None, **options):
    mesh = dome()
    atlas = DomeAtlas(mesh)
    decoded = SimpleNamespace(
        atlas=atlas,
        cameras=[view(a) for a in ANGLES],
        residual=residual or DomeResidual(2 * len(ANGLES)),
        lighting=LIGHTING,
        encoding=encoding,
        full_turn=False,
        channels=(residual or DomeResidual).channels,
        ceiling=options.pop("ceiling", None),
    )
    threads = options.pop("threads", None)
    renderer = ObjectRenderer(decoded, (mesh, atlas.geometry), **options)
    renderer.threads = threads or renderer.threads
    return renderer


def picture_of(made, index):
    """A captured view; where it was left out of the fit, from the residual of its neighbours."""
    shot = made.predicted if index in made.without else made.captured
    return next(made.render([shot(index)]))


def bilinear(texture, y, x):
    i, j = min(int(y), SIZE - 2), min(int(x), SIZE - 2)
    y, x = y - i, x - j
    upper = texture[i, j] * (1 - x) + texture[i, j + 1] * x
    lower = texture[i + 1, j] * (1 - x) + texture[i + 1, j + 1] * x
    return upper * (1 - y) + lower * y


def slow(made, camera, light, shares):
    """(rows, columns, 3) linear and covered: pixel by pixel, float64, with shares {observation: weight}.

    A view lends in proportion to 1 / (1 + (gloss / 0.15 diffuse light)^2) of the model in it.
    """
    raster = rasterise(made.mesh, camera)
    tile, s, t = made.atlas.locate(raster.triangle, raster.barycentric)
    lamp = made.lighting.lamp(camera, light)
    textures = []
    for number in range(made.atlas.tiles):
        positions, normals, _ = made.geometry(number)
        diffuse, specular = predict(*made.residual.parameters(number), positions, normals, camera.centre, lamp)
        texture = encode((diffuse + specular).astype(np.float64), made.encoding)
        weights = []
        for observation, weight in shares.items():
            eye = made.cameras[observation % len(ANGLES)]
            there = predict(*made.residual.parameters(number), positions, normals, eye.centre, made.lighting.lamp(eye))
            ratio = there[1].sum(axis=-1) / (0.15 * there[0].sum(axis=-1))
            weights.append(weight * np.maximum(1 / (1 + ratio**2), 1e-3) if len(shares) > 1 else np.float64(1))
        for observation, weight in zip(shares, weights, strict=True):
            share = np.broadcast_to(weight / sum(weights), texture.shape[:2])[..., None]
            texture = texture + share * made.residual.whole[(observation, *made.residual.cut(number))]
        textures.append(texture)
    out = np.zeros((camera.rows, camera.columns, 3))
    for place in zip(*np.nonzero(tile >= 0), strict=True):
        out[place] = decode(bilinear(textures[tile[place]], float(s[place]), float(t[place])), made.encoding)
    return np.maximum(out, 0), raster.triangle >= 0


class CodedViews:
    """View 1 of two lights as a picture of one level a light; the surface misses the corner and passes the outline."""

    channels = 3

    def __init__(self):
        self.extents = [Extent(k, int(k == 1), 0, 0, 512, 512) for k in range(len(ANGLES))]

    def texels(self, tile):
        levels = np.array([0.25, 0.5], np.float32)[None, :, None, None]
        return np.broadcast_to(levels, (3, 2, 512, 512)) if tile == 1 else None

    def stream(self, tile, index):
        mask = np.zeros((100, 110), bool)
        mask[:4, :5] = mask[48:52, 50:60] = True
        return pack_strayed([mask])[0] if tile == 1 else b""


def test_captured_views_are_pictures_where_they_are_coded_so():
    residual = DomeResidual(2 * len(ANGLES))
    without = make(encoding="linear", residual=residual)
    plain = picture_of(without, 2)
    residual.pictures = CodedViews()
    made = make(encoding="linear", residual=residual)
    for light, level in enumerate((0.25, 0.5)):
        shown = next(made.render([made.captured(1, light=light)]))
        assert shown.reached[:4, :5].all()
        assert not shown.covered[:4, :5].any()
        beyond = np.zeros_like(shown.covered)
        beyond[48:52, 50:60] = True
        assert shown.covered[beyond].all()
        assert (shown.linear[shown.reached & ~beyond] == level).all()
        texels = next(without.render([without.captured(1, light=light)])).linear
        np.testing.assert_array_equal(shown.linear[beyond], texels[beyond])
        assert not shown.linear[~shown.reached].any()
    both = next(made.render([made.captured(1).lit_by(((0, 1.0), (1, 0.5)))]))
    np.testing.assert_allclose(both.linear[both.reached & ~beyond], 0.5, atol=1e-6)
    np.testing.assert_array_equal(picture_of(made, 2).linear, plain.linear)


class Photographed(CodedViews):
    """All views of the first light as pictures of what texels show there; at `bare` pixels the surface is none."""

    def __init__(self, shown, bare):
        self.shown, self.bare, self.channels = shown, bare, shown[0].shape[-1]
        self.extents = [Extent(k, 1, 0, 0, 512, 512) for k in range(len(shown))]

    def texels(self, tile):
        whole = np.full((self.channels, 2, 512, 512), 7.0, np.float32)
        whole[:, :, :100, :110] = np.moveaxis(self.shown[tile], -1, 0)[:, None]
        return whole

    def stream(self, tile, index):
        return pack_strayed([self.bare])[0] if self.bare.any() else b""


@pytest.mark.parametrize("channels", [3, 1, 5])
def test_pictures_lend_what_they_differ_from_the_model_to_views_between(channels, monkeypatch):
    monkeypatch.setattr(module, "MOST_PLACES", 50)
    residual = DomeResidual(2 * len(ANGLES))
    bands, residual.channels = np.arange(channels) % 3, channels
    residual.kd, residual.ks, residual.whole = (v[..., bands] for v in (residual.kd, residual.ks, residual.whole))
    residual.whole[:] = (
        residual.whole[:1].mean(axis=(1, 2), keepdims=True) + 0.1 * np.sin(np.arange(TEXELS) / 4)[:, None]
    )
    texels, model = make(residual=residual), make(residual=residual, model_only=True)
    shown = [encode(picture_of(texels, k).linear, "srgb") for k in range(len(ANGLES))]
    shot = texels.between(1, 0.3)
    want, alone = (next(each.render([shot])) for each in (texels, model))
    bare = np.zeros((100, 110), bool)
    off = []
    for bare[40:60, 40:70] in (False, True):
        residual.pictures = Photographed(shown, bare)
        got = next(make(residual=residual).render([shot]))
        inner = cv2.erode(got.covered.astype(np.uint8), np.ones((9, 9))) > 0
        off.append(np.abs(got.linear - want.linear)[inner].mean())
        apart = np.abs(got.linear - alone.linear)[45:55, 50:60].max()
        assert apart < 1e-5 if bare.any() else apart > 0.01
    assert off[0] < 0.2 * np.abs(alone.linear - want.linear)[inner].mean()
    # a frame of the turn at a captured place, where one view is the only neighbour, is as good
    residual.pictures = Photographed(shown, np.zeros((100, 110), bool))
    at, alone = (next(made.render([made.between(2, 0.0)])).linear for made in (make(residual=residual), model))
    want = decode(shown[2], "srgb")
    assert np.abs(at - want)[inner].mean() < 0.2 * np.abs(alone - want)[inner].mean()


def test_places_turned_away_from_the_camera_take_what_the_picture_shows_beside_them():
    residual = DomeResidual(2 * len(ANGLES))
    shown = [encode(picture_of(make(residual=residual), k).linear, "srgb") for k in range(len(ANGLES))]
    residual.pictures = Photographed(shown, np.zeros((100, 110), bool))
    made = make(residual=residual)
    shot = made.between(1, 0.3)
    want = next(made.render([shot]))
    folded = (np.abs(made.mesh.vertices[:, :2]) < 0.15).all(axis=1)
    assert folded.any()
    made.mesh = replace(made.mesh, normals=np.where(folded[:, None], -1, 1) * made.mesh.normals)
    got = next(made.render([shot]))
    away = (got.linear != want.linear).any(axis=-1)
    assert 20 < away.sum() < 400
    around = cv2.dilate(away.astype(np.uint8), np.ones((15, 15))) > 0
    assert np.abs(got.linear - want.linear)[away].mean() < np.ptp(want.linear[around & ~away], axis=0).mean()
    assert (got.covered == want.covered).all()
    captured = made.captured(1)  # a photograph shows what is there
    made_so = make(residual=residual)
    np.testing.assert_array_equal(*(next(each.render([captured])).linear for each in (made, made_so)))


def test_the_surface_throws_shadows_between_views():
    made = make()
    lamp = CaptureLamps("direction", ((0.95, 0.0, 0.312),)).lamp(view(0.0))
    points, normals = (np.concatenate([made.geometry(k)[part].reshape(-1, 3) for k in range(9)]) for part in (0, 1))
    along = np.arange(0.02, 2, 0.01)
    ray = points[:, None] + along[:, None] * lamp.vector
    clear = (ray[..., 2] - np.where(np.abs(ray[..., 0]) <= 1, height(ray[..., 0], ray[..., 1]), 0)).min(axis=1)
    lit = made._find_lit(lamp, points, normals)
    sure = np.abs(clear) > 0.03
    np.testing.assert_array_equal(lit[sure] > 0, clear[sure] > 0)
    assert (lit == 0).sum() > 30


def test_texels_lend_apart_from_the_shadows_of_their_views():
    """Views show the model where the lamp sees the dome, and light of 0.05 everywhere; so does the view between."""
    residual = DomeResidual(2 * len(ANGLES))
    residual.empty = lambda tile: False
    made = make(encoding="linear", residual=residual)
    made.lighting = CaptureLamps("direction", ((0.95, 0.0, 0.312),) * 2)
    for index, camera in enumerate(made.cameras):
        lamp = made.lighting.lamp(camera)
        for tile in range(made.atlas.tiles):
            positions, normals, _ = made.geometry(tile)
            model = sum(predict(*residual.parameters(tile), positions, normals, camera.centre, lamp))
            lit = made._find_lit(lamp, positions.reshape(-1, 3), normals.reshape(-1, 3)).reshape(SIZE, SIZE, 1)
            residual.whole[(index, *residual.cut(tile))] = model * (lit - 1) + 0.05
    shot = made.between(1, 0.5)
    picture = next(made.render([shot]))
    model, covered = slow(made, shot.camera, 0, {})
    shown = picture.triangle[covered], picture.barycentric[covered]
    points, normals = (interpolate(v, made.mesh.triangles, *shown) for v in (made.mesh.vertices, made.mesh.normals))
    lit = np.zeros(covered.shape)
    lit[covered] = made._find_lit(made.lighting.lamp(shot.camera), points, normals)
    for part, least in ((covered & (lit > 0), 1000), (covered & (lit == 0), 100)):
        inner = cv2.erode(part.astype(np.uint8), np.ones((9, 9))) > 0
        assert inner.sum() > least
        want = model * lit[..., None] + 0.05
        np.testing.assert_allclose(picture.linear[inner], want[inner], atol=0.01)


@pytest.mark.parametrize("encoding", ["srgb", "linear"])
def test_captured_views_are_model_plus_residual_between_texels(encoding):
    made = make(encoding=encoding)
    for index in (0, 2):
        picture = picture_of(made, index)
        want, covered = slow(made, made.cameras[index], 0, {index: 1.0})
        np.testing.assert_array_equal(picture.covered, covered)
        assert covered.sum() > 1500
        np.testing.assert_allclose(picture.linear[covered], want[covered], atol=2e-6)
        assert not picture.linear[~picture.reached].any()
        assert (picture.reached & ~covered).sum() > 100


def test_model_alone():
    made = make(model_only=True)
    want, covered = slow(made, made.cameras[1], 0, {})
    np.testing.assert_allclose(picture_of(made, 1).linear[covered], want[covered], atol=2e-6)
    assert made.residual.decoded == []


def test_lights_are_summed_in_linear_light():
    made = make()
    shot = made.captured(1).lit_by(((0, 0.5), (1, 2.0)))
    picture = next(made.render([shot]))
    first, covered = slow(made, made.cameras[1], 0, {1: 1.0})
    second, _ = slow(made, made.cameras[1], 1, {len(ANGLES) + 1: 1.0})
    np.testing.assert_allclose(picture.linear[covered], 0.5 * first[covered] + 2 * second[covered], atol=5e-6)


def test_views_between_weight_the_neighbours_and_model_the_new_view():
    made = make()
    shot = made.between(1, 0.25)
    picture = next(made.render([shot]))
    want, covered = slow(made, view(-0.05), 0, {1: 0.75, 2: 0.25})
    # the dome is seen well from both neighbours everywhere
    np.testing.assert_allclose(picture.linear[covered], want[covered], atol=1e-4)


def test_between_at_a_captured_view_is_that_view():
    made = make()
    between, captured = made.render([made.between(2, 0.0), made.captured(2)])
    np.testing.assert_array_equal(between.linear, captured.linear)


def test_a_left_out_view_is_predicted_from_its_neighbours():
    residual = DomeResidual(2 * len(ANGLES))
    residual.whole[1] = 99.0  # what stands in its own slot must not be used
    made = make(residual=residual, without=frozenset({1}))
    want, covered = slow(made, made.cameras[1], 0, {0: 0.5, 2: 0.5})
    np.testing.assert_allclose(picture_of(made, 1).linear[covered], want[covered], atol=1e-4)


def test_only_tiles_in_view_that_hold_something_are_decoded_once():
    made = make(threads=1)
    for _ in made.render([made.captured(k) for k in range(4)]):
        pass
    assert sorted(made.residual.decoded) == [0, 1, 2, 3, 5, 6, 7, 8]


def test_pictures_do_not_depend_on_batches_threads_or_cache(monkeypatch):
    plain = [picture.linear for picture in make(threads=1).render([make().captured(k) for k in range(4)])]
    monkeypatch.setattr(module, "BATCH_BYTES", 1)
    monkeypatch.setattr(module, "CACHE_BYTES", 1)
    for large in (1, 1 << 30):
        monkeypatch.setattr(module, "LARGE_BATCH_BYTES", large)
        made = make(threads=4)
        for want, picture in zip(plain, made.render([made.captured(k) for k in range(4)]), strict=True):
            np.testing.assert_array_equal(picture.linear, want)


def test_batches_are_large_only_where_tiles_must_be_decoded_again(monkeypatch):
    monkeypatch.setattr(module, "BATCH_BYTES", 1)
    shots = [make().captured(k) for k in range(4)]
    once = make(threads=1)
    assert len(list(once.render(shots))) == 4
    assert sorted(once.residual.decoded) == [0, 1, 2, 3, 5, 6, 7, 8]
    monkeypatch.setattr(module, "CACHE_BYTES", 1)
    again = make(threads=1)
    assert len(list(again.render(shots))) == 4
    assert len(again.residual.decoded) == 2 * len(once.residual.decoded)  # the first view, then the others together


def test_pictures_are_clipped_to_what_the_capture_could_hold():
    residual = DomeResidual(2 * len(ANGLES), scale=2.0)
    free, bound = make(residual=residual, ceiling=None), make(residual=residual, ceiling=0.7)
    wild, tame = picture_of(free, 1), picture_of(bound, 1)
    assert wild.linear.min() == 0
    assert wild.linear.max() > 2
    np.testing.assert_array_equal(tame.linear[tame.covered], np.minimum(wild.linear[wild.covered], np.float32(0.7)))
    assert 0 <= tame.linear.min()
    assert tame.linear.max() <= np.float32(0.7)
    both = next(bound.render([bound.captured(1).lit_by(((0, 1.0), (1, 1.0)))]))
    assert 0.7 < both.linear.max() <= np.float32(1.4)


def test_nothing_in_view_gives_an_empty_picture():
    made = make()
    away = Camera("away", made.cameras[0].intrinsics, np.eye(3), np.array([0, 0, -9.0]), 20, 30)
    picture = next(made.render([replace(made.captured(0), camera=away, captured=None)]))
    assert not picture.reached.any()
    assert not picture.linear.any()


def test_normals_face_the_camera():
    made = make()
    picture = picture_of(made, 2)
    normals = made.normals(picture, made.cameras[2])
    assert np.allclose(np.linalg.norm(normals[picture.covered], axis=1), 1, atol=1e-5)
    assert normals[picture.covered][:, 2].mean() > 0.8
    assert not normals[~picture.covered].any()
