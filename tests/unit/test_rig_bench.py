"""The simulated dome over a painting: photographs through serial port, folder and terminal are those taken by hand."""

import subprocess
import sys
from pathlib import Path

import pytest
from captures import make_capture

from nishiki.errors import UserError
from nishiki.rig.description import open_rig
from nishiki.simulate.rig.bench import PaintingBench, run_at_terminal

SOURCE = Path(__file__).resolve().parents[2] / "workflow" / "src"
RIG = """
camera: {kind: folder, folder: camera, release: lamps, complete_s: 0.1}
lamps: {kind: dome, port: dome, count: 5, settle_s: 0}
"""
CAMPAIGN = """
import sys
from pathlib import Path
from nishiki.rig.description import open_rig
from nishiki.rig.operator import ask_operator

with open_rig(Path("rig.yaml")) as rig:
    ask_operator("object", "put the white board in place of the object")
    rig.lamps.light(2)
    (white,) = rig.camera.photograph(Path("taken"))
    ask_operator("camera", "put the lens cap on")
    rig.lamps.light(None)
    (dark,) = rig.camera.photograph(Path("taken"))
    ask_operator("camera", "take the lens cap off and put the object in place")
    rig.lamps.light(2)
    (sample,) = rig.camera.photograph(Path("taken"))
    print("names", white.name, dark.name, sample.name)
    sys.exit(5)
"""


@pytest.fixture
def bench(tmp_path, monkeypatch):
    capture = make_capture(tmp_path / "by-hand")
    made = PaintingBench(capture, tmp_path / "rig")
    (tmp_path / "rig" / "rig.yaml").write_text(RIG)
    (tmp_path / "rig" / "taken").mkdir()
    monkeypatch.chdir(tmp_path / "rig")
    yield made
    made.close()


def test_the_dome_releases_the_camera_under_each_lamp(bench):
    with open_rig(Path("rig.yaml")) as rig:
        for number, name in enumerate(bench.lamps, 1):
            rig.lamps.light(number)
            (path,) = rig.camera.photograph(Path("taken"))
            assert path.read_bytes() == bench.photographs["object", name].read_bytes()
        bench.dome.dead = {2}
        rig.lamps.light(3)
        (path,) = rig.camera.photograph(Path("taken"))
        assert path.read_bytes() == bench.darks[0].read_bytes()


def test_a_person_at_the_terminal_changes_what_is_before_the_lens(bench, capfd, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", str(SOURCE))
    assert run_at_terminal([sys.executable, "-c", CAMPAIGN], bench.obey) == 5
    said = capfd.readouterr().err
    taken = {path.name: path.read_bytes() for path in Path("taken").iterdir()}
    white, dark, sample = (taken[name] for name in said.split("names ")[1].split())
    assert white == bench.photographs["white", "L02"].read_bytes()
    assert dark == bench.darks[0].read_bytes()
    assert sample == bench.photographs["object", "L02"].read_bytes()
    assert "put the lens cap on" in said


def test_without_a_terminal_the_same_program_says_that_nobody_can_be_asked(bench, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", str(SOURCE))
    done = subprocess.run(
        [sys.executable, "-c", CAMPAIGN], stdin=subprocess.DEVNULL, capture_output=True, text=True, check=False
    )
    assert done.returncode == 1
    assert "without a terminal" in done.stderr


def test_what_the_person_does_not_understand_is_told(bench):
    with pytest.raises(UserError, match="does not understand"):
        bench.obey("sing a song")
