"""Plans of a capture rig: the frames that they expand to, the table that can be edited, and their mistakes."""

import numpy as np
import pytest
from captures import RING
from refusals import expect_facts

from nishiki.capture.schema import read_mapping
from nishiki.cli import main
from nishiki.errors import UserError
from nishiki.rig.frames_table import candidate_pairs, expected_fit, read_table, table_text
from nishiki.rig.plan import frame_distance, incidence_cosines, read_plan


def write_lights(folder, lights=RING):
    lines = [f"L{i + 1:02d}.png {x:.9g} {y:.9g} {z:.9g}" for i, (x, y, z) in enumerate(lights)]
    (folder / "dome.lp").write_text(f"{len(lights)}\n" + "\n".join(lines) + "\n")


def read(folder, text):
    write_lights(folder)
    (folder / "plan.yaml").write_text(text)
    return read_plan(folder / "plan.yaml")


DOME = """
kind: dome
suffix: png
lights: dome.lp
exposure_s: 0.5
white: {when: before, exposure_s: 0.25}
dark: {frames: 2}
checks_for: [L05]
"""


def test_a_dome_has_a_frame_and_a_board_for_every_lamp_and_darks_for_every_exposure(tmp_path):
    plan = read(tmp_path, DOME)
    frames = plan.frames()
    assert [frame.role for frame in frames] == ["white"] * 5 + ["sample"] * 4 + ["check"] + ["dark"] * 4
    assert [frame.lamp for frame in frames[:10]] == [1, 2, 3, 4, 5] * 2
    assert [frame.file for frame in frames[4:6]] == ["white/L05.png", "frames/L01.png"]
    assert [frame.exposure_s for frame in frames[-4:]] == [0.25, 0.25, 0.5, 0.5]
    cosines = incidence_cosines(plan, frames)
    assert cosines["frames/L01.png"] == 1
    assert cosines["frames/L03.png"] == pytest.approx(0.714, abs=1e-3)
    near, far = (frame_distance(plan, frames[5], frames[i]) for i in (6, 0))
    assert np.degrees(near) == pytest.approx(44.4, abs=0.1)
    assert np.isinf(far)


def test_positions_of_lamps_count_with_the_squared_distance(tmp_path):
    write_lights(tmp_path, [(0, 0, 500), (0, 300, 400), (0, 600, 800)])
    (tmp_path / "plan.yaml").write_text("kind: dome\nsuffix: png\nlights: dome.lp\nlights_kind: position_mm\n")
    plan = read_plan(tmp_path / "plan.yaml")
    values = np.array(list(incidence_cosines(plan, plan.frames()).values()))
    np.testing.assert_allclose(values / values[0], [1, 0.8, 0.2])


@pytest.mark.parametrize(("outer", "second"), [("view", ("000", "on")), ("state", ("001", "off"))])
def test_a_turntable_has_every_view_in_every_state(tmp_path, outer, second):
    text = "kind: turntable\nsuffix: nef\nsteps: 4\nstates: [off, on]\nwhite: {when: after}\nboard: {}\n"
    frames = read(tmp_path, f"{text}outer: {outer}\n").frames()
    samples = [frame for frame in frames if frame.role == "sample"]
    assert {(frame.view, frame.polariser) for frame in samples} == {
        (f"00{view}", state) for view in range(4) for state in ("off", "on")
    }
    assert (samples[1].view, samples[1].polariser) == second
    assert {dict(frame.axes)["turntable"] for frame in samples} == {0, 90, 180, 270}
    assert all(frame.polarisers == (("polariser", frame.polariser),) for frame in samples)
    assert [frame.role for frame in frames[8:]] == ["white"] * 2 + ["board"] * 4


def test_two_polarisers_share_a_state(tmp_path):
    text = "kind: turntable\nsuffix: nef\nsteps: 1\nstates: [0/0, 0/90]\npolarisers: [lamp, camera]\n"
    frames = read(tmp_path, text).frames()
    assert frames[1].polarisers == (("lamp", "0"), ("camera", "90"))
    assert frames[1].file == "frames/0_90.nef"
    assert not frames[1].axes
    assert not frames[1].view


GONIOMETER = """
kind: goniometer
suffix: nef
exposure_s: [0.5, 0.05]
separation_deg: 10
oblique: 6
white: {}
axes: {arm: {theta_r: 1}, table: {phi_r: -1, offset: 5}}
"""


@pytest.mark.slow
def test_a_goniometer_has_the_quarter_hemisphere_and_oblique_pairs_with_their_boards(tmp_path):
    frames = read(tmp_path, GONIOMETER).frames()
    samples = [frame for frame in frames if frame.role == "sample"]
    pairs = list(dict.fromkeys(frame.angles_deg for frame in samples))
    normal = np.array([pair[2:] for pair in pairs if pair[0] == 0])
    assert len(normal) == 8 * 7
    assert normal[:, 0].min() == 18
    assert normal.max(axis=0).tolist() == [81, 90]
    assert len(samples) == 2 * len(pairs)
    assert len(pairs) == len(normal) + 6
    whites = [frame for frame in frames if frame.role == "white"]
    assert {frame.angles_deg[:2] for frame in whites} == {pair[:2] for pair in pairs}
    assert {frame.exposure_s for frame in whites} == {0.5}
    assert all(dict(frame.axes) == {"arm": frame.angles_deg[2], "table": 5 - frame.angles_deg[3]} for frame in frames)


