"""Reading photographs: every format, codes unchanged, damage found."""

import struct
import zlib

import cv2
import numpy as np
import OpenEXR
import pytest
from refusals import refused

from nishiki.formats.images import read_codes, read_header
from nishiki.formats.masks import read_labels, read_mask
from nishiki.formats.problems import CaptureError

RGB = ("red", "green", "blue")


def picture(dtype, channels=3, rows=20, columns=30, seed=0):
    return np.random.default_rng(seed).integers(0, np.iinfo(dtype).max + 1, (rows, columns, channels)).astype(dtype)


def bgr(values):
    return values[:, :, ::-1] if values.shape[2] == 3 else values


@pytest.mark.parametrize("suffix", ["png", "tif"])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("channels", [1, 3])
def test_lossless_formats_give_the_codes_in_rgb_order(tmp_path, suffix, dtype, channels):
    values = picture(dtype, channels)
    path = tmp_path / f"a.{suffix}"
    cv2.imwrite(str(path), bgr(values))
    header = read_header(path)
    assert (header.rows, header.columns, header.channels, header.sample) == (20, 30, channels, np.dtype(dtype).name)
    np.testing.assert_array_equal(read_codes(path, RGB[:channels]), values)
    np.testing.assert_array_equal(read_codes(path, RGB[:channels], region=(2, 3, 5, 7)), values[2:7, 3:10])


def test_float_tiff(tmp_path):
    values = np.random.default_rng(0).random((20, 30, 3)).astype(np.float32)
    cv2.imwrite(str(tmp_path / "a.tif"), bgr(values))
    np.testing.assert_array_equal(read_codes(tmp_path / "a.tif", RGB), values)


def test_alpha_is_dropped_where_it_is_not_a_channel(tmp_path):
    values = picture(np.uint8, 4)
    cv2.imwrite(str(tmp_path / "a.png"), cv2.cvtColor(values, cv2.COLOR_RGBA2BGRA))
    np.testing.assert_array_equal(read_codes(tmp_path / "a.png", RGB), values[:, :, :3])
    np.testing.assert_array_equal(read_codes(tmp_path / "a.png", (*RGB, "infrared")), values)


