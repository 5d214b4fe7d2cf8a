"""A rig that photographs a painting in fields: two straight axes, one mosaic with the places where they stood."""

from dataclasses import dataclass, field
from pathlib import Path

import pytest
import yaml
from captures import make_capture
from rig_devices import Bench, write_plan

from nishiki.capture.folder import load_capture
from nishiki.capture.mosaic import MosaicCapture
from nishiki.errors import UserError
from nishiki.rig.axes import GrblAxis, GrblSettings
from nishiki.rig.description import reachable_angle
from nishiki.rig.device import DeviceError, Rig
from nishiki.rig.frames_table import read_table, table_text
from nishiki.rig.plan import read_plan
from nishiki.rig.run import read_frames_of, run_capture


@dataclass
class Straight:
    """A straight axis."""

    range_deg: tuple[float, float] = (-500.0, 500.0)
    straight: bool = True
    stands: float = 0.0
    moves: list[float] = field(default_factory=list)

    def home(self):
        self.stands = 0.0

    def move_to(self, degrees):
        self.stands = degrees
        self.moves.append(degrees)

    def close(self):
        pass


class StageBench(Bench):
    """What the camera sees depends on where the axes stand: photographs of another capture for each place."""

    def __init__(self, captures, disturb=lambda device: None):
        super().__init__(captures[0, 0], disturb)
        self.axes = {"x": Straight(), "y": Straight()}
        self.benches = {place: Bench(capture) for place, capture in captures.items()}

    def open(self, description):
        rig = super().open(description)
        return Rig(rig.camera, rig.lamps, axes=self.axes)

    def see(self):
        place = self.axes["x"].stands, self.axes["y"].stands
        if self.subject == "object":
            self.photographs = self.benches[place].photographs
        return super().see()


def go(bench, plan, capture):
    return run_capture(Path("rig.yaml"), plan, capture, open_devices=bench.open, ask=bench.ask)


@pytest.fixture
def stage(tmp_path):
    """Two fields side by side, 24 mm apart, of 64 x 40 pixels of half a millimetre, and their plan."""
    captures = {
        (0, 0): make_capture(tmp_path / "left", rows=40, columns=64, seed=1),
        (24, 0): make_capture(tmp_path / "right", rows=40, columns=64, seed=2),
    }
    plan = write_plan(tmp_path, captures[0, 0], fields={"rows": 1, "columns": 2, "step_mm": [24, 20]})
    described = yaml.safe_load(plan.read_text())
    described["capture"]["pixel_pitch_mm"] = 0.5
    plan.write_text(yaml.safe_dump(described, default_flow_style=None))
    return captures, plan


def test_a_stage_makes_a_mosaic_whose_boards_are_photographed_once(stage, tmp_path):
    captures, plan = stage
    bench = StageBench(captures)
    digest = go(bench, plan, tmp_path / "wall")
    wall = load_capture(tmp_path / "wall")
    assert isinstance(wall, MosaicCapture)
    assert wall.sealed
    assert wall.digest == digest
    assert {each.name: each.position_mm for each in wall.fields} == {"a1": (0, 0), "a2": (24, 0)}
    roles = [
        sum(frame.role == role for frame in wall.captures[0].frames) for role in ("sample", "check", "white", "dark")
    ]
    assert bench.exposures == sum(roles) + roles[0] + roles[1]
    for made, source in zip(wall.captures, captures.values(), strict=True):
        for role in ("sample", "white", "dark"):
            expected = source if role == "sample" else captures[0, 0]
            theirs = {
                frame.light: frame.path.read_bytes() for frame in load_capture(expected).frames if frame.role == role
            }
            ours = {frame.light: frame.path.read_bytes() for frame in made.frames if frame.role == role}
            assert ours == theirs or role == "dark"
    assert go(bench, plan, tmp_path / "wall") == digest
    assert bench.exposures == sum(roles) + roles[0] + roles[1]


def test_fields_are_not_put_into_a_capture_that_is_there(stage, tmp_path):
    captures, plan = stage
    bench, before = StageBench(captures), sorted((tmp_path / "left").rglob("*"))
    with pytest.raises(UserError, match="left"):
        go(bench, plan, tmp_path / "left")
    assert bench.exposures == 0
    assert sorted((tmp_path / "left").rglob("*")) == before


def test_a_run_that_stopped_in_the_second_field_goes_on_there(stage, tmp_path):
    captures, plan = stage
    steps = []

    def stop(device):
        steps.append(device)
        if steps.count("photograph") == 14:
            raise DeviceError("the camera refuses")

    with pytest.raises(DeviceError):
        go(StageBench(captures, stop), plan, tmp_path / "wall")
    assert not (tmp_path / "wall" / "fields.csv").exists()
    bench = StageBench(captures)
    stopped = go(bench, plan, tmp_path / "wall")
    assert bench.exposures < 5
    assert stopped == go(StageBench(captures), plan, tmp_path / "whole")


def test_fields_that_would_hardly_overlap_stop_after_the_first(stage, tmp_path):
    captures, plan = stage
    plan.write_text(plan.read_text().replace("[24, 20]", "[30, 20]"))
    bench = StageBench(captures)
    with pytest.raises(UserError, match="step_mm"):
        go(bench, plan, tmp_path / "wall")
    assert bench.axes["x"].moves[-1] == 0


@pytest.mark.parametrize(("moves", "expected"), [("camera", (30, -20)), ("painting", (-10, 40))])
def test_axes_go_row_by_row_and_back(stage, moves, expected, tmp_path):
    _, plan = stage
    grid = {"rows": 2, "columns": 3, "step_mm": [10, 30], "first_mm": [10, 10], "moves": moves}
    plan.write_text(yaml.safe_dump(yaml.safe_load(plan.read_text()) | {"fields": grid}))
    frames = read_plan(plan).frames()
    places = dict.fromkeys((frame.file.split("/")[1], frame.axes) for frame in frames if frame.role == "sample")
    assert [name for name, _ in places] == ["a1", "a2", "a3", "b3", "b2", "b1"]
    stands = {name: tuple(dict(axes).values()) for name, axes in places}
    assert stands["a1"] == (10, 10)
    assert stands["b3"] == expected
    table = tmp_path / "frames.tsv"
    table.write_text(table_text(frames, plan.name))
    assert read_table(table)[1] == frames == read_frames_of(table)[1]


def test_one_field_is_no_mosaic(stage):
    _, plan = stage
    plan.write_text(plan.read_text().replace("columns: 2", "columns: 1"))
    with pytest.raises(UserError, match="fields"):
        read_plan(plan)


def test_a_straight_axis_has_no_turn():
    assert reachable_angle(500, (0, 800), "x", straight=True) == 500
    with pytest.raises(UserError, match="mm"):
        reachable_angle(-10, (0, 800), "x", straight=True)
    settings = GrblSettings(kind="grbl", port="none", axis="X", range_deg=(0, 800), straight=True)
    assert GrblAxis("x", None, settings).straight
