"""Devices on serial lines against simulated ones behind pseudo-terminals: every protocol, and every fault of a line."""

import os
import threading
import time
import tty
from itertools import pairwise

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from refusals import refused
from simulated_devices import FAULTS, FaultyDome, SimulatedComXim, SimulatedDialogue, SimulatedGrbl

from nishiki.artifacts.declaration import parse
from nishiki.errors import UserError
from nishiki.rig import device as lines
from nishiki.rig.axes import ComXimSettings, ComXimTurntable, Grbl, GrblAxis, GrblSettings
from nishiki.rig.described import (
    BracketDome,
    DescribedAxis,
    DescribedLamps,
    DescribedPolariser,
    DomeSettings,
    HomeMadeAxis,
    HomeMadeLamps,
    HomeMadePolariser,
)
from nishiki.rig.device import LONGEST_LINE, DeviceError, DeviceLost, SerialLine
from nishiki.simulate.rig.dome import SimulatedDome

DESTRUCTIVE = [fault for fault in FAULTS if fault not in ("halves", "noise")]
"""Faults after which the answer never comes."""


@pytest.fixture(autouse=True)
def short_waits(monkeypatch):
    """Simulated devices answer at once: a missing answer need not be waited for as long as a real one."""
    monkeypatch.setattr(lines, "QUIET_S", 0.05)
    monkeypatch.setattr(lines, "ANSWER_S", 0.6)
    monkeypatch.setattr(lines, "GREETING_S", 1.0)
    monkeypatch.setattr(lines, "MOVE_S", 1.0)


@pytest.fixture
def port(tmp_path):
    return tmp_path / "port"


# One dialogue over a line


class Pair:
    """A pseudo-terminal: our line, and the far end as a file descriptor."""

    def __init__(self, **options):
        self.far, near = os.openpty()
        tty.setraw(near)
        self.line = SerialLine("device", os.ttyname(near), 9600, **options)
        os.close(near)

    def answer(self, data):
        """Send this once something was received."""

        def wait():
            os.read(self.far, 100)
            os.write(self.far, data)

        threading.Thread(target=wait, daemon=True).start()

    def receive(self, timeout_s):
        """Return the next complete line, None where none comes in time."""
        try:
            return self.line.answer("", timeout_s).string
        except DeviceLost:
            return None

    def __enter__(self):
        return self

    def __exit__(self, *exception):
        self.line.close()
        os.close(self.far)


words = st.text(st.characters(min_codepoint=33, max_codepoint=126), min_size=1, max_size=20)


@settings(max_examples=40, deadline=None)
@given(lines=st.lists(words, min_size=1, max_size=6), cuts=st.lists(st.integers(0, 120), max_size=6))
def test_lines_arrive_as_they_were_sent_however_they_are_cut(lines, cuts):
    data = "".join(f"{line}\r\n" for line in lines).encode()
    places = [0, *sorted(min(cut, len(data)) for cut in cuts), len(data)]
    with Pair() as pair:
        received = []
        for start, end in pairwise(places):
            os.write(pair.far, data[start:end])
            if (line := pair.receive(0)) is not None:
                received.append(line)
        while len(received) < len(lines) and (line := pair.receive(0.5)) is not None:
            received.append(line)
        assert received == lines
        assert pair.receive(0) is None


@settings(max_examples=40, deadline=None)
@given(noise=st.binary(max_size=200))
def test_noise_before_an_answer_is_no_answer(noise):
    with Pair() as pair:
        pair.answer(noise.replace(b"ok", b"") + b"\nok\n")
        assert pair.line.ask("G0", "^ok$", 2.0)[0] == "ok"


def test_a_partial_answer_is_named_in_the_error():
    with Pair() as pair:
        pair.answer(b"hello\nerr\xff")
        with pytest.raises(DeviceLost) as raised:
            pair.line.ask("G0 X1", "^ok$", 0.1)
    text = str(raised.value)
    for words in ("device", "'G0 X1'", "'hello'", "xff", "Remedy", "9600 baud"):
        assert words in text


