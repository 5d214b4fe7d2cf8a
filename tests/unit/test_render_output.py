"""Files: what other readers see in them, and that the same values give the same bytes."""

import errno
import struct
import sys
import zlib

import cv2
import numpy as np
import pytest
from PIL import Image
from refusals import refused

from nishiki.colour.colour import illuminant, white_xyz
from nishiki.errors import UserError
from nishiki.render.display import (
    display_image,
    normals_as_colours,
    write_animated_png,
    write_exr,
    write_normals_exr,
    write_normals_png,
    write_png,
    write_video,
)

STAMP = {"scene": "test", "stage": "render", "key": "0123456789ab", "version": "0.1.0"}


def picture(rows=21, columns=34):
    return np.random.default_rng(0).uniform(0, 1, (rows, columns, 3)).astype(np.float32)


def read_exr(path):
    import OpenEXR

    with OpenEXR.File(str(path), separate_channels=True) as file:
        return dict(file.header()), {name: np.array(c.pixels) for name, c in file.channels().items()}


def png_chunks(path):
    content, at, chunks = path.read_bytes(), 8, []
    while at < len(content):
        size = struct.unpack(">I", content[at : at + 4])[0]
        kind, body = content[at + 4 : at + 8], content[at + 8 : at + 8 + size]
        assert struct.unpack(">I", content[at + 8 + size : at + 12 + size])[0] == zlib.crc32(kind + body)
        chunks.append((kind, body))
        at += 12 + size
    return chunks


def test_a_full_disk_is_told_by_the_system_s_reason(tmp_path, monkeypatch):
    monkeypatch.setattr("nishiki.render.display._temporary_path", lambda path: "/dev/full")
    with pytest.raises(OSError) as told:
        write_exr(tmp_path / "x.exr", picture(), stamp={})
    assert told.value.errno == errno.ENOSPC


def test_exr_round_trip_header_and_bytes(tmp_path):
    xyz = picture()
    for name in ("a.exr", "b.exr"):
        write_exr(tmp_path / name, xyz, stamp=STAMP, coverage=xyz[..., 0])
    assert (tmp_path / "a.exr").read_bytes() == (tmp_path / "b.exr").read_bytes()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.exr", "b.exr"]
    header, channels = read_exr(tmp_path / "a.exr")
    np.testing.assert_array_equal(np.stack([channels[c] for c in "RGB"], -1), xyz)
    np.testing.assert_array_equal(channels["A"], xyz[..., 0])
    np.testing.assert_allclose(header["chromaticities"], (1, 0, 0, 1, 0, 0, 1 / 3, 1 / 3), rtol=1e-6)
    assert header["whiteLuminance"] == 100
    assert {k: header[f"nishiki.{k}"] for k in STAMP} == STAMP


def test_exr_in_srgb_primaries(tmp_path):
    linear = np.full((4, 5, 3), 0.7, np.float32)
    write_exr(tmp_path / "a.exr", linear, stamp=STAMP, colours="srgb")
    header, channels = read_exr(tmp_path / "a.exr")
    assert channels["G"].dtype == np.float32
    assert header["chromaticities"][0] == pytest.approx(0.64)
    for c in "RGB":
        np.testing.assert_array_equal(channels[c], np.float32(0.7))
    with refused(UserError, "lab"):
        write_exr(tmp_path / "b.exr", linear, stamp=STAMP, colours="lab")


def test_normals_exr(tmp_path):
    normals = np.zeros((3, 4, 3), np.float32) + np.float32([0.6, 0, 0.8])
    write_normals_exr(tmp_path / "n.exr", normals, stamp=STAMP)
    np.testing.assert_array_equal(read_exr(tmp_path / "n.exr")[1]["N.X"], normals[..., 0])


def test_png_chunks_and_pixels(tmp_path):
    pixels = (picture() * 255).astype(np.uint8)
    for name in ("a.png", "b.png"):
        write_png(tmp_path / name, pixels, stamp=STAMP | {"place": "奈良"})
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()
    chunks = png_chunks(tmp_path / "a.png")
    kinds = [kind for kind, _ in chunks]
    assert kinds[0] == b"IHDR"
    assert kinds[-1] == b"IEND"
    assert kinds.index(b"sRGB") < kinds.index(b"IDAT")
    assert (b"tEXt", b"nishiki.key\x000123456789ab") in chunks
    assert any(kind == b"iTXt" and body.endswith("奈良".encode()) for kind, body in chunks)
    np.testing.assert_array_equal(cv2.imread(str(tmp_path / "a.png"))[..., ::-1], pixels)
    with pytest.raises(UserError, match="uint8 or uint16"):
        write_png(tmp_path / "c.png", picture(), stamp=STAMP)


