"""The page of error against run time shows what is stored, and says why a default is not on its front."""

import importlib.util
import re
from pathlib import Path

import pytest
import yaml

PROGRAM = Path(__file__).resolve().parents[2] / "benchmarks/error_against_run_time.py"


@pytest.fixture(scope="module")
def program():
    spec = importlib.util.spec_from_file_location("error_against_run_time", PROGRAM)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_page_shows_every_drawing_that_its_program_makes_of_the_stored_lines(program):
    drawings = {path.name for path in program.page() if path.suffix == ".svg"}
    assert len(drawings) > 1
    assert {path.name for path in program.DRAWINGS.iterdir()} == drawings
    shown = re.findall(r"\(\.\./sweeps/([^)]+\.svg)\)", program.PAGE.read_text(encoding="utf-8"))
    assert sorted(shown) == sorted(drawings)


def test_every_default_is_on_its_front_or_the_page_says_why_not(program):
    notes = yaml.safe_load(program.NOTES.read_text())
    for subject in program.SUBJECTS.values():
        for part in subject.parts:
            scene = program.stored(part)
            off = scene and "off" in [program.standing(scene, k) for k in range(len(scene["measures"]))]
            assert not off or notes[part.name]["default"]


def test_every_part_is_a_valid_sweep_of_a_shipped_file(program):
    from nishiki.artifacts.declaration import parse
    from nishiki.stages.table import CHAIN
    from nishiki.sweep.variants import SweepSettings, expand

    for subject in program.SUBJECTS.values():
        for part in subject.parts:
            sweep = parse(SweepSettings, program.sweep_of(part), part.name)
            assert 4 <= len(expand(sweep, stages=CHAIN, where=part.name)) <= 12
            assert sweep.axis == "cpu_seconds"
