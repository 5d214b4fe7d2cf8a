"""Chunks and arrays in bands of rows, written and read past the array library."""

import errno
import resource
import signal

import numpy as np
import pytest
import zarr
from refusals import refused
from zarr.codecs import ZstdCodec

from nishiki.errors import UserError
from nishiki.formats.stored import BandedGroup, open_group, read_chunk, write_chunk


@pytest.mark.parametrize("compression", ["none", "zstd"])
def test_a_chunk_comes_back(tmp_path, compression):
    values = np.random.default_rng(1).integers(0, 65535, (1, 40, 30, 3)).astype("<u2")
    write_chunk(tmp_path / "c/0/0/0/0", values, compression=compression)
    back = read_chunk(tmp_path / "c/0/0/0/0", values.shape, values.dtype, compression=compression)
    np.testing.assert_array_equal(back, values)


def test_a_file_that_takes_only_a_piece_ends_with_its_name_and_the_reason(tmp_path):
    """A limit on the size of files stands for a disk that becomes full: it takes a piece, and refuses the rest."""
    path = tmp_path / "chunk"
    before = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, limits[1]))
    try:
        with pytest.raises(OSError, match="chunk") as told:
            write_chunk(path, np.zeros(2000, np.uint8), compression="none")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        signal.signal(signal.SIGXFSZ, before)
    assert told.value.errno == errno.EFBIG
    assert path.stat().st_size == 1000


@pytest.mark.parametrize("compression", ["none", "zstd"])
@pytest.mark.parametrize("dtype", ["float32", "uint8", "uint16", "float64", "bool"])
def test_the_array_library_reads_what_is_written_in_bands(tmp_path, dtype, compression):
    values = np.random.default_rng(2).integers(0, 200, (21, 6, 3)).astype(dtype)
    group = BandedGroup.create(tmp_path / "a.zarr", {"stamp": {"scene": "x"}})
    array = group.create_array("map", (21, 6, 3), (8, 6, 3), dtype, compression=compression, attributes={"unit": "m"})
    for start in (16, 0, 8):
        array[start : start + 8] = values[start : start + 8]
    group.update(pitch=None)
    stored = zarr.open_group(tmp_path / "a.zarr", mode="r")
    np.testing.assert_array_equal(stored["map"][...], values)
    assert stored["map"].dtype == dtype
    assert dict(stored["map"].attrs) == {"unit": "m"}
    assert dict(stored.attrs) == {"stamp": {"scene": "x"}, "pitch": None}


@pytest.mark.parametrize("chunks", [(8, 6, 3), (1, 4, 3), (7, 4, 2)])
def test_any_part_of_what_the_array_library_wrote_is_read(tmp_path, chunks):
    values = np.random.default_rng(3).normal(size=(21, 6, 3)).astype("float32")
    values[8:16] = 0  # chunks of zeros have no file
    stored = zarr.create_group(tmp_path / "a.zarr")
    stored.create_array("map", shape=values.shape, chunks=chunks, dtype="float32")[...] = values
    array = open_group(tmp_path / "a.zarr")["map"]
    for key in (..., 3, slice(3, 17), (4, slice(1, 5)), (slice(0, 0),), (20, 5, 2), (slice(None), 3, slice(1, None))):
        np.testing.assert_array_equal(array[key], values[key])
    for wrong in (slice(None, None, 2), slice(None, None, -1)):
        with refused(ValueError, "a.zarr"):
            array[wrong]
    with pytest.raises(IndexError):
        array[21]


def test_bands_that_the_array_library_wrote_are_read(tmp_path):
    values = np.random.default_rng(3).normal(size=(21, 6)).astype("float32")
    stored = zarr.create_group(tmp_path / "a.zarr", attributes={"format": 1})
    packers = [ZstdCodec(level=1, checksum=True)]
    stored.create_array("map", shape=(21, 6), chunks=(8, 6), dtype="float32", compressors=packers)[...] = values
    group = open_group(tmp_path / "a.zarr")
    assert group.attrs == {"format": 1}
    assert "map" in group
    assert "other" not in group
    for rows in (..., slice(3, 17), slice(8, 8), slice(20, None)):
        np.testing.assert_array_equal(group["map"][rows], values[rows])


@pytest.mark.parametrize("damage", ["flip", "remove"])
@pytest.mark.parametrize("compression", ["none", "zstd"])
def test_a_damaged_band_is_reported(tmp_path, compression, damage):
    group = BandedGroup.create(tmp_path / "a.zarr")
    group.create_array("map", (20, 600), (8, 600), "float32", compression=compression)[...] = np.ones((20, 600))
    path = group["map"].path(1)
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)
    if damage == "remove":
        path.unlink()
    with refused(UserError, "a.zarr"):
        group["map"][...]
    np.testing.assert_array_equal(group["map"][:8], 1)


def test_parts_of_bands_are_not_written(tmp_path):
    array = BandedGroup.create(tmp_path / "a.zarr").create_array("map", (20, 6), (8, 6), "float32")
    with refused(ValueError, "a.zarr"):
        array[4:12] = np.zeros((8, 6))


def test_attributes_change_only_where_they_are_written(tmp_path):
    group = BandedGroup.create(tmp_path / "a.zarr", {"stamp": "x"})
    with pytest.raises(TypeError):
        group.attrs["pitch"] = 0.5
    group.update(pitch=0.5)
    assert dict(BandedGroup(tmp_path / "a.zarr").attrs) == {"stamp": "x", "pitch": 0.5}