def test_a_line_without_end_is_noise_and_not_memory():
    with Pair() as pair:
        stop = threading.Event()

        def babble():
            while not stop.is_set():
                os.write(pair.far, b"x" * 512)

        threading.Thread(target=babble, daemon=True).start()
        try:
            with refused(DeviceLost, by="_next_line"):
                pair.line.answer("^ok$", 5.0)
            assert len(pair.line.buffer) <= LONGEST_LINE
        finally:
            stop.set()
            pair.line.discard()


def test_an_answer_to_an_earlier_line_is_not_taken_for_this_one():
    with Pair() as pair:
        os.write(pair.far, b"ok\n")
        time.sleep(0.02)
        with refused(DeviceLost, "'G0'", "^ok$"):
            pair.line.ask("G0", "^ok$", 0.05)


def test_a_restart_between_two_steps_is_noticed():
    with Pair(restart="^Grbl") as pair:
        os.write(pair.far, b"Grbl 1.1h ['$' for help]\n")
        time.sleep(0.02)
        with pytest.raises(DeviceLost, match="restarted"):
            pair.line.send("G0")


def test_a_port_that_is_not_there_can_be_waited_for(tmp_path):
    with pytest.raises(DeviceLost, match="nishiki rig ports"):
        SerialLine("dome", str(tmp_path / "ttyUSB7"), 9600)


def test_a_port_that_another_program_uses_is_refused():
    with Pair() as pair, refused(DeviceError, by="__init__") as raised:
        SerialLine("dome", pair.line.port, 9600)
    assert not isinstance(raised.value, DeviceLost)


# GRBL


def axis_of(controller, axis="X", units_per_degree=-1.0, **options):
    options |= {"axis": axis, "units_per_degree": units_per_degree}
    return GrblAxis("turntable", controller, GrblSettings(kind="grbl", port=controller.port, **options))


def table_of(port, **options):
    return ComXimTurntable("turntable", ComXimSettings(kind="comxim", port=str(port), **options))


def dome_of(port, count, **options):
    return BracketDome("dome", DomeSettings(kind="dome", port=str(port), count=count, **options))


@pytest.mark.parametrize("restarts", [True, False])
def test_an_axis_of_grbl_is_homed_and_turned(port, restarts):
    with SimulatedGrbl(port, restarts_when_opened=restarts) as device:
        controller = Grbl("controller", str(port))
        axis = axis_of(controller, home_deg=10.0)
        with refused(DeviceError, by="move_to"):
            axis.move_to(20.0)
        axis.home()
        axis.move_to(100.0)
        assert device.position["X"] == pytest.approx(-1.0 - 90.0)
        with refused(DeviceError, "0", "360", "400"):
            axis.move_to(400.0)
        axis.close()
        axis.close()
        with refused(DeviceError, by="move_to"):
            axis.move_to(20.0)


def test_a_move_returns_when_the_axis_stands(port):
    with SimulatedGrbl(port, speed=300.0) as device:
        axis = axis_of(Grbl("controller", str(port)))
        axis.home()
        start = time.monotonic()
        axis.move_to(90.0)
        assert time.monotonic() - start >= 0.3
        assert device.position["X"] == -91.0


def test_two_axes_share_a_controller_and_are_homed_once(port):
    with SimulatedGrbl(port) as device:
        controller = Grbl("controller", str(port))
        first, second = axis_of(controller), axis_of(controller, "Y", -2.0, range_deg=(-5.0, 90.0))
        first.home()
        second.home()
        second.move_to(45.0)
        first.move_to(30.0)
        assert device.received.count("$H") == 1
        assert (device.position["X"], device.position["Y"]) == (-31.0, -91.0)


def test_a_soft_limit_is_explained_and_the_axis_can_be_homed_again(port):
    with SimulatedGrbl(port, travel=200.0) as device:
        axis = axis_of(Grbl("controller", str(port)))
        axis.home()
        with pytest.raises(DeviceError, match=r"ALARM:2.*range_deg"):
            axis.move_to(300.0)
        with refused(DeviceError, by="move_to"):
            axis.move_to(10.0)
        axis.home()
        axis.move_to(10.0)
        assert device.position["X"] == -11.0


