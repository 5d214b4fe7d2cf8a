"""A stage in parts: shares, tallies, the joined files; and what must not be joined."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from refusals import refused

from nishiki.artifacts.artifact import Artifact, ArtifactWriter, open_artifact
from nishiki.artifacts.maps import Maps, MapWriter, StagePart, TiledStage, in_order, read_tally, write_tally
from nishiki.errors import UserError

ROWS, BAND = 10, 3
UPSTREAM = {"ingest": {"key": "0" * 12, "digest": "d"}}


@given(st.integers(0, 60), st.integers(1, 70))
def test_shares_cover_everything_once_in_order_and_evenly(items, total):
    shares = [StagePart(number, total).share(range(items)) for number in range(1, total + 1)]
    assert [item for share in shares for item in share] == list(range(items))
    assert max(map(len, shares)) - min(map(len, shares)) <= 1


@pytest.mark.parametrize("text", ["", "2", "0/3", "4/3", "-1/2", "1/2/3", "a/b", "1.0/2"])
def test_what_is_no_part_is_reported(text):
    with pytest.raises(UserError, match="--part"):
        StagePart.parse(text)


def test_a_tally_comes_back_exactly(tmp_path):
    tally = {
        "same": {"lights": ["a", "ä"], "x": 0.1, "none": None},
        "counts": {"n": 2**60},
        "sigma": np.float32([0.1, 3]),
    }
    write_tally(tmp_path, tally)
    found = read_tally(tmp_path)
    np.testing.assert_array_equal(found.pop("sigma"), tally.pop("sigma"))
    assert found == tally


@dataclass
class FakeContext:
    output: ArtifactWriter
    part: StagePart | None = None
    parts: tuple[Artifact, ...] = ()

    def share(self, items):
        return self.part.share(items) if self.part else items


def work(context):
    """Squares of the row numbers; the tally holds every third."""
    maps = MapWriter(context.output.folder, rows=ROWS, columns=4, band_rows=BAND, stamp={"scene": "x"})
    squares = maps.create("squares", dtype="int64")
    (context.output.folder / "common.txt").write_text("the same in all parts")
    sample = []
    for start in context.share(range(0, ROWS, BAND)):
        rows = np.arange(start, min(ROWS, start + BAND))
        squares[start : start + BAND] = np.repeat(rows[:, None] ** 2, 4, axis=1)
        sample.append(rows[::3])
    return {"same": {"rows": ROWS}, "sample": np.concatenate([np.empty(0, np.int64), *sample])}


def told(context, tallies):
    return {**tallies[0]["same"], "sample": np.concatenate([tally["sample"] for tally in tallies]).tolist()}


def made(folder: Path, **context) -> Artifact:
    with ArtifactWriter(folder) as output:
        context = FakeContext(output, **context)
        diagnostics = TiledStage(work, told)(context)
        part = {"part": f"{context.part.number}/{context.part.total}"} if context.part else {}
        manifest = {
            "scene": "x",
            "stage": "squares",
            "key": "0" * 12,
            "settings": {},
            "upstream": UPSTREAM,
            "code": "c",
        }
        output.finish({**manifest, **part, "diagnostics": diagnostics}, {})
    return open_artifact(folder)


@pytest.fixture
def whole(tmp_path):
    return made(tmp_path / "whole" / ("0" * 12))


@pytest.mark.parametrize("total", [1, 2, 3, 4, 7])
def test_joined_parts_are_the_undivided_artifact(tmp_path, whole, total):
    parts = [made(tmp_path / "parts" / str(n), part=StagePart(n, total)) for n in range(total, 0, -1)]
    ordered = in_order(parts, key="0" * 12, code="c", upstream=UPSTREAM)
    joined = made(tmp_path / "joined" / ("0" * 12), parts=ordered)
    assert joined.digest == whole.digest
    np.testing.assert_array_equal(Maps(joined.folder).read("squares")[:, 0], np.arange(ROWS) ** 2)


def test_parts_that_do_not_belong_together_are_refused(tmp_path):
    parts = [made(tmp_path / str(n), part=StagePart(n, 3)) for n in (1, 2, 3)]
    known = {"key": "0" * 12, "code": "c", "upstream": UPSTREAM}
    for wrong in (parts[:2], [*parts, parts[0]]):
        with refused(UserError, "1", "3", by="in_order"):
            in_order(wrong, **known)
    for change in ({"key": "1" * 12}, {"code": "d"}, {"upstream": {}}):
        with refused(UserError, by="in_order"):
            in_order(parts, **{**known, **change})


def test_a_common_file_that_differs_is_refused(tmp_path):
    parts = [made(tmp_path / str(n), part=StagePart(n, 2)) for n in (1, 2)]
    parts[1].path("common.txt").write_text("not the same in all!!")
    with pytest.raises(UserError, match=r"common\.txt"):
        made(tmp_path / "joined", parts=tuple(parts))


def test_parts_that_decided_differently_are_refused(tmp_path):
    parts = [made(tmp_path / str(n), part=StagePart(n, 2)) for n in (1, 2)]
    tally = read_tally(parts[1].folder)
    write_tally(parts[1].folder, {**tally, "same": {"rows": 11}})
    with refused(UserError, by="__call__"):
        made(tmp_path / "joined", parts=tuple(parts))
