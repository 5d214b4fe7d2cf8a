"""Polynomial texture maps (`.ptm`) become captures; their values are those of a slow decoder."""

import struct

import pytest
from relightable_images import (
    COLUMNS,
    ROWS,
    expect_refusal,
    expect_values,
    expect_whole_files_only,
    heading,
    jpeg_file,
    lrgb_file,
    older_lrgb_file,
    rgb_file,
)

FILES = {
    "rgb": rgb_file,
    "lrgb": lrgb_file,
    "older": older_lrgb_file,
    "jpeg_lrgb": jpeg_file,
    "jpeg_rgb": lambda: jpeg_file(count=18),
}


@pytest.mark.parametrize("kind", FILES)
def test_values_are_those_of_a_slow_decoder(tmp_path, kind):
    expect_values(tmp_path / "a.ptm", *FILES[kind]())


@pytest.mark.parametrize("kind", FILES)
def test_files_that_end_anywhere_or_claim_too_much_are_refused(tmp_path, kind):
    sizes = [b"100000\n100000\n", b"999999999\n1\n", b"0\n5\n", b"-3\n5\n", b"9" * 30 + b"\n1\n", b"x\n5\n"]
    expect_whole_files_only(tmp_path / "a.ptm", FILES[kind]()[0], f"{COLUMNS}\n{ROWS}\n".encode(), sizes)


@pytest.mark.parametrize(
    ("content", "text"),
    [
        (heading("PTM_FORMAT_LUM") + bytes(900), "PTM_FORMAT_LUM"),
        (heading("PTM_FORMAT_JPEGLS_LRGB") + bytes(900), "PTM_FORMAT_JPEGLS_LRGB.*Save it again as PTM_FORMAT_RGB"),
        (heading("PTM_FORMAT_RGB", "PTM_2.0") + bytes(900), r"PTM_2\.0"),
        (heading("PTM_FORMAT_RGB").replace(b"1.5", b"nan") + bytes(900), "numbers"),
        (jpeg_file(motion=3)[0], "motion"),
        (jpeg_file(transforms=[2] * 9)[0], "transforms"),
        (jpeg_file()[0].replace(b"2 -1 4", b"2 -1 0"), "not made before"),
        (jpeg_file()[0].replace(struct.pack(">I", ROWS * COLUMNS - 1), b"\0\0\1\0"), "beyond the picture"),
        (jpeg_file()[0].replace(b"\xff\xc0", b"\xff\xc3"), "JPEG"),
    ],
)
def test_other_kinds_are_refused_by_name(tmp_path, content, text, capsys):
    expect_refusal(tmp_path / "a.ptm", content, text, capsys)
