"""Rows shared out among threads: compiled kernels that release the interpreter lock, one strip of rows each.

A kernel writes only its own rows, so the result cannot depend on the number of threads; and it compiles in half the
time that a kernel with parallel loops of its own would take.
"""

import itertools
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import numba


def threads() -> int:
    """How many threads to use: NUMBA_NUM_THREADS where set, else the processors that this process may use."""
    return numba.config.NUMBA_NUM_THREADS


def over_rows(kernel: Callable, rows: int, *arguments) -> None:
    """Call kernel(start, stop, *arguments) for strips that cover 0..rows, several at a time."""
    workers = min(threads(), rows)
    # More strips than threads, so that a thread with easy rows helps out where rows are hard.
    strips = min(rows, workers * 4 if workers > 1 else 1)
    edges = [rows * index // strips for index in range(strips + 1)]
    if workers <= 1:
        kernel(0, rows, *arguments)
        return
    with ThreadPoolExecutor(workers) as pool:
        for job in [pool.submit(kernel, *pair, *arguments) for pair in itertools.pairwise(edges)]:
            job.result()
