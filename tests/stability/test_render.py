"""Pictures at grazing light and view, of broken maps, narrow lobes, near lamps, extreme scales."""

import numpy as np
import pytest
from hypothesis import strategies as st
from stability.cases import case, powers_of_ten, relative, worst_over
from stability.samples import EXTREME, tilted

from nishiki.brdf.torrance_sparrow import specular
from nishiki.errors import UserError
from nishiki.render.display import display_image, normals_as_colours
from nishiki.render.plane.frame import render
from nishiki.render.plane.kernel import NORMAL_MISSING, TURNED_AWAY, UNUSABLE
from nishiki.render.plane.scene import Gloss, Light, PlaneScene, View
from nishiki.render.plane.shade import PlaneMaps, cast_shadows, predict_observations


def maps(rows, columns, seed=0, most=0.6):
    normals = tilted(rows * columns, seed, most).reshape(rows, columns, 3).astype(np.float32)
    colours = np.random.default_rng(seed).uniform(0, 1, (rows, columns, 3)).astype(np.float32)
    return normals, colours


def _any_scene(seed, brightness, size, pitch):
    """Values that are not finite, or not 0 where the flags say that nothing is known."""
    rng = np.random.default_rng(seed)
    normals, colours = maps(5, 8, seed, rng.choice([0.5, 1.57, 3.0]))
    colours = (colours * 10.0**brightness).astype(np.float32)
    spoilt = rng.random((5, 8)) < 0.2
    normals[spoilt] = rng.choice(EXTREME, (spoilt.sum(), 3))
    colours[rng.random(colours.shape) < 0.05] = rng.choice(EXTREME)
    height = (rng.normal(size=(5, 8)) * 10.0**size).astype(np.float32) if seed % 2 else None
    if height is not None:
        height[rng.random(height.shape) < 0.2] = rng.choice(EXTREME)
    gamma = [[rng.choice([1e-6, 1e-3, 0.1, 3, 1e10, np.inf]), 1.0]]
    gloss = Gloss([[10.0 ** rng.uniform(-10, 30), 0]], gamma, [rng.choice([1, 1 + 1e-12, 1.45, 1e3])])
    lights = []
    for _ in range(rng.integers(1, 4)):
        x, y = rng.normal(size=2)
        z = rng.choice([1e-300, 1e-12, 1e-3, 1.0])
        if rng.random() < 0.5:
            radius = rng.choice([0, 1e-9, 0.01, 0.7])
            lights.append(Light(direction=(x, y, z), intensity=10.0 ** rng.uniform(-20, 20), angular_radius=radius))
        else:
            lights.append(Light(position_mm=(x, y, z), falloff=bool(seed % 3)))
    scene = PlaneScene(normals=normals, coefficients=colours, gloss=gloss, height=height, pitch=10.0**pitch)
    eye = (rng.normal() * 10, 0.0, rng.choice([1e-12, 1e-3, 10, 1e6]))
    views = (None, View(eye_mm=eye, rows=6, columns=5, field_of_view=rng.choice([1e-6, 0.5, 3.1])))
    wrong = 0
    for view in views:
        for march in (False, True):
            shadows = None if height is None else cast_shadows(height, lights, pitch=scene.pitch, march=march)
            found = render(scene, lights, view, visibility=shadows)
            wrong += int((~np.isfinite(found.xyz)).sum() + (~np.isfinite(found.coverage)).sum())
            wrong += int(np.count_nonzero(found.xyz[(found.flags & UNUSABLE) != 0]))
            wrong += 0 if shadows is None else int((~np.isfinite(shadows)).sum())
    return wrong


@pytest.mark.slow
@case(
    "Pictures of any maps, lamps and views",
    hazard="missing normals, infinite colours, lamps in the plane, an eye on the surface, lobes of 1e-6",
    treatment="flags normal_missing, colour_missing, overflow: the pixel is 0; 1 / cos_r is cancelled",
    outcome="finite; 0 where flagged",
    bound=0,
    unit="values",
)
def test_any_scene():
    drawn = st.integers(0, 10**6), st.floats(-44, 38), st.floats(-10, 10), st.floats(-6, 6)
    return worst_over(_any_scene, *drawn, examples=60)


