"""Height from normals: known surfaces, the dense solution of the same least squares, masks, mistakes."""

import numpy as np
import pytest

from nishiki.errors import UserError
from nishiki.photometric import height as height_module
from nishiki.photometric import multigrid
from nishiki.photometric.height import integrate_normals


def grid(rows, columns, pitch):
    """x to the right and y up, row 0 at the top."""
    x = np.arange(columns) * pitch + np.zeros((rows, 1))
    y = (rows - 1 - np.arange(rows))[:, None] * pitch + np.zeros((1, columns))
    return x, y


def normals_of(p, q):
    n = np.dstack([-p, -q, np.ones_like(p)])
    return n / np.linalg.norm(n, axis=2, keepdims=True)


def rms(height, truth, valid):
    e = (height - truth)[valid]
    return np.sqrt(np.mean((e - e.mean()) ** 2))


@pytest.mark.parametrize("method", ["dct", "weighted", "auto"])
@pytest.mark.parametrize("pitch", [1e-3, 1.0, 250.0])
def test_a_tilted_plane_is_exact_in_any_unit(method, pitch):
    x, y = grid(23, 31, pitch)
    plane = 0.3 * x - 0.7 * y
    field = integrate_normals(normals_of(0.3 + 0 * x, -0.7 + 0 * x), pixel_pitch=pitch, method=method)
    assert rms(field.height, plane, field.valid) < 2e-5 * np.ptp(plane)
    assert field.integrability_rms * pitch < 1e-6
    assert field.gradient_rms < 1e-4


def test_up_is_towards_row_zero():
    rising = normals_of(np.zeros((9, 5)), np.ones((9, 5)))
    height = integrate_normals(rising).height
    assert (np.diff(height, axis=0) < -0.99).all()
    right = normals_of(np.ones((9, 5)), np.zeros((9, 5)))
    assert (np.diff(integrate_normals(right).height, axis=1) > 0.99).all()


def waves(rows=120, columns=150):
    pitch = 2 / columns
    x, y = grid(rows, columns, pitch)
    truth = 0.1 * np.sin(6 * x) * np.cos(5 * y) + 0.05 * x * x
    p, q = 0.6 * np.cos(6 * x) * np.cos(5 * y) + 0.1 * x, -0.5 * np.sin(6 * x) * np.sin(5 * y)
    return x, y, pitch, truth, normals_of(p, q)


@pytest.mark.parametrize("method", ["dct", "weighted"])
def test_waves(method):
    _, _, pitch, truth, normals = waves()
    field = integrate_normals(normals, pixel_pitch=pitch, method=method)
    assert rms(field.height, truth, field.valid) < 1e-4 * np.ptp(truth)


def test_wrong_normals_outside_the_mask_do_nothing():
    x, y, pitch, truth, normals = waves()
    valid = (x - 1) ** 2 + (y - 0.8) ** 2 < 0.4
    spoilt = np.where(valid[..., None], normals, [0.9, 0.3, np.sqrt(0.1)])
    spoilt[0, 0] = np.nan
    field = integrate_normals(spoilt, valid=valid, pixel_pitch=pitch)
    assert field.method == "weighted"
    assert rms(field.height, truth, valid) < 2e-4 * np.ptp(truth)
    np.testing.assert_array_equal(np.isnan(field.height), ~valid)


def test_a_hemisphere_almost_to_its_rim():
    pitch = 2 / 160
    x, y = grid(160, 160, pitch)
    x, y = x - 1, y - 1
    inside = x**2 + y**2 < (0.97 * 0.9) ** 2
    z = np.sqrt(np.maximum(0.81 - x * x - y * y, 1e-3))
    field = integrate_normals(normals_of(-x / z, -y / z), valid=inside, pixel_pitch=pitch)
    assert rms(field.height, z, inside) < 5e-3 * 0.9
    assert field.residual <= 1e-5


def test_weighted_equals_the_dense_least_squares():
    rng = np.random.default_rng(3)
    rows, columns, pitch = 7, 9, 0.5
    p, q = rng.normal(0, 0.8, (2, rows, columns))
    normals = normals_of(p, q)
    valid = rng.uniform(size=(rows, columns)) > 0.15
    field = integrate_normals(normals, valid=valid, pixel_pitch=pitch, method="weighted", tolerance=1e-12)
    weight = np.where(valid, np.maximum(normals[..., 2] ** 4, 1e-3), 0)
    equations, right = [], []
    index = np.arange(rows * columns).reshape(rows, columns)
    for r in range(rows):
        for c in range(columns):
            for a, b, slope in ((r, c + 1, p), (r + 1, c, -q)):
                if a < rows and b < columns and weight[r, c] and weight[a, b]:
                    w = np.sqrt(min(weight[r, c], weight[a, b]))
                    row = np.zeros(rows * columns)
                    row[index[a, b]], row[index[r, c]] = w, -w
                    equations.append(row)
                    right.append(w * pitch * 0.5 * (slope[r, c] + slope[a, b]))
    dense = np.linalg.lstsq(np.array(equations), np.array(right), rcond=None)[0].reshape(rows, columns)
    for axis in (0, 1):
        both = (valid[1:] & valid[:-1]) if axis == 0 else (valid[:, 1:] & valid[:, :-1])
        np.testing.assert_allclose(np.diff(field.height, axis=axis)[both], np.diff(dense, axis=axis)[both], atol=2e-6)