def test_normals_png_is_opengl(tmp_path):
    normals = np.zeros((2, 3, 3), np.float32)
    normals[0, :] = [[0, 0, 1], [1, 0, 0], [0, 1, 0]]
    normals[1] = [[-1, 0, 0], [0, 0, 0], [np.nan, 0, 1]]
    write_normals_png(tmp_path / "n.png", normals, stamp=STAMP)
    read = cv2.imread(str(tmp_path / "n.png"), cv2.IMREAD_UNCHANGED)[..., ::-1]
    assert read.dtype == np.uint16
    np.testing.assert_array_equal(read, normals_as_colours(normals))
    assert read[0].tolist() == [[32768, 32768, 65535], [65535, 32768, 32768], [32768, 65535, 32768]]
    assert read[1].tolist() == [[0, 32768, 32768], [0, 0, 0], [0, 0, 0]]
    assert b"sRGB" not in [kind for kind, _ in png_chunks(tmp_path / "n.png")]


def test_white_is_255_under_every_lamp_and_clipping_is_counted():
    for name in ("A", "D65", "FL11"):
        white = white_xyz(illuminant(name))
        xyz = np.broadcast_to(white, (2, 5, 3)).astype(np.float32)
        shown = display_image(xyz, white=white)
        assert np.all(shown.pixels == 255)
        assert shown.clipped_high == 0
    as_measured = display_image(np.broadcast_to(white_xyz(illuminant("A")), (1, 1, 3)))
    assert as_measured.pixels[0, 0, 0] == 255
    assert as_measured.pixels[0, 0, 2] < 200
    assert as_measured.clipped_high == 1
    xyz = np.zeros((2, 2, 3), np.float32)
    xyz[0, 0] = 2 * white
    xyz[1, 1] = [0, 0.1, 0]
    shown = display_image(xyz, white=white)
    assert shown.clipped_high == 0.25
    assert shown.clipped_low == 0.25
    assert display_image(xyz, white=white, exposure=0.4).clipped_high == 0
    with pytest.raises(UserError, match="exposure"):
        display_image(xyz, exposure=0)


def frames(count=6, rows=45, columns=63):
    y, x = np.mgrid[:rows, :columns]
    for k in range(count):
        yield np.stack([(x * 4) % 256, (y * 5) % 256, np.full_like(x, 40 * k)], -1).astype(np.uint8)


def test_video_decodes_to_the_frames(tmp_path):
    av = pytest.importorskip("av", reason="the extra `video` is not installed")
    held, contents = [], set()
    for k in range(6):
        written = write_video(tmp_path / "a.mp4", frames(), stamp=STAMP, quality=4)
        assert written.frames == 6
        assert not written.note
        contents.add((tmp_path / "a.mp4").read_bytes())
        held.append(np.ones(1000 + 777 * k))  # other places in memory
    assert len(contents) == 1
    with av.open(str(tmp_path / "a.mp4")) as container:
        assert "nishiki.key=0123456789ab" in container.metadata["comment"]
        decoded = list(container.decode(video=0))
    assert len(decoded) == 6
    for frame, original in zip(decoded, frames(), strict=True):
        planes = frame.to_ndarray()[:46, :64].astype(float)
        luma = (planes[:45, :63] - 16) / 219 * 255
        expected = original @ np.array([0.2126, 0.7152, 0.0722])
        assert np.abs(luma - expected).mean() < 2
    with refused(UserError, "c.mp4"):
        write_video(tmp_path / "c.mp4", [], stamp=STAMP)
    with pytest.raises(UserError, match="frame 1"):
        write_video(tmp_path / "c.mp4", [next(frames()), np.zeros((3, 3, 3), np.uint8)], stamp=STAMP)


def test_without_the_encoder_an_animated_png_and_the_reason(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "av", None)
    written = write_video(tmp_path / "film.mp4", frames(), stamp=STAMP, frames_per_second=10)
    assert written.path == tmp_path / "film.png"
    assert "video" in written.note
    assert written.frames == 6
    with Image.open(written.path) as read:
        assert read.n_frames == 6
        assert read.info["loop"] == 0
        assert read.text["nishiki.scene"] == "test"
        for k, original in enumerate(frames()):
            read.seek(k)
            assert read.info["duration"] == 100
            np.testing.assert_array_equal(np.asarray(read.convert("RGB")), original)
    with refused(UserError, "x.png"):
        write_animated_png(tmp_path / "x.png", [], stamp=STAMP)
