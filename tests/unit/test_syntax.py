"""Kept syntaxes: equal to parsed ones, found by the bytes of the file alone, and never wrong after damage."""

import json

import pytest

from nishiki.artifacts import provenance
from nishiki.artifacts.provenance import _Store, syntax_of

CODE = '''"""Docstring."""
import os.path
from nishiki.a import b, c


def f(x):
    """Another."""
    from nishiki.late import late

    return x + 1  # a comment
'''
SAME = CODE.replace("Another.", "Said otherwise.").replace("  # a comment", "").replace("\n\n\n", "\n")


@pytest.fixture
def store(tmp_path, monkeypatch):
    """A store of this test; called again: as a new process finds it."""

    def fresh():
        made = _Store(tmp_path / ".kernels" / "syntax.json")
        monkeypatch.setattr(provenance, "_store", lambda: made)
        syntax_of.cache_clear()
        return made

    yield fresh
    syntax_of.cache_clear()


def written(path, text):
    path.write_text(text)
    syntax_of.cache_clear()
    return syntax_of(path)


def test_names_are_found_wherever_they_are_imported(tmp_path, store):
    store()
    names = {"os.path", "nishiki.a", "nishiki.a.b", "nishiki.a.c", "nishiki.late", "nishiki.late.late"}
    assert set(written(tmp_path / "a.py", CODE).names) == names


def test_comments_docstrings_and_layout_are_no_part_and_code_is(tmp_path, store):
    store()
    tree = written(tmp_path / "a.py", CODE).tree
    assert written(tmp_path / "a.py", SAME).tree == tree
    assert written(tmp_path / "a.py", CODE.replace("x + 1", "x + 2")).tree != tree


def test_a_later_process_parses_nothing_that_is_known(tmp_path, store, monkeypatch):
    first = store()
    found = written(tmp_path / "a.py", CODE)
    first.keep()
    store()
    monkeypatch.setattr(provenance.ast, "parse", lambda data: pytest.fail("parsed"))
    assert written(tmp_path / "elsewhere.py", CODE) == found


@pytest.mark.parametrize("text", ["", "[]", "3", "{", '{"a": 1}', '{"a": ["x"]}', '{"a": [1, 2]}', '{"a": null}'])
def test_a_damaged_store_is_as_good_as_none(tmp_path, store, text):
    (tmp_path / ".kernels").mkdir()
    (tmp_path / ".kernels" / "syntax.json").write_text(text)
    made = store()
    found = written(tmp_path / "a.py", CODE)
    made.keep()
    assert len(found.tree) == 64
    entries = json.loads((tmp_path / ".kernels" / "syntax.json").read_text())
    assert list(entries.values()) == [[found.tree, list(found.names)]]


def test_a_store_that_cannot_be_written_does_no_harm(tmp_path, store):
    (tmp_path / ".kernels").write_text("a file")
    made = store()
    written(tmp_path / "a.py", CODE)
    made.keep()
