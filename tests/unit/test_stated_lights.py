"""Lights files as people have them: positions in any unit, angles, strengths, old code pages, projects of RelightLab.

The photographs are of a relief under point lamps, reckoned here pixel by pixel from the law of Lambert and the square
of the distance, with a little noise.
"""

import json

import cv2
import numpy as np
import pytest

import nishiki
from nishiki.capture.convert import convert
from nishiki.capture.folder import load_capture
from nishiki.formats.problems import CaptureError
from nishiki.goniometry.directions import unit

ROWS, COLUMNS, WIDTH_MM = 30, 40, 120.0
AZIMUTH = np.radians(np.arange(12) * 30 + 7.0)
ELEVATION = np.radians(np.where(np.arange(12) % 2, 30.0, 60.0))
DIRECTIONS = np.stack(
    [np.cos(ELEVATION) * np.cos(AZIMUTH), np.cos(ELEVATION) * np.sin(AZIMUTH), np.sin(ELEVATION)], axis=1
)
DOME = 150 * DIRECTIONS
UNEVEN = DIRECTIONS * np.linspace(120, 220, 12)[:, None]
STRENGTHS = np.linspace(0.6, 1.4, 12)
NAMES = [f"img_{i + 1:02d}.png" for i in range(12)]


def relief():
    """Normals (3, rows, columns)."""
    row, column = np.indices((ROWS, COLUMNS))
    slope_x, slope_y = 0.5 * np.cos(column / 3) * np.cos(row / 5), 0.5 * np.sin(row / 4 + column / 17)
    return np.stack([-slope_x, slope_y, np.ones_like(slope_x)]) / np.sqrt(slope_x**2 + slope_y**2 + 1)


def photographs(folder, *, positions=None, strengths=None, names=NAMES):
    """Sixteen-bit pictures under lamps at positions in millimetres, or far away where there are none."""
    folder.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(0)
    row, column = np.indices((ROWS, COLUMNS))
    normal = relief()
    place = np.stack([column - (COLUMNS - 1) / 2, (ROWS - 1) / 2 - row, 0 * row]) * (WIDTH_MM / COLUMNS)
    albedo = 0.3 + 0.2 * (column > 20) + 0.1 * (row % 7 > 3)
    for i, name in enumerate(names):
        if positions is None:
            light = np.broadcast_to(DIRECTIONS[i][:, None, None], place.shape)
        else:
            away = positions[i][:, None, None] - place
            light = away / np.linalg.norm(away, axis=0) ** 3 * np.median(np.linalg.norm(positions, axis=1)) ** 2
        value = albedo * np.maximum((normal * light).sum(axis=0), 0) * (1 if strengths is None else strengths[i])
        code = np.rint(65535 * np.clip(0.5 * value * (1 + 0.01 * rng.normal(size=value.shape)), 0, 1)).astype(np.uint16)
        (folder / name).write_bytes(cv2.imencode(".png", code)[1].tobytes())
    return folder


def listed(rows, names=NAMES):
    lines = [" ".join([name, *(f"{value:.6f}" for value in row)]) for name, row in zip(names, rows, strict=True)]
    return "\n".join([str(len(lines)), *lines, ""])


def captured(source, target, **options):
    made = convert(source, target, **options)
    capture = load_capture(target)
    return capture, {each.kind for each in made.warnings}


def with_file(tmp_path, text, name="dome.lp", **scene):
    source = photographs(tmp_path / "s", **scene)
    (source / name).write_text(text)
    return source


def refusal(source, tmp_path, **options):
    with pytest.raises(CaptureError) as caught:
        convert(source, tmp_path / "refused", **options)
    return caught.value.problems[0]


