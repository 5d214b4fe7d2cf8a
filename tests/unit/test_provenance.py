"""Keys, canonical text and code digests."""

import math
import textwrap

import pytest
from hypothesis import given
from hypothesis import strategies as st

from nishiki.artifacts import provenance
from nishiki.artifacts.provenance import (
    canonical,
    code_digest,
    code_files,
    data_files,
    differences,
    modules_of,
    program_of,
    stage_key,
)

settings = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(2**50), 2**50)
    | st.floats(allow_nan=False, allow_infinity=False)
    | st.text(),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(), inner, max_size=3),
    max_leaves=8,
)


def test_canonical_text_sorts_keys_and_equates_whole_floats_with_integers():
    assert canonical({"b": 1.0, "a": [0.5, 2]}) == canonical({"a": (0.5, 2.0), "b": 1}) == '{"a":[0.5,2],"b":1}'


def test_canonical_text_equates_composed_and_decomposed_unicode():
    assert canonical("caf\u00e9") == canonical("cafe\u0301")


@pytest.mark.parametrize("value", [math.nan, math.inf, {"a": [-math.inf]}])
def test_canonical_text_refuses_what_is_not_finite(value):
    with pytest.raises(ValueError, match="finite"):
        canonical(value)


def test_canonical_text_distinguishes_true_from_one():
    assert canonical(True) != canonical(1)


@pytest.mark.slow
@given(settings, settings)
def test_equal_text_means_no_difference(first, second):
    same = canonical(first) == canonical(second)
    assert same == (differences({"x": first}, {"x": second}) == []) or {type(first), type(second)} >= {bool}


def test_key_depends_on_each_ingredient():
    base = ("normals", 1, {"solver": "a"}, {"ingest": "0" * 12})
    changed = [
        ("height", 1, {"solver": "a"}, {"ingest": "0" * 12}),
        ("normals", 2, {"solver": "a"}, {"ingest": "0" * 12}),
        ("normals", 1, {"solver": "b"}, {"ingest": "0" * 12}),
        ("normals", 1, {"solver": "a"}, {"ingest": "1" * 12}),
    ]
    keys = {stage_key(*arguments) for arguments in [base, *changed]}
    assert len(keys) == 5
    assert all(len(key) == 12 for key in keys)


USED = '''\
"""Text."""


def f():
    """More."""
    from nishiki.deep import VALUE
    return VALUE
'''


@pytest.fixture
def project(tmp_path, monkeypatch):
    """A small package and a script that imports one of its two modules."""
    package = tmp_path / "src" / "nishiki"
    package.mkdir(parents=True)
    (package / "__init__.py").write_text("")
    (package / "deep.py").write_text("VALUE = 1\n")
    (package / "used.py").write_text(USED)
    (package / "unused.py").write_text("OTHER = 1\n")
    script = tmp_path / "scripts" / "stage.py"
    script.parent.mkdir()
    script.write_text("from nishiki.used import f\nf()\n")
    monkeypatch.setattr(provenance, "SOURCE", tmp_path / "src")

    def digest():
        provenance._imports.cache_clear()
        provenance.syntax_of.cache_clear()
        return code_digest(script)

    return package, script, digest


def test_code_files_follow_imports_inside_functions(project):
    _, script, _ = project
    assert [path.name for path in code_files(script)] == ["stage.py", "deep.py", "used.py"]


@pytest.mark.parametrize(
    ("file", "old", "new", "changes"),
    [
        ("used.py", '"""Text."""', '"""Other text."""', False),
        ("used.py", '"""More."""', '"""Less."""', False),
        ("used.py", "    return VALUE", "    # why\n\n    return VALUE", False),
        ("used.py", "return VALUE", "return VALUE + 1", True),
        ("deep.py", "VALUE = 1", "VALUE = 2", True),
        ("unused.py", "OTHER = 1", "OTHER = 2", False),
    ],
)
def test_only_a_change_of_imported_code_changes_the_digest(project, file, old, new, changes):
    package, _, digest = project
    before = digest()
    text = (package / file).read_text()
    assert old in text
    (package / file).write_text(text.replace(old, new))
    assert (digest() != before) == changes


@pytest.mark.parametrize(
    ("module", "remade"),
    [
        ("painting", {"viewer"}),
        ("orbit", {"viewer", "object_viewer", "cloth_viewer"}),
        ("shadow_maps", {"object_viewer", "cloth_viewer"}),
        ("mean_picture", {"cloth_viewer"}),
    ],
)
def test_a_page_is_made_again_where_a_module_that_it_holds_changes_and_nowhere_else(module, remade):
    used = {
        stage: {path.name for path in data_files(code_files(program_of(stage)))}
        for stage in ("viewer", "object_viewer", "cloth_viewer")
    }
    assert {stage for stage, names in used.items() if f"{module}.js" in names} == remade
    assert all({"main.js", "style.css", "texts.en.json", "index.html.j2"} <= names for names in used.values())
    assert all(program_of(stage).with_suffix(".js").name in names for stage, names in used.items())


@pytest.mark.parametrize(
    ("stages", "unrelated"),
    [
        (("mosaic",), ("capture", "polarisation")),
        (("brdf", "evaluate", "render"), ("report",)),
        (("export",), ("evaluate/maps.py",)),
        (("ingest", "normals", "separate", "spectra"), ("report", "render", "export", "commands", "engine", "cli.py")),
    ],
)
def test_a_stage_is_not_made_again_for_code_that_it_does_not_run(stages, unrelated):
    for stage in stages:
        files = code_files(program_of(stage))[1:]  # without the stage itself
        files = {path.relative_to(provenance.SOURCE / "nishiki").as_posix() for path in files}
        assert not {name for name in files if name.startswith(unrelated)}, stage


def test_a_module_that_a_page_imports_and_nobody_has_is_named(tmp_path):
    (tmp_path / "page.js").write_text('import { start } from "viewer/nowhere";\n')
    with pytest.raises(FileNotFoundError, match=r"page\.js: imports viewer/nowhere"):
        modules_of(tmp_path / "page.js", [tmp_path])


def test_touching_a_file_changes_nothing(project):
    package, _, digest = project
    before = digest()
    (package / "used.py").touch()
    assert digest() == before


def test_differences_name_the_place():
    assert differences({"a": {"b": 1}, "c": 2}, {"a": {"b": 3}, "c": 2.0}) == ["a.b: 1 -> 3"]
    assert differences({}, {"k": None}) == [textwrap.dedent("k: '(absent)' -> None")]