def _shading_error(theta_i, phi, tilt, gamma):
    """One pixel against the array form of the model, normal tilted, lamp at theta_i."""
    normal = np.array([np.sin(tilt), 0.0, np.cos(tilt)], np.float32)
    light = np.array([np.sin(theta_i) * np.cos(phi), np.sin(theta_i) * np.sin(phi), np.cos(theta_i)])
    if light[2] <= 0:
        return 0.0
    found = next(
        predict_observations(
            PlaneMaps(normal.reshape(1, 1, 3), np.full((1, 1, 1), 0.5, np.float32), Gloss([[2.0]], [[gamma]], [1.45])),
            [Light(direction=tuple(light))],
        )
    )  # fmt: skip
    light = light / np.linalg.norm(light)
    n = normal.astype(np.float64)
    n /= np.linalg.norm(n)
    gloss = float(specular(n, light, np.array([0.0, 0, 1]), beta=2.0, gamma=gamma, refractive_index=1.45))
    exact = 0.5 * max(n @ light, 0.0) + gloss
    # the normal's length is rounded to float32, which a narrow lobe magnifies
    half = light + np.array([0, 0, 1])
    angle = np.arccos(np.clip(n @ half / np.linalg.norm(half), -1, 1))
    sensitivity = 1 + (angle / gamma) ** 2
    return abs(float(found.values.ravel()[0]) - exact) / max(exact, 1e-6) / sensitivity


@case(
    "Compiled shading at grazing light and view, lobes of 1e-4 to 10 rad",
    hazard="G / cos_r, acos near 1, four divisions merged into two",
    treatment="the same rewriting as the readable form",
    reference="the array form in float64",
    outcome="equal to float32's rounding of normal and result",
    bound=2e-6,
    unit="relative, over the lobe's sensitivity",
)
def test_shading():
    grazing = st.one_of(st.floats(0, 1.57), powers_of_ten(-9, 0).map(lambda d: np.pi / 2 - d))
    return worst_over(_shading_error, grazing, st.floats(0, 6.28), grazing, powers_of_ten(-4, 1), examples=200)


@case(
    "Colours and lamps times 2^-40 to 2^40",
    hazard="absolute thresholds",
    treatment="none but the range of float32",
    reference="the same at scale 1",
    outcome="the same bits times the scale; the same flags",
    bound=0,
    unit="values that differ",
)
def test_equivariance_of_pictures():
    normals, colours = maps(12, 9, 1)
    height = np.random.default_rng(1).normal(size=(12, 9)).astype(np.float32)
    gloss = [[1.5, 0.2]], [[0.1, 0.5]], [1.45]
    lamps = ((0.3, 0.2, 0.9), (-0.6, 0.1, 0.3))
    differ = 0

    def picture(colour, intensity, beta):
        scene = PlaneScene(normals=normals, coefficients=colour, gloss=Gloss(beta, *gloss[1:]), height=height)
        return render(scene, [Light(direction=d, intensity=intensity) for d in lamps])

    plain = picture(colours, 1.0, gloss[0])
    for exponent in (-40, -10, 10, 40):
        scale = 2.0**exponent
        brighter = picture(colours, scale, gloss[0])
        lighter = picture(colours * np.float32(scale), 1.0, (np.array(gloss[0]) * scale).tolist())
        for each in (brighter, lighter):
            differ += int((each.xyz != plain.xyz * np.float32(scale)).sum() + (each.flags != plain.flags).sum())
    return differ


