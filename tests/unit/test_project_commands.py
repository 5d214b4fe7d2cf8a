"""The commands init, add, status, and run with folders, captures and names; what Snakemake would do is not done."""

import shutil
from pathlib import Path

import pytest
from unit.test_convert_command import JPG, listed, photographs

from nishiki.capture.folder import load_capture
from nishiki.cli import main
from nishiki.commands.project import scene_name
from nishiki.engine.project import load_project


@pytest.fixture
def runs(tmp_path, monkeypatch):
    """An empty folder, and the scenes of each call of Snakemake."""
    called = []

    def call(flow, command, **options):
        called.append((list(flow.plans), command[command.index("--keep-going") + 1 :]))
        return 0

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("nishiki.commands.engine.call_engine", call)
    monkeypatch.setattr("nishiki.commands.results.page_of", lambda flow, scene, first: tmp_path / "report.html")
    photographs(tmp_path / "Größe 1", JPG)
    (tmp_path / "Größe 1" / "a.lp").write_text(listed(JPG))
    return called


def status_of(*words):
    with pytest.raises(SystemExit) as ended:
        main(list(words))
    return ended.value.code


def scenes():
    return {name: str(scene.capture) for name, scene in load_project(may_be_empty=True).scenes.items()}


def test_a_folder_of_photographs_is_converted_added_and_run(runs, capsys):
    assert status_of("run", "Größe 1/", "--width-mm", "40", "--title", "Plate") == 0
    name = "Grosse-1"
    assert runs == [([name], [])]
    assert scenes() == {name: f"captures/{name}"}
    text = Path("captures", name, "data", "capture.yaml").read_text(encoding="utf-8")
    assert "pixel_pitch_mm: 5.0" in text
    told = capsys.readouterr().out
    assert {"--lights,", "--encoding", "--white", "--mask", "--name"} <= set(told.split())
    assert status_of("run", "Größe 1") == 0, "converted before: used again"
    assert status_of("run", name, f"captures/{name}") == 0
    assert status_of("run", name, "--until", "normals") == 0
    assert [names for names, _ in runs] == [[name], [name], [name], [name]]
    assert runs[3][1] == ["--until", "normals", "--", f"results/{name}/current/index.json"]


@pytest.mark.parametrize(
    ("words", "fragment"),
    [
        (["platte"], "plate"),
        (["Größe 2/"], "folder"),
        (["plate", "--scene", "x"], "--name"),
        (["plate", "--until"], "--until"),
        (["Größe 1/", "--name", "plate", "--width-mm", "3"], "--width-mm"),
        (["plate", "--width-mm", "3"], "--width-mm"),
        (["--mask", "x.png"], "--mask"),
        (["Größe 1/", "--lights", "none.lp", "--name", "other"], "none.lp"),
    ],
)
def test_what_cannot_be_run_is_refused_before_any_work(runs, capsys, words, fragment):
    assert status_of("run", "Größe 1", "--name", "plate") == 0
    capsys.readouterr()
    assert status_of("run", *words) == 2
    assert fragment in capsys.readouterr().err
    assert (len(runs), list(scenes())) == (1, ["plate"])


def test_photographs_that_changed_are_not_taken_for_those_converted_before(runs):
    assert status_of("run", "Größe 1", "--name", "plate") == 0
    photographs(Path("Größe 1"), [JPG[0]], size=(7, 8))
    assert status_of("run", "Größe 1", "--name", "plate") == 2


def test_a_capture_with_an_error_is_neither_run_nor_added(runs):
    assert status_of("convert", "Größe 1", "captures/plate", "--unsealed") == 0
    next(load_capture("captures/plate").root.glob("frames/*")).unlink()
    assert status_of("init") == 0
    assert status_of("run", "captures/plate") == 2
    assert status_of("add", "captures/plate") == 2
    assert status_of("add", "Größe 1") == 2
    assert (runs, scenes()) == ([], {})


def test_init_add_and_status(runs, capsys):
    assert status_of("init", "mine") == 0
    assert status_of("init", "mine") == 2
    shutil.move("mine/config", "config")
    assert status_of("convert", "Größe 1", "captures/plate") == 0
    assert status_of("add", "captures/plate", "left-wing") == 0
    assert status_of("add", "captures/plate", "left-wing") == 0, "added already"
    assert scenes() == {"left-wing": "captures/plate"}
    capsys.readouterr()
    assert status_of("status") == 0
    assert capsys.readouterr().out.split()[:2] == ["left-wing", "unfinished"]


def test_names_of_scenes_have_plain_letters(tmp_path):
    assert scene_name(tmp_path / "Ölbild 3 (Flügel)") == "Olbild-3-Flugel"
    assert scene_name(tmp_path / "…") == "scene"


@pytest.mark.parametrize("words", [["--help"], ["run", "--help"], ["rig", "plan", "--help"], ["completion", "bash"]])
def test_help_and_completion_are_printed(capsys, words):
    assert status_of(*words) == 0
    assert "nishiki" in capsys.readouterr().out


def test_a_folder_of_fields_becomes_one_row_and_a_scene_for_each_field(runs, capsys):
    for number, name in enumerate(("left", "right")):
        photographs(Path("wall", name), JPG, size=(6 + number, 8))
    Path("wall/dome.lp").write_text(listed(JPG))
    assert status_of("run", "wall") == 2, "nobody says that these are fields"
    assert status_of("run", "wall", "--fields", "--width-mm", "40") == 0
    assert scenes() == {
        "wall--left": "captures/wall/fields/left",
        "wall--right": "captures/wall/fields/right",
        "wall": "captures/wall",
    }
    assert Path("config/scenes.tsv").read_text().count("captures/wall") == 1
    assert runs == [(["wall--left", "wall--right", "wall"], [])]
    assert "--width-mm" in capsys.readouterr().out
    assert status_of("run", "wall/") == 0, "converted before: used again"
    assert status_of("add", "captures/wall") == 0
    photographs(Path("wall/right"), [JPG[0]], size=(9, 8))
    assert status_of("run", "wall/") == 2
