"""Finished scenes are left out of a run, and only those: each kind of change and of damage is seen."""

import hashlib
import json
import os
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import pytest
from archives import READS, write_artifact, write_scene

from nishiki.artifacts.artifact import MANIFEST, RUN, open_artifact, publish, run_text
from nishiki.artifacts.provenance import canonical, stage_key
from nishiki.commands.engine import names_targets
from nishiki.commands.results import card_of
from nishiki.engine import finished
from nishiki.engine.plan import PlannedStage
from nishiki.engine.project import Scene, StageSettings
from nishiki.engine.running_lock import MARK, RUNS, register_run, scenes_to_make
from nishiki.engine.workflow import Workflow

NAMES = ("first", "second", "third")


@pytest.fixture
def flow(tmp_path, monkeypatch):
    """Three finished scenes of eight stages, and what a run asks of their plans."""
    versions = {"numpy": "2.4.6"}
    monkeypatch.setattr(finished, "_versions", lambda packages: versions)
    codes = dict.fromkeys((*READS, "publish"), "c1")
    plans = {}
    for name in NAMES:
        made = write_scene(tmp_path / name, published=False)
        keys = {stage: item.key for stage, item in made.items()}
        publish(tmp_path / name / "current", scene=name, stages=keys, deliverables={}, code="c1")
        stages = {stage: PlannedStage(stage, keys[stage], {}, {up: keys[up] for up in READS[stage]}) for stage in READS}
        scene = Scene(name, Path("captures/x"), None, ("report",), StageSettings())
        plans[name] = SimpleNamespace(scene=scene, stages=stages)
    flow = SimpleNamespace(plans=plans, results=str(tmp_path), code=codes.__getitem__, codes=codes, versions=versions)
    flow.path, flow.above = partial(Workflow.path, flow), partial(Workflow.above, flow)
    return flow


def folder(flow, stage):
    return Path(flow.results, "second", stage, flow.plans["second"].stages[stage].key)


def test_finished_scenes_are_finished_also_when_their_contents_are_looked_at(flow):
    assert finished.unfinished_scenes(flow) == {}
    assert finished.unfinished_scenes(flow, contents=True) == {}


def missing(flow):
    os.rename(folder(flow, "height"), folder(flow, "height").with_name("elsewhere"))


def lost_file(flow):
    (folder(flow, "normals") / "values.bin").unlink()


def truncated(flow):
    os.truncate(folder(flow, "spectra") / "maps.zarr/values/c/0/1", 399)


def link_in_place_of_a_file(flow):
    path = folder(flow, "spectra") / "values.bin"
    path.rename(path.with_name("moved"))
    path.symlink_to("moved")


def torn_manifest(flow):
    os.truncate(folder(flow, "ingest") / MANIFEST, 100)


def edited_manifest(flow):
    path = folder(flow, "brdf") / MANIFEST
    path.write_text(path.read_text().replace('"error": 0.5', '"error": 0.4'))


def manifest_of_another_key(flow):
    planned = flow.plans["second"].stages["render"]
    os.rename(folder(flow, "render"), folder(flow, "render").with_name("0" * 12))
    flow.plans["second"].stages["render"] = replace(planned, key="0" * 12)


def another_key(flow):
    planned = flow.plans["second"].stages["render"]
    flow.plans["second"].stages["render"] = replace(planned, key="1" * 12)


def another_stage_wanted(flow):
    flow.plans["second"].stages["evaluate"] = PlannedStage("evaluate", "2" * 12, {}, {})


def stage_no_longer_wanted(flow):
    del flow.plans["second"].stages["report"]


def upstream_made_again(flow):
    """The same key, another result: what was made from the old one is stale."""
    scene = Path(flow.results, "second")
    upstream = {name: open_artifact(folder(flow, name)) for name in READS["separate"]}
    write_artifact(scene, "separate", upstream, salt="again")


def made_by_other_code(flow):
    recorded_as(flow, "report", "code", "c0")


def made_with_another_library(flow):
    recorded_as(flow, "report", "libraries", {"numpy": "1.0.0"})


def recorded_as(flow, stage, entry, value):
    """Change what the last stage records, whole and published as a run would have left it."""
    path = folder(flow, stage)
    manifest = json.loads((path / MANIFEST).read_text()) | {entry: value}
    data = json.dumps(manifest, indent=1, sort_keys=True).encode()
    facts = {name: item for name, item in json.loads((path / RUN).read_text()).items() if "sha256" not in name}
    (path / MANIFEST).write_bytes(data)
    (path / RUN).write_text(run_text(facts, data))
    keys = {name: planned.key for name, planned in flow.plans["second"].stages.items()}
    publish(Path(flow.results, "second/current"), scene="second", stages=keys, deliverables={}, code="c1")


