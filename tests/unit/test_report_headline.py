"""Headlines of reports on objects and cloths: what is good, doubtful, and would improve most."""

import re

from nishiki.report.scene_page import headline
from nishiki.stages.report.cloth import cloth_headline
from nishiki.stages.report.object import object_headline

GOOD, DOUBTFUL, REMEDY = "Good", "Doubtful", "To improve it most"


def turn(psnr_db=42.0, *, views=36, boards=2, unit="mm", unseen=0.0, left_out=None):
    psnr = {"captured": {"mean_psnr_db": psnr_db}}
    if left_out is not None:
        psnr["left_out_interpolated"] = {"mean_psnr_db": left_out}
    ingest = {"views": [f"{k:03}" for k in range(views)], "boards": boards, "capture": {"turntable": {"unit": unit}}}
    return {"ingest": ingest, "object_evaluate": {"psnr": psnr}, "object_brdf": {"unseen_share": unseen}}


def test_a_line_without_anything_to_say_is_left_out_and_the_first_lack_gives_the_remedy():
    assert headline([], []) == []
    lines = dict(
        headline(
            [(1, 2, "one"), (None, 2, "five")],
            [(False, "no", "nothing"), (True, "two", "three"), (True, "four", "five")],
        )
    )
    parts = {heading: re.findall(r"\w+", text.lower()) for heading, text in lines.items()}
    assert parts == {GOOD: ["one"], DOUBTFUL: ["two", "four"], REMEDY: ["three"]}


def test_an_object_is_good_where_it_is_near_its_photographs():
    lines = dict(object_headline(turn(46.0, left_out=34.0)))
    assert "0.50 %" in lines[GOOD]  # 10^(-46 / 20)
    assert "2.0 %" in lines[GOOD]
    assert set(lines) == {GOOD}
    assert "5.0 %" in dict(object_headline(turn(26.0, left_out=34.0)))[DOUBTFUL]


def test_an_object_whose_views_are_stored_as_pictures_is_doubtful():
    lines = dict(
        object_headline(turn(46.0, left_out=34.0) | {"residual": {"pictures": {"equal_bytes_psnr_db": 32.4359}}})
    )
    assert "32.4 dB" in lines[DOUBTFUL]
    assert {GOOD, REMEDY} < set(lines)


def test_what_an_object_lacks_is_named_in_the_order_of_its_weight():
    lines = dict(object_headline(turn(views=12, boards=0, unit=None, unseen=0.2, left_out=31.0)))
    assert [word in lines[DOUBTFUL] for word in ("12 views", "20 %", "board", "unit")] == [True] * 4
    assert "degrees" in lines[REMEDY]
    assert "texels.hold_out" in dict(object_headline(turn()))[REMEDY]
    assert object_headline({"ingest": turn()["ingest"]}) == []  # nothing else was made of it


def test_a_cloth_is_judged_on_directions_left_out_and_by_its_noise():
    parts = {"30": {"rms_rel": 0.1}, "60": {"rms_rel": 0.14}}
    evaluation = {"default": "m", "regions": {"cloth": {"models": {"m": {"held_out": {"by_incidence": parts}}}}}}
    samples = {"noise_relative": 0.011, "normal_incidence": 540, "saturated": 0}
    lines = dict(cloth_headline(samples, evaluation, "cloth"))
    assert "12 %" in lines[GOOD]
    assert "1.1 %" in lines[GOOD]
    assert set(lines) == {GOOD}
    lines = dict(cloth_headline({"normal_incidence": 0, "saturated": 7}, {}, "cloth"))
    assert "7 measurements" in lines[DOUBTFUL]
    assert "normal" in lines[REMEDY]
    assert GOOD not in lines
