"""The simulated dome over a painting: photographs through serial port, folder and terminal are those taken by hand."""

import csv
import os
import re
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from captures import make_capture
from refusals import refused
from simulated_devices import VirtualCamera

from nishiki.commands.running import photograph_by_rig
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
from nishiki.rig.device import ask_operator

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
    assert "lens" in said


def as_jpeg(path):
    codes = cv2.imread(str(path), cv2.IMREAD_UNCHANGED) >> 4
    return cv2.imencode(".jpg", codes.astype(np.uint8))[1].tobytes()


BY_USB = """
from pathlib import Path
from nishiki.rig.description import open_rig

with open_rig(Path("rig.yaml")) as rig:
    for lamp in range(1, rig.lamps.count + 1):
        rig.lamps.light(lamp)
        print(*rig.camera.photograph(Path("taken")))
"""


def test_a_virtual_camera_on_usb_sees_what_the_dome_lights(bench, tmp_path):
    camera = VirtualCamera(tmp_path / "usb", as_jpeg(bench.darks[0]))
    bench.dome.on_light = lambda lit: camera.show(as_jpeg(bench.photograph(lit)))
    Path("rig.yaml").write_text(re.sub("camera: .*", "camera: {kind: gphoto}", RIG))
    environment = os.environ | {"PYTHONPATH": str(SOURCE), "VCAMERADIR": str(tmp_path / "usb")}
    done = subprocess.run([sys.executable, "-c", BY_USB], env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    paths = [Path(line) for line in done.stdout.splitlines()]
    assert len(set(paths)) == len(bench.lamps)
    for name, path in zip(bench.lamps, paths, strict=True):
        by_hand = cv2.imdecode(np.frombuffer(as_jpeg(bench.photographs["object", name]), np.uint8), cv2.IMREAD_COLOR)
        assert np.array_equal(cv2.imread(str(path)), by_hand)


def test_without_a_terminal_the_same_program_says_that_nobody_can_be_asked(bench, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", str(SOURCE))
    done = subprocess.run(
        [sys.executable, "-c", CAMPAIGN], stdin=subprocess.DEVNULL, capture_output=True, text=True, check=False
    )
    assert done.returncode == 1
    assert "without a terminal" in done.stderr


def test_what_the_person_does_not_understand_is_told(bench):
    with refused(UserError, by="obey"):
        bench.obey("sing a song")


def photographs(data):
    """Files of a capture by role and light, in the order of the table."""
    found = {}
    with (data / "frames.csv").open(newline="") as file:
        for row in csv.DictReader(file):
            found.setdefault((row["role"], row["light"]), []).append((data / row["file"]).read_bytes())
    return found


@pytest.mark.slow
def test_the_capture_of_the_demonstration_holds_the_photographs_that_were_taken_by_hand(tmp_path, monkeypatch):
    by_hand = make_capture(tmp_path / "by-hand")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTHONPATH", str(SOURCE))
    for _ in range(2):  # the second time the capture is kept
        assert photograph_by_rig(Path("by-hand"), Path("rig"), Path("by-rig")) == 0
    assert photographs(tmp_path / "by-rig/data") == photographs(by_hand)
    assert len(list((tmp_path / "rig/camera").iterdir())) == 11  # five lamps, object and board, and a dark frame
    assert (tmp_path / "by-rig/manifest-sha256.txt").is_file()
