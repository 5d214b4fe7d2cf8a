"""Spline of a positive function on the hemisphere: periodic in azimuth, smooth through the pole, never negative."""

from __future__ import annotations

import numpy as np
from numba import njit

MARGIN = 4  # nodes added on every side, so that the spline's ends are far from where it is used
RUN_OUT = 24  # rows that the straight line beyond the horizon is followed: the filter forgets by 0.27 a row
FLOOR = 1e-9  # of the largest value: smaller ones, zeros among them, have no usable logarithm


def coefficients(values: np.ndarray) -> np.ndarray:
    """Cubic B-spline coefficients (nt + 2 MARGIN, np + 2 MARGIN, channels) of log values (nt, np, channels).

    Rows are theta from the pole to the horizon, columns phi round the azimuth (an even number). Beyond the pole the
    function goes on at phi + pi; beyond the horizon the logarithm goes on as a straight line. ValueError otherwise.
    """
    values = np.asarray(values, np.float64)
    nt, around, _ = values.shape
    if around % 2 or nt <= MARGIN or around < 2 * MARGIN:
        raise ValueError(f"grid of {nt} x {around}: more than {MARGIN} rows, an even number of columns from 8 expected")
    least = np.maximum(values.max(axis=(0, 1)), 1e-300) * FLOOR
    logs = np.log(np.maximum(values, least))
    logs[0] = logs[0].mean(axis=0)  # one value at the pole, whatever the azimuth
    step = np.arange(1, RUN_OUT + 1)[:, None, None]
    half = np.concatenate([logs, logs[-1] + step * (logs[-1] - logs[-2])])
    # from horizon to horizon through the pole: there the spline is as smooth as anywhere
    arc = np.concatenate([np.roll(half[1:], around // 2, axis=1)[::-1], half])
    return _filtered(arc, around, len(half) - 1 - MARGIN, nt + 2 * MARGIN)


def _filtered(arc: np.ndarray, around: int, first: int, rows: int) -> np.ndarray:
    """Spline coefficients along both axes; round the azimuth the filter is exactly periodic."""
    from scipy.ndimage import spline_filter1d

    inner = spline_filter1d(arc, 3, axis=0, mode="mirror")[first : first + rows]
    # on a circle the filter [1/6, 4/6, 1/6] is a division in the Fourier domain
    response = (2 + np.cos(2 * np.pi * np.fft.rfftfreq(around))) / 3
    turned = np.fft.irfft(np.fft.rfft(inner, axis=1) / response[None, :, None], n=around, axis=1)
    return np.ascontiguousarray(np.concatenate([turned[:, -MARGIN:], turned, turned[:, :MARGIN]], axis=1))


def evaluate(spline: np.ndarray, outgoing: np.ndarray) -> np.ndarray:
    """exp of the spline (..., channels) at unit vectors (..., 3); 0 below the horizon."""
    flat = np.ascontiguousarray(outgoing.reshape(-1, 3))
    out = np.empty((len(flat), spline.shape[2]))
    _evaluate(spline, flat, out)
    return out.reshape(*outgoing.shape[:-1], spline.shape[2])


@njit(cache=True, nogil=True, error_model="numpy")
def _evaluate(spline, directions, out):
    """Fill out (n, channels) from the tensor product of cubic B-splines."""
    rows, columns, channels = spline.shape
    nt, around = rows - 2 * MARGIN, columns - 2 * MARGIN
    v, w = np.empty(4), np.empty(4)
    for i in range(len(directions)):
        x, y, z = directions[i]
        if not z >= 0:
            out[i] = 0.0
            continue
        down = np.arctan2(np.hypot(x, y), z) / (np.pi / 2) * (nt - 1)
        turn = np.arctan2(y, x) / (2 * np.pi)
        turn = (turn - np.floor(turn)) * around
        row, column = min(int(down), nt - 1), min(int(turn), around - 1)
        _weights(down - row, v)
        _weights(turn - column, w)
        for k in range(channels):
            total = 0.0
            for a in range(4):
                part = 0.0
                for b in range(4):
                    part += w[b] * spline[row + MARGIN - 1 + a, column + MARGIN - 1 + b, k]
                total += v[a] * part
            out[i, k] = np.exp(total)


@njit(cache=True, error_model="numpy")
def _weights(t, w):
    """Cubic B-spline weights of the four nodes round a place t in [0, 1] between the second and the third."""
    s = 1.0 - t
    w[0] = s * s * s / 6.0
    w[1] = (4.0 - 6.0 * t * t + 3.0 * t * t * t) / 6.0
    w[2] = (4.0 - 6.0 * s * s + 3.0 * s * s * s) / 6.0
    w[3] = t * t * t / 6.0