def test_separate_parts_are_levelled_each_by_itself():
    normals = normals_of(np.full((10, 20), 0.2), np.zeros((10, 20)))
    valid = np.ones((10, 20), dtype=bool)
    valid[:, 10] = False
    field = integrate_normals(normals, valid=valid)
    assert field.parts == 2
    assert abs(field.height[:, :10].mean()) < 1e-5
    assert abs(field.height[:, 11:].mean()) < 1e-5
    np.testing.assert_allclose(np.diff(field.height[:, :10], axis=1), 0.2, atol=1e-4)


def test_the_curl_of_a_field_that_is_no_surface_is_reported():
    x, y = grid(40, 40, 1.0)
    field = integrate_normals(normals_of(-0.01 * y, 0.01 * x))
    assert field.integrability_rms == pytest.approx(0.02, rel=1e-3)
    assert field.gradient_rms > 0.05


def test_single_precision_of_large_fields_agrees_with_double(monkeypatch):
    _, _, pitch, _, normals = waves()
    double = integrate_normals(normals, pixel_pitch=pitch, method="weighted").height
    monkeypatch.setattr("nishiki.photometric.height.WHOLE_PIXELS", 1)
    single = integrate_normals(normals, pixel_pitch=pitch, method="weighted").height
    assert np.abs(single - double).max() < 1e-4 * np.ptp(double)


def noisy(rows, columns):
    """Waves with noise that has curl, in a frame with gaps, a bar across and an island."""
    rng = np.random.default_rng(5)
    x, y = grid(rows, columns, 1.0)
    p = 0.4 * np.cos(x / 9) * np.cos(y / 7) + rng.normal(0, 0.3, x.shape)
    q = -0.4 * np.sin(x / 9) * np.sin(y / 7) + rng.normal(0, 0.3, x.shape)
    valid = rng.uniform(size=x.shape) > 0.05
    valid[rows // 3 : rows // 3 + 3, 4:-4] = False  # the bar leaves its two halves joined at both ends
    valid[: rows // 4, columns // 2] = False
    valid[rows // 2 - 8 : rows // 2 + 8, columns // 2 - 8 : columns // 2 + 8] = False
    valid[rows // 2 - 4 : rows // 2 + 4, columns // 2 - 4 : columns // 2 + 4] = True
    return normals_of(p, q), valid


@pytest.mark.parametrize("shape", [(407, 61), (64, 64), (121, 300), (700, 33)])
@pytest.mark.parametrize("method", ["weighted", "dct"])
def test_bands_on_the_disk_give_the_heights_of_the_whole_picture(shape, method, monkeypatch, tmp_path):
    """The same numbers but for roundings, so that no border of a band can be seen, and nothing is left behind."""
    normals, valid = noisy(*shape)
    whole = integrate_normals(normals, valid=valid, method=method, tolerance=1e-10)
    monkeypatch.setattr(multigrid, "BAND_PIXELS", 16 * shape[1])
    monkeypatch.setattr(multigrid, "WHOLE_PIXELS", 300)
    monkeypatch.setattr(height_module, "BAND_PIXELS", 16 * shape[1])
    bands = []

    def write(rows, values, inside):
        bands.append((rows, values, inside))

    found = height_module.integrate_bands(
        shape,
        lambda rows: (normals[rows], valid[rows]),
        write,
        pixel_pitch=1.0,
        method=method,
        iterations=(1e-10, 1000),
        folder=tmp_path,
    )
    assert len(bands) >= shape[0] // 16
    assert not list(tmp_path.iterdir())
    height = np.concatenate([values for _, values, _ in bands])
    np.testing.assert_array_equal(np.concatenate([inside for *_, inside in bands]), whole.valid)
    np.testing.assert_allclose(height, whole.height, atol=2e-6 * whole.range)
    assert found["parts"] == whole.parts > 1
    assert found["iterations"] == whole.iterations
    for name in ("integrability_rms", "gradient_rms", "bow", "range", "valid_pixels"):
        assert found[name] == pytest.approx(getattr(whole, name), rel=1e-6)


def test_steps_do_not_grow_with_the_picture():
    """Multigrid: as many iterations for sixteen times the pixels, on masks and steep noise alike."""
    fields = [noisy(rows, columns) for rows, columns in ((60, 90), (240, 360))]
    steps = [integrate_normals(normals, valid=valid).iterations for normals, valid in fields]
    assert max(steps) <= 25
    assert steps[1] <= steps[0] + 4


def test_one_row_and_one_pixel():
    one = integrate_normals(np.array([[[0.0, 0.0, 1.0]]]))
    assert one.height.shape == (1, 1)
    row = integrate_normals(normals_of(np.ones((1, 6)), np.zeros((1, 6))))
    np.testing.assert_allclose(np.diff(row.height[0]), 1, atol=1e-5)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"pixel_pitch": 0.0}, "0"),
        ({"pixel_pitch": np.nan}, "0"),
        ({"method": "magic"}, "magic"),
        ({"valid": np.ones((3, 3), dtype=bool)}, r"\(4, 5\)"),
        ({"valid": np.zeros((4, 5), dtype=bool)}, "20"),
    ],
)
def test_mistakes_are_named(change, message):
    with pytest.raises(UserError, match=message):
        integrate_normals(normals_of(np.zeros((4, 5)), np.zeros((4, 5))), **change)
