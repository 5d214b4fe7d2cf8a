"""Work shared out among threads."""

import numpy as np
import pytest

from nishiki.threads import in_threads, over_rows


@pytest.fixture(params=["1", "3"])
def threads(request, monkeypatch):
    monkeypatch.setenv("NUMBA_NUM_THREADS", request.param)
    return int(request.param)


def test_results_come_in_the_order_of_the_items(threads):
    assert list(in_threads(lambda number: number**2, iter(range(40)))) == [number**2 for number in range(40)]


def test_an_exception_ends_the_work_with_what_is_under_way(threads):
    done = []

    def work(number):
        done.append(number)
        if number == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        list(in_threads(work, range(100)))
    assert len(done) <= 3 + 2 * threads


@pytest.mark.parametrize("rows", [0, 1, 5, 41])
def test_strips_cover_every_row_once(threads, rows):
    counts = np.zeros(rows, int)

    def kernel(start, stop, step):
        counts[start:stop] += step

    over_rows(kernel, rows, 2)
    assert (counts == 2).all()
