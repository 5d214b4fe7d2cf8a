"""The frame of the stages: no value that is not finite leaves one, and a result beyond its limits stops the run."""

import contextlib
import io
import sys
import tempfile
from pathlib import Path

import numpy as np
import zarr
from hypothesis import strategies as st
from stability.cases import case, worst_over
from zarr.codecs import Crc32cCodec, ZstdCodec

from nishiki.artifacts.artifact import open_artifact
from nishiki.artifacts.declaration import Limit, at, check, limit_checks
from nishiki.artifacts.stage import problems, run_stage
from nishiki.errors import NotFinite
from nishiki.formats.banded_pictures import ExrWriter
from nishiki.stages.height import HeightSettings
from nishiki.stages.table import LIMITS

CODECS = {
    "plain": [],
    "zstd": [ZstdCodec(level=1, checksum=True)],
    "crc": [Crc32cCodec()],
    "both": [ZstdCodec(level=1), Crc32cCodec()],
}


def stored(folder: Path, values: np.ndarray, chunks: tuple, codec: str, **attributes) -> None:
    array = zarr.create_array(
        folder / "values",
        shape=values.shape,
        chunks=chunks,
        dtype=values.dtype,
        compressors=CODECS[codec],
        attributes=attributes,
        config={"write_empty_chunks": True},
    )
    array[...] = values


def _found(kind, shape, chunk, codec, places):
    """Wrong outcomes for one array with values that are not finite at given places: the reference is NumPy's."""
    rng = np.random.default_rng(len(places))
    values = rng.normal(size=shape).astype(kind)
    for place, value in places:
        values.reshape(-1)[place % values.size] = value
    with tempfile.TemporaryDirectory() as name:
        stored(Path(name), values, tuple(min(chunk, size) for size in shape), codec)
        np.savez(Path(name, "values.npz"), values=values)
        told = [text for text in problems(Path(name)) if text]
    nans, endless = np.argwhere(np.isnan(values)), np.argwhere(np.isinf(values))
    parts = [
        f"{len(at)} {word}, the first at {tuple(at[0].tolist())}"
        for at, word in ((endless, "infinite"), (nans, "NaN"))
        if len(at)
    ]
    expected = [f"{name}: {', '.join(parts)}" for name in ("values", "values.npz: values")] if parts else []
    return float(sorted(told) != sorted(expected))


@case(
    "A NaN or an infinity anywhere in an array",
    hazard="a value that is not finite, which every later stage would spread",
    treatment="everything a stage wrote is read once more before its artifact is finished",
    reference="NumPy's isnan and isinf, value by value",
    bound=0,
    unit="arrays told wrongly",
    outcome="the stage ends as a defect that names stage, array, count and first index",
)
def test_every_such_value_is_found():
    places = st.lists(st.tuples(st.integers(0, 10**6), st.sampled_from([np.nan, np.inf, -np.inf])), max_size=3)
    return worst_over(
        _found,
        st.sampled_from(["float16", "float32", "float64"]),
        st.lists(st.integers(1, 7), min_size=1, max_size=3).map(tuple),
        st.integers(1, 4),
        st.sampled_from(list(CODECS)),
        places,
        examples=60,
    )


@case(
    "Finite values whose sum is not",
    hazard="the check adds values up, and the sum of large ones overflows",
    treatment="an overflow only causes a second look, value by value",
    bound=0,
    unit="false alarms",
    outcome="no alarm",
)
def test_sums_that_overflow():
    alarms = 0
    with tempfile.TemporaryDirectory() as name:
        for number, kind in enumerate(("float16", "float32", "float64")):
            folder = Path(name, str(number))
            folder.mkdir()
            values = np.full((300, 7), np.finfo(kind).max, kind)
            stored(folder, values, (64, 7), "zstd")
            np.savez(folder / "values.npz", values=values)
            alarms += len([text for text in problems(folder) if text])
    return alarms


@case(
    "NaN in a text file or a picture",
    hazard="NaN in JSON, CSV or EXR, where no array check looks",
    treatment="text files are searched for the words, the writer of EXR refuses them",
    bound=0,
    unit="files told wrongly of 10",
    outcome="found; words that only contain nan or inf are let through",
)
def test_text_and_pictures():
    wrong = 0
    bad = {"a.json": '{"x": [1, NaN]}', "b.json": '{"x":-Infinity}', "c.csv": "a,b\n1,nan\n", "d.csv": "a\n-inf\n"}
    good = {
        "e.json": '{"nan": "Infinity war", "name": "NaN"}',
        "f.csv": "name,info\nnancy,infinite\n",
        "g.json": "{}",
        "h.csv": "",
    }
    for name, text in {**bad, **good}.items():
        with tempfile.TemporaryDirectory() as folder:
            Path(folder, name).write_text(text)
            wrong += bool([told for told in problems(Path(folder)) if told]) != (name in bad)
    for value in (np.inf, 1.0):
        with tempfile.TemporaryDirectory() as folder:
            refused = False
            try:
                with ExrWriter(Path(folder, "p.exr"), "R", 3, 4, {}) as exr:
                    exr.write(np.full((3, 4, 1), value))
            except NotFinite:
                refused = True
            wrong += refused != np.isinf(value)
    return wrong


