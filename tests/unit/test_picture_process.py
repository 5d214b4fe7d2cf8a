"""The process that decodes pictures: limits, breakdowns, threads, forks; layers and windows of OpenEXR."""

import os
import resource
import signal
import struct
import threading
import zlib

import cv2
import numpy as np
import OpenEXR
import pytest
import tifffile

from nishiki.capture.taking import channel_names
from nishiki.formats import picture_process
from nishiki.formats.images import read_codes, read_header, read_jpeg_bytes
from nishiki.formats.problems import CaptureError

NAMES = ("red", "green", "blue")
CODES = np.random.default_rng(0).integers(0, 255, (20, 30, 3)).astype(np.uint8)


@pytest.fixture
def picture(tmp_path):
    path = tmp_path / "a.png"
    cv2.imwrite(str(path), CODES[..., ::-1])
    np.testing.assert_array_equal(read_codes(path, NAMES), CODES)
    return path


def child():
    """The idle decoding process of this one."""
    return picture_process._idle[-1].process


def test_a_process_is_kept_and_replaced_when_it_dies(picture):
    first = child()
    read_codes(picture, NAMES)
    assert child() is first
    os.kill(first.pid, signal.SIGKILL)
    with pytest.raises(CaptureError) as caught:
        read_header(picture)
    assert caught.value.problems[0].kind == "image-truncated"
    np.testing.assert_array_equal(read_codes(picture, NAMES), CODES)
    assert child() is not first


@pytest.fixture
def fresh_decoder(monkeypatch):
    """No decoding process of an earlier test, whose peak of memory includes its pictures."""
    monkeypatch.setattr(picture_process, "_idle", [])
    yield
    picture_process.end_children()


@pytest.mark.slow
def test_a_strip_that_unpacks_to_a_gigabyte_is_refused_in_bounded_memory(tmp_path, fresh_decoder):
    """tifffile alone held it all: the file has a megabyte and claims 20 x 30 pixels."""
    path = tmp_path / "bomb.tif"
    packer = zlib.compressobj(9)
    strip = b"".join([packer.compress(bytes(1 << 24)) for _ in range(64)]) + packer.flush()
    tifffile.imwrite(path, np.zeros((20, 30), np.uint8), photometric="minisblack", compression="zlib", rowsperstrip=20)
    content = bytearray(path.read_bytes())
    with tifffile.TiffFile(path) as tiff:
        offsets, counts = (tiff.pages.first.tags[code].valueoffset for code in (273, 279))
    struct.pack_into("<I", content, offsets, len(content))
    struct.pack_into("<I", content, counts, len(strip))
    path.write_bytes(bytes(content) + strip)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(CaptureError) as caught:
        read_codes(path, ("grey",))
    assert caught.value.problems[0].kind in ("image-absurd", "image-truncated")
    with open(f"/proc/{child().pid}/status") as status:
        peak = next(int(line.split()[1]) for line in status if line.startswith("VmHWM"))
    assert peak < 200 << 10  # KiB
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 100 << 10


def test_a_decoder_that_does_not_end_is_ended(picture, monkeypatch):
    monkeypatch.setattr(picture_process, "_idle", [])
    monkeypatch.setattr(picture_process, "_START", "while True: pass")
    monkeypatch.setattr(picture_process.subprocess, "Popen", limited(picture_process.subprocess.Popen))
    with pytest.raises(CaptureError) as caught:
        read_header(picture)
    assert caught.value.problems[0].kind == "image-absurd"


def limited(start):
    """A process of one second."""
    return lambda *words, **options: start(
        *words, preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_CPU, (1, 2)), **options
    )