@case(
    "Scenes in lengths from 1e-6 to 1e6, shadows included",
    hazard="absolute distances of near lamps, of horizons, of the eye",
    treatment="everything is a ratio of lengths",
    reference="the same at scale 1",
    outcome="the same picture",
    bound=1e-5,
)
def test_lengths():
    normals, colours = maps(12, 9, 2)
    height = np.random.default_rng(2).normal(size=(12, 9)).astype(np.float32)

    def picture(unit, shadows, falloff):
        scene = PlaneScene(normals=normals, coefficients=colours, height=height * np.float32(unit), pitch=unit)
        lamps = [
            Light(position_mm=(5 * unit, 3 * unit, 20 * unit), falloff=falloff, angular_radius=0.02),
            Light(direction=(1, 0.5, 0.4)),
        ]
        view = View(eye_mm=(2 * unit, 0, 30 * unit), rows=10, columns=8, field_of_view=0.5)
        visibility = cast_shadows(scene.height, lamps, pitch=scene.pitch, march=shadows == "march")
        return render(scene, lamps, view, visibility=None if shadows == "none" else visibility).xyz

    worst = 0.0
    for shadows in ("sweep", "march", "none"):
        for falloff in (False, True):
            plain = picture(1.0, shadows, falloff)
            for unit in (2.0**-20, 2.0**20, 1e-6, 1e6):
                worst = max(worst, relative(picture(unit, shadows, falloff), plain))
    return worst


@case(
    "Normals that face away from the viewer, and lamps behind a facet",
    hazard="negative cosines; 1 / cos_r of 0",
    treatment="no light from behind; flagged turned_away where the view is, diffuse shown, gloss 0",
    outcome="as stated",
    bound=0,
    unit="wrong pixels",
)
def test_turned_away():
    tilt = np.array([0.0, 1.5, np.pi / 2, 1.6, 3.0])
    normals = np.stack([np.sin(tilt), 0 * tilt, np.cos(tilt)], axis=-1)[None].astype(np.float32)
    scene = PlaneScene(
        normals=normals, coefficients=np.full((1, 5, 3), 0.5, np.float32), gloss=Gloss([[5.0]], [[2.0]], [1.45])
    )
    behind = render(scene, [Light(direction=(-1, 0, 1e-9))])
    ahead = render(scene, [Light(direction=(0, 0, 1))])
    away = normals[0, :, 2] <= 0
    wrong = int((((ahead.flags[0] & TURNED_AWAY) != 0) != away).sum())
    wrong += int(np.count_nonzero(ahead.xyz[0, normals[0, :, 2] < -1e-3]))
    return wrong + int(np.count_nonzero(behind.xyz[0, 1:4]))


@case(
    "A picture of one pixel, one row, one column; one known pixel among missing ones",
    hazard="neighbours that do not exist; means over nothing",
    treatment="samples without a known normal are left out; a pixel without any is flagged",
    outcome="finite; the known pixel shows, the others are 0 and flagged",
    bound=0,
    unit="wrong pixels",
)
def test_little_pictures():
    wrong = 0
    light = [Light(direction=(0.2, 0.1, 1.0))]
    for shape in ((1, 1), (1, 7), (7, 1)):
        normals, colours = maps(*shape, 3)
        scene = PlaneScene(normals=normals, coefficients=colours, height=np.zeros(shape, np.float32))
        for view in (None, View(rows=3, columns=4), View(eye_mm=(0, 0, 9.0), rows=3, columns=3)):
            for march in (False, True):
                shadows = cast_shadows(scene.height, light, pitch=scene.pitch, march=march)
                found = render(scene, light, view, visibility=shadows)
                wrong += int((~np.isfinite(found.xyz)).sum() + ((found.flags & UNUSABLE) != 0).sum())
    normals, colours = maps(9, 9, 4)
    only = np.zeros_like(normals)
    only[4, 5] = normals[4, 5]
    found = render(PlaneScene(normals=only, coefficients=colours), light)
    known = np.zeros((9, 9), bool)
    known[4, 5] = True
    return wrong + int((((found.flags & NORMAL_MISSING) == 0) != known).sum() + np.count_nonzero(found.xyz[~known]))


