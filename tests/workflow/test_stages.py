"""A stage is a folder and a line of the table; what a declaration says beside the settings runs nothing again."""

import json

import pytest

pytestmark = pytest.mark.slow

DECLARATION = '''"""Declaration of the stage `brightness`."""


from pydantic import Field

from nishiki.artifacts.declaration import Guarded, Limit, at
from nishiki.stages.base import Cost, Stage

LIMITS = (Limit("dark", "brightness of the object", at("brightness"), least=1e-6, remedy="expose longer", why="black"),)


class BrightnessSettings(Guarded, stage="brightness", version=1, limits=LIMITS):
    """How bright the object is."""

    percentile: float = Field(50, ge=0, le=100, description="of the albedo")


STAGE = Stage(
    settings=BrightnessSettings,
    does="how bright the object is",
    requires=("normals",),
    deliverables=("*.json",),
    cost=lambda facts: Cost(mib=200, seconds=2),
)
'''
RUN = '''"""Brightness: a percentile of the albedo."""

import json

import numpy as np

from nishiki.artifacts.maps import Maps


def run(context):
    """The percentile, as a file and in the diagnostics."""
    albedo = Maps(context.inputs["normals"].folder).read("albedo")
    value = float(np.percentile(albedo[albedo > 0], context.settings.percentile))
    (context.output.folder / "brightness.json").write_text(json.dumps({"brightness": value}))
    return {"brightness": value}
'''


def test_a_new_stage_is_a_folder_and_a_line(site):
    before = site.run_facts()
    folder = site.folder / "workflow/src/nishiki/stages/brightness"
    folder.mkdir()
    for name, text in (("__init__.py", DECLARATION), ("run.py", RUN)):
        (folder / name).write_text(text)
    table = site.folder / "workflow/src/nishiki/stages/table.py"
    table.write_text(table.read_text().replace('    "height",\n', '    "brightness",\n    "height",\n'))
    site.configure(products=["brightness", "render", "evaluate", "report"], brightness={"percentile": 90})
    assert "how bright the object is" in site.nishiki("plan").stdout
    site.nishiki("run")
    current = site.folder / "results/tiny/current"
    value = json.loads((current / "brightness.json").read_text())["brightness"]
    manifest = json.loads((current / "brightness/artifact.json").read_text())
    assert 0 < value < 2
    assert manifest["settings"]["percentile"] == 90
    assert manifest["diagnostics"]["brightness"] == value
    after = site.run_facts()
    assert {stage: after[stage] for stage in ("ingest", "separate", "normals")} == {
        stage: before[stage] for stage in ("ingest", "separate", "normals")
    }, "stages that are not its own ran again"
    done = site.nishiki("run", "--cores", "1")
    assert ": done" not in done.stderr
    site.configure(products=["brightness"], brightness={"percentile": 101})
    done = site.nishiki("run", check=False)
    assert done.returncode == 2
    assert "brightness.percentile" in done.stderr


def test_a_changed_cost_limit_or_text_of_a_declaration_runs_nothing(site):
    path = site.folder / "workflow/src/nishiki/stages/normals/__init__.py"
    text = path.read_text()
    changed = text.replace("mib=400", "mib=401").replace("most=45", "most=44").replace("degrees", "deg")
    assert changed != text
    path.write_text(changed)
    assert site.would_run() == []
