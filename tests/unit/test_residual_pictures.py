"""Views coded as pictures: the decoder shows what the encoder left, under every light, and only of the object."""

import numpy as np
import pytest
from residual_source import SphereSource, scene_of
from turned_sphere import tiles_of_sphere

from nishiki.codec import pictures as coded_pictures
from nishiki.codec.allocate import one_pass, pilot
from nishiki.codec.design import Design
from nishiki.codec.pictures import PictureSource, attach_strayed, decode_picture, pack_strayed
from nishiki.codec.solve import Pursuit
from nishiki.codec.store import PICTURES, STORE, Residual, write_residual
from nishiki.codec.tile_code import Effort
from nishiki.errors import UserError
from nishiki.stages.residual import run

VIEWS, LIGHTS, SHAPE = 3, 2, (90, 70)
EFFORT = Effort(pursuit=Pursuit(rounds=4, inner=4), refinements=2)


def photographs():
    """Smooth pictures (views, lights, rows, columns, 3) and a disc that moves with the view."""
    rows, columns = np.meshgrid(*(np.arange(n) for n in SHAPE), indexing="ij")
    values, masks = np.empty((VIEWS, LIGHTS, *SHAPE, 3), np.float32), []
    for view in range(VIEWS):
        masks.append(np.hypot(rows - 45, columns - 30 - 5 * view) < 27)
        for light in range(LIGHTS):
            wave = 0.4 + 0.2 * np.sin((rows + 9 * light) / 7 + view) * np.cos(columns / 9)
            values[view, light] = np.where(masks[-1][..., None], wave[..., None] * [1, 0.8, 0.6], 9)
    return values, masks


@pytest.mark.parametrize("side", [48, 512])
def test_pictures_of_the_decoder_are_those_of_the_encoder(tmp_path, monkeypatch, side):
    monkeypatch.setattr(coded_pictures, "SIDE", side)
    values, masks = photographs()
    source = PictureSource(lambda view: (values[view], masks[view]), (0, 2), VIEWS, SHAPE, 3)
    plain = {"views": VIEWS, "channels": 3, "full_turn": True, "encoding": "linear", "model": False}
    design = Design(tile_size=side, lights=LIGHTS, **plain)
    found = pilot(source, None, design, EFFORT, threads=1)
    pictures = one_pass(source, None, found.at_step(0.02), EFFORT, threads=1)
    missed = [np.zeros(SHAPE, bool) for _ in range(VIEWS)]
    missed[2][40:60, 30:51] = True
    pictures = attach_strayed(pictures, pack_strayed(missed))
    tiles = tiles_of_sphere(views=VIEWS, pixels=16, size=8, around=2, high=1, sub=1)[:4]
    texels, scene = SphereSource(tiles), scene_of(VIEWS)
    around = pilot(texels, scene, Design(tile_size=8, lights=1, **plain), EFFORT, threads=1).at_step(0.05)
    parts = write_residual(tmp_path, one_pass(texels, scene, around, EFFORT, threads=1), pictures, stamp={}, report={})
    stored = [p.stat().st_size for name in (STORE, PICTURES) for p in (tmp_path / name).rglob("*") if p.is_file()]
    assert sum(stored) == parts["total"] == sum(size for name, size in parts.items() if name != "total")
    residual, error = Residual(tmp_path), 0.0
    assert decode_picture(residual.pictures, 1, 0, SHAPE) is None
    for view in (0, 2):
        for light in range(LIGHTS):
            shown, beyond = decode_picture(residual.pictures, view, light, SHAPE)
            np.testing.assert_array_equal(beyond, missed[view])
            error += float(np.sum((shown - values[view, light])[masks[view]].astype(np.float64) ** 2))
    assert pictures.pixels == LIGHTS * (masks[0].sum() + masks[2].sum())
    assert error == pytest.approx(pictures.error, rel=2e-3)
    signal = sum(np.sum(values[view][:, masks[view]].astype(np.float64) ** 2) for view in (0, 2))
    assert error < 1e-4 * signal  # 40 dB
    (tmp_path / PICTURES / "zarr.json").write_text("{}")
    with pytest.raises(UserError):
        Residual(tmp_path)


def test_texels_are_compared_with_pictures_over_the_whole_outline(monkeypatch):
    """A chair whose hull misses a tenth of its outline had 34.5 dB on the rest and 24.5 dB in all."""
    values, masks = photographs()
    surface = masks[0] & (np.arange(SHAPE[1]) < 30)
    monkeypatch.setattr(run, "outline_of", lambda mesh, camera: surface)
    source = PictureSource(lambda view: (values[view], masks[view]), (0, 2), VIEWS, SHAPE, 3)
    strayed, sums = run.strayed_parts(None, 0, None, source)
    beyond = masks[0] & (np.arange(SHAPE[1]) >= 30 + run.RIM)
    assert strayed[beyond].mean() > 0.9  # opened by two pixels
    assert run.strayed_parts(None, 1, None, source)[1] == (0, 0, 0.0)
    errors = np.where(beyond[..., None], values[0], 0.01)[:, masks[0]]
    assert run.rate_over_outlines(40.0, np.array(sums)) == pytest.approx(
        -10 * np.log10(np.square(errors).mean()), abs=0.01
    )
    assert run.rate_over_outlines(None, np.array(sums)) is None
    assert run.rate_over_outlines(40.0, np.array((9, 0, 0.0))) == 40.0
