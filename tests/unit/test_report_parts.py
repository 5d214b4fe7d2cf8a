"""Drawings, pictures and texts of the report."""

import xml.etree.ElementTree as ElementTree
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from refusals import expect_facts

from nishiki.artifacts.maps import shrink
from nishiki.colour.colour import decode, srgb_matrix, xyz_to_lab
from nishiki.report.page import Figures, Table
from nishiki.report.pictures import (
    MISSING,
    balance,
    block_of,
    bright_picture,
    class_picture,
    colour_map,
    file_picture,
    heat,
    hillshade,
    normal_picture,
    ruler,
    scalar_picture,
    sea,
)
from nishiki.report.scene_page import conditions, flat, settings_rows, text
from nishiki.report.svg import (
    ChartAxis,
    ChartCurve,
    bars,
    chart,
    degrees,
    figure,
    format_signed,
    lights_plot,
    percent,
    plain,
    ticks,
)
from nishiki.stages.render import RenderSettings
from nishiki.stages.report.painting import choices, describe, describe_exposure, gloss_blocks, verdict
from nishiki.stages.report.painting_prediction import chosen, signed_differences
from nishiki.stages.report.painting_surface import _draw_places, spread_out
from nishiki.stages.separate import SeparateSettings


def decoded(picture) -> np.ndarray:
    import base64

    data = base64.b64decode(picture.source.split(",", 1)[1])
    return cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)[..., ::-1]


@pytest.mark.parametrize("table", [heat(), sea()])
def test_lightness_of_a_colour_map_grows_evenly(table):
    coded = table / 255
    linear = np.where(coded <= 0.04045, coded / 12.92, ((coded + 0.055) / 1.055) ** 2.4)
    to_xyz = np.linalg.inv(srgb_matrix())
    lab = xyz_to_lab(linear @ to_xyz.T, to_xyz.sum(axis=1))
    steps = np.diff(lab[:, 0])
    assert steps.min() > -0.3  # 8 bits round to 0.4 of lightness
    even = np.linspace(lab[0, 0], lab[-1, 0], 256)
    assert np.abs(lab[:, 0] - even).max() < 1.5


def test_coloured_clips_and_marks_what_is_missing():
    table = heat()
    found = colour_map(np.array([[-5.0, 0.0, 1.0, 9.0, np.nan]]), table, 0.0, 1.0)
    assert found[0, 0].tolist() == found[0, 1].tolist() == table[0].tolist()
    assert found[0, 2].tolist() == found[0, 3].tolist() == table[255].tolist()
    assert found[0, 4].tolist() == MISSING.tolist()


@pytest.mark.parametrize(("columns", "widest", "block"), [(720, 720, 1), (721, 720, 2), (4608, 720, 7), (3, 128, 1)])
def test_block_keeps_the_picture_within_its_width(columns, widest, block):
    assert block_of(columns, widest) == block


