"""Heavy packages: declared where they are loaded, loaded where they are needed, and told of where they are missing."""

import ast
import functools
import importlib
import subprocess
import sys
from pathlib import Path

import pytest

from nishiki.artifacts.provenance import SOURCE, stage_program
from nishiki.errors import UserError
from nishiki.installation import EXTRAS, MODULES, install_command, is_installed, list_loaded, optional
from nishiki.stages.table import CHAIN

PROJECT = Path(__file__).resolve().parents[2]
LIGHT = {"numpy"}
NAMES = {module: name for name, module in MODULES.items()}
PLACES = {
    "av": {"display.py"},
    "colour-science": {"target.py"},
    "gphoto2": {"cameras.py"},
    "materialx": {"textured_surface.py"},
    "pymeshlab": {"scans.py"},
    "pyarrow": {"results.py"},
    "pyserial": {"description.py", "device.py"},
    "rawpy": {"decoders.py"},
    "scikit-image": {"hull.py", "shape.py"},
    "trimesh": {"mesh.py", "scans.py", "surfaces.py"},
    "usd-core": {"textured_surface.py"},
}
"""The modules that take a package of an extra. Of a new one, `idle` of the declaration says which scenes load it."""


@functools.cache
def imported(path: Path, *, at_start: bool) -> frozenset[str]:
    """Heavy packages that a module imports: at its top level, or anywhere."""
    text = path.read_text(encoding="utf-8")
    if not any(name in text for name in (*NAMES, *EXTRAS)):
        return frozenset()
    tree = ast.parse(text)
    found = set()
    for node in tree.body if at_start else ast.walk(tree):
        if isinstance(node, ast.Import):
            found |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            found.add(node.module.split(".")[0])
        elif isinstance(node, ast.Call) and getattr(node.func, "id", "") == "optional" and not at_start:
            found |= {MODULES.get(item.value, "") for item in node.args if isinstance(item, ast.Constant)}
    return frozenset(NAMES[module] for module in found & set(NAMES))


@functools.cache
def of_project(path: Path) -> tuple[Path, ...]:
    """Modules of this project that a module imports at its top level."""
    found = []
    for node in ast.parse(path.read_text(encoding="utf-8")).body:
        names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
        if isinstance(node, ast.ImportFrom) and node.module:
            names = [node.module, *(f"{node.module}.{alias.name}" for alias in node.names)]
        places = [SOURCE.joinpath(*name.split(".")).with_suffix(".py") for name in names]
        places += [PROJECT / "scripts" / f"{name}.py" for name in names]
        found += [place for place in places if place.is_file()]
    return tuple(found)


def at_start(path: Path) -> dict[str, str]:
    """Heavy packages that importing a module loads, and one of the modules that ask for each."""
    seen, queue = set(), [path]
    while queue:
        module = queue.pop()
        if module not in seen:
            seen.add(module)
            queue += of_project(module)
    return {package: module.name for module in seen for package in imported(module, at_start=True)}


@pytest.mark.slow
@pytest.mark.parametrize("stage", CHAIN.values(), ids=CHAIN)
def test_importing_a_stage_loads_no_package_that_it_has_not_declared(stage):
    found = at_start(PROJECT / stage_program(stage.name))
    assert not {package: where for package, where in found.items() if package not in {*stage.libraries, *LIGHT}}


@pytest.mark.slow
def test_only_compiled_kernels_and_stores_are_imported_before_they_are_needed():
    modules = [*SOURCE.rglob("*.py"), *(PROJECT / "scripts").glob("*.py")]
    eager = {str(path): imported(path, at_start=True) - LIGHT - {"numba", "zarr"} for path in modules}
    assert not {name: found for name, found in eager.items() if found}


@pytest.mark.slow
def test_optional_packages_are_taken_where_this_list_says():
    places = {package: set() for package in EXTRAS}
    for path in [*SOURCE.rglob("*.py"), *(PROJECT / "scripts").glob("*.py")]:
        for package in imported(path, at_start=False) & set(EXTRAS):
            places[package].add(path.name)
    assert places == PLACES


@pytest.mark.parametrize("command", ["nishiki.cli", "nishiki.commands.inspecting"])
def test_the_command_line_loads_nothing_heavy(command):
    found = "from nishiki.installation import list_loaded; print(*list_loaded())"
    code = f"import sys; sys.path.insert(0, {str(SOURCE)!r}); import {command}; {found}"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert set(done.stdout.split()) <= (set() if command.endswith("cli") else LIGHT)


def test_conditions_are_of_declared_libraries():
    assert not [
        (name, package)
        for name, stage in CHAIN.items()
        for package in stage.unused_packages
        if package not in stage.libraries
    ]
    assert set(EXTRAS) <= set(MODULES)


def test_every_optional_package_that_a_stage_declares_has_a_condition():
    for stage in CHAIN.values():
        assert set(stage.libraries) & set(EXTRAS) <= set(stage.unused_packages)


def test_a_missing_extra_is_told_with_the_command_that_installs_it(monkeypatch):
    monkeypatch.setitem(MODULES, "trimesh", "trimesh_that_nobody_has")
    assert not is_installed("trimesh")
    with pytest.raises(UserError, match=r"\./nishiki install --extras mesh"):
        optional("trimesh")


def test_one_command_installs_all_that_is_missing():
    assert install_command(("rawpy", "trimesh", "pymeshlab")) == "./nishiki install --extras mesh raw"


def test_extras_are_those_of_the_project_file():
    import tomllib

    extras = tomllib.loads((PROJECT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    for package, extra in EXTRAS.items():
        assert any(line.startswith(package) for line in extras[extra])
    launcher = (PROJECT / "nishiki").read_text()
    assert all(f" {extra} " in launcher.replace('"', " ") for extra in extras)


def test_what_numba_takes_of_scipy_is_not_counted(monkeypatch):
    for name in [name for name in sys.modules if name.startswith("scipy")]:
        monkeypatch.delitem(sys.modules, name)
    importlib.import_module("scipy.linalg")
    assert "scipy" not in list_loaded()
    importlib.import_module("scipy.fft")
    assert "scipy" in list_loaded()
