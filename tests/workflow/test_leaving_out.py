"""What the stages really loaded and read, against what plans and the table of stages say."""

import json
import os
import re

import pytest
from loaded_and_read import WhatIsLoadedAndRead, run_facts

from nishiki.installation import EXTRAS

pytestmark = pytest.mark.slow


class TestPainting(WhatIsLoadedAndRead):
    """The painting."""

    @pytest.fixture
    def finished(self, finished_site):
        """The scene."""
        return finished_site


def test_a_scene_that_needs_less_reads_less(site):
    whole = bytes_of_photographs(site)
    with_all_products = normals_files(site)
    (site.folder / "config/scenes.tsv").write_text("scene\tcapture\ttruth\tproducts\ntiny\tcaptures/tiny\t\tnormals\n")
    photographs = sorted((site.folder / "captures/tiny/data/frames").glob("check*"))
    for file in photographs:
        os.rename(file, file.with_suffix(".aside"))
        file.write_bytes(b"nobody should look at this")
    try:
        text = site.nishiki("plan").stdout
        site.nishiki("run")
        facts = run_facts(site)
        less = bytes_of_photographs(site)
        with_normals_alone = normals_files(site)
    finally:
        for file in photographs:
            os.replace(file.with_suffix(".aside"), file)
    assert re.search(r"without 4 .*check", text)
    assert set(facts) == {"ingest", "separate", "normals"}
    assert less < 0.9 * whole
    assert with_normals_alone == with_all_products, "normals depend on the products asked for"
    assert not set(facts["normals"]["packages"]) & set(EXTRAS)


def bytes_of_photographs(site) -> int:
    """Bytes of the files that the published ingest opened. The process also reads its imports, more than tiny files."""
    artifact = json.loads((site.folder / "results/tiny/current/ingest/artifact.json").read_text())
    return artifact["diagnostics"]["read"]["total"]["bytes_read"]


def normals_files(site):
    """Bytes of every file of the published map of normals, by name."""
    folder = (site.folder / "results/tiny/current/normals").resolve() / "maps.zarr/normals"
    files = {str(file.relative_to(folder)): file.read_bytes() for file in folder.rglob("*") if file.is_file()}
    assert any("c/" in name for name in files), "expected chunks of the map"
    return files
