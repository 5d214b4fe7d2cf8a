"""Arithmetic of lanes: every lane as a float32 number, at any place of an array."""

import os
import subprocess
import sys

import numpy as np
import pytest
from numba import njit

from nishiki.lanes import LANES, choose, load, planes, root, splat, store


@njit(error_model="numpy")
def combined(values, marks, start, out, marked):
    zero, half = np.float32(0.0), np.float32(0.5)
    total = splat(zero)
    for j in range(values.shape[0]):
        value, mark = load(values, (j, start)), load(marks, (j, start))
        kept = mark & (value > zero) | (value <= -half)
        total += choose(kept, value * value - half, value / (value * value + np.float32(1.0)))
        store(marked, (j, start), kept)
    store(out, start, root(total * total + half))


def expected(values, marks):
    kept = marks & (values > 0) | (values <= -np.float32(0.5))
    half, total = np.float32(0.5), np.zeros(values.shape[1], np.float32)
    for value, chosen in zip(values, kept, strict=True):
        total += np.where(chosen, value * value - half, value / (value * value + np.float32(1.0)))
    return np.sqrt(total * total + half), kept


def test_lanes_are_rounded_as_single_numbers_are():
    rng = np.random.default_rng(1)
    values = rng.normal(size=(7, 3 * LANES + 5)).astype(np.float32)
    marks = rng.random(values.shape) < 0.5
    right, kept = expected(values, marks)
    for start in (0, 3, 2 * LANES + 5):  # begins anywhere
        out, marked = np.zeros(values.shape[1], np.float32), np.zeros(values.shape, np.bool_)
        combined(values, marks, start, out, marked)
        there = slice(start, start + LANES)
        assert np.array_equal(out[there], right[there])
        assert np.array_equal(marked[:, there], kept[:, there])
        out[there], marked[:, there] = 0, False
        assert not out.any()  # nothing beside them was written
        assert not marked.any()


def test_planes_begin_at_a_register():
    for count, width in ((1, LANES), (3, 2 * LANES)):
        plane = planes(count, width)
        assert (plane.shape, plane.dtype) == ((count, width), np.float32)
        assert not plane.any()
        assert plane.ctypes.data % (4 * LANES) == 0


SUMS_OF_A_BLOCK = """
import sys
import numpy as np
from nishiki.lanes import BLOCK, LANES
from nishiki.photometric.lobe import SLOPES, SUMS, add_products

rng = np.random.default_rng(3)
slopes, sums = rng.normal(size=(SLOPES * 41, LANES)).astype(np.float32), np.zeros(SUMS * BLOCK, np.float32)
add_products(slopes, 0, sums)
sys.stdout.buffer.write(sums.tobytes())
"""


@pytest.mark.slow
def test_sums_have_the_same_bytes_on_every_processor(tmp_path):
    """The oldest 64-bit instruction set has no fused multiply-add, which rounds once in place of twice."""
    bytes_of = {}
    for processor in ("x86-64", "x86-64-v3"):
        environment = {
            **os.environ,
            "NUMBA_CPU_NAME": processor,
            "NUMBA_CPU_FEATURES": "",
            "NUMBA_CACHE_DIR": str(tmp_path),
        }
        done = subprocess.run([sys.executable, "-c", SUMS_OF_A_BLOCK], env=environment, capture_output=True, check=True)
        bytes_of[processor] = done.stdout
    assert len(bytes_of["x86-64"]) > 1000
    assert bytes_of["x86-64"] == bytes_of["x86-64-v3"]