def test_a_missing_switch_is_explained(port):
    with SimulatedGrbl(port) as device:
        device.switch_works = False
        axis = axis_of(Grbl("controller", str(port)))
        with refused(DeviceError, "$H", "ALARM:9"):
            axis.home()
        device.switch_works = True
        axis.home()


def test_an_open_door_is_explained(port):
    with SimulatedGrbl(port) as device:
        axis = axis_of(Grbl("controller", str(port)))
        axis.home()
        device.door_open = True
        with refused(DeviceError, "'?'"):
            axis.move_to(10.0)


def test_an_axis_that_the_controller_has_not_is_refused(port):
    with SimulatedGrbl(port):
        with refused(DeviceError, by="home"):
            axis_of(Grbl("controller", str(port)), "A").home()


@pytest.mark.parametrize("fault", DESTRUCTIVE)
def test_no_fault_leaves_grbl_with_a_position_that_it_may_not_have(port, fault):
    with SimulatedGrbl(port) as device:
        axis = axis_of(Grbl("controller", str(port)))
        axis.home()
        device.faults.append(fault)
        with pytest.raises(DeviceLost, match=r"controller.*'G53 G0 X-91.000'.*Remedy"):
            axis.move_to(90.0)
        with pytest.raises(DeviceError):
            axis.move_to(10.0)
        axis.close()
        device.plug()
        again = axis_of(Grbl("controller", str(port)))
        again.home()
        again.move_to(90.0)
        assert device.position["X"] == -91.0


@pytest.mark.parametrize("fault", ["halves", "noise"])
def test_cut_and_noisy_answers_of_grbl_are_understood(port, fault):
    with SimulatedGrbl(port) as device:
        axis = axis_of(Grbl("controller", str(port)))
        axis.home()
        device.faults.extend([fault] * 3)
        axis.move_to(90.0)
        assert device.position["X"] == -91.0


def test_a_restart_between_two_moves_of_grbl_is_noticed(port):
    with SimulatedGrbl(port) as device:
        axis = axis_of(Grbl("controller", str(port)))
        axis.home()
        axis.move_to(20.0)
        device.restart()
        time.sleep(0.05)
        with pytest.raises(DeviceLost, match="restarted"):
            axis.move_to(30.0)
        with refused(DeviceError, by="move_to"):
            axis.move_to(30.0)


def test_a_line_where_nothing_answers_is_not_taken_for_grbl(port):
    with SimulatedDialogue(port, {}):
        with refused(DeviceLost, by="_restart"):
            Grbl("controller", str(port))


class InchesGrbl(SimulatedGrbl):
    """A controller with $13=1: its status reports are in inches, commands are in millimetres."""

    def _status(self):
        state, _, rest = super()._status().split("|")
        return f"{state}|MPos:{','.join(f'{value / 25.4:.4f}' for value in self.position.values())}|{rest}"


class GarbledGrbl(SimulatedGrbl):
    """A controller whose line doubles a point."""

    def _status(self):
        return super()._status().replace(".", "..", 1)


class OldGrbl(SimulatedGrbl):
    """A controller with GRBL 0.9: commas divide its status reports."""

    def greet(self):
        return ["", "Grbl 0.9j ['$' for help]", *super().greet()[2:]]

    def _status(self):
        return super()._status().replace("|", ",")


@pytest.mark.parametrize(
    ("kind", "setting"), [(InchesGrbl, r"\$13=0"), (OldGrbl, r"GRBL 1\.1"), (GarbledGrbl, r"\$10=1")]
)
def test_a_controller_that_reports_in_another_way_is_refused_at_once(port, kind, setting):
    def turn():
        axis = axis_of(Grbl("controller", str(port)))
        axis.home()
        axis.move_to(10.0)

    start = time.monotonic()
    with kind(port):
        with pytest.raises(DeviceError, match=setting) as told:
            turn()
    assert not isinstance(told.value, DeviceLost)  # which would be tried again
    assert time.monotonic() - start < 5.0


