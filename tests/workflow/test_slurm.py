"""The workflow through a real Slurm, on this machine: the same bytes as a local run, retries with more memory."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import dataclass

import pytest
from slurm.cluster import QUICK, Unavailable, cluster, install_plugin

pytestmark = pytest.mark.long


@pytest.fixture(scope="session")
def slurm(tmp_path_factory):
    """A running Slurm, as the environment variables that a run needs; skipped where there can be none."""
    try:
        with cluster(tmp_path_factory.mktemp("slurm")):
            yield {"PYTHONPATH": str(install_plugin(tmp_path_factory.mktemp("plugin")))}
    except Unavailable as error:
        pytest.skip(str(error))


@dataclass
class SlurmRun:
    """A scene's local results, and a run of the same scene through Slurm beside them."""

    site: object
    environment: dict[str, str]
    results: str = "results-slurm"

    def start(self, *arguments: str, keep: bool = False, **settings) -> subprocess.Popen:
        """Start a run from nothing, or, keep, from what an earlier one left."""
        self.site.configure(results=self.results, **settings)
        if not keep:
            shutil.rmtree(self.site.folder / self.results, ignore_errors=True)
        path = f"{self.site.folder / 'workflow/src'}:{self.environment['PYTHONPATH']}"
        command = [sys.executable, "-m", "nishiki", "run", "--profile", "slurm", *QUICK, *arguments]
        environment = {**os.environ, "PYTHONPATH": path}
        return subprocess.Popen(
            command,
            cwd=self.site.folder,
            env=environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            start_new_session=True,
        )

    def index(self, results: str) -> dict:
        """Keys and digests of the artifacts of the scene."""
        return json.loads((self.site.folder / results / "tiny/current/index.json").read_text())

    def finish(self, started: subprocess.Popen, *, seconds: float = 600) -> str:
        """What the run told, on its screen and in Snakemake's log file. It must have succeeded, through Slurm."""
        try:
            text, _ = started.communicate(timeout=seconds)
        finally:
            started.kill()
        assert started.returncode == 0, text
        text += max((self.site.folder / ".snakemake/log").glob("*.log")).read_text()
        assert "has been submitted with SLURM jobid" in text
        return text


def test_a_scene_in_parts_through_slurm_has_the_bytes_of_a_local_run(slurm, site):
    run = SlurmRun(site, slurm)
    text = run.finish(run.start(scatter={"separate": 2, "normals": 3}))
    assert text.count("(Rule: part)") == 5
    assert run.index(run.results) == run.index("results")
    assert not list((site.folder / run.results / ".parts").rglob("*.json"))


def test_scenes_of_all_chains_through_slurm_have_the_bytes_of_local_runs(slurm, site, object_site, cloth_site):
    runs = [SlurmRun(one, slurm) for one in (site, object_site, cloth_site)]
    for run, started in [(run, run.start()) for run in runs]:
        run.finish(started)
        assert run.index(run.results) == run.index("results")


def test_a_job_that_slurm_kills_for_its_memory_is_given_more(slurm, site):
    """A cost model far too low: the first attempts are killed, a later one is given enough; the bytes are the same."""
    path = site.folder / "workflow/src/nishiki/stages/base.py"
    text = path.read_text()
    wrong = text.replace("return self.mib + growing + self.tiles * tile_mib", "return 10.0")
    assert wrong != text
    path.write_text(wrong)
    rules = site.folder / "workflow/rules/common.smk"
    rules.write_text(rules.read_text().replace("ENGINE_MB = 400", "ENGINE_MB = 240"))
    run = SlurmRun(site, slurm)
    told = run.finish(run.start(products=["normals"]))
    assert "Trying to restart" in told
    assert told.count("has been submitted with SLURM jobid") > 1
    assert set(run.index(run.results)["artifacts"]) == {"ingest", "separate", "normals"}


def running_jobs() -> list[str]:
    """Numbers of the jobs that Slurm has at work."""
    return subprocess.run(
        ["squeue", "--noheader", "--states=RUNNING", "--format=%i"], capture_output=True, text=True, check=True
    ).stdout.split()


def wait_for(condition, *, seconds: float = 120.0):
    """The first true answer."""
    until = time.monotonic() + seconds
    while not (found := condition()):
        assert time.monotonic() < until
        time.sleep(0.2)
    return found


def test_a_job_that_slurm_cancels_is_submitted_again(slurm, site):
    run = SlurmRun(site, slurm)
    started = run.start()
    (job, *_) = wait_for(running_jobs)
    subprocess.run(["scancel", job], check=True)
    text = run.finish(started)
    assert "Trying to restart" in text
    assert run.index(run.results) == run.index("results")


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
def test_a_run_that_is_ended_or_killed_while_slurm_works_is_resumed_to_the_same_bytes(slurm, site, number):
    run = SlurmRun(site, slurm)
    first = run.start()
    wait_for(running_jobs)
    os.killpg(first.pid, number)
    text, _ = first.communicate(timeout=120)
    if number == signal.SIGTERM:
        assert not running_jobs(), text
    again = run.start(keep=True)
    run.finish(again)
    assert run.index(run.results) == run.index("results")