def test_threads_read_at_the_same_time(picture):
    results = []
    threads = [threading.Thread(target=lambda: results.append(read_codes(picture, NAMES))) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(results) == 4
    assert all(np.array_equal(codes, CODES) for codes in results)


def test_a_fork_has_processes_of_its_own(picture):
    mine = child().pid
    reading, writing = os.pipe()
    pid = os.fork()
    if pid == 0:
        try:
            good = not picture_process._idle and np.array_equal(read_codes(picture, NAMES), CODES)
            os.write(writing, b"1" if good and child().pid != mine else b"0")
        finally:
            os._exit(0)
    os.waitpid(pid, 0)
    assert os.read(reading, 1) == b"1"
    np.testing.assert_array_equal(read_codes(picture, NAMES), CODES)


def test_pictures_in_memory_are_read_too():
    content = cv2.imencode(".jpg", CODES[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 100])[1].tobytes()
    read = read_jpeg_bytes(content, "tile")
    np.testing.assert_array_equal(read, cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR)[..., ::-1])
    with pytest.raises(CaptureError):
        read_jpeg_bytes(content[:-40], "tile")


PLANES = np.random.default_rng(1).random((8, 8, 10)).astype(np.float32)


def exr(path, *parts, **attributes):
    """An EXR of parts, each a dict of channel to the number of its plane."""
    made = []
    for number, channels in enumerate(parts):
        header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, **attributes}
        header |= {"name": channels.pop("name", f"part {number}")} if len(parts) > 1 else {}
        made.append(OpenEXR.Part(header, {name: PLANES[plane] for name, plane in channels.items()}))
    OpenEXR.File(made).write(str(path))
    return path


COMBINED = {f"ViewLayer.Combined.{name}": k for k, name in enumerate("RGBA")}
DIFFUSE = {f"ViewLayer.Diffuse.{name}": k + 4 for k, name in enumerate("RGB")}


@pytest.mark.parametrize(
    ("parts", "planes"),
    [
        ([{"R": 0, "G": 1, "B": 2, "A": 3, "Z": 4}], (0, 1, 2)),
        ([{**COMBINED, "ViewLayer.Depth.Z": 4}], (0, 1, 2)),
        ([{**DIFFUSE, **COMBINED}], (0, 1, 2)),
        ([{**DIFFUSE, "R": 3, "G": 0, "B": 1}], (3, 0, 1)),
        ([{"name": "depth", "Z": 7}, {"name": "rgba", "R": 2, "G": 1, "B": 0, "A": 3}], (2, 1, 0)),
    ],
)
def test_the_layer_of_the_whole_light_is_taken(tmp_path, parts, planes):
    header = read_header(exr(tmp_path / "a.exr", *map(dict, parts)))
    assert channel_names(header) == NAMES
    np.testing.assert_array_equal(read_codes(tmp_path / "a.exr", NAMES), np.moveaxis(PLANES[list(planes)], 0, 2))


def test_several_layers_are_chosen_by_name(tmp_path):
    other = {name.replace("Diffuse", "Glossy"): plane - 4 for name, plane in DIFFUSE.items()}
    path = exr(tmp_path / "a.exr", {**DIFFUSE, **other})
    with pytest.raises(CaptureError) as caught:
        channel_names(read_header(path))
    assert caught.value.problems[0].kind == "layers-several"
    np.testing.assert_array_equal(read_codes(path, tuple(DIFFUSE)), np.moveaxis(PLANES[4:7], 0, 2))
    with pytest.raises(CaptureError) as caught:
        read_codes(path, NAMES)
    assert caught.value.problems[0].kind == "channels-differ"


def test_data_windows_lie_in_the_display_window(tmp_path):
    whole = np.zeros((12, 16, 3), np.float32)
    whole[1:9, 2:12] = np.moveaxis(PLANES[:3], 0, 2)
    corner = np.array
    windows = {"displayWindow": (corner([0, 0], "i4"), corner([15, 11], "i4"))}
    windows["dataWindow"] = (corner([2, 1], "i4"), corner([11, 8], "i4"))
    exr(tmp_path / "a.exr", {"R": 0, "G": 1, "B": 2}, **windows)
    np.testing.assert_array_equal(read_codes(tmp_path / "a.exr", NAMES), whole)
    windows["displayWindow"] = (corner([4, 3], "i4"), corner([9, 6], "i4"))  # data beyond what is shown
    exr(tmp_path / "b.exr", {"R": 0, "G": 1, "B": 2}, **windows)
    np.testing.assert_array_equal(read_codes(tmp_path / "b.exr", NAMES), whole[3:7, 4:10])
