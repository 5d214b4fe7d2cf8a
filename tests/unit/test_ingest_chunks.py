"""Chunks of the observations, written past the array library."""

import errno
import resource
import signal

import numpy as np
import pytest

from nishiki.formats.zarr_chunks import read_chunk, write_chunk


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
