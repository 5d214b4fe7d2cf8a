"""The reflection model of an object: texels without a highlight, seen once or never, at any brightness and size."""

import mpmath
import numpy as np
from hypothesis import strategies as st
from stability.cases import case, powers_of_ten, relative, worst_over
from unit.test_object_brdf import patch, ring

from nishiki.brdf.slopes import GRAZING
from nishiki.brdf.texels.environment import fit_environment, fit_highlight, settle
from nishiki.brdf.texels.environment import residuals as left_of
from nishiki.brdf.texels.model import CaptureLamps, factors, predict
from nishiki.brdf.texels.neighbours import Lattice, Neighbourhood, fill, spread
from nishiki.brdf.texels.object_fit import fit_object
from nishiki.brdf.texels.parameters import Parameters, TexelFlag
from nishiki.brdf.texels.texel_fit import CaptureViews, Tile, sample_texels

CAMERA = CaptureLamps("camera", ((0.0, 0.0, 0.0),))
SEEN = 0.15  # cos(theta_r) above which a texel is visible


def lighting() -> CaptureLamps:
    return CaptureLamps.from_capture({"kind": "camera"}, lights=1, unit="mm")


def tile_of(views=ring, *, number=0, kd=0.5, ks=0.3, sigma=0.25, scale=1.0, size=1.0, offset=0.0, seed=0):
    """Exact data of one patch of a sphere under a lamp beside the camera."""
    positions, normals = patch(number)
    shift = offset * np.array([1.0, -0.5, 0.25])
    cameras = views()
    centres = np.array([c.centre for c in cameras])
    albedo = kd * (1 + 0.5 * np.random.default_rng(seed).uniform(-1, 1, (*positions.shape[:2], 3)))
    arguments = (albedo, np.full(albedo.shape, ks), np.full(albedo.shape[:2], sigma), positions, normals)
    values, visible = [], []
    for camera in cameras:
        diffuse, specular = predict(*arguments, camera.centre, lighting().lamp(camera))
        towards = camera.centre - positions
        cosine = (normals * towards).sum(axis=-1) / np.linalg.norm(towards, axis=-1)
        values.append((diffuse + specular) * np.float32(scale))
        visible.append(cosine > SEEN)
    inside = np.ones(positions.shape[:2], bool)
    tile = Tile(
        np.array(values), np.array(visible), ((positions + shift) * size).astype(np.float32),
        normals.astype(np.float32), inside,
    )  # fmt: skip
    lamps = [lighting().lamp(c) for c in moved(cameras, size, shift)]
    return tile, CaptureViews(((centres + shift) * size), lamps, "linear")


def moved(cameras, size, shift):
    from dataclasses import replace

    return [replace(c, translation=(c.translation - c.rotation @ shift) * size) for c in cameras]


def fitted(tiles, what, **rest):
    kept: dict[int, Parameters] = {}
    told = fit_object(lambda k: tiles[k], range(len(tiles)), what, kept.__setitem__, **rest)
    return [kept[k] for k in range(len(tiles))], told


def finite(parameters, told):
    arrays = [getattr(p, name) for p in parameters for name in ("kd", "ks", "sigma")]
    figures = [value for value in vars(told).values() if isinstance(value, float)]
    return all(np.isfinite(a).all() for a in arrays) and bool(np.isfinite(figures).all())


def exact_model(kd, ks, sigma, cos_r, alpha, cos_i):
    with mpmath.workdps(50):
        diffuse = mpmath.mpf(kd) * max(mpmath.mpf(cos_i), 0)
        if sigma == 0:
            lobe = mpmath.mpf(1 if alpha == 0 else 0)
        else:
            lobe = (1 + (mpmath.mpf(alpha) / (2 * mpmath.mpf(sigma))) ** 2) ** -2
        specular = mpmath.mpf(ks) / max(mpmath.mpf(cos_r), mpmath.mpf(GRAZING)) * lobe
        return float(diffuse), float(specular) if cos_i > 0 and cos_r > 0 else 0.0


