"""What every chain is held to: its stages load and read what plans and the table of stages say."""

import json

from nishiki.installation import EXTRAS
from nishiki.stages.table import CHAIN

LIGHT = {"numpy"}


def run_facts(site) -> dict[str, dict]:
    """What each stage recorded of its run, by its name."""
    current = site.folder / "results/tiny/current"
    return {path.parent.name: json.loads(path.read_text()) for path in current.glob("*/run.json")}


class WhatIsLoadedAndRead:
    """Tests of a finished scene, the fixture `finished` of the class that inherits them."""

    def test_no_stage_loads_a_heavy_package_that_it_has_not_declared(self, finished):
        found = run_facts(finished)
        undeclared = {
            name: set(facts["packages"]) - LIGHT - set(CHAIN[name].libraries) for name, facts in found.items()
        }
        assert len(undeclared) > 6
        assert not {name: packages for name, packages in undeclared.items() if packages}

    def test_optional_packages_are_loaded_exactly_where_the_plan_says(self, finished):
        told = json.loads(finished.nishiki("plan", "--json").stdout)
        planned = {stage["stage"]: set(stage["packages"]) & set(EXTRAS) for stage in told["stages"]}
        found = {name: set(facts["packages"]) & set(EXTRAS) for name, facts in run_facts(finished).items()}
        assert found == planned
        assert set(told["optional_packages"]["loaded"]) == set().union(*planned.values())

    def test_ingest_reads_what_the_plan_says(self, finished):
        told = json.loads(finished.nishiki("plan", "--json").stdout)
        current = finished.folder / "results/tiny/current/ingest"
        assert json.loads((current / "artifact.json").read_text())["diagnostics"]["read"] == told["reads"]
        # every file at least once: to be decoded; and most twice: to be proven against the seal
        assert json.loads((current / "run.json").read_text())["bytes_read"] > told["reads"]["total"]["bytes_read"]

    def test_the_report_says_what_was_read_and_left_out(self, finished):
        page = (finished.folder / "results/tiny/current/report.html").read_text()
        assert "rawpy" in page
