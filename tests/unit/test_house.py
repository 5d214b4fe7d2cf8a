"""The house's own rules: one lock, one table of stages, empty packages, nothing that names a machine."""

import ast
import re
import subprocess
from collections import Counter
from functools import cache
from graphlib import TopologicalSorter
from importlib import import_module
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import FunctionType

import pytest
import yaml

import nishiki
from nishiki.artifacts.declaration import Closed, Output
from nishiki.artifacts.provenance import SOURCE, program_of, syntax_of
from nishiki.engine.project import Configuration
from nishiki.stages.table import CHAIN

PROJECT = Path(__file__).resolve().parents[2]
PACKAGE = PROJECT / "workflow" / "src" / "nishiki"


@cache
def tree_of(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"))


@cache
def nodes_of(path: Path) -> tuple[ast.AST, ...]:
    return tuple(ast.walk(tree_of(path)))


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


@pytest.mark.parametrize(("name", "stage"), CHAIN.items(), ids=CHAIN)
def test_every_stage_has_a_folder_a_page_and_its_own_block_of_settings(name, stage):
    assert stage.name == name
    assert program_of(name).parent.parent == PACKAGE / "stages"
    assert (PROJECT / "docs/stages" / f"{name}.md").is_file()
    assert name in Configuration.model_fields


def test_every_folder_of_stages_is_in_the_table():
    packages = {path.parent.name for path in (PACKAGE / "stages").glob("*/__init__.py")}
    assert packages == {program_of(name).parent.name for name in CHAIN}


def imports() -> dict[str, set[str]]:
    """Modules of the package by the names of those that they import, late imports included."""
    paths = {
        ".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts).removesuffix(".__init__"): path
        for path in PACKAGE.rglob("*.py")
    }
    return {name: {other for other in syntax_of(path).names if other in paths} for name, path in paths.items()}


def folder(module: str) -> str:
    """Folder of a module of the package; a module at its root stands for itself."""
    return module.split(".")[1]


def test_no_folder_imports_one_that_imports_it():
    relations: dict[str, set[str]] = {}
    for module, others in imports().items():
        if module != "nishiki":
            above = relations.setdefault(folder(module), set())
            above |= {folder(other) for other in others if other != "nishiki"} - {folder(module)}
    assert len(list(TopologicalSorter(relations).static_order())) == len(relations)  # raises CycleError


def test_no_module_imports_one_that_imports_it():
    assert len(list(TopologicalSorter(imports()).static_order())) > 300  # raises CycleError


def definitions(kind: type) -> list:
    paths = list(PACKAGE.rglob("*.py"))
    listed = [tree_of(path).body for path in paths] if kind is ast.ClassDef else map(nodes_of, paths)
    return [node for nodes in listed for node in nodes if type(node) is kind]


def test_the_name_of_a_class_means_one_thing():
    repeated = {name for name, count in Counter(node.name for node in definitions(ast.ClassDef)).items() if count > 1}
    assert repeated == {"Camera"}  # a calibrated view, and a device


def test_functions_are_not_named_by_a_participle():
    """Properties may be, as adjectives; `captured` and `predicted` of the renderer are called by users of objects."""
    word = re.compile(r"_?([a-z]+(?<!e)ed|seen|shown|told|known|kept|found|left|held|lit|given|taken|made|said|drawn)")
    functions = [
        node.name
        for node in definitions(ast.FunctionDef)
        if not any(ast.unparse(each).endswith("property") for each in node.decorator_list)
    ]
    assert {name for name in functions if word.fullmatch(name)} <= {"captured", "predicted"}


def test_what_modules_take_from_a_declaration_is_a_model_of_settings_or_its_arrays():
    """A declaration is no part of a code digest, so nothing that decides a result may stand in one; an array of another
    type is another version of the stage."""
    declared = {f"nishiki.stages.{program_of(name).parent.name}" for name in CHAIN}
    taken, imported = set(), imports()
    for module, others in imported.items():
        if others & declared and module not in declared:
            path = SOURCE.joinpath(*module.split(".")).with_suffix(".py")
            for node in nodes_of(path):
                if isinstance(node, ast.ImportFrom) and node.module in declared:
                    names = {alias.name for alias in node.names}
                    taken |= {(node.module, name) for name in names if f"{node.module}.{name}" not in imported}
    assert len(taken) > 10
    for module, name in taken:
        model = getattr(import_module(module), name)
        if isinstance(model, tuple):
            assert all(isinstance(each, Output) for each in model), f"{module}.{name}"
            continue
        assert issubclass(model, Closed), f"{module}.{name}"
        own = {key for key, item in vars(model).items() if isinstance(item, FunctionType | property)}
        assert not {key for key in own if not key.startswith("__")}, name


@pytest.mark.parametrize("stage", CHAIN.values(), ids=CHAIN)
def test_every_setting_says_what_it_means(stage):
    silent = [name for name, field in stage.settings.model_fields.items() if not field.description]
    assert not silent


def test_packages_are_empty_but_for_declarations_so_that_one_stage_does_not_import_all():
    root, declared = PACKAGE / "__init__.py", {program_of(name).with_name("__init__.py") for name in CHAIN}
    assert not [path for path in PACKAGE.rglob("__init__.py") if path not in {root, *declared} and path.stat().st_size]
    heavy = {"numpy", "scipy", "numba", "zarr", "trimesh", "nishiki.stages.table"}
    assert not [path for path in declared if heavy & set(syntax_of(path).names)]
    # That of the package names what is public and imports nothing by itself; the block is for type checkers.
    statements = [node for node in tree_of(root).body if not isinstance(node, ast.If | ast.FunctionDef)]
    assert not [node for node in statements if isinstance(node, ast.Import | ast.ImportFrom)]
    blocks = [node for node in tree_of(root).body if isinstance(node, ast.If)]
    assert [ast.unparse(node.test) for node in blocks] == ["TYPE_CHECKING"]


def test_no_module_calls_what_is_public_through_the_package():
    """The package's own `__init__.py` is no part of a code digest: nothing that decides a result may go through it."""
    paths = [*PACKAGE.rglob("*.py"), *(PROJECT / "scripts").glob("*.py")]
    public = {f"nishiki.{name}" for name in nishiki.__all__}
    others = [path for path in paths if path != PACKAGE / "__init__.py"]
    assert not [path.name for path in others if public & set(syntax_of(path).names)]
    for path in others:
        imported = [node for node in nodes_of(path) if isinstance(node, ast.Import)]
        assert not [alias for node in imported for alias in node.names if alias.name == "nishiki"], path.name


def test_docstrings_of_functions_begin_with_a_verb():
    spec = spec_from_file_location("figures", PROJECT / ".ci/figures.py")
    figures = module_from_spec(spec)
    spec.loader.exec_module(figures)
    assert figures.summaries_without_verb() == []


def test_the_package_does_not_import_the_workflow_engine():
    assert not [
        path for path in PACKAGE.rglob("*.py") if re.search(r"^\s*(from|import) snakemake\b", path.read_text(), re.M)
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
            for node in (nodes_of(path) if "jit" in text else ())
            if isinstance(node, ast.FunctionDef) and any("jit" in ast.unparse(d) for d in node.decorator_list)
        ]
        calls = [call for node in compiled for call in ast.walk(node) if isinstance(call, ast.Call)]
        found += [f"{path.name}:{call.lineno}" for call in calls if getattr(call.func, "id", "") == "float"]
    assert not found