def _model(theta, between, sigma, ks):
    """Error of the model at a point seen at theta, lit at theta - between in the same plane."""
    view = np.array([np.sin(theta), 0.0, np.cos(theta)])
    light = np.array([np.sin(theta - between), 0.0, np.cos(theta - between)])
    lamp = CaptureLamps("direction", ((0.0, 0.0, 1.0),)).lamp(ring()[0])
    from dataclasses import replace

    lamp = replace(lamp, vector=light.astype(np.float32))
    place, normal = np.zeros((1, 3)), np.array([[0.0, 0.0, 1.0]])
    found = predict(np.array([[0.5]]), np.array([[ks]]), np.array([sigma]), place, normal, 10 * view, lamp)
    alpha = abs(theta - between / 2)
    exact = exact_model(0.5, ks, float(np.float32(sigma)), np.cos(theta), alpha, np.cos(theta - between))
    if not all(np.isfinite(f).all() for f in found):
        return np.inf
    peak = ks / max(np.cos(theta), GRAZING)
    # alpha comes from directions in float32: 3e-7 radians, of which the lobe makes alpha / sigma^2.
    slack = peak * min(1.0, 3e-7 * max(alpha, 1e-3) / max(sigma, 1e-3) ** 2 + 1e-6)
    diffuse, specular = found[0].item() - exact[0], found[1].item() - exact[1]
    if sigma < 1e-5 and 0 < alpha < 1e-5:  # a mirror is as sharp as the directions are
        return 0.0
    near_horizon = min(abs(np.cos(theta)), abs(np.cos(theta - between))) < 1e-6
    return 0.0 if near_horizon else max(abs(diffuse) / 0.5, abs(specular) / (peak * 1e-6 + slack) * 1e-6)


@case(
    "Grazing views and lobes of any width",
    hazard="K_s / cos(theta_r) at the horizon; alpha^2 / sigma^2 with sigma from 0 to infinity",
    treatment="1/cos is held below 20, which is 87 degrees; sigma = 0 is a mirror, infinity a lobe without end",
    reference="mpmath, 50 digits, with the same hold",
    bound=5e-6,
    unit="of the peak, float32",
    outcome="finite everywhere",
)
def test_the_model_at_its_limits():
    angles = st.floats(0, 1.5707)
    widths = st.one_of(st.just(0.0), powers_of_ten(-3, 6))
    return worst_over(_model, angles, st.floats(0, 1.2), widths, powers_of_ten(-6, 6), examples=150)


@case(
    "A mirror and an endless lobe",
    hazard="0/0 and infinity/infinity in the ratio of angle and width",
    treatment="limits taken, not divisions",
    bound=0,
    unit="wrong values of 6",
    outcome="1 at the peak and 0 beside it; 1 everywhere",
)
def test_a_mirror():
    from dataclasses import replace

    lamp = replace(
        CaptureLamps("direction", ((0.0, 0.0, 1.0),)).lamp(ring()[0]), vector=np.array([0, 0, 1.0], np.float32)
    )
    wrong = 0
    for sigma, aside, expected in (
        (0.0, 0.0, 1.0), (0.0, 0.1, 0.0), (np.inf, 0.1, 1.0), (1e-30, 0.0, 1.0), (1e-30, 0.1, 0.0), (np.nan, 0.1, 0.0),
    ):  # fmt: skip
        view = 10 * np.array([np.sin(aside), 0, np.cos(aside)])
        ones = np.ones((1, 1))
        found = predict(ones, ones, np.array([sigma]), np.zeros((1, 3)), np.array([[0, 0, 1.0]]), view, lamp)[1].item()
        wrong += not abs(found - expected * (1 / np.cos(aside))) < 1e-5
    return wrong


@case(
    "No highlight on any texel",
    hazard="the width of a lobe that is not there; gloss from neighbours that have none",
    treatment="flagged; the width is the default, the gloss what the data bound it to",
    reference="the true diffuse colour",
    bound=2e-3,
    unit="of K_d",
    outcome="K_s at most 1e-3 of K_d, every texel flagged or with a bounded width",
)
def test_no_highlight():
    tile, what = tile_of(ks=0.0)
    (found,), told = fitted([tile], what)
    true = 0.5 * (1 + 0.5 * np.random.default_rng(0).uniform(-1, 1, found.kd.shape))
    if not finite([found], told) or found.ks.max() > 1e-3:
        return np.inf
    return relative(found.kd, true)