@case(
    "Shadows of heights that are NaN, infinite or 1e30, under lamps at the horizon",
    hazard="tangents of nothing; hulls of infinities; rays of 1e12 steps",
    treatment="heights that are not finite cast no shadow and receive none; a ray ends with the map",
    outcome="between 0 and 1, finite; a flat surface is never in shadow",
    bound=0,
    unit="wrong pixels",
)
def test_shadows():
    rng = np.random.default_rng(6)
    wrong = 0
    lamps = [Light(direction=(1, 0.3, z), angular_radius=r) for z in (1e-12, 1e-3, 1.0) for r in (0.0, 0.3)]
    lamps += [Light(position_mm=(3.0, 1.0, z)) for z in (1e-6, 1.0, 1e9)]
    for spoil in (None, np.nan, np.inf, -np.inf, 1e30, -1e30):
        height = np.zeros((9, 11), np.float32) if spoil is None else rng.normal(size=(9, 11)).astype(np.float32)
        if spoil is not None:
            height[4, 5] = spoil
        for march in (False, True):
            found = cast_shadows(height, lamps, pitch=1.0, march=march)
            wrong += int((~((found >= 0) & (found <= 1))).sum())
            if spoil is None:
                wrong += int((found[[0, 2, 4, 6, 7, 8]] != 1).sum())
    return wrong


@case(
    "Lamps, views, gloss and exposure that mean nothing",
    hazard="NaN that enters every pixel",
    treatment="refused where they are stated, with a remedy",
    outcome="exit status 2",
    bound=0,
    unit="that passed",
)
def test_nonsense():
    nan, passed = float("nan"), 0
    hopeless = (
        lambda: Light(direction=(nan, 0, 1)), lambda: Light(direction=(0, 0, 0)), lambda: Light(direction=(0, 0, -1)),
        lambda: Light(position_mm=(0, 0, np.inf)), lambda: Light(direction=(0, 0, 1), intensity=nan),
        lambda: Light(direction=(0, 0, 1), intensity=-1), lambda: Light(direction=(0, 0, 1), spectrum=np.zeros(61)),
        lambda: Light(direction=(0, 0, 1), angular_radius=nan), lambda: Gloss([[nan]], [[0.1]], [1.5]),
        lambda: Gloss([[1.0]], [[0.0]], [1.5]), lambda: Gloss([[1.0]], [[nan]], [1.5]),
        lambda: Gloss([[1.0]], [[0.1]], [0.5]), lambda: Gloss([[np.inf]], [[0.1]], [1.5]),
        lambda: View(eye_mm=(0, 0, 0), rows=2, columns=2),
        lambda: View(eye_mm=(0, 0, 1), up=(0, 0, 1), rows=2, columns=2),
        lambda: View(eye_mm=(0, 0, 1), rows=2, columns=2, field_of_view=nan),
        lambda: display_image(np.ones((1, 1, 3)), exposure=nan),
        lambda: PlaneScene(normals=np.ones((1, 1, 3)), coefficients=np.ones((1, 1, 3)), pitch=nan),
    )  # fmt: skip
    for make in hopeless:
        try:
            make()
            passed += 1
        except UserError:
            continue
    return passed


@case(
    "Display of values that are negative, huge, NaN; normals that are missing",
    hazard="conversion of NaN to 8 bits is undefined",
    treatment="clipped and counted; NaN is black; a missing normal has a colour of its own",
    outcome="the same bytes everywhere",
    bound=0,
    unit="wrong pixels",
)
def test_display():
    values = np.float32([0, 1, -1, 3e38, -3e38, np.nan, np.inf, -np.inf])
    xyz = np.repeat(values[None, :, None], 3, axis=2)
    with np.errstate(invalid="ignore", over="ignore"):
        found = display_image(xyz)
    wrong = int(found.pixels[0, 0].any() + (found.pixels[0, 1].min() < 240) + found.pixels[0, 2].any())
    wrong += int(found.pixels[0, 5].any()) + int(not 0 <= found.clipped_low <= found.clipped_high + 1)
    normals = np.array([[[0, 0, 1], [0, 0, 0], [np.nan, 0, 1], [np.inf, 0, 0], [3e38, 3e38, 0]]], np.float32)
    coded = normals_as_colours(normals)
    return wrong + int(coded[0, 1:].any()) + int(coded[0, 0, 2] != 65535)
