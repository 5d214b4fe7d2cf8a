"""The helper of tests that finds packages of npm."""

import os

from npm_packages import npm_folder


def test_the_first_folder_that_has_all_files_is_taken(tmp_path, monkeypatch):
    for place, files in {"a": ["x/x.js"], "b": ["x/x.js", "y.js"], "c": ["x/x.js", "y.js"]}.items():
        for file in files:
            (tmp_path / place / file).parent.mkdir(parents=True, exist_ok=True)
            (tmp_path / place / file).touch()
    monkeypatch.setenv("NODE_PATH", os.pathsep.join(["", *(str(tmp_path / place) for place in "abc")]))
    assert npm_folder("x/x.js") == tmp_path / "a"
    assert npm_folder("x/x.js", "y.js") == tmp_path / "b"
    assert npm_folder("x/x.js", "z.js") is None
    monkeypatch.chdir(tmp_path / "a")
    monkeypatch.delenv("NODE_PATH")
    assert npm_folder("x/x.js") is None
