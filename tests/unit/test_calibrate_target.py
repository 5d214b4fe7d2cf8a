"""A colour target: found in photographs of it, read, judged; sensitivities recovered from it; the command."""

import json
import warnings

import cv2
import numpy as np
import pytest
import yaml
from refusals import expect_facts, refused

from nishiki import cli
from nishiki.calibrate import target
from nishiki.calibrate.target import chart_reflectances, recover
from nishiki.colour.colour import illuminant, srgb_encode, white_xyz, xyz_from_spectra, xyz_to_srgb_linear
from nishiki.colour.sampling import WAVELENGTHS_NM, channel_weights
from nishiki.errors import UserError

with warnings.catch_warnings():
    warnings.simplefilter("ignore")
    import colour

NAMES, REFLECTANCES = chart_reflectances()
REFERENCE = xyz_from_spectra(illuminant("D50"), REFLECTANCES)


def camera_of(name: str) -> np.ndarray:
    """Sensitivities (3, 61) that the National Physical Laboratory measured: no part of the method's components."""
    table = colour.MSDS_CAMERA_SENSITIVITIES[name]
    return np.maximum([np.interp(WAVELENGTHS_NM, table.wavelengths, curve) for curve in table.values.T], 0)


def photograph(patches: np.ndarray, turn_deg: float, noise: float = 0.002, spacing: float = 55.0):
    """A chart on grey, seen askew: (rows, columns, 3) linear, and the middles of its corner patches."""
    angle = np.radians(turn_deg)
    plane = np.array(
        [
            [np.cos(angle) * spacing, -np.sin(angle) * spacing, 110],
            [np.sin(angle) * spacing, np.cos(angle) * spacing, 100],
            [0.004, 0.002, 1],
        ]
    )
    finer = 4
    fine = np.diag([finer, finer, 1.0]) @ plane
    picture = np.full((320 * finer, 480 * finer, 3), 0.2)

    def fill(low, high, value):
        corners = np.array([[low, (high[0], low[1]), high, (low[0], high[1])]], float)
        place = np.round(cv2.perspectiveTransform(corners, fine)[0]).astype(np.int32)
        cv2.fillConvexPoly(picture, place, tuple(float(v) for v in value))

    fill((-0.7, -0.7), (5.7, 3.7), (0.03, 0.03, 0.03))
    for k, value in enumerate(patches):
        x, y = k % 6, k // 6
        fill((x - 0.42, y - 0.42), (x + 0.42, y + 0.42), value)
    seen = cv2.resize(picture, (480, 320), interpolation=cv2.INTER_AREA)
    seen = seen + noise * np.random.default_rng(3).standard_normal(seen.shape)
    middles = cv2.perspectiveTransform(np.array([[(0.0, 0.0), (5.0, 0.0), (5.0, 3.0), (0.0, 3.0)]]), plane)[0]
    return np.clip(seen, 0, 1), middles


def coded(linear: np.ndarray) -> np.ndarray:
    return np.round(255 * srgb_encode(linear)).astype(np.uint8)


def as_srgb(level: float) -> np.ndarray:
    """Linear sRGB of the reference colours, exposed so that white lies at a level."""
    return level * np.clip(xyz_to_srgb_linear(REFERENCE, white=white_xyz(illuminant("D50"))), 0, 1)


@pytest.mark.parametrize("turn_deg", [-8, 0, 5])
def test_a_chart_is_found_and_its_patches_are_read(turn_deg):
    patches = 0.9 * REFLECTANCES @ channel_weights(illuminant("D50"), camera_of("Nikon 5100 (NPL)")).T
    linear, middles = photograph(patches, turn_deg)
    for corners in (target.find_target(coded(linear)), target.target_at(middles)):
        read = target.read_patches(linear, corners, 1.0)
        np.testing.assert_allclose(read.mean, patches, atol=0.002)
        assert read.usable.all()
        assert 0.001 < np.median(read.deviation) < 0.003


def test_without_a_chart_the_remedy_names_the_corners():
    with pytest.raises(UserError, match="--corners"):
        target.find_target(np.full((200, 300, 3), 128, np.uint8))


