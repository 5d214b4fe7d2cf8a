"""What the command line says of itself and of bad arguments: one line, exit status 2."""

from types import SimpleNamespace

import pytest
from refusals import expect_facts
from unit.test_plan_economy import PLANE

from nishiki.cli import main
from nishiki.engine.workflow import LEAVE_OUT, Workflow
from nishiki.errors import UserError


def said(capsys, *words):
    """Exit status and what was printed on standard error."""
    with pytest.raises(SystemExit) as left:
        main([str(word) for word in words])
    return left.value.code, capsys.readouterr().err


@pytest.fixture
def project(tmp_path, monkeypatch):
    """A folder with a configuration of its own name and a table without scenes."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine.yaml").write_text("scenes: table.tsv\n")
    (tmp_path / "table.tsv").write_text("scene\tcapture\n")
    return tmp_path


@pytest.mark.parametrize("cores", ["0", "-1", "two", "1.5", "", "²"])
def test_cores_are_a_number_from_one_or_all(capsys, cores):
    status, told = said(capsys, "run", f"--cores={cores}")
    assert status == 2
    assert "--cores" in told


def test_options_are_not_guessed_from_their_beginnings(capsys, project):
    """`--config a=1` is Snakemake's, not the beginning of --configfile."""
    status, told = said(capsys, "run", "--config", "a=1")
    assert status == 2
    assert "config/config.yaml" in told


@pytest.mark.parametrize(
    ("text", "words"),
    [("scenes: table.tsv\nheigth: {}\n", "heigth"), ("scenes: table.tsv\nheight: {method: no}\n", "height.method")],
)
def test_mistakes_in_settings_name_the_file_that_was_given(capsys, project, text, words):
    (project / "mine.yaml").write_text(text)
    status, told = said(capsys, "plan", "--configfile", "mine.yaml")
    assert status == 2
    assert told.startswith("nishiki plan: mine.yaml")
    assert words in told


def test_a_table_without_scenes_is_reported(capsys, project):
    status, told = said(capsys, "plan", "--configfile", "mine.yaml")
    assert status == 2
    expect_facts(told, "table.tsv", "./nishiki run")
    (project / "table.tsv").write_text("scene\tcapture\na\tb\t\nc\td\te\tf\n")
    expect_facts(said(capsys, "plan", "--configfile", "mine.yaml")[1], "'c'", 2, 4)
    (project / "table.tsv").write_text("")
    expect_facts(said(capsys, "plan", "--configfile", "mine.yaml")[1], "table.tsv")


def test_a_capture_that_is_not_there_is_told_with_the_way_to_one(capsys, project):
    (project / "table.tsv").write_text("scene\tcapture\nwing\tcaptures/wing\n")
    status, told = said(capsys, "plan", "--configfile", "mine.yaml")
    assert status == 2
    expect_facts(told, "'wing'", "captures/wing", "./nishiki convert")


@pytest.fixture
def three_scenes(project, monkeypatch):
    """A table of three scenes, the second of which has no capture; what a run asks of Snakemake is not done."""

    def facts(scene):
        if scene.name == "wing":
            raise UserError(f"scene {scene.name!r}: no such capture folder")
        return PLANE

    monkeypatch.setattr("nishiki.engine.workflow.scene_facts", facts)
    monkeypatch.setattr("nishiki.commands.inspecting.expect_packages", lambda flow: None)
    rows = "".join(f"{name}\tcaptures/{name}\tnormals\n" for name in ("jar", "wing", "bowl"))
    (project / "table.tsv").write_text("scene\tcapture\tproducts\n" + rows)
    return project