@pytest.mark.parametrize("positions", [DOME, UNEVEN], ids=["dome", "uneven"])
def test_positions_are_known_by_the_fall_off_and_so_is_the_width(tmp_path, positions):
    capture, told = captured(with_file(tmp_path, listed(positions), positions=positions), tmp_path / "c")
    assert "lights-positions" in told
    assert capture.settings.lights.kind == "position_mm"
    assert capture.settings.pixel_pitch_mm == pytest.approx(WIDTH_MM / COLUMNS, rel=0.03)
    np.testing.assert_allclose(capture.lights.vectors, positions, atol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("unit_mm", [10, 25.4, 1000, WIDTH_MM / COLUMNS], ids=["cm", "inch", "m", "pixels"])
def test_the_unit_of_positions_is_asked_for_and_found_from_the_width(tmp_path, unit_mm):
    source = with_file(tmp_path, listed(DOME / unit_mm), positions=DOME)
    problem = refusal(source, tmp_path)
    assert problem.kind == "lights-ambiguous"
    assert "--width-mm" in problem.remedy
    for name, kind in (("a", None), ("b", "position_mm")):
        capture, _ = captured(source, tmp_path / name, width_mm=WIDTH_MM, lights_kind=kind)
        np.testing.assert_allclose(capture.lights.vectors, DOME, rtol=1e-3, atol=1e-2)
        assert capture.settings.pixel_pitch_mm == WIDTH_MM / COLUMNS


def test_far_lamps_in_inches_are_not_taken_for_lamps_nearer_than_the_object_is_wide(tmp_path):
    source = with_file(tmp_path, listed(1000 * DIRECTIONS / 25.4))
    options = {"width_mm": WIDTH_MM, "lights_kind": "position_mm"}
    problem = refusal(source, tmp_path, **options)
    assert (problem.kind, problem.file) == ("lights-ambiguous", "dome.lp")
    capture, _ = captured(source, tmp_path / "c", **options | {"lights_kind": "direction"})
    np.testing.assert_allclose(capture.directions, DIRECTIONS, atol=1e-5)
    (source / "dome.lp").write_text(listed(1000 * DIRECTIONS))
    capture, _ = captured(source, tmp_path / "d", **options)
    np.testing.assert_allclose(capture.lights.vectors, 1000 * DIRECTIONS, atol=1e-4)


@pytest.mark.parametrize("lengths", [150, 1.7, np.linspace(1, 3, 12)[:, None]], ids=["150", "1.7", "uneven"])
def test_directions_of_any_length_stay_directions(tmp_path, lengths):
    capture, told = captured(with_file(tmp_path, listed(DIRECTIONS * lengths)), tmp_path / "c")
    assert "light-not-unit" in told
    assert capture.settings.lights.kind == "direction"
    np.testing.assert_allclose(capture.directions, DIRECTIONS, atol=1e-6)


def test_what_photographs_do_not_tell_is_refused_and_both_remedies_work(tmp_path):
    source = tmp_path / "s"
    source.mkdir()
    for name in NAMES:
        (source / name).write_bytes(cv2.imencode(".png", np.full((ROWS, COLUMNS), 90, np.uint8))[1].tobytes())
    (source / "dome.lp").write_text(listed(UNEVEN))
    problem = refusal(source, tmp_path)
    assert problem.kind == "lights-ambiguous"
    for place, kind in enumerate(("position_mm", "direction")):
        assert f"--lights-kind {kind}" in problem.remedy
        capture, _ = captured(source, tmp_path / f"c{place}", lights_kind=kind, width_mm=WIDTH_MM)
        assert capture.settings.lights.kind == kind


@pytest.mark.parametrize(
    ("rows", "kind", "azimuth"),
    [
        ([np.degrees(AZIMUTH), np.degrees(ELEVATION), np.ones(12)], "azimuth_elevation", AZIMUTH),
        ([np.degrees(ELEVATION), np.degrees(AZIMUTH) - 180], "elevation_azimuth", AZIMUTH - np.pi),
        ([AZIMUTH, np.pi / 2 - ELEVATION, np.full(12, 150.0)], "azimuth_polar", AZIMUTH),
        ([np.degrees(AZIMUTH) / 4, np.degrees(ELEVATION), np.ones(12)], "azimuth_elevation", AZIMUTH / 4),
        ([np.degrees(ELEVATION), np.degrees(AZIMUTH) / 4], "elevation_azimuth", AZIMUTH / 4),
    ],
)
def test_angles_are_refused_by_name_and_read_when_their_kind_is_given(tmp_path, rows, kind, azimuth):
    source = with_file(tmp_path, listed(np.transpose(rows)))
    problem = refusal(source, tmp_path)
    assert problem.kind == "lights-angles"
    assert f"--lights-kind {kind}" in problem.remedy
    capture, _ = captured(source, tmp_path / "c", lights_kind=kind)
    np.testing.assert_allclose(capture.directions, unit(np.pi / 2 - ELEVATION, azimuth), atol=1e-5)


def test_the_wrong_kind_of_angle_is_contradicted_by_the_photographs(tmp_path):
    source = with_file(tmp_path, listed(np.transpose([AZIMUTH, np.pi / 2 - ELEVATION])))
    problem = refusal(source, tmp_path, lights_kind="azimuth_elevation")
    assert problem.kind == "lights-contradicted"
    assert "--lights-kind azimuth_polar" in problem.remedy


@pytest.mark.slow
@pytest.mark.parametrize("positions", [None, UNEVEN], ids=["far", "near"])
@pytest.mark.parametrize("power", [1, -1], ids=["strengths", "factors"])
def test_a_fourth_number_is_a_strength_or_a_factor_by_what_the_photographs_show(tmp_path, positions, power):
    vectors = DIRECTIONS if positions is None else positions
    text = listed(np.column_stack([vectors, STRENGTHS**power]))
    source = with_file(tmp_path, text, positions=positions, strengths=STRENGTHS)
    capture, _ = captured(source, tmp_path / "c")
    assert capture.settings.lights.kind == ("direction" if positions is None else "position_mm")
    ratio = capture.intensities[:, 0] / STRENGTHS * (1 if positions is None else np.linspace(120, 220, 12) ** 2)
    np.testing.assert_allclose(ratio, ratio[0], rtol=0.01)


def test_a_fourth_number_that_says_nothing_is_not_used(tmp_path):
    for place, further in (("equal", np.ones(12)), ("unrelated", STRENGTHS)):
        source = with_file(tmp_path / place, listed(np.column_stack([DIRECTIONS, further])))
        capture, told = captured(source, tmp_path / place / "c")
        assert capture.intensities is None
        assert ("lights-further-numbers" in told) == (place == "unrelated")
        np.testing.assert_allclose(capture.directions, DIRECTIONS, atol=1e-6)


@pytest.mark.parametrize(
    ("encoding", "stem"), [("cp932", "表面能"), ("gbk", "画像"), ("cp1251", "фото"), ("mac_roman", "Größe")]
)
def test_names_in_an_old_code_page_are_those_of_the_photographs(tmp_path, encoding, stem):
    names = [f"{stem}{i + 1:02d}.png" for i in range(12)]
    source = photographs(tmp_path / "s", names=names)
    text = listed(DIRECTIONS, [f"C:\\{stem}\\{name}" for name in names])
    (source / "dome.lp").write_bytes(text.encode(encoding))
    capture, _ = captured(source, tmp_path / "c")
    assert [frame.file for frame in capture.observed] == [f"frames/{name}" for name in names]
    (source / "dome.lp").write_bytes(text.replace("0", "x", 1).encode(encoding))
    assert refusal(source, tmp_path).kind == "lights-unreadable"


def points(vectors):
    return [dict(zip("xyz", map(float, vector), strict=True)) for vector in vectors]


def project(place, *, images=None, **more):
    """A project of RelightLab beside its folder of photographs."""
    images = images or [{"filename": name, "skip": False, "visible": True} for name in NAMES]
    content = {"width": COLUMNS, "height": ROWS, "folder": "photos", "images": images, "dome": dome()} | more
    (place / "relief.relight").write_text(json.dumps(content))
    return place


def dome(**more):
    empty = {"imageWidth": 0, "domeDiameter": 0, "positionsSphere": [], "positions3d": [], "ledAdjust": []}
    return {**empty, "lightConfiguration": "directional", "directions": points(DIRECTIONS), **more}


def test_a_project_of_relightlab_has_its_directions_in_the_dome(tmp_path):
    images = [{"filename": name, "skip": i == 2, "visible": i != 7} for i, name in enumerate(NAMES)]
    used = [i for i in range(12) if i not in (2, 7, 9)]
    directions = DIRECTIONS.copy()
    directions[9] = 0
    photographs(tmp_path / "s/photos")
    for stated in (directions, np.delete(directions, 2, axis=0)):  # some versions state one for a skipped one, too
        project(tmp_path / "s", images=images, dome=dome(directions=points(stated)))
        capture, told = captured(tmp_path / "s", tmp_path / f"c{len(stated)}")
        assert [frame.light for frame in capture.observed] == [NAMES[i][:-4] for i in used]
        np.testing.assert_allclose(capture.directions, DIRECTIONS[used], atol=1e-7)
        assert "photograph-unlisted" in told
    project(tmp_path / "s", images=images, dome=dome(directions=points(directions[:7])))
    assert refusal(tmp_path / "s", tmp_path).kind == "lights-unreadable"
    project(tmp_path / "s", dome=dome(directions=[]))
    assert refusal(tmp_path / "s", tmp_path).kind == "lights-unreadable"


def test_crop_shifts_and_scale_of_a_project(tmp_path):
    photographs(tmp_path / "s/photos")
    crop = {"left": 5, "top": 3, "width": 20, "height": 10, "angle": 0}
    aligns = [{"rect": {}, "offsets": [[0, 0]] * 6 + [[3, 2]] * 6}]
    project(tmp_path / "s", crop=crop, aligns=aligns, pixelSize=0.05)
    capture, told = captured(tmp_path / "s", tmp_path / "c")
    assert capture.settings.region_of_interest == (3, 5, 10, 20)
    assert capture.settings.pixel_pitch_mm == 0.05
    assert {"project-crop", "project-aligns"} <= told
    assert [frame.shift_px for frame in capture.observed] == [(0, 0)] * 6 + [(3, 2)] * 6
    project(tmp_path / "s", crop=crop | {"left": 5, "top": 8, "width": 10, "height": 20, "angle": 90})
    capture, _ = captured(tmp_path / "s", tmp_path / "turned")  # the picture is 30 wide and 40 high then
    assert capture.settings.region_of_interest == (15, 8, 10, 20)


def test_a_project_called_relight_and_nothing_else(tmp_path):
    photographs(tmp_path / "s")
    project(tmp_path / "s", folder=".").joinpath("relief.relight").rename(tmp_path / "s/.relight")
    capture, _ = captured(tmp_path / "s", tmp_path / "c")
    np.testing.assert_allclose(capture.directions, DIRECTIONS, atol=1e-7)


def test_photographs_outside_of_a_project_are_named_with_the_command(tmp_path):
    photographs(tmp_path / "photos")
    (tmp_path / "p").mkdir()
    project(tmp_path / "p", folder="../photos")
    problem = refusal(tmp_path / "p", tmp_path)
    assert (problem.kind, problem.found) == ("photograph-missing", str(tmp_path / "photos"))
    assert str(tmp_path / "p/relief.relight") in problem.remedy
    convert(tmp_path / "photos", tmp_path / "c", lights_file=tmp_path / "p/relief.relight")


@pytest.mark.parametrize(
    ("stated", "asked"),
    [
        ({"imageWidth": WIDTH_MM, "lightConfiguration": "spherical", "positionsSphere": points(DOME)}, False),
        ({"imageWidth": WIDTH_MM, "lightConfiguration": "spherical", "domeDiameter": 300}, False),
        ({"imageWidth": WIDTH_MM, "lightConfiguration": "lights3d", "positions3d": points(DOME)}, False),
        ({"lightConfiguration": "spherical", "domeDiameter": 300}, True),
        ({"imageWidth": WIDTH_MM, "domeDiameter": 300}, True),
    ],
    ids=["positions", "diameter", "lights3d", "no width", "directional"],
)
def test_lamps_of_a_dome_are_near(tmp_path, stated, asked):
    content = json.dumps(dome(**stated, ledAdjust=[{c: 1 / each for c in "rgb"} for each in STRENGTHS]))
    source = with_file(tmp_path, content, "rig.dome", positions=DOME, strengths=STRENGTHS)
    capture, told = captured(source, tmp_path / "c")
    assert capture.settings.lights.kind == "position_mm"
    assert ("lights-positions" in told) == asked
    assert capture.settings.pixel_pitch_mm == pytest.approx(WIDTH_MM / COLUMNS, rel=0.03)
    np.testing.assert_allclose(capture.lights.vectors, DOME, atol=1e-4)
    np.testing.assert_allclose(capture.intensities[:, 0], STRENGTHS)


def test_a_dome_with_a_diameter_whose_lamps_are_far_by_the_photographs(tmp_path):
    source = with_file(tmp_path, json.dumps(dome(domeDiameter=300, imageWidth=WIDTH_MM)), "rig.dome")
    capture, _ = captured(source, tmp_path / "c")
    assert capture.settings.lights.kind == "direction"
    np.testing.assert_allclose(capture.directions, DIRECTIONS, atol=1e-7)


@pytest.mark.slow
@pytest.mark.parametrize("region", [None, (5, 8, 20, 20)], ids=["whole", "cut"])
def test_normals_under_near_lamps_are_those_of_the_relief(tmp_path, region):
    source = with_file(tmp_path, listed(UNEVEN), positions=UNEVEN)
    convert(source, tmp_path / "c", region=region, lights_kind="position_mm", width_mm=WIDTH_MM)
    observed = nishiki.read_observations(tmp_path / "c")
    field = nishiki.estimate_normals(
        observed.values[..., 0], observed.directions, valid=observed.valid, solver="least_squares"
    )
    row, column, rows, columns = region or (0, 0, ROWS, COLUMNS)
    truth = np.moveaxis(relief(), 0, 2)[row : row + rows, column : column + columns]
    off = np.degrees(np.arccos(np.clip((field.normals * truth).sum(axis=2), -1, 1)))
    assert np.median(off) < 1.0  # of one per cent of noise
    far = nishiki.estimate_normals(observed.values[..., 0], DIRECTIONS, solver="least_squares").normals
    assert np.degrees(np.arccos(np.clip((far * truth).sum(axis=2), -1, 1))).mean() > 4


@pytest.mark.data
def test_samples_of_lights_files(data, tmp_path):
    folder = data / "faulty_captures" / "photographs"
    near = {"07-dome-spherical": 1e-9, "07-lp-in-mm": 0.01}
    for name, error in near.items():
        capture, _ = captured(folder / name, tmp_path / name)
        assert capture.settings.lights.kind == "position_mm"
        assert capture.settings.pixel_pitch_mm == pytest.approx(1.25, rel=error)
        np.testing.assert_allclose(capture.lights.vectors, DOME, atol=1e-5)
    for name in ("07-relightlab-plain", "07-relightlab-cropped", "12-lp-intensity", "12-names-cp932"):
        capture, _ = captured(folder / name, tmp_path / name)
        assert capture.settings.lights.kind == "direction"
        np.testing.assert_allclose(capture.directions, DIRECTIONS, atol=1e-5)
    assert load_capture(tmp_path / "07-relightlab-cropped").settings.region_of_interest == (10, 20, 50, 60)
    assert refusal(folder / "12-lp-angles", tmp_path).kind == "lights-angles"
    capture, _ = captured(folder / "12-lp-angles", tmp_path / "angles", lights_kind="azimuth_elevation")
    np.testing.assert_allclose(capture.directions, DIRECTIONS, atol=1e-5)
