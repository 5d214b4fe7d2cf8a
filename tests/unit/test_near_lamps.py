"""Lamps at a finite distance: told from far ones by the fall-off of their light, and mended by the remedy as it reads.

The photographs are those of a relief of hills by a rough law of reflection with gloss and cast shadows.
"""

import cv2
import numpy as np
import pytest
from lit_relief import COLUMNS, degrees, dome, photographs, relief

import nishiki
from nishiki.capture.convert import convert
from nishiki.capture.folder import load_capture
from nishiki.formats.problems import CaptureError
from nishiki.observations.check import check_capture
from nishiki.photometric.consistency import measure_width

RINGS = {"dome": ((8, 35), (4, 65)), "ring": ((12, 45),), "low": ((8, 30),), "three": ((10, 25), (8, 45), (6, 70))}
WIDTH_MM = 200.0


@pytest.mark.slow
@pytest.mark.parametrize("rings", RINGS)
@pytest.mark.parametrize("options", [{}, {"gloss": 0.5}, {"steep": 1.0}], ids=["matt", "glossy", "flat"])
def test_the_distance_is_measured_and_far_lamps_are_silent(rings, options):
    directions = dome(RINGS[rings])
    far = measure_width(photographs(directions, seed=4, **options), directions)
    assert not far.matters
    for width in (0.15, 0.5):
        found = measure_width(photographs(directions, seed=4, width=width, **options), directions)
        assert found.matters
        assert found.width == pytest.approx(width, rel=0.2)
        assert abs(found.width - width) < 3 * found.sigma


def test_the_bow_is_that_of_the_normals_under_far_lamps():
    directions, width = dome(RINGS["three"]), 0.3
    values = photographs(directions, seed=2, width=width, steep=1.0)
    found = measure_width(values, directions)
    flat = nishiki.estimate_normals(values, directions, solver="least_squares").normals
    slope = -flat[..., 0] / flat[..., 2] + np.gradient(-relief(2, 1.0))[1]
    x = (np.arange(COLUMNS) + 0.5) / COLUMNS - 0.5
    assert found.bow == pytest.approx(-np.polyfit(x, slope.mean(axis=0), 1)[0] / 8, rel=0.25)


def write_set(folder, stack, directions):
    folder.mkdir()
    lines = []
    for j, (values, direction) in enumerate(zip(stack, directions, strict=True)):
        codes = np.rint(65535 * np.clip(0.6 * values, 0, 1)).astype(np.uint16)
        (folder / f"p{j:02d}.png").write_bytes(cv2.imencode(".png", codes)[1].tobytes())
        lines.append(f"p{j:02d}.png " + " ".join(f"{value:.6f}" for value in direction))
    (folder / "dome.lp").write_text("\n".join([str(len(lines)), *lines, ""]))
    return folder


@pytest.mark.slow
def test_a_list_of_unit_directions_is_warned_of_and_its_remedy_works(tmp_path):
    directions, width = dome(((5, 35), (3, 65))), 0.5
    source = write_set(tmp_path / "near", photographs(directions, seed=3, width=width), directions)
    convert(source, tmp_path / "far")
    (told,) = (p for p in check_capture(tmp_path / "far", level="full") if p.kind == "lamps-near")
    assert "--lights-kind position_mm --width-mm WIDTH" in told.remedy
    convert(source, tmp_path / "c", lights_kind="position_mm", width_mm=WIDTH_MM)
    capture = load_capture(tmp_path / "c")
    assert capture.settings.lights.kind == "position_mm"
    distances = np.linalg.norm(capture.lights.vectors, axis=1)
    np.testing.assert_allclose(distances, WIDTH_MM / width, rtol=0.15)
    down, right = np.gradient(relief(3))
    truth = np.stack([-right, down, np.ones_like(right)], axis=2)
    truth /= np.linalg.norm(truth, axis=2, keepdims=True)
    errors = []
    for name in ("far", "c"):
        observed = nishiki.read_observations(tmp_path / name)
        field = nishiki.estimate_normals(observed.values.mean(axis=3), observed.directions, valid=observed.valid)
        errors.append(degrees(field.normals, truth)[field.valid].mean())
    assert errors[1] < 0.4 * errors[0]


def test_far_lamps_are_not_turned_into_positions(tmp_path):
    directions = dome()
    source = write_set(tmp_path / "s", photographs(directions, seed=3), directions)
    with pytest.raises(CaptureError) as refused:
        convert(source, tmp_path / "c", lights_kind="position_mm", width_mm=WIDTH_MM)
    assert refused.value.problems[0].kind == "lights-ambiguous"


@pytest.mark.data
def test_directions_by_line_become_positions_where_lamps_are_said_to_be_near(data, tmp_path):
    convert(data / "diligent_cat", tmp_path / "capture", lights_kind="position_mm", width_mm=100.0)
    capture = load_capture(tmp_path / "capture")
    assert capture.settings.lights.kind == "position_mm"
    assert np.median(np.linalg.norm(capture.lights.vectors, axis=1)) == pytest.approx(700, rel=0.15)
