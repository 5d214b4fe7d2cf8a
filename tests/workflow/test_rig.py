"""A painting photographed through a rig gives what the same painting photographed by hand gives."""

import csv
from pathlib import Path

import cv2
import numpy as np
import pytest
import zarr

from nishiki.commands.running import photograph_by_rig

pytestmark = pytest.mark.slow


@pytest.fixture
def by_rig(site, monkeypatch):
    """The finished painting and, as a second scene, the same painting through a simulated dome."""
    monkeypatch.chdir(site.folder)
    monkeypatch.setenv("PYTHONPATH", str(site.folder / "workflow/src"))
    assert photograph_by_rig(Path("captures/tiny"), Path("captures/rig"), Path("captures/by-rig")) == 0
    rows = "tiny\tcaptures/tiny\tcaptures/tiny-truth\t\nby-rig\tcaptures/by-rig\t\theight,render\n"
    (site.folder / "config/scenes.tsv").write_text("scene\tcapture\ttruth\tproducts\n" + rows)
    return site


def photographs(capture: Path) -> dict[tuple[str, str], list[bytes]]:
    """Files of a capture by role and light, in the order of the table."""
    found: dict[tuple[str, str], list[bytes]] = {}
    with (capture / "data/frames.csv").open(newline="") as file:
        for row in csv.DictReader(file):
            found.setdefault((row["role"], row["light"]), []).append((capture / "data" / row["file"]).read_bytes())
    return found


def arrays(group: zarr.Group) -> dict[str, np.ndarray]:
    return {name: array[:] for name, array in group.arrays()}


def test_by_rig_and_by_hand_give_identical_photographs_and_results(by_rig):
    folder = by_rig.folder / "captures"
    assert photographs(folder / "by-rig") == photographs(folder / "tiny")
    assert (folder / "by-rig/manifest-sha256.txt").is_file()
    by_rig.nishiki("verify", "--capture", "captures/by-rig")
    by_rig.nishiki("run")
    hand, rig = (by_rig.folder / "results" / name / "current" for name in ("tiny", "by-rig"))
    for stage in ("normals", "height", "spectra"):
        first, second = (arrays(zarr.open_group(scene / stage / "maps.zarr", mode="r")) for scene in (hand, rig))
        assert set(first) == set(second)
        for name, values in first.items():
            assert np.array_equal(values, second[name], equal_nan=values.dtype.kind == "f"), f"{stage}: {name}"
    assert (hand / "brdf/parameters.json").read_bytes() == (rig / "brdf/parameters.json").read_bytes()
    assert np.array_equal(*(cv2.imread(str(scene / "daylight.png")) for scene in (hand, rig)))