def staged(folder: Path, diagnostics: dict, values: np.ndarray, settings: str = "{}", **attributes):
    """A stage that writes one array and reports these diagnostics; exit status, what it said, what it left."""

    def run(context):
        stored(context.output.folder, values, values.shape, "zstd", **attributes)
        return diagnostics

    told = ["--output", str(folder / "height"), "--settings", settings, "--capture", str(folder)]
    arguments, sys.argv = sys.argv, ["height.py", *told]
    said, status = io.StringIO(), 0
    try:
        with contextlib.redirect_stderr(said):
            run_stage(HeightSettings, run, "text", digest_of_capture=lambda path: "0" * 64)
    except SystemExit as end:
        status = end.code
    except NotFinite as error:
        status = 1
        said.write(str(error))
    finally:
        sys.argv = arguments
    left = sorted(path.name for path in (folder / "height").iterdir()) if (folder / "height").is_dir() else []
    return status, said.getvalue(), left


@case(
    "A stage that wrote a NaN",
    hazard="a defect of the program that looks like a result",
    treatment="the artifact is not finished; where NaN has a stated meaning in that array, it is",
    bound=0,
    unit="wrong outcomes of 3",
    outcome="exit status 1 with stage, array, count and index; nothing kept, nothing finished lost",
)
def test_a_stage_that_wrote_a_nan():
    values = np.zeros((4, 5), np.float32)
    values[2, 3] = np.nan
    wrong = 0
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        status, _, left = staged(folder, {"residual": 0.0}, np.zeros((4, 5), np.float32), '{"method": "dct"}')
        wrong += status != 0 or len(left) != 1
        status, said, after = staged(folder, {"residual": 0.0}, values)
        wrong += status != 1 or "height wrote" not in said or "values: 1 NaN, the first at (2, 3)" not in said
        wrong += after != left or open_artifact(folder / "height" / left[0]).stage != "height"
        status, _, after = staged(folder, {"residual": 0.0}, values, nan="nothing here")
        wrong += status != 0 or len(after) != 2
    return wrong


@case(
    "A result beyond its limit",
    hazard="a figure that shows that the result misleads, in a file that nobody reads",
    treatment="limits are checked before the artifact is finished; the setting allow names those that may be exceeded",
    bound=0,
    unit="wrong outcomes of 6",
    outcome="exit status 2, one line with figure, limit and remedy; nothing kept; allowed: finished as usual",
)
def test_a_result_beyond_its_limit():
    values, wrong = np.zeros((2, 2), np.float32), 0
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for residual in (0.5, float("nan")):
            status, said, left = staged(folder, {"residual": residual}, values)
            wrong += status != 2 or bool(left)
            wrong += "at most 0.001" not in said or "Remedy" not in said or "height.allow: [convergence]" not in said
        status, _, left = staged(folder, {"residual": 0.5}, values, '{"allow": ["convergence"]}')
        told = open_artifact(folder / "height" / left[0]) if left else None
        wrong += status != 0 or told is None or told.settings["allow"] != ["convergence"]
        status, said, _ = staged(folder, {"residual": 0.5}, values, '{"allow": ["convergense"]}')
        wrong += status != 2 or "did you mean 'convergence'" not in said
    return wrong


@case(
    "Every limit, just inside and just outside",
    hazard="a limit that is compared the wrong way round, or that a NaN passes",
    treatment="one comparison for all; a NaN is beyond every limit",
    bound=0,
    unit="wrong outcomes",
    outcome="inside passes, outside and NaN stop",
)
def test_every_limit_both_sides():
    wrong = 0
    for limits in LIMITS.values():
        for limit in limits:
            if not limit.stated:
                wrong += limit.beyond(np.inf) or limit.beyond(-np.inf)
                continue
            edge = limit.most if limit.most is not None else limit.least
            out = np.inf if limit.most is not None else -np.inf
            wrong += limit.beyond(edge) + (not limit.beyond(np.nextafter(edge, out))) + (not limit.beyond(np.nan))
    return wrong


@case(
    "Diagnostics that are missing, None or empty",
    hazard="the check itself fails on a result that has nothing to say",
    treatment="a figure that is not there has no limit; a share of nothing is 0",
    bound=0,
    unit="stages that failed",
    outcome="no figure, no stop",
)
def test_missing_diagnostics():
    wrong = 0
    blank = ({}, {"scans": None, "fit": None, "calibration": None, "points": {}, "outliers": {}, "regions": {}})
    for limits in LIMITS.values():
        for told in (*blank, {"samples": [], "residual": None, "object_pixels": 0, "valid_pixels": None}):
            found = [
                each for each in limit_checks(limits, told) if each.limit.name not in ("object_pixels", "visible_share")
            ]
            wrong += any(each.beyond for each in found)
    check("render", (), {"anything": float("nan")})
    wrong += Limit("x", "x", at("a.b.c"), most=1).figure({"a": {"b": 3}}) is not None
    return wrong
