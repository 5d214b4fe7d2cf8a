"""Cameras of a rig: libgphoto2 with its virtual camera, and a folder that another program fills."""

import os
import subprocess
import sys
import threading
import time
from pathlib import Path

import cv2
import numpy as np
import pytest
from refusals import refused
from simulated_devices import CAPACITY, VirtualCamera

from nishiki.rig.cameras import FolderSettings, WatchedFolder, number_of, run_command
from nishiki.rig.device import DeviceError, DeviceLost, Exposure

SOURCE = Path(__file__).resolve().parents[2] / "workflow" / "src"


def jpeg(value):
    return cv2.imencode(".jpg", np.full((12, 16, 3), value, np.uint8))[1].tobytes()


# libgphoto2


def run_with_camera(folder, code):
    """Run a script in a process that has a virtual camera; its output as lines."""
    environment = os.environ | {"VCAMERADIR": str(folder), "PYTHONPATH": str(SOURCE)}
    start = "from pathlib import Path\nfrom nishiki.rig.cameras import *\nfrom nishiki.rig.device import *\n"
    done = subprocess.run(
        [sys.executable, "-c", start + code], env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


@pytest.fixture
def virtual(tmp_path):
    (tmp_path / "photographs").mkdir()
    return VirtualCamera(tmp_path / "camera", jpeg(0))


def test_photographs_of_the_virtual_camera_are_those_before_its_lens(virtual, tmp_path):
    (tmp_path / "a.jpg").write_bytes(jpeg(80).ljust(CAPACITY, b"\0"))
    (tmp_path / "b.jpg").write_bytes(jpeg(160).ljust(CAPACITY, b"\0"))
    code = f"""
import shutil
camera = GPhotoCamera("camera", GPhotoSettings(kind="gphoto", settings={{"capturetarget": "Memory card"}}))
print(camera.configure(Exposure(seconds=0.02, aperture=8.0)))
for name in "ab":
    shutil.copyfile(f"{tmp_path}/{{name}}.jpg", "{virtual.picture}")
    paths = camera.photograph(Path("{tmp_path}/photographs"))
    print(len(paths), paths[0].name, paths[0].read_bytes() == Path(f"{tmp_path}/{{name}}.jpg").read_bytes())
camera.close()
camera.close()
again = GPhotoCamera("camera", GPhotoSettings(kind="gphoto", model="Nikon DSC D750"))
print(len(again.photograph(Path("{tmp_path}/photographs"))))
"""
    lines = run_with_camera(tmp_path / "camera", code)
    assert lines[0] == "Exposure(seconds=0.02, aperture=8.0, iso=None)"
    assert [line.split()[0] for line in lines[1:3]] == ["1", "1"]
    assert all(line.endswith("True") for line in lines[1:3])
    assert lines[1] != lines[2]  # names of their own
    assert lines[3] == "1"


def test_what_the_camera_cannot_do_is_explained(virtual, tmp_path):
    code = """
def tell(call):
    try:
        print("no error", call())
    except DeviceError as error:
        print(type(error).__name__, error)

camera = GPhotoCamera("camera", GPhotoSettings(kind="gphoto"))
tell(lambda: camera.configure(Exposure(iso=100)))
tell(lambda: camera.configure(Exposure(seconds=30.0)))
tell(lambda: camera.configure(Exposure(seconds=0.018)).seconds)
camera.close()
tell(lambda: GPhotoCamera("camera", GPhotoSettings(kind="gphoto", settings={"whitebalance": "Daylight"})))
tell(lambda: GPhotoCamera("camera", GPhotoSettings(kind="gphoto", settings={"capturetarget": "Nowhere"})))
tell(lambda: GPhotoCamera("camera", GPhotoSettings(kind="gphoto", model="Canon EOS R5")))
"""
    lines = run_with_camera(tmp_path / "camera", code)
    expected = [
        ("DeviceError", "iso cannot be set from here", "leave it out of the plan"),
        ("DeviceError", "one of its steps of seconds, found 30", "1.0000s"),
        ("no error", "0.02"),
        ("DeviceError", "no setting 'whitebalance'", "shutterspeed"),
        ("DeviceError", "cannot be 'Nowhere'", "Internal RAM"),
        ("DeviceLost", "expected Canon EOS R5 on USB, found none", "wake it up"),
    ]
    assert len(lines) == len(expected)
    for line, words in zip(lines, expected, strict=True):
        assert not [text for text in words if text not in line], line


def test_errors_of_libgphoto2_say_whether_the_camera_can_come_back(virtual, tmp_path):
    code = """
import gphoto2

class Sleeping:
    def __init__(self, code):
        self.code = code

    def capture(self, kind):
        raise gphoto2.GPhoto2Error(self.code)

class Interrupted:
    def __init__(self, camera):
        self.capture, self.wait_for_event = camera.capture, camera.wait_for_event

    def file_get(self, *place):
        raise gphoto2.GPhoto2Error(-1)

camera = GPhotoCamera("camera", GPhotoSettings(kind="gphoto"))
real = camera.camera
for code in (-7, -10, -52, -53, -1):
    camera.camera = Sleeping(code)
    try:
        camera.photograph(Path("."))
    except DeviceError as error:
        print(type(error).__name__, error)
camera.camera = Interrupted(real)
try:
    camera.photograph(Path("."))
except DeviceError as error:
    print(type(error).__name__, error)
"""
    lines = run_with_camera(tmp_path / "camera", code)
    kinds = ["DeviceLost"] * 3 + ["DeviceError", "DeviceError", "DeviceLost"]
    assert [line.split()[0] for line in lines] == kinds
    assert "focus" in lines[4]
    assert all("Remedy" in line for line in lines)


@pytest.mark.parametrize(
    ("text", "number"),
    [
        ("1/60", 1 / 60),
        ("0.0100s", 0.01),
        ("2.5", 2.5),
        ("0,5", 0.5),
        ('30"', 30),
        ("f/5.6", 5.6),
        ("F8", 8),
        ("400", 400),
        ("10/10", 1),
        ("Auto", None),
        ("bulb", None),
        ("0", None),
        ("1/0", None),
        ("--", None),
    ],
)
def test_settings_are_read_in_the_words_of_every_maker(text, number):
    assert number_of(text) == (None if number is None else pytest.approx(number))


# A watched folder


@pytest.fixture
def folders(tmp_path):
    (tmp_path / "camera").mkdir()
    (tmp_path / "photographs").mkdir()
    return tmp_path / "camera", tmp_path / "photographs"


def later(seconds, action, *values):
    threading.Timer(seconds, action, values).start()


def write_slowly(path, data):
    """As software does that saves over a network."""
    with path.open("wb") as file:
        for start in range(0, len(data), 100):
            file.write(data[start : start + 100])
            file.flush()
            time.sleep(0.03)


def watch(folder, release, **options):
    options = {"wait_s": 2.0, "complete_s": 0.15, **options}
    return WatchedFolder("camera", folder, FolderSettings(kind="folder", folder=str(folder), **options), release)


def test_a_photograph_is_taken_once_it_is_complete(folders):
    source, target = folders
    data = bytes(range(256)) * 4
    camera = watch(source, lambda: later(0.05, write_slowly, source / "DSC_0001.NEF", data))
    (path,) = camera.photograph(target)
    assert path == target / "DSC_0001.NEF"
    assert path.read_bytes() == data
    assert (source / "DSC_0001.NEF").is_file()


def test_files_that_are_being_written_are_not_taken(folders):
    source, target = folders

    def release():
        (source / "DSC_0001.jpg.tmp").write_bytes(b"half")
        (source / ".DSC_0001.jpg").write_bytes(b"half")
        later(0.4, (source / "DSC_0001.jpg.tmp").rename, source / "DSC_0001.jpg")

    (path,) = watch(source, release).photograph(target)
    assert path.name == "DSC_0001.jpg"


def test_raw_and_jpeg_belong_to_one_exposure(folders):
    source, target = folders

    def release():
        (source / "DSC_0001.JPG").write_bytes(b"jpeg")
        later(0.4, (source / "DSC_0001.NEF").write_bytes, b"raw")

    paths = watch(source, release, files=2).photograph(target)
    assert [path.name for path in paths] == ["DSC_0001.JPG", "DSC_0001.NEF"]


def test_files_that_were_there_are_left_alone(folders):
    source, target = folders
    (source / "DSC_0000.jpg").write_bytes(b"old")
    (path,) = watch(source, lambda: (source / "DSC_0001.jpg").write_bytes(b"new")).photograph(target)
    assert path.read_bytes() == b"new"


def test_a_photograph_that_nobody_asked_for_is_refused(folders):
    source, target = folders
    camera = watch(source, lambda: (source / "DSC_0002.jpg").write_bytes(b"asked"))
    (source / "DSC_0001.jpg").write_bytes(b"by accident")
    with refused(DeviceError, "DSC_0001.jpg") as raised:
        camera.photograph(target)
    assert not isinstance(raised.value, DeviceLost)
    assert not list(target.iterdir())


def test_more_files_than_an_exposure_has_are_refused(folders):
    source, target = folders

    def release():
        (source / "DSC_0001.JPG").write_bytes(b"jpeg")
        (source / "DSC_0001.NEF").write_bytes(b"raw")

    with pytest.raises(DeviceError, match=r"expected 1 file.*DSC_0001\.JPG, DSC_0001\.NEF.*Remedy"):
        watch(source, release).photograph(target)


def test_a_photograph_that_does_not_come_is_waited_for_no_longer_than_said(folders):
    source, target = folders
    camera = watch(source, lambda: None, wait_s=0.2, complete_s=0.05)
    with refused(DeviceLost, 1, "0.2"):
        camera.photograph(target)
    camera = watch(source, (source / "empty.jpg").touch, wait_s=0.2, complete_s=0.05)
    with pytest.raises(DeviceLost, match=r"found empty\.jpg \(0 bytes\)"):
        camera.photograph(target)


def test_a_folder_that_is_not_there_can_be_waited_for(tmp_path):
    with refused(DeviceLost, by="_sizes"):
        watch(tmp_path / "nowhere", None)


def test_the_operator_is_asked_to_release(folders, capsys):
    source, target = folders
    camera = watch(source, None)
    later(0.1, (source / "a.jpg").write_bytes, b"light")
    camera.photograph(target)
    assert "camera:" in capsys.readouterr().err


def test_the_exposure_behind_a_folder_is_set_elsewhere(folders):
    camera = watch(folders[0], None)
    assert camera.configure(Exposure()) == Exposure()
    with refused(DeviceError, by="configure"):
        camera.configure(Exposure(seconds=1.0))


def test_a_command_may_release_the_camera(folders):
    source, target = folders
    script = f"open({str(source / 'a.jpg')!r}, 'wb').write(b'light')"
    (path,) = watch(source, run_command("camera", (sys.executable, "-c", script))).photograph(target)
    assert path.read_bytes() == b"light"
    with refused(DeviceError, "3", by="release"):
        run_command("camera", (sys.executable, "-c", "import sys; print('asleep'); sys.exit(3)"))()
    with refused(DeviceError, "no-such-program", "release"):
        run_command("camera", ("no-such-program",))()