# ComXim


@settings(max_examples=8, deadline=None)
@given(angles=st.lists(st.floats(-720, 720), min_size=1, max_size=5))
def test_a_comxim_turntable_stands_where_it_was_sent(tmp_path_factory, angles):
    path = tmp_path_factory.mktemp("line") / "port"
    with SimulatedComXim(path, speed=1e6) as device:
        table = table_of(path, reference="table")
        table.home()
        for angle in angles:
            table.move_to(angle)
            assert abs((device.angle - angle + 180) % 360 - 180) <= 0.006  # half of a hundredth, and rounding
        table.close()


def test_the_zero_of_a_comxim_table_needs_a_person_unless_the_table_keeps_it(port, monkeypatch):
    with SimulatedComXim(port) as device:
        table = table_of(port)
        with refused(DeviceError, by="move_to"):
            table.move_to(10.0)
        with refused(DeviceError, by="home"):
            table.home()
        device.angle = 33.0
        monkeypatch.setattr(lines, "ask_operator", lambda name, request: None)
        table.home()
        assert device.zero == 33.0
        table.move_to(20.0)
        assert device.angle == 53.0


def test_a_comxim_table_with_the_other_spelling_is_explained(port):
    with SimulatedComXim(port, command="TURNSINGLE"):
        table = table_of(port, reference="table")
        with pytest.raises(DeviceError, match=r"CR\+ERR=12.*command: TURNSINGLE"):
            table.home()
        table.close()
        table = table_of(port, command="TURNSINGLE", reference="table")
        table.home()


@pytest.mark.parametrize("fault", [fault for fault in DESTRUCTIVE if fault != "restart"])
def test_no_fault_leaves_a_comxim_table_with_a_position(port, fault):
    with SimulatedComXim(port) as device:
        table = table_of(port, reference="table")
        table.home()
        device.faults.append(fault)
        with pytest.raises(DeviceLost, match=r"turntable.*CT\+TRUNSINGLE\(0,90\).*Remedy"):
            table.move_to(90.0)
        with refused(DeviceError, by="move_to"):
            table.move_to(90.0)


# Domes


def test_a_dome_lights_one_lamp_alone(port):
    with SimulatedDome(port, 16) as device:
        lamps = dome_of(port, 16, settle_s=0.0)
        assert device.lit == set()  # not all, as after the start
        for lamp in (1, 16, 3):
            lamps.light(lamp)
            assert device.lit == {lamp - 1}
        with pytest.raises(DeviceError, match="from 1 to 16, found 17"):
            lamps.light(17)
        lamps.light(None)
        assert device.lit == set()
        lamps.light(2)
        lamps.close()
        lamps.close()
        assert device.lit == set()


def test_a_dome_releases_the_camera_on_its_cable(port):
    seen = []
    with SimulatedDome(port, 4, seen.append) as device:
        lamps = dome_of(port, 4, settle_s=0.0)
        lamps.light(2)
        lamps.release()
        device.dead = {2}
        lamps.light(3)
        lamps.release()
        assert seen == [{1}, set()]


def test_the_light_is_steady_when_the_call_returns(port):
    with SimulatedDome(port, 4):
        lamps = dome_of(port, 4, settle_s=0.2)
        start = time.monotonic()
        lamps.light(1)
        assert time.monotonic() - start >= 0.2


@pytest.mark.parametrize("fault", DESTRUCTIVE)
def test_a_dome_that_fails_is_lost_and_can_be_opened_again(port, fault):
    with FaultyDome(port, 8) as device:
        lamps = dome_of(port, 8, settle_s=0.0)
        device.faults.append(fault)
        with pytest.raises(DeviceLost, match=r"dome.*'<3,4>'.*Remedy"):
            lamps.light(5)
        lamps.close()
        device.plug()
        again = dome_of(port, 8, settle_s=0.0)
        again.light(5)
        assert device.lit == {4}