@pytest.mark.slow
def test_planned_oblique_pairs_leave_less_to_be_known_than_pairs_spread_evenly():
    """The sum of squared errors that is expected over all pairs after the fit, by the parameters alone."""
    from nishiki.brdf.cloth.yarn_fit import _slopes
    from nishiki.goniometry.directions import unit
    from nishiki.rig.frames_table import recommend_oblique

    views = np.array([(t, p) for t in (9.0, 36.0, 63.0) for p in (0.0, 30.0, 60.0, 90.0)])
    fit, pairs = expected_fit(unit(*np.radians(views).T)), candidate_pairs(0.0)
    slopes = _slopes(fit, unit(*np.radians(pairs[:, :2]).T), unit(*np.radians(pairs[:, 2:]).T))[:, :-1]

    def expected_error(rows):
        information = fit.information + slopes[rows].T @ slopes[rows] / 0.05**2
        return np.sum(slopes * (slopes @ np.linalg.inv(information)))

    planned = np.array(recommend_oblique(views, 12, 0.0))
    rows = [int(np.flatnonzero((pairs == pair).all(axis=1))[0]) for pair in planned]
    evenly = np.linspace(0, len(pairs) - 1, 12).astype(int)
    assert expected_error(rows) < 0.8 * expected_error(evenly)


@pytest.mark.parametrize("text", [DOME, pytest.param(GONIOMETER, marks=pytest.mark.slow), DOME.replace("0.5", "auto")])
def test_a_table_is_read_as_it_was_written(tmp_path, text):
    frames = read(tmp_path, text).frames()
    table = tmp_path / "frames.tsv"
    table.write_text(table_text(frames, "plan.yaml"))
    assert read_table(table) == (tmp_path / "plan.yaml", frames)


def test_the_command_saves_a_table_that_names_its_plan(tmp_path, capsys):
    read(tmp_path, DOME)
    table = tmp_path / "tables" / "frames.tsv"
    with pytest.raises(SystemExit) as end:
        main(["rig", "plan", str(tmp_path / "plan.yaml"), "--table", str(table)])
    assert end.value.code == 0
    expect_facts(capsys.readouterr().out, "14 frames", "5 white", "4 sample", "1 check", "4 dark")
    assert read_table(table)[0].samefile(tmp_path / "plan.yaml")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("kind: dome", "kind: dom", "'dom'"),
        ("suffix: png", "suffix: bmp", "suffix"),
        ("checks_for: [L05]", "checks_for: [L77]", "L77"),
        ("lights: dome.lp", "lights: other.lp", "other.lp"),
        ("exposure_s: 0.5\n", "", "white.exposure_s"),
        ("exposure_s: 0.5\n", "exposure_s: [0.5, 1]\n", "goniometer"),
        ("dark: {frames: 2}", "capture: {geometry: plane}", "geometry"),
        ("dark: {frames: 2}", "darks: {frames: 2}", "'dark'"),
    ],
)
def test_a_mistake_in_a_plan_is_named(tmp_path, old, new, message):
    assert old in DOME
    with pytest.raises(UserError, match=message.replace(".", r"\.")):
        read(tmp_path, DOME.replace(old, new)).frames()


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("# plan: plan.yaml", "# table", "line 1: "),
        ("frames/L02.png", "frames/L01.png", "frames/L01.png"),
        ("frames/L02.png", "../L02.png", "line 9: "),
        ("\tlamp\t", "\tlmap\t", "lmap"),
        ("frames/L02.png\tsample\t2", "frames/L02.png\tsample\ttwo", "'two'"),
        ("frames/L02.png\tsample", "frames/L02.png\texample", "'example'"),
    ],
)
def test_a_mistake_in_a_table_is_named(tmp_path, old, new, message):
    frames = read(tmp_path, DOME).frames()
    table = tmp_path / "frames.tsv"
    text = table_text(frames, "plan.yaml")
    assert old in text
    table.write_text(text.replace(old, new))
    with pytest.raises(UserError, match=message.replace(".", r"\.")):
        read_table(table)


def test_words_of_polariser_states_need_no_quotes(tmp_path):
    plan = read(tmp_path, "kind: turntable\nsuffix: nef\nsteps: 2\nstates: [off, on]\n")
    assert plan.settings.states == ("off", "on")
    assert read_mapping(tmp_path / "plan.yaml")["states"] == [False, True]  # what plain YAML makes of it