def test_corners_the_wrong_way_round_are_refused():
    linear, middles = photograph(as_srgb(0.95), 3)
    with refused(UserError, by="target_at"):
        target.target_at(middles[[0, 2, 1, 3]])
    turned = target.read_patches(linear, target.target_at(middles[[2, 3, 0, 1]]), 1.0)
    with refused(UserError, "--corners"):
        target.expect_target(turned.mean, REFERENCE)
    shifted = target.read_patches(linear, target.target_at(middles * 0.5 + 60), 1.0)
    with refused(UserError, "--corners"):
        target.expect_target(shifted.mean, REFERENCE)
    with pytest.raises(UserError, match="outside"):
        target.read_patches(linear, target.target_at(middles + np.array([400, 0])), 1.0)
    with pytest.raises(UserError, match="larger"):
        target.read_patches(linear, target.target_at(100 + 0.03 * middles), 1.0)


def test_a_perfect_picture_has_no_errors_and_a_dark_one_keeps_its_hue():
    linear, middles = photograph(as_srgb(1.0), 4, noise=0)
    read = target.read_patches(linear, target.target_at(middles), 1.0)
    exact = target.errors_of(read.mean, REFERENCE, read.usable, delivered=True)
    inside = np.array([name != "cyan" for name in NAMES])  # cyan lies outside of sRGB
    assert np.nanmax(exact.delta_e[inside]) < 0.02
    dark = target.errors_of(0.8 * read.mean, REFERENCE, read.usable, delivered=True)
    assert dark.lightness > 5
    assert dark.white_balance < 0.5


def test_differences_are_those_of_colour_science():
    random = np.random.default_rng(1)
    xyz = REFERENCE * (1 + 0.05 * random.standard_normal(REFERENCE.shape))
    usable = np.ones(24, bool)
    usable[3] = False
    errors = target.errors_of(xyz, REFERENCE, usable)
    white = colour.XYZ_to_xy(white_xyz(illuminant("D50")))
    lab, expected = (colour.XYZ_to_Lab(each, white) for each in (xyz, REFERENCE))
    difference = colour.delta_E(lab, expected, method="CIE 2000")
    np.testing.assert_allclose(errors.delta_e[usable], difference[usable], rtol=1e-6)
    assert np.isnan(errors.delta_e[3])
    assert errors.summary["delta_e_mean"] == pytest.approx(np.delete(difference, 3).mean())
    assert errors.lightness == pytest.approx(np.abs((lab - expected)[18:, 0]).max())


def test_each_colour_after_correction_is_predicted_from_the_others():
    """Against normal equations, patch by patch."""
    linear = 0.8 * REFLECTANCES @ channel_weights(illuminant("A"), camera_of("Nikon 5100 (NPL)")).T
    usable = np.ones(24, bool)
    usable[[5, 11]] = False
    matrix, predicted = target.fitted_xyz(linear, REFERENCE, usable)
    for k in (0, 5, 17):
        chosen = [j for j in range(24) if usable[j] and j != k]
        left, right = np.zeros((3, 3)), np.zeros((3, 3))
        for j in chosen:
            weight = 1 / max(REFERENCE[j, 1], 0.02) ** 2
            left += weight * np.outer(linear[j], linear[j])
            right += weight * np.outer(REFERENCE[j], linear[j])
        np.testing.assert_allclose(predicted[k], right @ np.linalg.inv(left) @ linear[k], rtol=1e-8)
    assert np.abs(linear @ matrix.T - REFERENCE).max() < 0.1


@pytest.mark.parametrize("standard", target.CRITERIA)
def test_the_verdict_is_the_best_level_whose_limits_all_hold(standard):
    levels = list(target.CRITERIA[standard].items())
    for (level, limits), worse in zip(levels, [*(name for name, _ in levels[1:]), "none"], strict=True):
        figures = dict.fromkeys(("delta_e_mean", "delta_e_90th_percentile", "delta_e_max"), 0.0) | limits
        assert target.verdict(figures, standard) == level
        beyond = target.verdict({**figures, "lightness_max": limits["lightness_max"] + 0.01}, standard)
        assert beyond == worse


@pytest.mark.parametrize(("lamp", "most"), [("D65", 0.03), ("A", 0.03)])
def test_sensitivities_of_a_camera_that_the_method_never_saw(lamp, most):
    camera = camera_of("Nikon 5100 (NPL)")
    seen = 0.9 * REFLECTANCES @ channel_weights(illuminant(lamp), camera).T
    found = recover(seen, illuminant(lamp), REFLECTANCES, np.ones(24, bool))
    true = camera / camera.max(axis=1, keepdims=True)
    assert np.sqrt(np.mean((found.curves - true) ** 2)) < most
    assert found.left_out < 0.002


