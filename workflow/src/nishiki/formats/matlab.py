"""Numbers from MATLAB files up to level 7, by variable: scipy reads them in the process that decodes pictures."""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from nishiki.formats.files import read_bytes
from nishiki.formats.picture_process import hold, request_matlab
from nishiki.formats.problems import CaptureError

MOST_NUMBERS = 1 << 20  # of all variables together


def read_matlab(path: Path, names: Sequence[str]) -> dict[str, np.ndarray]:
    """Those of the named variables that the file has: arrays of numbers, cell arrays as object arrays of these.

    Shapes are MATLAB's (two axes at least). ValueError where it is no such file, is damaged, or holds one of the
    variables as something else (text, complex numbers, sparse matrices, cells in cells); FileNotFoundError;
    nishiki.formats.files.Refused where it is larger than is read.
    """
    handle = hold(read_bytes(path, "matlab_bytes", name=path.name))
    try:
        stored = request_matlab(handle, path.name, names)
    except CaptureError as e:
        raise ValueError(e.problems[0].found or e.problems[0].what) from None
    finally:
        os.close(handle)
    return {name: _array(*content) for name, content in stored.items()}


def stored_numbers(file: BinaryIO, names: Sequence[str]) -> dict[str, tuple[tuple[int, ...], list]]:
    """Shape and values of variables of an open file, in MATLAB's order; a cell is a shape and values in its turn.

    Runs in the process that decodes. Errors of any kind where `read_matlab` raises ValueError.
    """
    from scipy.io import loadmat

    file.seek(0)
    stored = loadmat(file, variable_names=names)
    content, left = {}, MOST_NUMBERS
    for name in names:
        if name not in stored:
            continue
        cells = stored[name].ravel() if stored[name].dtype == object else [stored[name]]
        left -= sum(cell.size for cell in cells)
        if left < 0 or any(cell.dtype.kind not in "fiu" for cell in cells):
            raise ValueError(f"{name!r} holds no numbers, or more than {MOST_NUMBERS}")
        content[name] = _shaped(stored[name])
    return content


def _shaped(array: np.ndarray) -> tuple[tuple[int, ...], list]:
    values = array.ravel(order="F")
    return array.shape, [_shaped(cell) for cell in values] if array.dtype == object else values.tolist()


def _array(shape: list[int], values: list[Any]) -> np.ndarray:
    cells = bool(values) and isinstance(values[0], list)
    array = np.empty(len(values), object if cells else np.float64)
    for i, value in enumerate(values):
        array[i] = _array(*value) if cells else value
    return array.reshape(shape, order="F")
