"""rig.yaml: what it may name, what is told of mistakes, and the commands that use it."""

import re
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
from refusals import expect_facts, refused
from simulated_devices import SimulatedComXim, SimulatedDialogue, SimulatedGrbl

from nishiki.cli import main
from nishiki.errors import UserError
from nishiki.rig import device as lines
from nishiki.rig.description import open_rig, read_rig
from nishiki.rig.device import DeviceError, DeviceLost, Exposure
from nishiki.simulate.rig.dome import SimulatedDome

OWN_CAMERA = """
from pathlib import Path
from nishiki.rig.device import Exposure

class Camera:
    def __init__(self, name):
        self.name, self.taken = name, 0

    def configure(self, exposure):
        return Exposure(seconds=0.5)

    def photograph(self, folder):
        self.taken += 1
        path = Path(folder) / f"{self.name}-{self.taken}.raw"
        path.write_bytes(b"light")
        return (path,)

    def close(self):
        pass
"""
RIG = """
camera: {kind: python, file: camera.py, name: Camera, options: {name: ours}}
lamps: {kind: dome, port: dome, count: 4, settle_s: 0}
axes:
  lamp: {kind: grbl, port: grbl, axis: X, units_per_degree: -1, range_deg: [0, 90]}
  camera: {kind: grbl, port: grbl, axis: Y, units_per_degree: -1, range_deg: [0, 90]}
  turntable: {kind: comxim, port: comxim, reference: table}
polarisers:
  lamp: {kind: prompt}
  camera: {kind: described, file: servo.yaml, port: servo}
"""
SERVO = """
port: /dev/nowhere
states:
  off: {send: A0, expect: at 0}
  on: {send: A90, expect: at 90}
"""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A description with all kinds of devices, and the files that it names."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "camera.py").write_text(OWN_CAMERA)
    (tmp_path / "servo.yaml").write_text(SERVO)
    (tmp_path / "rig.yaml").write_text(RIG)
    return tmp_path


@pytest.fixture
def devices(folder):
    """The simulated devices of the description, by the names of their ports."""
    with (
        SimulatedDome(folder / "dome", 4) as lamps,
        SimulatedGrbl(folder / "grbl") as axes,
        SimulatedComXim(folder / "comxim") as turntable,
        SimulatedDialogue(folder / "servo", {"A0": "at 0", "A90": "at 90"}) as servo,
    ):
        yield SimpleNamespace(dome=lamps, grbl=axes, comxim=turntable, servo=servo)


@pytest.fixture
def terminal(monkeypatch):
    """An operator who does what is asked; the requests."""
    requests = []
    answers = SimpleNamespace(isatty=lambda: True, readline=lambda: requests.append("asked") or "\n")
    monkeypatch.setattr(sys, "stdin", answers)
    return requests


def test_every_device_of_a_description_is_opened_moved_and_closed(folder, devices, terminal):
    with open_rig(folder / "rig.yaml") as rig:
        rig.home()
        rig.lamps.light(2)
        assert devices.dome.lit == {1}
        rig.axes["lamp"].move_to(30.0)
        rig.axes["camera"].move_to(60.0)
        rig.axes["turntable"].move_to(120.0)
        assert (devices.grbl.position["X"], devices.grbl.position["Y"]) == (-31.0, -61.0)
        assert devices.grbl.received.count("$H") == 1
        assert devices.comxim.angle == pytest.approx(120.0)
        rig.polarisers["camera"].set("on")
        assert devices.servo.received == ["A90"]
        rig.polarisers["lamp"].set("on")
        rig.polarisers["lamp"].set("on")
        assert len(terminal) == 1  # asked once for a state
        assert rig.camera.configure(Exposure()).seconds == 0.5
        assert [path.name for path in rig.camera.photograph(folder)] == ["ours-1.raw"]
    assert devices.dome.lit == set()


def test_where_one_device_does_not_open_the_others_are_closed(folder, devices):
    devices.comxim.unplug()
    with pytest.raises(DeviceLost, match="turntable"):
        open_rig(folder / "rig.yaml")
    devices.comxim.plug()
    open_rig(folder / "rig.yaml").close()  # no port is still in use


def test_a_lost_rig_can_be_closed_and_opened_again(folder, devices):
    rig = open_rig(folder / "rig.yaml")
    for device in vars(devices).values():
        device.unplug()
    with pytest.raises(DeviceLost):
        rig.home()
    rig.close()
    for device in vars(devices).values():
        device.plug()
    with open_rig(folder / "rig.yaml") as again:
        again.home()
        again.lamps.light(1)