def test_jpeg_ignores_orientation_and_reads_luma(tmp_path):
    smooth = np.add.outer(np.arange(32) * 4, np.arange(48) * 2).astype(np.uint8)
    values = np.stack([smooth, smooth // 2, 255 - smooth], axis=2)
    _, coded = cv2.imencode(".jpg", bgr(values), [cv2.IMWRITE_JPEG_QUALITY, 98])
    exif = (
        b"Exif\0\0MM\0*\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0\x06\0\0\0\0\0\0"  # orientation 6: turn by 90 degrees
    )
    data = coded.tobytes()
    path = tmp_path / "a.jpg"
    path.write_bytes(data[:2] + b"\xff\xe1" + struct.pack(">H", len(exif) + 2) + exif + data[2:])
    read = read_codes(path, RGB)
    assert read.shape == (32, 48, 3)
    assert np.abs(read.astype(int) - values).max() <= 12
    luma = read_codes(path, RGB, luma=True)
    assert luma.shape == (32, 48, 1)
    assert np.abs(luma[..., 0] - values @ np.array([0.299, 0.587, 0.114])).max() <= 3


@pytest.mark.parametrize("half", [True, False])
@pytest.mark.parametrize("names", [("R", "G", "B"), ("blue", "green", "red"), ("R", "G", "B", "A")])
def test_exr_channels_are_matched_by_name(tmp_path, half, names):
    values = np.random.default_rng(0).random((20, 30, len(names))).astype(np.float16 if half else np.float32)
    channels = {name: np.ascontiguousarray(values[..., i]) for i, name in enumerate(names)}
    write_exr(tmp_path / "a.exr", channels)
    read = read_codes(tmp_path / "a.exr", RGB)
    order = [
        next(i for i, n in enumerate(names) if n in wanted) for wanted in (("R", "red"), ("G", "green"), ("B", "blue"))
    ]
    assert read.dtype == np.float32
    np.testing.assert_array_equal(read, values[..., order].astype(np.float32))


def test_exr_of_many_bands(tmp_path):
    values = np.random.default_rng(0).random((6, 9, 8)).astype(np.float32)
    bands = [f"S{400 + 40 * i}nm" for i in range(8)]
    write_exr(tmp_path / "a.exr", {name: np.ascontiguousarray(values[..., i]) for i, name in enumerate(bands)})
    np.testing.assert_array_equal(read_codes(tmp_path / "a.exr", tuple(reversed(bands))), values[..., ::-1])
    np.testing.assert_array_equal(read_codes(tmp_path / "a.exr", tuple(f"band{i}" for i in range(8))), values)
    with pytest.raises(CaptureError) as caught:
        read_codes(tmp_path / "a.exr", RGB)
    assert caught.value.problems[0].kind == "channels-differ"


def write_exr(path, channels):
    with OpenEXR.File({"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}, channels) as file:
        file.write(str(path))


def test_pages_are_channels(tmp_path):
    values = picture(np.uint16, 7)
    cv2.imwritemulti(str(tmp_path / "a.tif"), [values[:, :, k].copy() for k in range(7)])
    assert read_header(tmp_path / "a.tif").channels == 7
    np.testing.assert_array_equal(read_codes(tmp_path / "a.tif", tuple("abcdefg")), values)


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("apart", [False, True])
@pytest.mark.parametrize("deflate", [False, True])
@pytest.mark.parametrize("tile", [0, 16])
def test_tiff_of_many_channels(tmp_path, order, apart, deflate, tile):
    values = picture(np.uint16, 6)
    path = tmp_path / "a.tif"
    path.write_bytes(tiff_bytes(values, order=order, apart=apart, deflate=deflate, tile=tile))
    np.testing.assert_array_equal(read_codes(path, tuple("abcdef")), values)


def test_tiff_with_differences(tmp_path):
    values = picture(np.uint8, 5)
    stored = tiff_bytes(values, differences=True)
    (tmp_path / "a.tif").write_bytes(stored)
    np.testing.assert_array_equal(read_codes(tmp_path / "a.tif", tuple("abcde")), values)


def tiff_bytes(values, *, order="<", apart=False, deflate=False, tile=0, differences=False):
    """An independent TIFF writer: strips of 7 rows, or tiles."""
    rows, columns, channels = values.shape
    stored = values.astype(values.dtype.newbyteorder(order))
    if differences:
        stored = np.diff(values, axis=1, prepend=np.zeros_like(values[:, :1])).astype(stored.dtype)
    height, width = (tile, tile) if tile else (7, columns)
    planes = [stored[:, :, k : k + 1] for k in range(channels)] if apart else [stored]
    pieces = []
    for plane in planes:
        for top in range(0, rows, height):
            for left in range(0, columns, width):
                part = plane[top : top + height, left : left + width]
                if tile:
                    part = np.pad(part, ((0, tile - part.shape[0]), (0, tile - part.shape[1]), (0, 0)))
                raw = np.ascontiguousarray(part).tobytes()
                pieces.append(zlib.compress(raw) if deflate else raw)
    body, offsets = b"", []
    for piece in pieces:
        offsets.append(8 + len(body))
        body += piece
    counts = [len(piece) for piece in pieces]
    bits = [8 * values.itemsize] * channels
    entries = [(256, 4, [columns]), (257, 4, [rows]), (258, 3, bits), (259, 3, [8 if deflate else 1]), (262, 3, [1])]
    entries += [(277, 3, [channels]), (284, 3, [2 if apart else 1]), (317, 3, [2 if differences else 1])]
    places = [(322, 3, [tile]), (323, 3, [tile]), (324, 4, offsets), (325, 4, counts)]
    entries += places if tile else [(273, 4, offsets), (278, 3, [height]), (279, 4, counts)]
    start = 8 + len(body)
    extra_at = start + 2 + 12 * len(entries) + 4
    table, extra = struct.pack(order + "H", len(entries)), b""
    for tag, kind, numbers in sorted(entries):
        data = struct.pack(order + ("H" if kind == 3 else "I") * len(numbers), *numbers)
        if len(data) > 4:
            data, extra = struct.pack(order + "I", extra_at + len(extra)), extra + data
        table += struct.pack(order + "HHI", tag, kind, len(numbers)) + data.ljust(4, b"\0")
    mark = b"II*\0" if order == "<" else b"MM\0*"
    return mark + struct.pack(order + "I", start) + body + table + struct.pack(order + "I", 0) + extra


def dng_bytes(mosaic, *, black=64, white=4095):
    """A minimal uncompressed DNG: RGGB mosaic (rows, columns) uint16."""
    rows, columns = mosaic.shape
    body = mosaic.astype("<u2").tobytes()
    one = struct.pack("<ii", 1, 1)
    zero = struct.pack("<ii", 0, 1)
    matrix = b"".join(one if i % 4 == 0 else zero for i in range(9))
    entries = [
        (254, 4, 1, struct.pack("<I", 0)),
        (256, 4, 1, struct.pack("<I", columns)), (257, 4, 1, struct.pack("<I", rows)),
        (258, 3, 1, struct.pack("<H", 16)), (259, 3, 1, struct.pack("<H", 1)), (262, 3, 1, struct.pack("<H", 32803)),
        (271, 2, 5, b"Test\0"), (272, 2, 5, b"Cam1\0"), (273, 4, 1, struct.pack("<I", 8)),
        (274, 3, 1, struct.pack("<H", 6)), (277, 3, 1, struct.pack("<H", 1)), (278, 4, 1, struct.pack("<I", rows)),
        (279, 4, 1, struct.pack("<I", len(body))), (284, 3, 1, struct.pack("<H", 1)),
        (33421, 3, 2, struct.pack("<HH", 2, 2)), (33422, 1, 4, bytes([0, 1, 1, 2])),
        (50706, 1, 4, bytes([1, 4, 0, 0])), (50707, 1, 4, bytes([1, 1, 0, 0])), (50708, 2, 5, b"Cam1\0"),
        (50714, 4, 1, struct.pack("<I", black)), (50717, 4, 1, struct.pack("<I", white)),
        (50721, 10, 9, matrix), (50778, 3, 1, struct.pack("<H", 21)),
    ]  # fmt: skip
    start = 8 + len(body)
    extra_at = start + 2 + 12 * len(entries) + 4
    table, extra = struct.pack("<H", len(entries)), b""
    for tag, kind, count, data in entries:
        if len(data) > 4:
            data, extra = struct.pack("<I", extra_at + len(extra)), extra + data + b"\0" * (len(data) % 2)
        table += struct.pack("<HHI", tag, kind, count) + data.ljust(4, b"\0")
    return b"II*\0" + struct.pack("<I", start) + body + table + struct.pack("<I", 0) + extra


def test_raw_is_linear_in_the_sensors_codes(tmp_path):
    pytest.importorskip("rawpy")
    mosaic = np.zeros((64, 96), np.uint16)
    levels = {"red": 64 + 1000, "green": 64 + 2000, "blue": 64 + 500}
    mosaic[0::2, 0::2], mosaic[1::2, 1::2] = levels["red"], levels["blue"]
    mosaic[0::2, 1::2] = mosaic[1::2, 0::2] = levels["green"]
    for name, factor in (("a", 1.0), ("b", 0.25)):
        scaled = np.rint(64 + (mosaic - 64.0) * factor).astype(np.uint16)
        (tmp_path / f"{name}.dng").write_bytes(dng_bytes(scaled))
    header = read_header(tmp_path / "a.dng")
    assert (header.rows, header.columns, header.channels, header.sample) == (64, 96, 3, "uint16")
    bright, dim = (read_codes(tmp_path / f"{n}.dng", RGB)[20:40, 20:40].reshape(-1, 3) for n in "ab")
    expected = np.array([1000, 2000, 500]) * 65535 / (4095 - 64)
    np.testing.assert_allclose(bright, np.broadcast_to(expected, bright.shape), rtol=2e-3)
    np.testing.assert_allclose(dim, np.broadcast_to(expected / 4, dim.shape), rtol=5e-3)


def test_raw_that_is_none(tmp_path):
    pytest.importorskip("rawpy")
    (tmp_path / "a.nef").write_bytes(b"no picture at all" * 100)
    with pytest.raises(CaptureError) as caught:
        read_header(tmp_path / "a.nef")
    assert caught.value.problems[0].kind == "image-unreadable"


@pytest.mark.parametrize("suffix", ["png", "jpg", "tif", "exr"])
@pytest.mark.parametrize("share", [0.02, 0.5, 0.98])
def test_truncated_files_are_found(tmp_path, suffix, share):
    path = tmp_path / f"a.{suffix}"
    if suffix == "exr":
        values = np.random.default_rng(0).random((60, 80, 3)).astype(np.float32)
        write_exr(path, {n: np.ascontiguousarray(values[..., i]) for i, n in enumerate("RGB")})
    else:
        cv2.imwrite(str(path), picture(np.uint8, 3, 60, 80))
    data = path.read_bytes()
    path.write_bytes(data[: int(share * len(data))])
    with pytest.raises(CaptureError) as caught:
        read_codes(path, RGB) if suffix == "exr" else read_header(path)
    assert caught.value.problems[0].kind == "image-truncated"
    assert f"a.{suffix}" in str(caught.value)


@pytest.mark.parametrize("place", [0.3, 0.6, 0.95])
def test_a_flipped_bit_in_a_png_is_found(tmp_path, place):
    path = tmp_path / "a.png"
    cv2.imwrite(str(path), picture(np.uint16))
    data = bytearray(path.read_bytes())
    data[int(place * len(data))] ^= 4
    path.write_bytes(data)
    with pytest.raises(CaptureError):
        read_codes(path, RGB)


def test_a_thumbnails_end_is_not_taken_for_the_pictures(tmp_path):
    _, coded = cv2.imencode(".jpg", picture(np.uint8, 3, 60, 80))
    data = coded.tobytes()
    _, small = cv2.imencode(".jpg", picture(np.uint8, 3, 8, 8))
    exif = b"Exif\0\0" + small.tobytes()
    whole = data[:2] + b"\xff\xe1" + struct.pack(">H", len(exif) + 2) + exif + data[2:]
    (tmp_path / "a.jpg").write_bytes(whole)
    assert read_codes(tmp_path / "a.jpg", RGB).shape == (60, 80, 3)
    for missing in (400, len(data) - len(coded) // 2):
        (tmp_path / "a.jpg").write_bytes(whole[:-missing])
        with refused(CaptureError, kind="image-truncated"):
            read_header(tmp_path / "a.jpg")


@pytest.mark.parametrize("suffix", ["png", "jpg"])
@pytest.mark.parametrize("appended", [1, 5000])
def test_what_programs_append_to_a_picture_is_no_damage(tmp_path, suffix, appended):
    path = tmp_path / f"a.{suffix}"
    cv2.imwrite(str(path), picture(np.uint8, 3, 60, 80))
    path.write_bytes(path.read_bytes() + b"\0" * appended)
    assert read_codes(path, RGB).shape == (60, 80, 3)


def test_claims_of_absurd_size_are_refused_before_decoding(tmp_path):
    cv2.imwrite(str(tmp_path / "a.png"), picture(np.uint8))
    data = bytearray((tmp_path / "a.png").read_bytes())
    for rows, columns in ((200_000, 30), (100_000, 100_000), (20_000, 20_000), (0, 30)):
        data[16:24] = struct.pack(">II", columns, rows)
        (tmp_path / "a.png").write_bytes(data)
        with pytest.raises(CaptureError) as caught:
            read_header(tmp_path / "a.png")
        assert caught.value.problems[0].kind == "image-absurd"


def test_masks_and_labels(tmp_path):
    mask = np.zeros((20, 30, 3), np.uint8)
    mask[5:9, 3:20, 1] = 255
    cv2.imwrite(str(tmp_path / "m.png"), mask)
    np.testing.assert_array_equal(read_mask(tmp_path / "m.png"), mask.any(axis=2))
    labels = picture(np.uint16, 1)
    cv2.imwrite(str(tmp_path / "l.png"), labels)
    np.testing.assert_array_equal(read_labels(tmp_path / "l.png"), labels[..., 0])
    with pytest.raises(CaptureError):
        read_labels(tmp_path / "m.png")
