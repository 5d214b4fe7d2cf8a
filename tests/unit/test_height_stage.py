"""The stage height: its unit, and what it says of reliefs that bow."""

from types import SimpleNamespace

import numpy as np
from pages import make_artifact

from nishiki.artifacts.artifact import Artifact, ArtifactWriter
from nishiki.artifacts.declaration import check, limit_warnings
from nishiki.artifacts.maps import Maps
from nishiki.artifacts.stage import Context, expect_finite
from nishiki.progress import Progress
from nishiki.stages.height import LIMITS, HeightSettings
from nishiki.stages.height.run import run
from nishiki.stages.normals import NormalsSettings
from nishiki.stages.normals.run import create_maps

STAMP = {"scene": "small", "stage": "height", "key": "0123456789ab", "version": "1"}
PITCH_MM = 0.5


def solved_normals(folder, slope_x, slope_y) -> Artifact:
    """The artifact of the stage normals for slopes (rows, columns)."""
    settings = NormalsSettings(solver="least_squares")
    frames = SimpleNamespace(
        uncertainty={},
        shape=slope_x.shape,
        channels=("grey",),
        band_rows=16,
        pixel_pitch_mm=PITCH_MM,
        to_srgb=None,
        white_board=True,
    )
    normals = np.dstack([-slope_x, -slope_y, np.ones_like(slope_x)])

    def fill(writer):
        context = SimpleNamespace(output=writer, stamp=STAMP, settings=settings)
        maps = create_maps(context, frames, terms=0, relight=False, several=False)
        maps["normals"][...] = normals / np.linalg.norm(normals, axis=2, keepdims=True)
        maps["flags"][...] = np.zeros(slope_x.shape, np.uint8)
        maps["sigma"][...] = np.full(slope_x.shape, 0.01)
        return {"finishes": [{"joint": False}]}

    return make_artifact(folder, settings, fill, stamp=STAMP, stage="normals")


def integrated(folder, normals: Artifact, **settings) -> tuple[dict, dict]:
    """Maps and diagnostics of the stage."""
    with ArtifactWriter(folder / "height" / STAMP["key"]) as output:
        context = Context(
            {"normals": normals}, HeightSettings(**settings), output, None, None, STAMP, Progress("small/height")
        )
        diagnostics = run(context)
        expect_finite(output.folder, "height")
        maps = Maps(output.folder)
        return {name: maps.read(name) for name in ("height", "normals") if name in maps}, diagnostics


def test_heights_of_a_capture_with_a_known_scale_are_in_millimetres(tmp_path):
    """The stage normals keeps the distance of pixels; without it exports would have no scale."""
    level = np.zeros((30, 40))
    maps, diagnostics = integrated(tmp_path, solved_normals(tmp_path, level + 0.2, level + 0.1))
    assert diagnostics["unit"] == "mm"
    np.testing.assert_allclose(np.diff(maps["height"], axis=1), 0.2 * PITCH_MM, atol=1e-5)


def dome(columns=40, rows=30):
    """Slopes of a dome that is 0.25 of its width high."""
    x = np.linspace(-1, 1, columns) + np.zeros((rows, 1))
    y = np.linspace(0.75, -0.75, rows)[:, None] + np.zeros(columns)
    return -0.5 * x, -0.5 * y


def test_a_relief_that_bows_is_warned_of_with_the_remedy(tmp_path):
    maps, diagnostics = integrated(tmp_path, solved_normals(tmp_path, *dome()))
    assert "normals" not in maps
    assert diagnostics["flattened_deg"] == 0
    (warning,) = limit_warnings("height", LIMITS, diagnostics)
    assert "height.flatten: true" in warning
    assert "height.allow: [bow]" in warning
    check("height", LIMITS, diagnostics)
    assert not limit_warnings("height", LIMITS, diagnostics, ["bow"])


def test_a_flattened_relief_is_not_warned_of(tmp_path):
    maps, diagnostics = integrated(tmp_path, solved_normals(tmp_path, *dome()), flatten=True)
    assert np.ptp(maps["height"]) < 0.01 * 40 * PITCH_MM
    assert maps["normals"][..., 2].min() > np.cos(np.radians(2))
    assert diagnostics["flattened_deg"] > 10
    assert not limit_warnings("height", LIMITS, diagnostics)
