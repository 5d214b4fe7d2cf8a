"""Limit the threads of a process, and divide rows of pictures among them.

Compiled kernels release the interpreter while they run. A kernel writes only its own rows, so the result cannot depend
on the number of threads; and it compiles in half the time that a parallel loop of the compiler's would take.
"""

import functools
import itertools
import os
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor, wait
from typing import TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")

VARIABLES = ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "OPENCV_FOR_THREADS_NUM")
"""Environment variables from which libraries read their number of threads; the workflow sets all for every job."""
ALONE = {"OPENBLAS_NUM_THREADS": "1"}
"""Also set for every job. Each of our threads multiplies matrices itself; OpenBLAS's own threads would only wait
busily: with two of each, the export of relightable images took twice the processor time."""
STRIPS_A_THREAD = 4
"""More strips than threads, so that a thread with easy rows helps out where rows are hard."""

LEAST_VALUES = 1 << 15
"""Least number of values of arrays for which several threads are used."""


def threads() -> int:
    """Return the number of threads for this process: that of its job, else one for each processor that it may use.

    A job of a cluster sees all processors of its machine, so their number says nothing.
    """
    given = os.environ.get(VARIABLES[0], "")
    return int(given) if given.isdecimal() and int(given) else len(os.sched_getaffinity(0))


def in_threads(
    work: Callable[[Item], Result], items: Iterable[Item], most: int | None = None, ahead: int | None = None
) -> Iterator[Result]:
    """Yield results of `work` in the order of the items, several at a time.

    The threads are kept for the next call, as starting them takes longer than many kernels run. Inside `work` a further
    call does its items one by one. An exception, an interrupt for example, ends it with the items that are under way.

    Parameters
    ----------
    work : callable
        Function of one item.
    items : iterable
        Items, read as they are needed.
    most : int, optional
        Most threads; all of this process by default, or where it has fewer.
    ahead : int, optional
        Items that wait or are under way beside the next result; as many as threads by default.
    """
    workers = threads() if most is None else min(threads(), most)
    if workers <= 1 or getattr(_thread, "works", False):
        yield from map(work, items)
        return
    waiting: deque[Future[Result]] = deque()
    try:
        for item in items:
            waiting.append(_pool(workers).submit(work, item))
            if len(waiting) > (ahead or workers):
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()
    finally:
        wait([future for future in waiting if not future.cancel()])


def over_rows(kernel: Callable[..., None], rows: int, *arguments) -> None:
    """Call kernel(start, stop, *arguments) for strips that cover 0 .. rows - 1, several at a time.

    Arrays of few values are one strip: a parcel of near lamps is done before another thread has begun.
    """
    if rows < 2 or threads() == 1 or _values(arguments) < LEAST_VALUES:
        kernel(0, rows, *arguments)
        return
    strips = min(rows, threads() * STRIPS_A_THREAD)
    edges = [rows * index // strips for index in range(strips + 1)] if rows else []
    for _ in in_threads(lambda pair: kernel(*pair, *arguments), itertools.pairwise(edges), rows, strips):
        pass


def _values(arguments: tuple) -> int:
    """Count the values of all arrays among arguments and tuples of them."""
    return sum(_values(each) if isinstance(each, tuple) else getattr(each, "size", 1) for each in arguments)


def strips(rows: int, most: int = 256) -> Iterator[slice]:
    """Cut 0 .. rows - 1 into slices of at most so many rows, which bound the memory."""
    return (slice(start, min(start + most, rows)) for start in range(0, rows, most))


def over_items(work: Callable[[Item], object], items: Iterable[Item], most: int | None = None) -> None:
    """Call `work` for every item, several at a time, where it stores what it finds itself."""
    for _ in in_threads(work, items, most, STRIPS_A_THREAD * threads()):
        pass


_thread = threading.local()


@functools.cache
def _pool(workers: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(workers, "shared", lambda: setattr(_thread, "works", True))


os.register_at_fork(after_in_child=_pool.cache_clear)  # threads do not come along