@settings(deadline=None)
@given(st.integers(1, 40), st.integers(1, 40), st.integers(1, 7), st.booleans(), st.integers(0, 2**31))
def test_shrink_against_the_obvious_loop(rows, columns, block, worst, seed):
    random = np.random.default_rng(seed)
    values = random.random((rows, columns)).astype(np.float32)
    values[random.random((rows, columns)) < 0.2] = np.nan
    found = shrink(lambda band: values[band], (rows, columns), block, how="largest" if worst else "mean")
    assert found.shape == (-(-rows // block), -(-columns // block))
    for i in range(found.shape[0]):
        for j in range(found.shape[1]):
            part = values[i * block : (i + 1) * block, j * block : (j + 1) * block]
            part = part[np.isfinite(part)]
            if part.size == 0:
                assert not np.isfinite(found[i, j])
            else:
                assert found[i, j] == pytest.approx(part.max() if worst else part.mean(), rel=1e-6)


def test_shrink_takes_the_pixel_in_the_middle_of_a_block_that_may_be_cut():
    values = np.arange(7 * 8, dtype=np.uint8).reshape(7, 8)
    found = shrink(lambda band: values[band], values.shape, 3, "middle")
    np.testing.assert_array_equal(found, values[np.ix_([1, 4, 6], [1, 4, 7])])
    assert found.dtype == np.uint8


def test_shrink_bands_do_not_change_the_result(monkeypatch):
    monkeypatch.setattr("nishiki.artifacts.maps.BAND_VALUES", 100)
    values = np.random.default_rng(1).random((700, 9, 3)).astype(np.float32)
    found = shrink(lambda band: values[band], (700, 9), 3)
    whole = values[:699].reshape(233, 3, 3, 3, 3).mean(axis=(1, 3))
    assert found[:233] == pytest.approx(whole, rel=1e-6)


def test_scalar_picture_of_nothing_is_all_missing():
    picture = scalar_picture(np.full((4, 5), np.nan), heat(), unit="x")
    assert np.abs(decoded(picture).astype(int) - MISSING).max() <= 3  # JPEG
    assert (picture.rows, picture.columns) == (4, 5)


def test_class_picture_is_exact():
    key = {0: ("#102030", "a"), 2: ("#fefdfc", "b")}
    codes = decoded(class_picture(np.array([[0.0, 2.0, np.nan]]), key))
    assert codes[0].tolist() == [[16, 32, 48], [254, 253, 252], MISSING.tolist()]


def test_normals_are_shown_in_the_opengl_convention():
    normals = np.zeros((16, 16, 3), np.float32)
    normals[...] = (0.0, 1.0, 0.0)
    assert np.abs(decoded(normal_picture(normals))[8, 8].astype(int) - (128, 255, 128)).max() <= 3


def test_hillshade_is_light_towards_the_upper_left():
    rows, columns = np.mgrid[:40, :40]
    bump = 5 * np.exp(-((rows - 20.0) ** 2 + (columns - 20.0) ** 2) / 60)
    shade = hillshade(bump, step=1.0)
    assert shade[15, 15] > shade[0, 0] > shade[25, 25]
    assert hillshade(np.zeros((1, 5)), step=1.0).shape == (1, 5)
    flat = hillshade(np.zeros((5, 5)), step=1.0)
    assert np.isfinite(flat).all()


def test_a_png_that_is_none_is_refused():
    with pytest.raises(ValueError, match="not a picture"):
        file_picture(b"text", 720)


@pytest.mark.parametrize(("code", "factor"), [(60, 15), (120, 3), (250, 1)])
def test_a_dark_png_is_brightened_and_its_caption_says_by_how_much(code, factor):
    data = cv2.imencode(".png", np.full((8, 8, 3), code, np.uint8))[1].tobytes()
    picture, note = bright_picture(data, 8)
    shown = decode(decoded(picture) / 255.0, "srgb").mean()
    assert np.isclose(shown / decode(np.float64(code / 255.0), "srgb"), factor, rtol=0.05)
    assert (f" {factor} " in note) == (factor > 1)


def test_a_large_png_is_averaged_in_linear_light():
    board = np.indices((8, 8)).sum(axis=0) % 2 * 255
    data = cv2.imencode(".png", np.repeat(board[..., None], 3, axis=-1).astype(np.uint8))[1].tobytes()
    assert np.abs(decoded(file_picture(data, 4)).astype(int) - 188).max() <= 2  # half the light is code 188


@given(st.floats(-1e6, 1e6), st.floats(1e-6, 1e6))
def test_ticks_are_round_and_inside(low, span):
    found = ticks(low, low + span)
    assert 2 <= len(found) <= 12 or span < 1e-6 * abs(low)
    for value in found:
        slack = 1e-6 * span + 4 * np.spacing(abs(low) + span)
        assert low - slack <= value <= low + span + slack


def test_a_chart_is_well_formed_whatever_the_names():
    svg = chart(
        [ChartCurve('a<b>&"c', np.arange(3), np.array([0.0, np.nan, 1.0]))], x_label="<x>", y_label="&", title='"t"'
    )
    root = ElementTree.fromstring(svg)
    assert root.attrib["aria-label"] == '"t"'
    assert chart([], x_label="x", y_label="y", title="empty").startswith("<svg")


def test_points_outside_a_chart_are_not_drawn():
    curve = ChartCurve("", np.array([0.5, 0.5, 5.0]), np.array([0.5, 9.0, 0.5]), dots=True)
    svg = chart([curve], x_label="x", y_label="y", title="t", x_range=(0, 1), y_range=(0, 1))
    assert svg.count("<circle") == 1


def test_lights_stand_where_they_shine_from():
    directions = np.array([[0, 0, 1], [np.sqrt(0.5), 0, np.sqrt(0.5)], [0, np.sqrt(0.5), np.sqrt(0.5)]])
    svg = lights_plot(directions, ["top", "right", "up"], ["sample", "sample", "check"], size=340)
    circles = [
        (float(c.attrib["cx"]), float(c.attrib["cy"]))
        for c in ElementTree.fromstring(svg).iter("circle")
        if list(c)  # lights carry a title
    ]
    assert circles == [(170.0, 170.0), (240.0, 170.0), (170.0, 100.0)]  # 45 degrees: half of the radius of 140


def test_bars_of_nothing_but_zero():
    assert ElementTree.fromstring(bars([0.0], ["a"], title="t", unit="%")) is not None


def test_spread_out_points_are_far_apart_and_never_equal():
    points = np.array([[0.0, 0], [0, 0], [10, 0], [5, 0], [0, 8]])
    assert spread_out(points, 4, 0) == [0, 2, 4, 3]
    assert spread_out(points[:2], 4, 0) == [0]


@pytest.mark.parametrize(
    ("value", "shown"),
    [
        (None, "–"),
        (0, "0"),
        (12345, "12\u202f345"),
        (2.0, "2.00"),
        (0.0, "0"),
        (-0.5, "−0.500"),
        (123.4, "123"),
        (99.96, "100"),
        (0.00123, "0.00123"),
        (327700.0, "327\u202f700"),
        (3.277e9, "3.28 × 10⁹"),
        (-2.5e-6, "−2.50 × 10⁻⁶"),
        (123456789, "1.23456789 × 10⁸"),
    ],
)
def test_figures(value, shown):
    assert figure(value) == shown


@settings(deadline=None)
@given(st.floats(-1e12, 1e12, allow_subnormal=False), st.integers(1, 8), st.booleans())
def test_a_number_reads_back_to_its_digits_and_never_shows_an_e(value, digits, padded):
    shown = plain(value, digits, padded=padded)
    assert "e" not in shown
    assert "-" not in shown
    raised = "".join(mark for mark in shown if mark in "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
    mantissa = shown.removesuffix("10" + raised).removesuffix(" × ") if raised else shown
    exponent = int(raised.translate(str.maketrans("⁻⁰¹²³⁴⁵⁶⁷⁸⁹", "-0123456789"))) if raised else 0
    back = float(mantissa.replace("\u202f", "").replace("−", "-") or 1) * 10.0**exponent
    assert back == pytest.approx(value, rel=0.51 * 10.0 ** (1 - digits), abs=0)


@pytest.mark.parametrize(
    ("columns", "pitch", "percent", "label"),
    [(1000, 0.1, 20.0, "20 mm"), (4000, 1.0, 25.0, "1 m"), (640, 0.0004, 19.53125, "50 µm"), (100, None, None, None)],
)
def test_scale_bars_are_round_and_short(columns, pitch, percent, label):
    found = ruler(columns, pitch)
    assert (found is None) == (pitch is None)
    if found:
        assert (found.percent, found.label) == (pytest.approx(percent), label)


def test_marks_stand_at_the_places_whose_spectra_are_drawn():
    rng = np.random.default_rng(4)
    small = rng.uniform(0.1, 0.9, (12, 15, 3)).astype(np.float32)
    basis = np.abs(rng.normal(0.3, 0.1, (3, 61)))
    charts, marks = _draw_places(small, small @ np.eye(3), basis, np.full((12, 15, 61), 0.1), 4)
    assert [text for _, _, text in marks] == [str(k + 1) for k in range(len(charts))]
    for chart_, (x, y, number) in zip(charts, marks, strict=True):
        assert chart_.heading == f"{number}: row {int(y) * 4 + 2}, column {int(x) * 4 + 2}"


def test_the_signed_difference_is_the_luminance_of_what_was_predicted_too_much():
    observed = np.full((6, 8, 3), 0.4, np.float32)
    predicted = observed + np.array([0.01, 0.01, 0.01], np.float32)
    predicted[0] -= 0.05
    inside = np.ones((6, 8), bool)
    inside[:, 0] = False
    pair = {"predicted": predicted, "observed": observed, "inside": inside}
    (found, _), end = signed_differences([pair, pair])
    np.testing.assert_allclose(found[1:, 1:], 1.0, atol=1e-4)
    np.testing.assert_allclose(found[0, 1:], -4.0, atol=1e-4)
    assert np.isnan(found[:, 0]).all()
    assert end == 5
    assert signed_differences([{**pair, "predicted": observed}])[1] == 1
    middle = colour_map(np.zeros((1, 1)), balance(), -5, 5)[0, 0].astype(int)
    assert np.ptp(middle) <= 4  # no error is grey
    assert [format_signed(v) for v in (None, 0.0, -0.0004, -0.012)] == ["–", "0\u202f%", "0\u202f%", "−1.2\u202f%"]


def test_captions_state_the_exposure():
    expect_facts(describe_exposure(3.9, chosen=True), "3.9")


def test_parameters_at_a_bound_are_rows_of_the_conditions():
    told = {"gamma": 1.0, "at_bounds": ["half width of lobe 1: 92 degrees, the upper end"], "red": {"at_bounds": ["n"]}}
    manifest = {"stage": "brdf", "settings": {}, "diagnostics": told}
    rows = [row for row in conditions(manifest, ()) if "bound" in row[-1]]
    assert [row[1].split(": ", 1)[1] for row in rows] == [*told["at_bounds"], "red: n"]


def test_percent_and_degrees():
    assert [percent(v) for v in (None, 0.0, 0.001, 12.345)] == ["–", "0", "< 0.01\u202f%", "12.35\u202f%"]
    assert [degrees(v) for v in (None, -0.2, -45.4)] == ["–", "0°", "−45°"]


def test_settings_that_differ_are_marked_and_planned_ones_are_not():
    values = SeparateSettings(w1=1.5, hold_out=("a",)).model_dump(mode="json") | {"w2": 0.1}
    rows, changed = settings_rows(values, SeparateSettings)
    by_name = {name: rest for name, *rest in rows}
    assert [rows[number][0] for number in changed] == ["<code>w1</code>"]
    assert "plan" in by_name["<code>hold_out</code>"][1]
    assert by_name["<code>w1</code>"][:2] == ["1.5", "1.2"]


def test_diagnostics_become_short_lines():
    found = dict(flat({"a": {"b": 1.0, "c": None}, "d": list(range(1000))}))
    assert found["a.b"] == "1"
    assert found["a.c"] == "none"
    assert len(found["d"]) == 160
    assert found["d"].endswith("…")
    assert text(True) == "yes"


def test_chosen_lights_hold_the_best_and_the_worst():
    lights = [{"de00": {"mean": value}} for value in (3.0, 1.0, 2.0, 9.0, 5.0, None)]
    assert chosen(lights[:3]) == [0, 1, 2]
    picked = chosen(lights)
    assert len(picked) == 4
    assert {3, 5} <= set(picked)


def test_choices_name_the_published_method():
    rows = choices({"separate": {"method": "threshold"}, "normals": {"solver": "lobe"}}).rows
    assert [row[1].split()[0] for row in rows] == ["threshold", "lobe"]
    assert len(rows[0][1]) > len("threshold")


def test_pictures_are_described_in_words():
    pictures = RenderSettings().model_dump(mode="json")["pictures"]
    by_name = {entry["name"]: describe(entry) for entry in pictures}
    assert by_name["lamplight"].startswith("A ")
    assert "45°" in by_name["lamplight"]
    assert "azimuth −90°" in by_name["oblique"]


def _parameters(gamma):
    phi = np.linspace(0, 1.2, 60)
    fitted = 5 * 2.0 ** -((phi / 0.1) ** 2)
    profile = {"phi": phi.tolist(), "value": (fitted + 0.01).tolist(), "count": [100] * 60, "fitted": fitted.tolist()}
    region = {"beta": [5.0], "gamma": [gamma], "refractive_index": 1.45, "residual": 0.1, "samples": 60}
    region["flags"] = ["AT_BOUND", "no gloss: Lambert"]
    return {"regions": [region | {"profile": profile, "transmission": 0.0}]}


def blocks_of(blocks, kind):
    return [block for block in blocks if isinstance(block, kind)]


def test_gloss_is_drawn_twice_and_measured_in_degrees():
    section = gloss_blocks(_parameters(0.1)["regions"], [])
    ((linear, logarithmic),) = (figures.items for figures in blocks_of(section, Figures))
    assert "logarithmic" in logarithmic.heading
    for item in (linear, logarithmic):
        ElementTree.fromstring(item.svg)
    (row,) = blocks_of(section, Table)[0].rows
    assert "Lambert" in row[-1]
    assert row[4] == pytest.approx(np.degrees(0.1))


def test_gloss_of_a_matte_scene_has_no_chart():
    parameters = _parameters(1.6)
    region = parameters["regions"][0]
    region["beta"] = [0.0]
    region["profile"] = {"phi": [], "value": [], "count": [], "fitted": []}
    assert blocks_of(gloss_blocks(parameters["regions"], []), Figures)[0].items == []


@pytest.mark.parametrize(("low", "high"), [(0.9, 30.0), (1e-5, 3.0)])
def test_a_logarithmic_axis_has_round_ticks_at_their_places(low, high):
    axis = ChartAxis(low, high, 0.0, 100.0, logarithmic=True)
    assert axis.marks() == ([1.0, 2.0, 5.0, 10.0, 20.0] if low > 0.1 else [1e-5, 1e-4, 1e-3, 1e-2, 0.1, 1.0])
    assert axis(high) == pytest.approx(100)
    assert np.isnan(axis(0.0))


@pytest.mark.parametrize(
    ("board", "lamps", "pitch", "error", "good", "asked"),
    [
        (True, 12, 0.1, 1.2, True, "calibrate"),
        (False, 4, None, 10.3, False, "--white"),
        (True, 5, 0.1, 3.0, True, "twelve"),
    ],
)
def test_the_first_lines_name_the_one_thing_that_would_improve_most(board, lamps, pitch, error, good, asked):
    normals = {"sigma_median_deg": 2.6, "valid_pixels": 80, "object_pixels": 100}
    frames = SimpleNamespace(lights=range(lamps), white_board=board, pixel_pitch_mm=pitch)
    lights = [{"incidence_deg": 20.0, "level_error": 0.01}, {"incidence_deg": 65.0, "level_error": -0.12}]
    parts = [
        {"finish": 0, "dark": dark, "share": 0.5, "de00": {"mean": mean}, "lights": lights[: 1 + dark]}
        for dark, mean in ((False, 0.5 * error), (True, error))
    ]
    evaluation = {"lights": [1], "overall": {"de00": {"mean": 0.6 * error}}, "parts": parts}
    rows = dict(verdict({"normals": normals}, evaluation, frames, guessed=True))
    assert (f"{error:.1f}" in rows.get("Good", ""), f"{error:.1f}" in rows["Doubtful"]) == (good, not good)
    assert "20 %" in rows["Doubtful"]
    assert "12 %" in rows["Doubtful"]
    assert "65°" in rows["Doubtful"]
    assert asked in rows["To improve it most"]