@pytest.mark.parametrize("status", [0, 1])
def test_a_scene_that_cannot_be_planned_does_not_stop_the_others(capsys, three_scenes, monkeypatch, status):
    called = []

    def call(flow, command, *, failures, **options):
        called.append((list(flow.plans), "--keep-going" in command))
        if status:
            failures.append({"scene": "jar", "stage": "ingest", "name": "jar/ingest", "why": "torn", "log": "x.log"})
        return status

    monkeypatch.setattr("nishiki.commands.engine.call_engine", call)
    ended, told = said(capsys, "run", "--configfile", "mine.yaml")
    assert (ended, called) == (1, [(["jar", "bowl"], True)])
    assert "'wing'" in told.splitlines()[0]
    expect_facts(told, "0 of 3", "jar (at ingest)", "bowl (at ingest)", "wing")
    assert ("  jar/ingest: torn (log: x.log)\n" in told) == bool(status)
    assert "'wing'" in told.splitlines()[-1]
    ended, told = said(capsys, "run", "--configfile", "mine.yaml", "--stop-at-first-failure")
    assert (ended, len(called)) == (2, 1)
    assert "'wing'" in told


def test_snakemake_leaves_out_what_cannot_be_planned_where_the_run_says_so(three_scenes, monkeypatch):
    flow = Workflow(file="mine.yaml", lazy=True)
    assert flow.can_be_planned("wing"), "not asked to leave anything out: its plan tells what is wrong"
    monkeypatch.setenv(LEAVE_OUT, "1")
    assert [flow.can_be_planned(name) for name in ("jar", "wing", "bowl")] == [True, False, True]


def test_where_no_scene_can_be_planned_nothing_is_run(capsys, three_scenes):
    (three_scenes / "table.tsv").write_text("scene\tcapture\nwing\tcaptures/wing\n")
    told = "nishiki run: scene 'wing': no such capture folder\n"
    assert said(capsys, "run", "--configfile", "mine.yaml") == (2, told)


def test_verify_without_anything_to_verify_is_no_success(capsys, project):
    (project / "empty").mkdir()
    status, told = said(capsys, "verify", "empty")
    assert status == 2
    expect_facts(told, "empty")


def test_files_that_the_system_refuses_are_told_in_one_line(capsys, project, monkeypatch):
    def refuse():
        raise PermissionError(13, "Permission denied", "/nowhere/x\n")

    monkeypatch.setattr("nishiki.engine.project.Configuration.model_json_schema", refuse)
    told = "nishiki schema: Permission denied (/nowhere/x\\n). Remedy: check its permissions and run again\n"
    assert said(capsys, "schema") == (2, told)


def test_an_interrupt_is_told_in_one_line(capsys, monkeypatch):
    def interrupt():
        raise KeyboardInterrupt

    monkeypatch.setattr("nishiki.engine.project.Configuration.model_json_schema", interrupt)
    assert said(capsys, "schema") == (130, "nishiki schema: interrupted\n")


SIDE_BY_SIDE = ("--dist", "loadfile", "--no-loadscope-reorder")


@pytest.mark.parametrize(
    ("words", "passed_on"),
    [
        ([], ["-n", *SIDE_BY_SIDE]),
        (["--quick"], ["--quick", "-n", *SIDE_BY_SIDE]),
        (["--long"], ["--long", "-n", *SIDE_BY_SIDE]),
        (["tests/unit", "-k", "spectra"], ["tests/unit", "-k", "spectra"]),
        (["--quick", "-x"], ["--quick", "-x"]),
    ],
)
def test_the_tier_and_all_other_arguments_reach_pytest(monkeypatch, words, passed_on):
    commands = []
    monkeypatch.setattr("nishiki.commands.project.install_for_meshlab", lambda: None)
    monkeypatch.setattr(
        "nishiki.commands.project.subprocess.run",
        lambda command, **_: commands.append(command) or SimpleNamespace(returncode=3),
    )
    with pytest.raises(SystemExit) as left:
        main(["test", *words])
    assert left.value.code == 3
    assert [word for word in commands[0][1:] if not word.isdigit()] == ["-m", "pytest", *passed_on]


@pytest.mark.parametrize(
    "words", [("test", "--quick", "--long"), ("demo", "--object", "--cloth"), ("runn",), ("check", "--quik", "x")]
)
def test_arguments_that_mean_nothing_are_refused_and_name_the_help(capsys, words):
    status, told = said(capsys, *words)
    assert status == 2
    assert "--help" in told
