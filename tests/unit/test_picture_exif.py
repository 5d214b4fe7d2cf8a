"""Exposure, orientation and colour space as cameras write them, from every container."""

from io import BytesIO

import numpy as np
import pytest
from PIL import Image

from nishiki.formats.images import read_exif
from nishiki.formats.picture_files import Exif, exif_of

EXPOSURE, APERTURE, ISO, TAKEN, FRACTION, SPACE = 0x829A, 0x829D, 0x8827, 0x9003, 0x9291, 0xA001


@pytest.fixture(params=["jpg", "png", "tif"])
def photograph(request, tmp_path):
    exif = Image.Exif()
    exif[0x0110], exif[0x0112] = "Camera", 6
    exif.get_ifd(0x8769).update(
        {EXPOSURE: (1, 50), APERTURE: 5.6, ISO: 200, TAKEN: "2026:01:02 03:04:05", FRACTION: "25", SPACE: 1}
    )
    path = tmp_path / f"a.{request.param}"
    if request.param == "tif":
        path.write_bytes(exif.tobytes().removeprefix(b"Exif\0\0"))  # Pillow writes no Exif directory into a TIFF
    else:
        Image.fromarray(np.zeros((8, 9, 3), np.uint8)).save(path, exif=exif)
    return path


def test_every_container_states_the_same_facts(photograph):
    found = exif_of(BytesIO(photograph.read_bytes()))
    assert found == Exif(1 / 50, 5.6, 200, 6, "srgb", "Camera", "2026:01:02 03:04:05.25")


def test_a_file_without_facts_has_an_empty_record(tmp_path):
    for name in ("a.jpg", "a.png", "a.tif"):
        Image.fromarray(np.zeros((8, 9, 3), np.uint8)).save(tmp_path / name)
        assert read_exif(tmp_path / name) == Exif()
    (tmp_path / "b.jpg").write_bytes(b"Dear colleague,")
    assert read_exif(tmp_path / "b.jpg") == Exif()


def test_a_damaged_block_counts_as_none(photograph):
    content = bytearray(photograph.read_bytes())
    place = content.find(b"II*\0" if b"II*\0" in content else b"MM\0*")
    for value in (0xFF, 0):
        content[place + 4 : place + 200] = bytes([value]) * len(content[place + 4 : place + 200])
        assert exif_of(BytesIO(content)) == Exif()
