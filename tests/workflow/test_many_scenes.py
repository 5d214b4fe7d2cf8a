"""Ten thousand finished scenes in one table: one that lacks its report is found and made, the others are left alone."""

import os
import shutil

import pytest
from refusals import expect_facts

pytestmark = pytest.mark.long
SCENES = 10_000


def test_one_unfinished_scene_among_many_is_made_and_no_other(site):
    results = site.folder / "results"
    names = [f"scene{number:05d}" for number in range(SCENES)]
    for name in names:
        shutil.copytree(results / "tiny", results / name, symlinks=True, copy_function=os.link)
    rows = "".join(f"{name}\tcaptures/tiny\tcaptures/tiny-truth\n" for name in names)
    (site.folder / "config/scenes.tsv").write_text("scene\tcapture\ttruth\n" + rows)
    unfinished = results / names[SCENES // 3]
    shutil.rmtree((unfinished / "current/report").resolve())
    before = written(results)
    done = site.nishiki("run")
    expect_facts(done.stderr, f"{SCENES - 1} of {SCENES}")
    assert (unfinished / "current/report/report.html").is_file()
    after = written(results)
    assert {name for name in after if after[name] != before[name]} == {unfinished.name}
    expect_facts(site.nishiki("run").stderr, f"{SCENES} of {SCENES}")


def written(results):
    """When each scene's publication was written, in nanoseconds."""
    return {folder.parent.name: folder.stat().st_mtime_ns for folder in results.glob("scene*/current")}