def test_a_camera_unlike_the_others_is_noticed():
    """A sensor of three layers: its curves are no sums of the components."""
    seen = 0.9 * REFLECTANCES @ channel_weights(illuminant("D65"), camera_of("Sigma SDMerill (NPL)")).T
    assert recover(seen, illuminant("D65"), REFLECTANCES, np.ones(24, bool)).left_out > 0.005


def test_the_command_writes_figures_curves_and_a_page(tmp_path, capsys):
    patches = 0.9 * REFLECTANCES @ channel_weights(illuminant("D50"), camera_of("Nikon 5100 (NPL)")).T
    linear, middles = photograph(patches, 2)
    file = tmp_path / "chart.png"
    cv2.imwrite(str(file), np.round(65535 * linear[..., ::-1]).astype(np.uint16))
    folder = tmp_path / "out" / "chart"
    arguments = ["calibrate", "target", str(file), str(folder), "--light", "D50"]
    with pytest.raises(SystemExit) as end:
        cli.main(arguments)
    assert end.value.code == 0
    printed = capsys.readouterr()
    assert "linear" in printed.err
    assert printed.out.count("CIEDE2000") == 1
    figures = json.loads((folder / "calibration.json").read_text())
    assert figures["after_correction"]["delta_e_mean"] < 2
    assert "as_delivered" not in figures
    curves = np.loadtxt(folder / "sensitivities.csv", delimiter=",", skiprows=1)
    assert curves.shape == (61, 4)
    page = (folder / "calibration.html").read_text()
    assert "CIEDE2000" in page
    assert "http" not in page.replace("http://www.w3.org", "")
    with pytest.raises(SystemExit) as end:
        cli.main(arguments)
    assert end.value.code == 2
    assert str(folder) in capsys.readouterr().err
    by_hand = [f"{x:.1f},{y:.1f}" for x, y in middles]
    with pytest.raises(SystemExit) as end:
        cli.main(
            ["calibrate", "target", str(file), str(tmp_path / "hand"), "--encoding", "linear", "--corners", *by_hand]
        )
    assert end.value.code == 0
    other = json.loads((tmp_path / "hand" / "calibration.json").read_text())
    assert other["after_correction"]["delta_e_mean"] == pytest.approx(
        figures["after_correction"]["delta_e_mean"], abs=0.05
    )
    assert not (tmp_path / "hand" / "sensitivities.csv").exists()


def test_sensitivities_go_into_a_capture_that_is_not_sealed(tmp_path, capsys):
    patches = 0.9 * REFLECTANCES @ channel_weights(illuminant("D50"), camera_of("Nikon 5100 (NPL)")).T
    file, capture = tmp_path / "chart.png", tmp_path / "capture"
    cv2.imwrite(str(file), np.round(65535 * photograph(patches, 2)[0][..., ::-1]).astype(np.uint16))
    capture.mkdir()
    (capture / "capture.yaml").write_text("title: Landscape\ncamera: {bits: 12}\n")
    into = ["--into", str(capture)]
    with pytest.raises(SystemExit) as end:
        cli.main(["calibrate", "target", str(file), str(tmp_path / "one"), *into])
    assert end.value.code == 2
    assert "--light" in capsys.readouterr().err
    with pytest.raises(SystemExit) as end:
        cli.main(["calibrate", "target", str(file), str(tmp_path / "two"), "--light", "D50", *into])
    assert end.value.code == 0
    settings = yaml.safe_load((capture / "capture.yaml").read_text())
    assert settings["camera"] == {
        "bits": 12,
        "channels": ["red", "green", "blue"],
        "sensitivities": "sensitivities.csv",
    }
    assert (capture / "sensitivities.csv").read_text() == (tmp_path / "two" / "sensitivities.csv").read_text()


def test_a_saturated_chart_is_refused_and_leaves_nothing(tmp_path, capsys):
    linear, middles = photograph(as_srgb(0.95), 2)
    file = tmp_path / "bright.png"
    cv2.imwrite(str(file), coded(np.clip(12 * linear, 0, 1))[..., ::-1])
    by_hand = [f"{x:.1f},{y:.1f}" for x, y in middles]
    with pytest.raises(SystemExit) as end:
        cli.main(["calibrate", "target", str(file), str(tmp_path / "out"), "--corners", *by_hand])
    assert end.value.code == 2
    told = capsys.readouterr().err
    expect_facts(told, file.name, 24)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["bright.png"]
