"""The house's own rules: one lock, one table of stages, empty packages, nothing that names a machine."""

import ast
import re
import subprocess
from pathlib import Path

import pytest
import yaml

from nishiki.engine.chains import CHAIN
from nishiki.engine.project import Configuration

PROJECT = Path(__file__).resolve().parents[2]
PACKAGE = PROJECT / "workflow" / "src" / "nishiki"


def tracked() -> list[Path]:
    names = subprocess.run(
        ["git", "ls-files"], cwd=PROJECT, capture_output=True, text=True, check=False
    ).stdout.splitlines()
    return [PROJECT / name for name in names if (PROJECT / name).is_file()]


def test_exported_requirements_are_those_of_the_lock():
    lock = (PROJECT / "uv.lock").read_text()
    locked = set(re.findall(r'\[\[package\]\]\nname = "([^"]+)"\nversion = "([^"]+)"', lock))
    exported = re.findall(r"^([a-z0-9-]+)==([^ ;\n]+)", (PROJECT / "envs/requirements.txt").read_text(), re.MULTILINE)
    assert len(exported) > 30
    assert not [pair for pair in exported if pair not in locked]


@pytest.mark.parametrize("stage", CHAIN.values(), ids=CHAIN)
def test_every_stage_has_a_rule_a_script_settings_and_a_page(stage):
    assert f"rule {stage.name}:" in (PROJECT / "workflow/rules" / f"{stage.name}.smk").read_text()
    assert (PROJECT / "scripts" / f"{stage.name}.py").is_file()
    assert (PROJECT / "docs/stages" / f"{stage.name}.md").is_file()
    assert stage.name in Configuration.model_fields


@pytest.mark.parametrize("stage", CHAIN.values(), ids=CHAIN)
def test_every_setting_says_what_it_means(stage):
    silent = [name for name, field in stage.settings.model_fields.items() if not field.description]
    structured = {"pictures", "sequences", "lights", "view"}
    assert not set(silent) - structured


def test_packages_are_empty_so_that_one_stage_does_not_import_all():
    assert not [path for path in PACKAGE.rglob("__init__.py") if path.read_text().strip()]


def test_rooms_do_not_import_the_workflow_engine():
    assert not [
        path for path in PACKAGE.rglob("*.py") if re.search(r"^\s*(from|import) snakemake", path.read_text(), re.M)
    ]


def test_shipped_configuration_is_valid():
    values = yaml.safe_load((PROJECT / "config/config.yaml").read_text())
    Configuration.model_validate(values)


def test_nothing_names_a_machine():
    places = re.compile(r"(?<![\w.])/(work|home|root)/\w")
    named = [
        str(path.relative_to(PROJECT))
        for path in tracked()
        if path.suffix in {".py", ".md", ".yaml", ".smk", ".toml", ".sh", ".j2"} and places.search(path.read_text())
    ]
    assert not named


def test_kernels_say_which_float_they_mean():
    """In compiled code float(x) of a float32 stays one, unlike in Python: np.float64(x) is what computes in float64."""
    found = []
    for path in [*PACKAGE.rglob("*.py"), *(PROJECT / "scripts").glob("*.py")]:
        text = path.read_text(encoding="utf-8")
        compiled = [
            node
            for node in (ast.walk(ast.parse(text)) if "jit" in text else ())
            if isinstance(node, ast.FunctionDef) and any("jit" in ast.unparse(d) for d in node.decorator_list)
        ]
        calls = [call for node in compiled for call in ast.walk(node) if isinstance(call, ast.Call)]
        found += [f"{path.name}:{call.lineno}" for call in calls if getattr(call.func, "id", "") == "float"]
    assert not found
