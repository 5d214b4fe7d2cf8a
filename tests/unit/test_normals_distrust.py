"""Selections that are not followed: against a slow reference, accidents of few lamps, gloss, real lamps."""

import cv2
import numpy as np
import pytest

from nishiki.photometric.flags import NO_ESTIMATE, NormalFlag
from nishiki.photometric.light_selection import select_diffuse
from nishiki.photometric.solve import SOMEWHAT, SUSPECT, WORSE, estimate_normals, find_distrusted, lambertian


def unit(vectors):
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def two_rows(count=8):
    """Lamps in two parallel rows: those of one lie in a plane with the object."""
    x = np.linspace(-0.8, 0.8, count)
    return unit(np.concatenate([np.column_stack([x, np.full(count, y), np.ones(count)]) for y in (-0.3, 0.4)]))


def reference(stack, lights, usable, known):
    """Pixel by pixel from the definition, with NumPy's own solver and singular values."""
    halves = unit(lights + np.array([0, 0, 1]))
    found = []
    for values, use, may in zip(stack.T, usable.T.astype(bool), known.T.astype(bool), strict=True):
        condition, least = (np.linalg.cond(lights[chosen]) ** 2 for chosen in (use, may))
        g = np.linalg.lstsq(lights[use], values[use], rcond=None)[0]
        x = np.maximum(halves @ unit(g), 0)
        bright = may & ~use & (values > np.maximum(lights @ g, 0))
        unexplained = bright.any() and x[bright].mean() < x[use].mean()
        suspect = condition > SUSPECT
        found.append(suspect and (condition > WORSE * least or (condition > SOMEWHAT * least and unexplained)))
    return np.array(found)


def test_reference():
    rng = np.random.default_rng(3)
    lights = unit(rng.normal(size=(12, 3)) * [0.2, 0.15, 0] + [0, 0, 1])
    normals = unit(rng.normal(size=(400, 3)) * [0.4, 0.4, 0] + [0, 0, 1])
    stack = np.maximum(lights @ normals.T, 0.05) * rng.uniform(0.8, 1.3, (12, 400))
    stack = stack.astype(np.float32)
    known = (rng.random(stack.shape) < 0.9).astype(np.uint8)
    usable = known * (rng.random(stack.shape) < 0.6).astype(np.uint8)
    usable[:3], known[:3] = 1, 1
    outputs = lambertian(stack, lights, usable, 1e4)
    assert ((outputs[3] & NO_ESTIMATE) == 0).all()
    found = find_distrusted(stack, lights, usable, known, outputs)
    np.testing.assert_array_equal(found, np.flatnonzero(reference(stack, lights, usable, known)))
    assert 20 < len(found) < 380


def test_a_row_of_lamps_is_not_followed():
    """One row agrees with any normal along a line; two rows with one."""
    lights, normals = two_rows(), unit(np.random.default_rng(5).normal(size=(50, 3)) * [0.2, 0.2, 0] + [0, 0, 1])
    stack = (lights @ normals.T).astype(np.float32)[:, None]
    valid = np.ones(stack.shape, bool)
    row = valid.copy()
    row[8:] = False
    found = estimate_normals(stack, lights, usable=row, valid=valid)
    assert (found.flags == 0).all()
    assert (found.lights_used > 8).all()
    np.testing.assert_allclose(found.normals[0], normals, atol=2e-3)
    alone = estimate_normals(stack, lights, usable=row)  # nothing else is known to be valid
    assert ((alone.flags & (NormalFlag.COPLANAR_LIGHTS | NormalFlag.ILL_CONDITIONED)) != 0).all()


def test_gloss_left_out_stays_left_out():
    """In a narrow cone, the samples nearest to the mirror direction being too bright is what gloss does."""
    lights = unit(np.random.default_rng(7).normal(size=(12, 3)) * [0.25, 0.25, 0] + [0, 0, 1])
    normal = unit(np.array([0.1, 0.05, 1.0]))
    x = unit(lights + np.array([0, 0, 1])) @ normal
    stack = np.tile((lights @ normal)[:, None], (1, 2)).astype(np.float32)
    usable = np.ones(stack.shape, np.uint8)
    usable[np.argsort(-x)[:4], 0] = 0  # gloss
    usable[np.argsort(x)[:4], 1] = 0  # too bright where no gloss is
    stack[usable == 0] *= 1.3
    known = np.ones_like(usable)
    found = find_distrusted(stack, lights, usable, known, lambertian(stack, lights, usable, 1e4))
    assert found.tolist() == [1]


def test_pixels_without_lamps_enough_stay_without():
    lights = two_rows()
    usable = np.zeros((16, 3), np.uint8)
    usable[:2] = 1
    stack, known = np.ones((16, 3), np.float32), np.ones((16, 3), np.uint8)
    assert not len(find_distrusted(stack, lights, usable, known, lambertian(stack, lights, usable, 1e4)))


@pytest.mark.data
@pytest.mark.parametrize(("name", "before"), [("diligent_ball", 6.98), ("diligent_cat", 15.98)])
def test_every_fourth_lamp(data, name, before):
    """24 measured lamps in two rows: below half of the error that following every selection gives."""
    folder = data / name
    lamps = np.arange(0, 96, 4)
    lights = unit(np.loadtxt(folder / "light_directions.txt"))[lamps]
    strength = np.loadtxt(folder / "light_intensities.txt")[lamps]
    inside = cv2.imread(str(folder / "mask.png"), 0) > 0
    pictures = [cv2.imread(str(folder / f"{j + 1:03d}.png"), cv2.IMREAD_UNCHANGED)[inside][::9] for j in lamps]
    valid = np.array([(picture < 65535).all(axis=-1) for picture in pictures])[:, None]
    stack = np.float32([(p[:, ::-1] / 65535 / s).mean(axis=-1) for p, s in zip(pictures, strength, strict=True)])
    truth = unit(np.load(folder / "normals_gt.npz")["normals"][inside][::9])
    stack = stack[:, None]
    usable = select_diffuse(stack, lights, valid=valid).usable
    found = estimate_normals(stack, lights, usable=usable, valid=valid).normals[0]
    error = np.degrees(np.arccos(np.clip((found * truth).sum(axis=-1), -1, 1))).mean()
    assert error < before / 2
