"""The frame around a stage: what it reports of a machine that lacks something."""

import errno
import os
import re
import sys

import pytest

from nishiki.artifacts.stage import run_stage
from nishiki.stages.height import HeightSettings
from nishiki.stages.runner import main


def stage(monkeypatch, tmp_path, error):
    def run(context):
        context.output.path("half.bin").write_bytes(b"half")
        raise error

    monkeypatch.setattr(sys, "argv", ["height.py", "--output", str(tmp_path / "height")])
    run_stage(HeightSettings, run, "text")


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), "c/0"), "c/0"),
        (OSError(errno.EROFS, os.strerror(errno.EROFS)), os.strerror(errno.EROFS)),
        (OSError(errno.ESTALE, os.strerror(errno.ESTALE), "frames.zarr"), "frames.zarr.*Remedy"),
        (OSError(errno.EHOSTDOWN, os.strerror(errno.EHOSTDOWN), "frames.zarr"), "frames.zarr.*Remedy"),
        (MemoryError("cannot allocate 9 GiB"), "9 GiB"),
    ],
)
def test_a_machine_that_lacks_something_is_told_in_one_line(monkeypatch, tmp_path, capsys, error, said):
    with pytest.raises(SystemExit) as ended:
        stage(monkeypatch, tmp_path, error)
    assert ended.value.code == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert re.search(said, line)
    assert list((tmp_path / "height").iterdir()) == []


def test_other_errors_are_bugs_and_keep_their_trace(monkeypatch, tmp_path):
    with pytest.raises(FileNotFoundError):
        stage(monkeypatch, tmp_path, FileNotFoundError(errno.ENOENT, "no such file"))


@pytest.mark.parametrize("name", ["heigth", "table", "--output"])
def test_a_stage_that_does_not_exist_is_named_beside_those_that_do(monkeypatch, capsys, name):
    monkeypatch.setattr(sys, "argv", ["stage.py", name, "--help"])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 2
    assert re.search(rf"'{name}'.*stage\.py NAME --help.*height", capsys.readouterr().err)
    monkeypatch.setattr(sys, "argv", ["stage.py"])
    main()
    assert ": ingest, " in capsys.readouterr().out