def test_without_a_terminal_nobody_is_asked(folder, devices, monkeypatch):
    monkeypatch.setattr(sys, "stdin", SimpleNamespace(isatty=lambda: False))
    with open_rig(folder / "rig.yaml") as rig:
        with refused(DeviceError, "'on'"):
            rig.polarisers["lamp"].set("on")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("camera: {kind: gphotos}", "'gphoto', 'folder', 'python'"),
        ("camera: {kind: gphoto, modell: x}", "'model'"),
        ("lamps: {kind: dome, port: x, count: 4}", "'camera'"),
        ("camera: {kind: gphoto}\nlamps: {kind: dome, port: x}", "lamps.count"),
        ("camera: {kind: folder, folder: x, release: lamps}", "dome"),
        ("camera: {kind: gphoto}\naxes: {t: {kind: grbl, port: x, axis: Q}}", "axes.t.axis"),
        ("camera: {kind: gphoto}\naxes: {t: {kind: grbl, port: x, axis: X, range_deg: [9, 1]}}", "range_deg"),
        ("camera: {kind: gphoto}\npolarisers: {p: {kind: prompt, states: [half]}}", "half"),
        ("camera: {kind: python, file: none.py, name: X}", "none.py"),
        ("camera: {kind: python, file: camera.py, name: Lens}", "'Lens'"),
        ("camera: [", "rig.yaml"),
    ],
)
def test_mistakes_in_a_description_are_explained(folder, text, words):
    (folder / "rig.yaml").write_text(text)
    with pytest.raises(UserError) as raised:
        open_rig(folder / "rig.yaml")
    assert words in str(raised.value)
    assert not isinstance(raised.value, DeviceError)


def test_the_examples_of_the_documentation_are_descriptions(tmp_path):
    """Every block of YAML on the pages of devices that begins with `camera:` can be read."""
    pages = Path(__file__).resolve().parents[2] / "docs" / "devices"
    text = "".join(page.read_text() for page in pages.glob("*.md"))
    examples = [block for block in re.findall(r"```yaml\n(.*?)```", text, re.S) if re.search(r"^camera:", block, re.M)]
    assert len(examples) >= 3
    for example in examples:
        (tmp_path / "rig.yaml").write_text(example)
        read_rig(tmp_path / "rig.yaml")


def called(capsys, *words):
    """Exit status, output and errors of the command line."""
    with pytest.raises(SystemExit) as left:
        main(list(words))
    return left.value.code, *capsys.readouterr()


def test_rig_test_moves_everything_and_prints_a_line_each(folder, devices, terminal, capsys):
    status, out, err = called(capsys, "rig", "test", "rig.yaml")
    assert status == 0, err
    lines = out.splitlines()
    names = ("lamps", "axis lamp", "axis camera", "axis turntable", "polariser lamp", "polariser camera", "camera")
    assert [line.split(":")[0] for line in lines] == [*names, "rig.yaml"]
    expect_facts(lines[0], 4)
    assert "ours-1.raw" in lines[6]
    assert "FAILED" not in out


def test_rig_test_tells_what_fails_with_the_remedy_and_goes_on(folder, devices, terminal, capsys):
    devices.grbl.switch_works = False
    status, out, _ = called(capsys, "rig", "test", "rig.yaml")
    assert status == 2
    assert [line.split(":")[0] for line in out.splitlines() if ": FAILED" in line] == ["axis lamp", "axis camera"]
    expect_facts(out, "2 of 7")


def test_rig_test_of_a_rig_that_is_not_there(folder, capsys, monkeypatch):
    status, _, err = called(capsys, "rig", "test", "rig.yaml")
    assert status == 2
    assert "nishiki rig: lamps:" in err
    assert "Remedy" in err
    status, _, err = called(capsys, "rig", "test", "other.yaml")
    assert status == 2
    assert "other.yaml" in err


def test_ports_are_listed_with_vendor_and_product(capsys, monkeypatch):
    from serial.tools import list_ports, list_ports_common

    port = list_ports_common.ListPortInfo("/dev/ttyUSB0", skip_link_detection=True)
    port.vid, port.pid, port.manufacturer, port.product = 0x1A86, 0x7523, "QinHeng", "USB Serial"
    monkeypatch.setattr(list_ports, "comports", lambda: [port])
    monkeypatch.setattr("nishiki.rig.description.camera_ports", lambda: ["usb:001,004  Canon EOS R5"])
    status, out, _ = called(capsys, "rig", "ports")
    assert status == 0
    serial, camera = out.splitlines()
    expect_facts(serial, "/dev/ttyUSB0", "QinHeng USB Serial", "1a86", "7523", "CH340")
    assert camera == "usb:001,004  Canon EOS R5"


def test_where_nothing_is_connected_the_command_helps(capsys, monkeypatch):
    monkeypatch.setattr("nishiki.rig.description.serial_ports", lambda: ([], []))
    monkeypatch.setattr("nishiki.rig.description.camera_ports", list)
    status, out, _ = called(capsys, "rig", "ports")
    assert status == 0
    assert "demo --rig" in out


def test_without_the_extra_the_remedy_is_named(folder, capsys, monkeypatch):
    from nishiki.installation import MODULES

    monkeypatch.setitem(MODULES, "pyserial", "serial_that_nobody_has")
    for words in (("rig", "ports"), ("rig", "test", "rig.yaml")):
        status, _, err = called(capsys, *words)
        assert status == 2
        assert "./nishiki install --extras rig" in err


@pytest.fixture(autouse=True)
def short_waits(monkeypatch):
    monkeypatch.setattr(lines, "QUIET_S", 0.05)
    monkeypatch.setattr(lines, "GREETING_S", 1.0)
