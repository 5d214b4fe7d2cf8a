"""Masks, silhouettes and label pictures as people save them: which pixels are the object, which doubts are named."""

from __future__ import annotations

import cv2
import numpy as np
import OpenEXR
import pytest

from nishiki.capture.convert import convert
from nishiki.formats.masks import alpha_problems, examine_mask, label_problems, read_labels
from nishiki.formats.problems import CaptureError, error, group_problems
from nishiki.observations.check import check_capture

ROWS, COLUMNS = 60, 80
Y, X = np.mgrid[:ROWS, :COLUMNS]
SHAPE = ((Y - 30) / 20) ** 2 + ((X - 40) / 25) ** 2 < 1
WHITE = np.where(SHAPE, 255, 0).astype(np.uint8)
FULL = np.ones((ROWS, COLUMNS), bool)


def kinds(problems):
    return [problem.kind for problem in problems]


def examined(folder, codes, name="mask.png", options=()):
    path = folder / name
    if name.endswith(".exr"):
        header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
        OpenEXR.File(header, codes).write(str(path))
    else:
        assert cv2.imwrite(str(path), codes, list(options))
    return examine_mask(path)


def with_alpha(colours, alpha):
    return np.dstack([colours, colours, colours, alpha])


@pytest.mark.parametrize(
    ("codes", "doubts"),
    {
        "black and white": (WHITE, []),
        "numbers 0 and 1": (SHAPE.astype(np.uint8), []),
        "16 bit": (SHAPE.astype(np.uint16) * 65535, []),
        "8 bit values in 16 bit": (WHITE.astype(np.uint16), []),
        "video range": (np.where(SHAPE, 235, 16).astype(np.uint8), []),
        "one colour on black": (np.dstack([0 * WHITE, 0 * WHITE, WHITE // 2]), []),
        "grey background": (np.where(SHAPE, 255, 128).astype(np.uint8), []),
        "white, shape in alpha": (with_alpha(np.full_like(WHITE, 255), WHITE), []),
        "black, shape in alpha": (with_alpha(np.zeros_like(WHITE), WHITE), []),
        "black on transparent white": (with_alpha(255 - WHITE, WHITE), []),
        "opaque, shape in colours": (with_alpha(WHITE, np.full_like(WHITE, 255)), []),
        "shape within a layer": (with_alpha(WHITE, np.where(X > 3, 255, 0).astype(np.uint8)), ["mask-alpha"]),
        "photograph cut out": (with_alpha((X * Y % 251).astype(np.uint8), WHITE), ["mask-alpha"]),
        "soft edge of a pixel": (cv2.GaussianBlur(WHITE, (0, 0), 0.5), []),
        "two colours on black": (np.dstack([WHITE * (Y < 30), 0 * WHITE, WHITE // 4 * (Y >= 30)]), ["mask-colours"]),
        "numbers of three parts": (SHAPE.astype(np.uint8) * np.where(Y < 30, 1, 3).astype(np.uint8), ["mask-levels"]),
        "127 and 128": (np.where(SHAPE, 128, 127).astype(np.uint8), ["mask-levels"]),
    }.values(),
)
def test_the_shape_is_read_exactly(tmp_path, codes, doubts):
    mask = examined(tmp_path, codes)
    np.testing.assert_array_equal(mask.inside, SHAPE)
    assert kinds(mask.problems) == doubts


@pytest.mark.parametrize("quality", [30, 75, 95])
def test_jpeg_keeps_the_shape_and_is_named(tmp_path, quality):
    mask = examined(tmp_path, WHITE, "mask.jpg", (cv2.IMWRITE_JPEG_QUALITY, quality))
    assert (mask.inside != SHAPE).mean() < 0.001
    assert kinds(mask.problems) == ["mask-levels"]


def test_float_masks_and_samples_that_are_no_numbers(tmp_path):
    alone, ones = SHAPE.astype(np.float32), np.ones(SHAPE.shape, np.float32)
    for channels in ({"Y": alone}, {"A": alone}, {"R": ones, "G": ones.copy(), "B": ones.copy(), "A": alone}):
        mask = examined(tmp_path, channels, "mask.exr")
        np.testing.assert_array_equal(mask.inside, SHAPE)
        assert mask.problems == ()
    broken = alone.copy()
    broken[0, 0] = np.nan
    mask = examined(tmp_path, {"Y": broken}, "mask.exr")
    np.testing.assert_array_equal(mask.inside, SHAPE)
    assert kinds(mask.problems) == ["mask-levels"]


def test_feathered_edges_are_cut_at_the_middle_and_named(tmp_path):
    mask = examined(tmp_path, cv2.GaussianBlur(np.where(SHAPE, 65535.0, 0.0), (0, 0), 3).astype(np.uint16))
    assert (mask.inside != SHAPE).sum() < 0.02 * SHAPE.sum()
    assert kinds(mask.problems) == ["mask-levels"]


STANDING = SHAPE | ((abs(X - 40) < 12) & (Y > 30))  # touches the lower edge


@pytest.mark.parametrize(
    ("inside", "inverted"),
    {
        "object": (SHAPE, False),
        "its background": (~SHAPE, True),
        "object that stands on the edge": (STANDING, False),
        "its background, too": (~STANDING, True),
        "whole picture": (FULL, False),
        "painting up to a rim": ((Y > 1) & (Y < 58) & (X > 2) & (X < 77), False),
        "painting with three pins left out": (FULL & ((Y - 20) % 17 > 2) | (X % 26 > 2), False),
        "painting with a chart at its edge left out": (FULL & ~((Y > 50) & (X > 20) & (X < 50)), False),
        "ring": (SHAPE & (((Y - 30) / 10) ** 2 + ((X - 40) / 12) ** 2 > 1), False),
    }.values(),
)
def test_a_mask_of_the_background_is_named(tmp_path, inside, inverted):
    mask = examined(tmp_path, np.where(inside, 255, 0).astype(np.uint8))
    np.testing.assert_array_equal(mask.inside, inside)
    assert kinds(mask.problems) == (["mask-inverted"] if inverted else [])


def test_masks_of_image_editors(data):
    for path in sorted((data / "faulty_captures/photographs/06-masks/masks").iterdir()):
        mask = examine_mask(path)
        share = {"inverted.png": 7 / 12, "feathered.png": 0.41}.get(path.name, 5 / 12)
        named = {"inverted.png": ["mask-inverted"], "feathered.png": ["mask-levels"], "lossy.jpg": ["mask-levels"]}
        assert mask.inside.mean() == pytest.approx(share, abs=0.002), path.name
        assert kinds(mask.problems) == named.get(path.name, []), path.name


def test_no_word_on_sound_masks(data):
    masks = [*data.glob("uw_*/*mask.png"), *data.glob("diligent_*/mask.png")]
    assert len(masks) >= 7
    assert [path for path in masks if examine_mask(path).problems] == []


def test_convert_and_check_name_jpeg_silhouettes_in_one_line(data, tmp_path):
    case = data / "faulty_captures/objects/03-jpeg-masks"
    made = convert(case / "photographs", tmp_path / "x", mask=case / "masks", examine=check_capture)
    for problems in (made.warnings, check_capture(tmp_path / "x", level="quick")):
        assert kinds(problems).count("mask-levels") == 12
        assert kinds(group_problems(problems)).count("mask-levels") == 1


def test_the_alpha_channel_of_photographs_that_were_cut_out_is_named(data, tmp_path):
    case = data / "faulty_captures/objects/05-cutouts-rgba"
    assert "alpha-unused" in kinds(convert(case, tmp_path / "x").warnings)
    used = convert(case, tmp_path / "y", mask=case)
    assert "alpha-unused" not in kinds(used.warnings)
    assert examine_mask(case / "turn_00.png").inside.sum() == 3162
    cv2.imwrite(str(tmp_path / "opaque.png"), with_alpha(WHITE, np.full_like(WHITE, 255)))
    assert alpha_problems(tmp_path / "opaque.png") == []


def test_labels_are_exact_or_named(tmp_path):
    labels = np.where(SHAPE, 200, 0).astype(np.uint8)
    labels[SHAPE & (Y < 30)] = 100
    cv2.imwrite(str(tmp_path / "l.png"), np.dstack([labels] * 3))
    np.testing.assert_array_equal(read_labels(tmp_path / "l.png"), labels)
    assert label_problems(labels, "l.png") == []
    assert kinds(label_problems(cv2.GaussianBlur(labels, (0, 0), 1), "l.png")) == ["regions-blended"]
    cv2.imwrite(str(tmp_path / "l.jpg"), labels)
    with pytest.raises(CaptureError) as caught:
        read_labels(tmp_path / "l.jpg")
    assert kinds(caught.value.problems) == ["regions-lossy"]


def test_equal_problems_are_one_with_a_count():
    many = [error("image-size", f"{i}.png", "size differs", found=f"{i}") for i in range(20)]
    alone = error("mask-empty", "m.png", "mask has no pixels")
    joined = group_problems([*many, alone])
    assert kinds(joined) == ["image-size", "mask-empty"]
    assert (joined[0].file, "20" in joined[0].what, joined[1]) == ("0.png", True, alone)
    assert str(CaptureError(many)).count("\n") == 0
    assert len(CaptureError(many).problems) == 20
    assert group_problems(many[:3]) == many[:3]
    same = [error("image-missing", f"{i}.png", "file is missing") for i in range(2)]
    assert len(group_problems(same)) == 1
    remedies = [error("unknown-column", "frames.csv", f"column {i}", remedy=f"Did you mean {i}?") for i in range(8)]
    assert group_problems(remedies) == remedies


def test_several_masks_beside_the_photographs_are_named(tmp_path):
    for i in range(4):
        cv2.imwrite(str(tmp_path / f"L{i}.png"), np.full((6, 8), 1000 * (i + 1), np.uint16))
    (tmp_path / "dome.lp").write_text("4\nL0 .6 0 .8\nL1 0 .6 .8\nL2 -.6 0 .8\nL3 0 -.6 .8\n")
    for name in ("mask.png", "mask_old.jpg"):
        cv2.imwrite(str(tmp_path / name), np.full((6, 8), 255, np.uint8))
    assert "mask-several" in kinds(convert(tmp_path, tmp_path / "c").warnings)
    (tmp_path / "mask.png").unlink()
    made = convert(tmp_path, tmp_path / "d")
    assert "mask-several" not in kinds(made.warnings)
    assert (tmp_path / "d/mask.jpg").is_file()