def not_published(flow):
    Path(flow.results, "second/current/index.json").unlink()


def published_by_other_code(flow):
    keys = {name: planned.key for name, planned in flow.plans["second"].stages.items()}
    publish(Path(flow.results, "second/current"), scene="second", stages=keys, deliverables={}, code="c0")


def torn_index(flow):
    os.truncate(Path(flow.results, "second/current/index.json"), 50)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (missing, ""),
        (lost_file, "values.bin (missing"),
        (truncated, "399"),
        (link_in_place_of_a_file, "values.bin (missing"),
        (torn_manifest, "artifact.json"),
        (edited_manifest, "artifact.json"),
        (manifest_of_another_key, "render"),
        (another_key, ""),
        (another_stage_wanted, ""),
        (stage_no_longer_wanted, "publish"),
        (upstream_made_again, "separate"),
        (made_by_other_code, "report"),
        (made_with_another_library, "report"),
        (not_published, "publish"),
        (published_by_other_code, "publish"),
        (torn_index, "publish"),
    ],
)
def test_a_changed_scene_is_not_finished_and_the_others_are(flow, change, reason):
    change(flow)
    found = finished.unfinished_scenes(flow)
    assert list(found) == ["second"]
    assert reason in found["second"]
    flow.artifact = lambda scene, stage: flow.path(scene, stage, flow.plans[scene].stages[stage].key)
    assert [card_of(flow, name, "").state for name in NAMES] == ["finished", "unfinished", "finished"]


def test_new_code_and_new_libraries_concern_every_scene(flow):
    flow.codes["normals"] = "c2"
    assert set(finished.unfinished_scenes(flow)) == set(NAMES)
    flow.codes["normals"] = "c1"
    flow.codes["publish"] = "c2"
    assert all("publish" in why for why in finished.unfinished_scenes(flow).values())
    flow.codes["publish"] = "c1"
    flow.versions["numpy"] = "3.0.0"
    assert set(finished.unfinished_scenes(flow)) == set(NAMES)


def test_behind_a_killed_run_a_damaged_file_of_the_right_size_is_seen(flow):
    path = folder(flow, "normals") / "values.bin"
    path.write_bytes(b"\0" * 400)
    assert finished.unfinished_scenes(flow) == {}
    found = finished.unfinished_scenes(flow, contents=True)
    assert list(found) == ["second"]
    assert "SHA-256 differs" in found["second"]


def test_the_key_of_a_stage_is_the_digest_of_one_canonical_text():
    settings = {"b": [1.0, "Ü", None], "a": {"z": True}}
    upstream = {"normals": "0123456789ab", "height": "ba9876543210"}
    text = canonical({"stage": "render", "version": 3, "settings": settings, "upstream": upstream})
    assert stage_key("render", 3, settings, upstream) == hashlib.sha256(text.encode()).hexdigest()[:12]


def test_the_engine_of_a_run_is_told_which_scenes_are_left(tmp_path, monkeypatch):
    assert scenes_to_make(tmp_path, NAMES) == list(NAMES)
    with register_run(tmp_path, NAMES) as run:
        monkeypatch.setenv(MARK, run.facts["id"])
        assert scenes_to_make(tmp_path, NAMES) == list(NAMES)
        run.record_unfinished({"third", "first"})
        assert scenes_to_make(tmp_path, NAMES) == ["first", "third"]
        run.ended = "done"
    assert not list((tmp_path / RUNS).glob("*.json"))
    assert scenes_to_make(tmp_path, NAMES) == list(NAMES)


@pytest.mark.parametrize(
    ("rest", "profile", "says"),
    [
        ([], {"executor": "slurm", "jobs": 200, "rerun-incomplete": True}, False),
        (["--keep-going", "-j", "4", "--resources", "mem_mb=1000", "--latency-wait=20"], {}, False),
        (["--slurm-init-seconds-before-status-checks", "2"], {}, False),
        (["--forceall"], {}, True),
        (["-F"], {}, True),
        (["--forcerun", "normals"], {}, True),
        (["results/tiny/current/index.json"], {}, True),
        (["all"], {}, True),
        (["--until=normals"], {}, True),
        (["--config", "products=[normals]"], {}, True),
        (["--rerun-triggers", "mtime"], {}, True),
        (["--touch"], {}, True),
        (["--no-such-option"], {}, True),
        ([], {"forceall": True}, True),
        ([], {"rerun_triggers": ["mtime"]}, True),
    ],
)
def test_options_that_say_what_to_make_leave_the_decision_to_the_engine(rest, profile, says):
    assert names_targets(rest, profile) == says