@case(
    "Texels seen once, twice and never",
    hazard="two unknowns from one sample; a mean over nothing",
    treatment="K_s from the neighbours, K_d from what is seen; unseen texels are filled and flagged",
    bound=0,
    unit="wrong flags or values",
    outcome="finite, flags exact",
)
def test_texels_seen_rarely():
    tile, what = tile_of()
    count = tile.visible.sum(axis=0)
    for column, most in ((0, 0), (1, 1), (2, 2)):
        keep = np.cumsum(tile.visible[:, :, column], axis=0) <= most
        tile.visible[:, :, column] &= keep
    (found,), told = fitted([tile], what)
    wrong = int(not finite([found], told)) + int(count.min() < 3)
    wrong += int(
        ((found.flags[:, 0] & TexelFlag.UNSEEN) == 0).sum() + ((found.flags[:, 3:] & TexelFlag.UNSEEN) != 0).sum()
    )
    wrong += int(((found.flags[:, 1] & TexelFlag.ONCE) == 0).sum() + ((found.flags[:, 2:] & TexelFlag.ONCE) != 0).sum())
    return wrong + int((found.kd < 0).sum() + (found.ks < 0).sum() + (found.sigma <= 0).sum())


@case(
    "Nothing to fit: no tile seen, one texel, one view, black, saturated, NaN",
    hazard="medians and means of nothing, noise of 0",
    treatment="defaults where nothing is known; observations that are not finite are left out",
    bound=0,
    unit="cases with a NaN of 8",
    outcome="finite parameters and figures",
)
def test_nothing_to_fit():
    wrong = 0
    for kind in ("unseen", "texel", "view", "black", "constant", "missing", "outside", "facing away"):
        tile, what = tile_of(number=1)
        values, visible, inside, normals = tile.values.copy(), tile.visible.copy(), tile.inside.copy(), tile.normals
        if kind == "unseen":
            visible[:] = False
        elif kind == "texel":
            inside[:] = False
            inside[3, 4] = True
        elif kind == "view":
            visible[1:] = False
        elif kind == "black":
            values[:] = 0
        elif kind == "constant":
            values[:] = 1
        elif kind == "missing":
            values[:] = np.nan
        elif kind == "outside":
            inside[:] = False
        else:
            normals = -normals
        found, told = fitted([Tile(values, visible, tile.positions, normals, inside)], what)
        wrong += not finite(found, told)
    return wrong


def _brightness(exponent):
    s = 10.0**exponent
    (one,), _ = fitted([tile_of()[0]], tile_of()[1])
    tile, what = tile_of(scale=s)
    (found,), told = fitted([tile], what)
    if not finite([found], told):
        return np.inf
    return max(relative(found.kd / s, one.kd), relative(found.ks / s, one.ks), relative(found.sigma, one.sigma))


@case(
    "An object under 12 orders of magnitude of brightness",
    hazard="noise, pulls and first guesses in absolute units; squares in float32",
    treatment="all relative to the scene's own noise and level",
    reference="the same at scale 1",
    bound=2e-2,
    outcome="equivariant K_d and K_s, the same sigma",
)
def test_equivariance_of_brightness():
    return worst_over(_brightness, st.sampled_from([-6.0, -3.0, 3.0, 6.0]), examples=4)


def _size(exponent, offset):
    (one,), _ = fitted([tile_of()[0]], tile_of()[1])
    tile, what = tile_of(size=10.0**exponent, offset=offset)
    (found,), told = fitted([tile], what)
    if not finite([found], told):
        return np.inf
    return max(relative(found.kd, one.kd), relative(found.ks, one.ks), relative(found.sigma, one.sigma))


@case(
    "An object from a micrometre to a kilometre, and 1000 times its size from the origin",
    hazard="lattice of the neighbourhood with 2^20 cells about the origin; squared distances in float32",
    treatment="the lattice is counted in texels from the object itself",
    reference="the same at scale 1 in the origin",
    bound=2e-2,
    outcome="the same parameters",
)
def test_equivariance_of_the_objects_size():
    cases = st.sampled_from([(-9.0, 0.0), (-6.0, 0.0), (6.0, 0.0), (9.0, 0.0), (0.0, 5e4)])
    return worst_over(lambda pair: _size(*pair), cases, examples=5)


@case(
    "Neighbours far from the origin",
    hazard="node numbers are held within 2^20 cells of the origin: beyond, all texels fall onto one node",
    treatment="nodes are counted from the first texel",
    reference="the same field at the origin",
    bound=1e-6,
    outcome="the same field",
)
def test_field_far_from_the_origin():
    rng = np.random.default_rng(0)
    places, values = rng.uniform(0, 20, (300, 3)), rng.normal(size=(300, 2))

    def at(shift):
        lattice = Lattice(1.0, tuple((places + shift)[0]))
        part = spread(places + shift, values, np.ones(300), lattice)
        return Neighbourhood(lattice, 2, [part]).field(0.1, np.zeros(2)).at(places + shift)

    return max(relative(at(np.array([k, -k, k])), at(np.zeros(3))) for k in (0.0, 1e5, 3e6, 1e9))