def test_a_dome_with_other_commands_is_explained(port):
    with SimulatedDialogue(port, {}) as device:
        device.ends = lambda text: text.endswith(">")
        device.answers = {"<0>": "<INCORRECT FUNCTION CALL: 0>"}
        with refused(DeviceError, "<0>"):
            dome_of(port, 8)


# Home-made devices


def test_a_home_made_polariser_is_set(port):
    answers = {"A90": "at 90", "A0": "at 0"}
    states = {"off": {"send": "A0", "expect": "at 0"}, "on": {"send": "A90", "expect": "at 90", "timeout_s": 0.2}}
    described = parse(DescribedPolariser, {"port": str(port), "greeting": "servo", "states": states}, "servo.yaml")
    with SimulatedDialogue(port, answers, greeting="servo ready") as device:
        polariser = HomeMadePolariser("polariser", described)
        polariser.set("on")
        polariser.set("off")
        assert device.received == ["A90", "A0"]
        with refused(DeviceError, "45", by="expect_state"):
            polariser.set("45")
        device.answers = {"A90": "ERROR: servo blocked"}
        with refused(DeviceError, "A90"):
            polariser.set("on")
        device.faults.append("silence")
        with refused(DeviceLost, "0.2"):
            polariser.set("on")
        device.restart()
        time.sleep(0.05)
        with pytest.raises(DeviceLost, match="restarted"):
            polariser.set("on")
        polariser.close()


def test_home_made_lamps_are_lit_by_their_own_numbers(port):
    exchanges = {"light": {"send": "L{lamp:02d}", "expect": "ok"}, "dark": {"send": "D", "expect": "ok"}}
    values = {"port": str(port), "count": 12, "first": 0, "settle_s": 0.0, **exchanges}
    with SimulatedDialogue(port, {"D": "ok", "L00": "ok", "L11": "ok"}) as device:
        lamps = HomeMadeLamps("lamps", parse(DescribedLamps, values, "lamps.yaml"))
        lamps.light(1)
        lamps.light(12)
        lamps.light(None)
        lamps.close()
        assert device.received == ["D", "L00", "L11", "D", "D"]


def test_a_home_made_axis_moves_only_where_its_position_is_known(port):
    move = {"send": "M{degrees:.2f}", "expect": "done", "timeout_s": 0.2}
    values = {"port": str(port), "move": move, "home": {"send": "H", "expect": "homed"}, "range_deg": [0, 90]}
    with SimulatedDialogue(port, {"H": "homed", "M45.00": "done"}) as device:
        axis = HomeMadeAxis("arm", parse(DescribedAxis, values, "arm.yaml"))
        with refused(DeviceError, by="move_to"):
            axis.move_to(45.0)
        axis.home()
        axis.move_to(45.0)
        with pytest.raises(DeviceError, match="from 0 to 90 degrees"):
            axis.move_to(91.0)
        device.faults.append("partial")
        with pytest.raises(DeviceLost):
            axis.move_to(45.0)
        with refused(DeviceError, by="move_to"):
            axis.move_to(45.0)


@pytest.mark.parametrize(
    ("model", "values", "words"),
    [
        (DescribedAxis, {"port": "x", "move": {"send": "M{angle}", "expect": "ok"}}, "{degrees}"),
        (DescribedAxis, {"port": "x", "move": {"send": "M{degrees", "expect": "ok"}}, "{degrees}"),
        (DescribedAxis, {"port": "x", "move": {"sent": "M", "expect": "ok"}}, "'send'"),
        (DescribedPolariser, {"port": "x", "states": {"half": {"send": "M", "expect": "ok"}}}, "half"),
        (DescribedPolariser, {"port": "x", "states": {"on": {"send": "M"}}}, "states.on.expect"),
    ],
)
def test_mistakes_in_the_description_of_a_device_are_explained(model, values, words):
    with pytest.raises(UserError, match=r"device\.yaml") as raised:
        parse(model, values, "device.yaml")
    assert words in str(raised.value)
