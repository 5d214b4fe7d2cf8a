"""How many threads a process may use, and rows of pictures shared out among them.

Compiled kernels release the interpreter while they run. A kernel writes only its own rows, so the result cannot depend
on the number of threads; and it compiles in half the time that a parallel loop of the compiler's would take.
"""

import itertools
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

VARIABLES = ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "OPENCV_FOR_THREADS_NUM")
"""What each library reads its number of threads from; the workflow sets all of them for every job."""
STRIPS_A_THREAD = 4
"""More strips than threads, so that a thread with easy rows helps out where rows are hard."""


def threads() -> int:
    """Threads that this process may use: those that its job was given, else one for each processor that it may use.

    A job of a cluster sees all processors of its machine, so their number says nothing.
    """
    given = os.environ.get(VARIABLES[0], "")
    return int(given) if given.isdecimal() and int(given) else len(os.sched_getaffinity(0))


def over_rows(kernel: Callable[..., None], rows: int, *arguments) -> None:
    """Call kernel(start, stop, *arguments) for strips that cover 0 .. rows - 1, several at a time."""
    workers = min(threads(), rows)
    if workers <= 1:
        kernel(0, rows, *arguments)
        return
    strips = min(rows, workers * STRIPS_A_THREAD)
    edges = [rows * index // strips for index in range(strips + 1)]
    with ThreadPoolExecutor(workers) as pool:
        for job in [pool.submit(kernel, *pair, *arguments) for pair in itertools.pairwise(edges)]:
            job.result()