@case(
    "Unknown lighting that nothing reveals",
    hazard="medians over no observation, a singular system, a scale of the residuals of 0",
    treatment="a lamp at the camera; no highlight is claimed",
    bound=0,
    unit="cases with a NaN of 6",
    outcome="finite coefficients that are nowhere negative",
)
def test_environment_of_nothing():
    wrong = 0
    rng = np.random.default_rng(0)
    for texels, level, weight in ((0, 1, 1), (3, 1, 1), (200, 0, 1), (200, 1, 0), (200, 1, 1), (200, 1e-12, 1)):
        normals = rng.normal(size=(texels, 8, 3))
        normals[..., 2] = np.abs(normals[..., 2]) + 0.3
        normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
        values = level * normals[..., 2:3] * rng.uniform(0.2, 1, (texels, 1, 3))
        weights = np.full((texels, 8), float(weight))
        fit = fit_environment(values, normals, weights)
        left = left_of(values, normals, weights, fit.coefficients)
        lobe = fit_highlight(left.mean(axis=-1), normals, np.broadcast_to([0, 0, 1.0], normals.shape), weights)
        figures = [*fit.coefficients, fit.explained, lobe.gain, *lobe.direction]
        wrong += not np.isfinite(figures).all() or not np.isfinite(left).all()
    return wrong


@case(
    "Lighting settled on a sample of nothing",
    hazard="no texel that three views show",
    treatment="what was stated stays; what was not is a lamp at the camera",
    bound=0,
    unit="cases with a NaN of 4",
    outcome="finite report",
)
def test_settling_on_nothing():
    wrong = 0
    tile, _ = tile_of()
    blind = Tile(tile.values, np.zeros_like(tile.visible), tile.positions, tile.normals, tile.inside)
    cameras, light_of = ring(), np.zeros(36, int)
    for stated in (lighting(), CaptureLamps.from_capture({"kind": "unknown"}, lights=1, unit="mm")):
        for tiles in ([blind], [blind, tile]):
            sample = sample_texels(lambda k, tiles=tiles: tiles[k], list(range(len(tiles))), 4000)
            found, report = settle(stated, sample, cameras, light_of, falloff="auto")
            numbers = [v for v in _numbers(report) if isinstance(v, float)]
            wrong += not np.isfinite(numbers).all() or not np.isfinite(found.lamp(cameras[0]).vector).all()
    return wrong


def _numbers(value):
    if isinstance(value, dict | list | tuple):
        for each in value.values() if isinstance(value, dict) else value:
            yield from _numbers(each)
    else:
        yield value


@case(
    "Filling a tile from one texel, or from none",
    hazard="0/0 in the pyramid, at odd sizes and one row",
    treatment="divided where there is weight; 0 where nothing is known",
    reference="the one known value",
    bound=1e-6,
    outcome="the value everywhere, or 0",
)
def test_filling():
    worst = 0.0
    for shape in ((1, 1), (1, 7), (5, 3), (16, 16)):
        values = np.full((*shape, 2), np.nan)
        known = np.zeros(shape, bool)
        worst = max(worst, np.abs(fill(values, known)).max())
        values[-1, -1], known[-1, -1] = 3e5, True
        worst = max(worst, relative(fill(values, known), np.full((*shape, 2), 3e5)))
    return worst


@case(
    "Factors at the lamp's own place",
    hazard="1 / distance^2 of a near lamp at distance 0",
    treatment="a floor of 1e-30 under the square",
    bound=0,
    unit="values that are not finite",
    outcome="finite",
)
def test_a_lamp_in_the_surface():
    from dataclasses import replace

    lamp = replace(lighting().lamp(ring()[0]), vector=np.zeros(3, np.float32), reference=100.0)
    places = np.array([[0.0, 0, 0], [0, 0, 1e-3], [0, 0, 1.0]])
    normals = np.broadcast_to([0, 0, 1.0], places.shape)
    found = factors(places, normals, np.array([0, 0, 50.0]), lamp, 3)
    return sum(int((~np.isfinite(each)).sum()) for each in found)
