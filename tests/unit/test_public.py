"""The public functions: documented in full, loaded one by one, and their examples run."""

import ast
import inspect
import json
import re
import shutil
import subprocess
import sys
import types

import numpy as np
import pytest
from captures import make_capture
from examples import run_examples
from refusals import refused
from unit.test_convert_command import listed, photographs

import nishiki
from nishiki.artifacts.provenance import PACKAGE, SOURCE, code_files, program_of
from nishiki.brdf.cloth.store import save_brdf
from nishiki.brdf.cloth.yarn_facets import CENTRE, shape_of, without_correction
from nishiki.errors import UserError
from nishiki.formats.images import read_codes
from nishiki.stages.table import NAMES

INIT = SOURCE / PACKAGE / "__init__.py"
DIGITISED = {"read_object", "render_view"}
"""Their examples need a digitised object: tests/workflow/test_object.py runs them."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """What the examples read: a capture of five lights, and a fitted cloth."""
    folder = tmp_path_factory.mktemp("examples")
    make_capture(folder / "captures/painting")
    names = [f"a{i}.png" for i in range(4)]
    photographs(folder / "photographs", names)
    (folder / "photographs" / "a.lp").write_text(listed(names))
    (folder / "results/satin/current").mkdir(parents=True)
    save_brdf(folder / "results/satin/current/brdf.npz", without_correction(shape_of(CENTRE), [0.05, 0.1], [0.0, 0.01]))
    return folder


def sections(name: str) -> dict[str, str]:
    """Sections of a docstring by their titles."""
    parts = re.split(r"^([A-Z][A-Za-z ]+)\n-{3,}\n", inspect.cleandoc(getattr(nishiki, name).__doc__), flags=re.M)
    return dict(zip(parts[1::2], parts[2::2], strict=True))


@pytest.mark.parametrize("name", nishiki.__all__)
def test_public_names_are_documented_in_full(name):
    thing, found = getattr(nishiki, name), sections(name)
    assert {"Parameters", "Examples"} <= set(found)
    entries = re.findall(r"^\*{0,2}([a-z_0-9]+(?:, [a-z_0-9]+)*)(?: : .+)?$", found["Parameters"], re.M)
    described = {single for entry in entries for single in entry.split(", ")}
    assert described == set(inspect.signature(thing).parameters)
    if not inspect.isclass(thing):
        assert "Raises" in found
        assert "Returns" in found or inspect.signature(thing).return_annotation in (None, "None")


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in nishiki.__all__ if name not in DIGITISED])
def test_examples_run(name, folder, tmp_path, monkeypatch):
    shutil.copytree(folder, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    run_examples(name)


def test_public_names_are_listed_once_and_each_has_its_place():
    assert list(nishiki.__all__) == sorted(nishiki.__all__)
    assert set(nishiki.__all__) > set(nishiki._PLACES)
    assert set(nishiki.__all__) <= set(dir(nishiki))
    with refused(AttributeError, "normals_of"):
        nishiki.normals_of  # noqa: B018


def test_what_type_checkers_read_is_what_is_loaded():
    shown = {}
    for node in ast.walk(ast.parse(INIT.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom):
            shown |= {alias.asname or alias.name: f"{node.module}:{alias.name}" for alias in node.names}
    assert shown == {name: f"nishiki.{nishiki._PLACES.get(name, f'api:{name}')}" for name in nishiki.__all__}


def test_one_name_does_not_load_the_others():
    code = "import sys, nishiki; nishiki.fresnel; print(*[name for name in sys.modules if name.startswith('nishiki.')])"
    environment = {"PYTHONPATH": str(SOURCE), "PATH": ""}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, env=environment)
    loaded = set(done.stdout.split())
    assert "nishiki.brdf.torrance_sparrow" in loaded
    assert not {name for name in loaded if name.split(".")[1] in ("capture", "colour", "photometric", "api", "stages")}


@pytest.mark.slow
def test_no_stage_depends_on_the_public_names():
    for name in NAMES:
        files = {path.relative_to(SOURCE / PACKAGE).as_posix() for path in code_files(program_of(name))}
        assert not files & {"__init__.py", "api.py"}


def test_observations_are_what_was_photographed(folder):
    observed = nishiki.read_observations(folder / "captures/painting", white_block=1)
    field = nishiki.estimate_normals(
        observed.values[~observed.check, ..., 1],
        observed.directions[~observed.check],
        valid=observed.valid[~observed.check],
        solver="least_squares",
    )
    assert np.degrees(np.arccos(np.clip(field.normals[..., 2], -1, 1))).max() < 0.5
    assert 0.39 < field.albedo.min() < field.albedo.max() < 0.51


def test_a_geometry_of_many_views_is_refused_in_one_sentence(tmp_path, monkeypatch):
    from types import SimpleNamespace

    monkeypatch.setattr("nishiki.capture.folder.load_capture", lambda root: SimpleNamespace(geometry="turntable"))
    with refused(nishiki.errors.UserError, "plane", "turntable"):
        nishiki.read_observations(tmp_path)


def test_a_folder_without_an_object_is_reported(tmp_path):
    with refused(nishiki.errors.UserError, "cameras"):
        nishiki.read_object(tmp_path)


@pytest.mark.parametrize("codes", [np.full((4, 2, 3), 200, np.uint8), np.full((4, 2, 3), 20000.0)])
def test_codes_of_a_file_are_not_taken_for_light(codes):
    lights = np.array([[0.6, 0, 0.8], [-0.6, 0, 0.8], [0, 0.6, 0.8], [0, -0.6, 0.8]])
    with pytest.raises(UserError):
        nishiki.estimate_normals(codes, lights)
    field = nishiki.estimate_normals(codes / 70000, lights, solver="least_squares")
    assert len(repr(field)) < 600
    assert "<table>" in field._repr_html_()


def test_a_picture_is_saved_as_it_was_given(tmp_path):
    linear = np.linspace(0, 1, 12, dtype=np.float32).reshape(2, 2, 3)
    nishiki.save_picture(tmp_path / "a.exr", linear)
    assert np.allclose(read_codes(tmp_path / "a.exr", ("R", "G", "B")), linear)
    for path, values in ((tmp_path / "a.bmp", linear), (tmp_path / "a.png", linear[..., 0, :, None])):
        with pytest.raises(UserError):
            nishiki.save_picture(path, values)


def test_the_notebook_runs(folder, tmp_path, monkeypatch):
    """Its cells, on another capture; a picture that it shows must be one."""
    shutil.copytree(folder, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    shown = []
    display = types.ModuleType("IPython.display")
    display.Image = lambda name: shown.append(read_codes(tmp_path / name, tuple("rgb")).shape)
    monkeypatch.setitem(sys.modules, "IPython", types.ModuleType("IPython"))
    monkeypatch.setitem(sys.modules, "IPython.display", display)
    cells = json.loads((SOURCE.parents[1] / "docs/notebook.ipynb").read_text(encoding="utf-8"))["cells"]
    code = ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"]
    names = {}
    for number, text in enumerate(code):
        exec(compile(text, f"cell {number}", "exec"), names)
    assert shown == [(24, 32, 3)] * 2
    assert len([cell for cell in cells if any("image/png" in out["data"] for out in cell.get("outputs", []))]) == 2
