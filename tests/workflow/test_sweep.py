"""A sweep through the workflow: interrupted and continued, its table and page, bad files."""

import csv
import json
import os
import signal
import time

import pytest
import yaml

from nishiki.sweep.variants import AS_CONFIGURED

pytestmark = pytest.mark.slow

SWEEP = {
    "stage": "spectra",
    "variants": {"paper": {"method": "paper"}},
    "paper": "paper",
}


def write_sweep(site, **changes):
    path = site.folder / "config/methods.yaml"
    path.write_text(yaml.safe_dump({**SWEEP, "repeats": 2, **changes}))
    return "config/methods.yaml"


def timings(site):
    return sorted((site.folder / "results/sweeps/timings/tiny/spectra").glob("*/*.json"))


def interrupted(site, sweep):
    """Start a sweep, and interrupt it as soon as its third repeat is there; the repeats that were finished then.

    The newest one is left out: Snakemake may not have seen its end."""
    process = site.start("sweep", sweep)
    until = time.monotonic() + 300
    while len(timings(site)) < 3 and process.poll() is None and time.monotonic() < until:
        time.sleep(0.05)
    os.killpg(process.pid, signal.SIGTERM)
    process.wait(120)
    while group_lives(process.pid) and time.monotonic() < until + 120:
        time.sleep(0.05)
    return dict(sorted(((path, path.stat().st_mtime_ns) for path in timings(site)), key=lambda item: item[1])[:-1])


def group_lives(leader):
    """Whether a process of the group is left."""
    try:
        os.killpg(leader, 0)
    except ProcessLookupError:
        return False
    return True


def test_an_interrupted_sweep_continues_and_tells_error_against_time(site):
    sweep = write_sweep(site)
    before = interrupted(site, sweep)
    assert 1 <= len(before) < 4, before
    assert not (site.folder / "results/sweeps/methods/sweep.json").exists()
    current = os.readlink(site.folder / "results/tiny/current/spectra")

    text = site.nishiki("sweep", sweep).stdout
    assert "default" in text
    assert "results/sweeps/methods/sweep.html" in text
    assert len(timings(site)) == 4
    assert {path: path.stat().st_mtime_ns for path in before} == before
    assert not [path for path in (site.folder / "results/sweeps").rglob(".*")]
    assert os.readlink(site.folder / "results/tiny/current/spectra") == current

    content = json.loads((site.folder / "results/sweeps/methods/sweep.json").read_text())
    (scene,) = content["scenes"]
    rows = {row["name"]: row for row in scene["rows"]}
    assert set(rows) == {AS_CONFIGURED, "paper"}
    assert scene["counted"] == ["spectra"]
    for row in rows.values():
        evaluation = json.loads(evaluation_of(site, row).read_text())["diagnostics"]
        assert row["errors"] == [evaluation["reflectance_rmse_mean"]]
        recorded = [
            json.loads(path.read_text()) for path in timings(site) if path.parent.name == row["keys"]["spectra"]
        ]
        assert len(recorded) == 2
        assert row["times"]["seconds"]["median"] == pytest.approx(sum(one["seconds"] for one in recorded) / 2, abs=1e-3)
        assert all(one["same"] and one["digest"] == digest_of(site, row) for one in recorded)
    assert rows["paper"]["errors"] > rows[AS_CONFIGURED]["errors"]
    with (site.folder / "results/sweeps/methods/sweep.csv").open() as file:
        table = list(csv.DictReader(file))
    assert [row["variant"] for row in table] == list(rows)
    assert "<svg" in (site.folder / "results/sweeps/methods/sweep.html").read_text()
    assert ": done" not in site.nishiki("sweep", sweep).stderr
    assert site.would_run() == []


def evaluation_of(site, row):
    """Manifest of the evaluation that was made from a row's spectra."""
    for path in (site.folder / "results/tiny/evaluate").glob("*/artifact.json"):
        if json.loads(path.read_text())["upstream"]["spectra"]["key"] == row["keys"]["spectra"]:
            return path
    raise AssertionError(f"no evaluation of {row['name']}")


def digest_of(site, row):
    from nishiki.artifacts.provenance import file_digest

    return file_digest(site.folder / "results/tiny/spectra" / row["keys"]["spectra"] / "artifact.json")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"variants": {"x": {"methd": "paper"}}, "paper": ""}, "'method'"),
        ({"stage": "spectre"}, "'spectre'"),
        ({"scenes": ["none"]}, "'none'"),
    ],
)
def test_a_bad_sweep_is_told_in_one_line_with_status_2(asked, changes, message):
    site, ask = asked
    status, _, told = ask("sweep", write_sweep(site, **changes))
    assert status == 2
    assert message in told
    assert "config/methods.yaml" in told
    assert len(told.strip().splitlines()) == 1
