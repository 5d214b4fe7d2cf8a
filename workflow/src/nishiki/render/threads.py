"""Rows of a picture shared out among threads; compiled kernels release the interpreter while they run."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import numba

_BANDS_PER_THREAD = 4  # so that a thread whose rows are cheap (matte, background) takes over from the others


def over_rows(kernel: Callable[[int, int], None], rows: int) -> None:
    """Call kernel(first, last) for bands that cover 0 .. rows - 1, on as many threads as numba is set to use.

    The kernel writes to its own rows only; then the result is the same for any number of threads.
    """
    threads = min(numba.get_num_threads(), rows)
    if threads <= 1:
        kernel(0, rows)
        return
    bands = min(rows, threads * _BANDS_PER_THREAD)
    edges = [rows * k // bands for k in range(bands + 1)]
    with ThreadPoolExecutor(threads) as pool:
        for _ in pool.map(kernel, edges[:-1], edges[1:]):
            pass  # reading the results passes on an exception
