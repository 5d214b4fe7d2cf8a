"""How many threads a process may use, and rows of pictures shared out among them.

Compiled kernels release the interpreter while they run. A kernel writes only its own rows, so the result cannot depend
on the number of threads; and it compiles in half the time that a parallel loop of the compiler's would take.
"""

import itertools
import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")

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


def in_order(
    pool: ThreadPoolExecutor, work: Callable[[Item], Result], items: Iterable[Item], ahead: int
) -> Iterator[Result]:
    """Yield results of `work` in the order of the items, of which at most `ahead` are under way."""
    waiting: deque[Future[Result]] = deque()
    for item in items:
        waiting.append(pool.submit(work, item))
        if len(waiting) > ahead:
            yield waiting.popleft().result()
    while waiting:
        yield waiting.popleft().result()


def in_threads(work: Callable[[Item], Result], items: Iterable[Item], most: int | None = None) -> Iterator[Result]:
    """Yield results of `work` in the order of the items, several at a time, at most `most` if given.

    An exception, an interrupt for example, ends it with the items that are under way.
    """
    workers = threads() if most is None else min(threads(), most)
    if workers <= 1:
        yield from map(work, items)
        return
    pool = ThreadPoolExecutor(workers)
    try:
        yield from in_order(pool, work, items, workers)
    finally:
        pool.shutdown(cancel_futures=True)


def over_rows(kernel: Callable[..., None], rows: int, *arguments) -> None:
    """Call kernel(start, stop, *arguments) for strips that cover 0 .. rows - 1, several at a time."""
    strips = min(rows, threads() * STRIPS_A_THREAD) if threads() > 1 else 1
    edges = [rows * index // strips for index in range(strips + 1)] if rows else []
    for _ in in_threads(lambda pair: kernel(*pair, *arguments), itertools.pairwise(edges), rows):
        pass
