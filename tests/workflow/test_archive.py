"""A finished scene as an archive: resumed after a kill, verified, pruned, packed; no clock is trusted."""

import json
import os
import shutil
import signal
import time
from contextlib import suppress

import pytest
from refusals import expect_facts

from nishiki.artifacts.artifact import MANIFEST, RUN, open_artifact, run_text

pytestmark = pytest.mark.slow


def wait_for(condition, process, seconds=120.0):
    until = time.monotonic() + seconds
    while not condition():
        assert process.poll() is None, "the run ended before it could be disturbed"
        assert time.monotonic() < until
        time.sleep(0.02)


def stages_listed(site):
    """Stages of the artifacts that prune would remove."""
    lines = [json.loads(line) for line in site.nishiki("prune", "--json").stdout.splitlines()]
    return sorted(line["path"].split("/")[-2] for line in lines if line.get("what") == "remove")


def test_a_killed_run_is_resumed_by_one_command_and_a_live_one_is_left_alone(site):
    undisturbed = site.run_facts()
    site.configure(height={"method": "weighted"})
    process = site.start("run")
    try:
        wait_for(lambda: list((site.folder / "results/.runs").glob("*.json")), process)
        os.killpg(process.pid, signal.SIGSTOP)  # alive, and still so when the last of the commands has been asked
        for command in (["run"], ["prune", "--delete"]):
            done = site.nishiki(*command, check=False)
            assert (done.returncode, "a run" in done.stderr, "alive" in done.stderr) == (2, True, True), command
            assert str(process.pid) in done.stderr
        assert process.poll() is None
    finally:
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()
    assert list((site.folder / "results/.runs").glob("*.json"))
    done = site.nishiki("run")
    assert "resuming" in done.stderr
    assert not list((site.folder / "results/.runs").glob("*.json"))
    now = site.run_facts()
    changed = sorted(stage for stage in now if now[stage] != undisturbed[stage])
    assert "height" in changed
    assert not {"ingest", "separate", "normals"} & set(changed)
    assert set(changed) <= set(stages_listed(site))
    site.nishiki("prune", "--delete")
    assert stages_listed(site) == []
    assert "sound" in site.nishiki("verify").stdout
    assert site.would_run() == []


def test_an_interrupted_run_says_so_without_tracebacks_and_goes_on(site):
    undisturbed = json.loads((site.folder / "results/tiny/current/index.json").read_text())
    shutil.rmtree(site.folder / "results")
    process = site.start("run")
    try:
        wait_for(lambda: list((site.folder / "results/tiny").glob("normals/*")), process)  # its stage starts now
        time.sleep(1.0)
        os.killpg(process.pid, signal.SIGINT)
        process.wait(timeout=60)
    finally:
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()
    told = (site.folder / "run.log").read_text()
    assert process.returncode == 1
    assert "Traceback" not in told
    expect_facts(told, "interrupted", "0 of 1", "tiny")
    site.nishiki("run")
    now = json.loads((site.folder / "results/tiny/current/index.json").read_text())
    assert now == undisturbed, "a second run from nothing gives the same bytes, interrupted or not"


def test_a_clock_that_went_backwards_neither_repeats_nor_skips_anything(site):
    manifests = sorted((site.folder / "results/tiny").glob(f"*/*/{MANIFEST}"))
    for number, path in enumerate(manifests):  # upstream newer than downstream, and all in the future
        os.utime(path, (4e9 - number, 4e9 - number))
    for path in sorted((site.folder / "results/tiny/ingest").glob(f"*/{MANIFEST}")):
        os.utime(path, (4.2e9, 4.2e9))
    assert site.would_run() == []
    # evaluate is made again with another result, at a time before that of the report that was made from the old one.
    folder = (site.folder / "results/tiny/current/evaluate").resolve()
    manifest = open_artifact(folder).manifest
    data = json.dumps({**manifest, "diagnostics": {**manifest["diagnostics"], "another": 1}}).encode()
    facts = {name: value for name, value in json.loads((folder / RUN).read_text()).items() if "sha256" not in name}
    (folder / MANIFEST).write_bytes(data)
    (folder / RUN).write_text(run_text(facts, data))
    os.utime(folder / MANIFEST, (1e9, 1e9))
    assert "stale" in site.nishiki("verify", check=False).stdout
    site.nishiki("run")
    assert "sound" in site.nishiki("verify").stdout
    report = open_artifact((site.folder / "results/tiny/current/report").resolve())
    assert report.manifest["upstream"]["evaluate"]["digest"] == open_artifact(folder).digest


def test_a_packed_scene_is_sound_where_nothing_else_is(site, tmp_path):
    site.nishiki("pack", "tiny", "--output", str(tmp_path / "crate"), "--zip")
    site.nishiki("pack", "tiny", "--output", str(tmp_path / "small"), "--without-capture")
    for name in ("crate", "crate.zip", "small"):
        done = site.nishiki("verify", "--json", str(tmp_path / name))
        facts = json.loads(done.stdout)
        assert (facts["sound"], facts["scene"], sorted(facts["stages"])) == (True, "tiny", sorted(site.usual_stages()))
        assert facts["photographs"] == (name != "small")
    described = json.loads((tmp_path / "crate/ro-crate-metadata.json").read_text())
    made_by = [entity["description"] for entity in described["@graph"] if entity["@id"].startswith("#run-")]
    assert len(made_by) == len(site.usual_stages())
    assert all("packed" in text for text in made_by)
