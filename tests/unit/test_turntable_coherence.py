"""Silhouettes against cameras: sound turntables pass, and each mistake is named with the remedy that works."""

import csv
from dataclasses import replace

import cv2
import numpy as np
import pytest
import yaml
from scipy.io import savemat

from nishiki.capture.convert import convert
from nishiki.capture.folder import load_capture
from nishiki.formats.problems import CaptureError
from nishiki.geometry.camera import look_at
from nishiki.geometry.coherence import NOTICEABLE, measure_coherence
from nishiki.observations.check import check_capture
from nishiki.observations.turntable_coherence import DOUBTFUL, describe_coherence

ROWS, COLUMNS = 120, 150
BALLS = {
    "figure": [(0, 0, 0, 1), (0, 1.2, 0.2, 0.55), (0.9, 0.5, 0.3, 0.4), (-0.7, 0.9, -0.5, 0.3), (0.2, -1, 0.6, 0.5)],
    "handle": [(0, 0, 0, 0.9), (0.1, 0.7, 0.3, 0.5)]
    + [(0.9 + 0.6 * np.cos(a), 0.1 + 0.6 * np.sin(a), 0.15, 0.14) for a in np.linspace(-2.2, 2.2, 25)],
    "bowl": [
        (np.cos(a), 0.25 * b, 1.2 * np.sin(a), 0.22) for a in np.linspace(0, 2 * np.pi, 40, endpoint=False)
        for b in range(3) if b < 2 or a < 4
    ] + [(x, -0.3, z, 0.35) for x in (-0.6, 0, 0.6) for z in (-0.6, 0, 0.6)],
}  # fmt: skip
"""Unions of balls: x, y, z, radius. A body with limbs, one with a thin handle, and a hollow one with a broken rim."""


def cameras_round(count, *, degrees=360.0, elevation=20.0):
    """Cameras whose axis is not quite at the pictures' middle, in the order of the turn."""
    cameras = []
    for k in range(count):
        angle, high = np.radians(degrees * k / count), np.radians(elevation)
        eye = 9 * np.array([np.cos(high) * np.sin(angle), np.sin(high), np.cos(high) * np.cos(angle)])
        camera = look_at(eye, (0, 0.1, 0), rows=ROWS, columns=COLUMNS, field_of_view=np.radians(28), name=f"v{k:02d}")
        camera.intrinsics[:2, 2] += 3.0, -2.0
        cameras.append(camera)
    return cameras


def silhouettes_of(kind, cameras, *, noise=0.0, seed=0):
    """A pixel shows the object where its line of sight meets a ball; noise: pixels by which the outline wavers."""
    rng, masks = np.random.default_rng(seed), []
    balls = np.array(BALLS[kind], float)
    for camera in cameras:
        columns, rows = np.meshgrid(np.arange(camera.columns), np.arange(camera.rows))
        rays = np.stack([columns, rows, np.ones_like(rows)], axis=-1) @ np.linalg.inv(camera.intrinsics).T
        rays = rays @ camera.rotation
        rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
        depth = np.full(rows.shape, -np.inf)
        for x, y, z, radius in balls:
            along = rays @ (np.array([x, y, z]) - camera.centre)
            miss = np.linalg.norm(camera.centre + along[..., None] * rays - (x, y, z), axis=-1)
            depth = np.maximum(depth, (radius - miss) * camera.intrinsics[0, 0] / 9)  # pixels within the outline
        waver = cv2.GaussianBlur(rng.normal(size=rows.shape), (0, 0), 3) * 10 * noise
        masks.append(depth + waver > 0)
    return masks


def rearrange(masks, order):
    return [masks[k] for k in order]


@pytest.mark.slow
@pytest.mark.parametrize("kind", BALLS)
@pytest.mark.parametrize("count", [5, 6, 12])
@pytest.mark.parametrize("noise", [0.0, 0.5])
def test_sound_turntables_pass(kind, count, noise):
    cameras = cameras_round(count)
    found = measure_coherence(silhouettes_of(kind, cameras, noise=noise), cameras)
    assert found.correction is None
    assert found.contradiction < (NOTICEABLE if not noise else DOUBTFUL)
    assert describe_coherence(found, cameras, {}) == []


def exchanged(count, first, second):
    order = list(range(count))
    order[first], order[second] = order[second], order[first]
    return order


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["figure", pytest.param("handle", marks=pytest.mark.long)])
@pytest.mark.parametrize(
    ("fault", "named"),
    [
        ("turned the other way", "turn-reversed"),
        ("half a turn, the other way", "turn-reversed"),
        ("sorted as text", "cameras-order"),
        ("two views exchanged", "views-exchanged"),
        ("mirrored", "pictures-mirrored"),
        ("upside down", "pictures-mirrored"),
        ("cameras of smaller pictures", "camera-scale"),
        ("eleven steps for twelve", "turn-angles"),
        ("inverted", "silhouette-inverted"),
        ("one inverted", "silhouette-inverted"),
        ("one moved", "view-contradicts"),
        ("half moved", None),
    ],
)
def test_mistakes_are_named(kind, fault, named):
    count = 12
    half = fault.startswith("half a turn")
    cameras = cameras_round(count, degrees=180.0 if half else 360.0)
    masks = silhouettes_of(kind, cameras)
    stated = cameras
    if fault == "turned the other way":
        masks = rearrange(masks, [-k % count for k in range(count)])
    elif half:
        stated = cameras_round(count, degrees=-180.0)
    elif fault == "sorted as text":
        masks = rearrange(masks, sorted(range(count), key=lambda k: str(k + 1)))
    elif fault == "two views exchanged":
        masks = rearrange(masks, exchanged(count, 2, 7))
    elif fault == "mirrored":
        masks = [mask[:, ::-1] for mask in masks]
    elif fault == "upside down":
        masks = [mask[::-1] for mask in masks]
    elif fault == "cameras of smaller pictures":
        half_size = np.diag([0.5, 0.5, 1.0])
        stated = [replace(camera, intrinsics=half_size @ camera.intrinsics) for camera in cameras]
    elif fault == "eleven steps for twelve":
        masks = silhouettes_of(kind, cameras_round(count, degrees=360 * 12 / 11))
    elif fault == "inverted":
        masks = [~mask for mask in masks]
    elif fault == "one inverted":
        masks[4] = ~masks[4]
    else:
        places = [4] if fault == "one moved" else range(6)
        masks = [np.roll(mask, 6, axis=1) if k in places else mask for k, mask in enumerate(masks)]
    found = measure_coherence(masks, stated)
    assert (found.correction.kind if found.correction else None) == named
    (problem,) = describe_coherence(found, stated, {})
    assert problem.kind == (named or "views-contradict")
    if named in ("cameras-order", "views-exchanged"):
        mended = [stated[k] for k in found.correction.order]
        assert measure_coherence(masks, mended).contradiction < NOTICEABLE
    if fault == "one inverted" or fault == "one moved":
        assert list(found.correction.views) == [4]
    if named == "turn-angles":
        assert float(found.correction.detail) == pytest.approx(12 / 11, abs=1e-3)


def shadowed(masks):
    """Masks of which one shows nothing of the upper part of the object, and one nothing of the lower part."""
    out = [mask.copy() for mask in masks]
    out[0][:45], out[len(out) // 2][80:] = False, False
    return out


@pytest.mark.slow
@pytest.mark.parametrize(
    ("fault", "named"),
    [
        (None, None),
        ("turned the other way", "turn-reversed"),
        ("two views exchanged", "views-exchanged"),
        ("one moved", "view-contradicts"),
    ],
)
def test_shadows_of_single_views_contradict_nothing(fault, named):
    count = 18
    cameras = cameras_round(count)
    masks = shadowed(silhouettes_of("figure", cameras))
    if fault == "turned the other way":
        masks = rearrange(masks, [-k % count for k in range(count)])
    elif fault == "two views exchanged":
        masks = rearrange(masks, exchanged(count, 2, 7))
    elif fault == "one moved":
        masks[4] = np.roll(masks[4], 8, axis=1)
    else:
        assert measure_coherence(masks, cameras).contradiction > DOUBTFUL
    found = measure_coherence(masks, cameras, misses=1)
    assert (found.correction.kind if found.correction else None) == named
    assert named or found.contradiction < NOTICEABLE


@pytest.fixture
def folder(tmp_path):
    """Photographs, silhouettes and the cameras of a turntable that turns the other way."""
    cameras = cameras_round(8)
    masks = silhouettes_of("handle", rearrange(cameras, [-k % 8 for k in range(8)]))
    source = tmp_path / "source"
    for name in ("photographs", "masks"):
        (source / name).mkdir(parents=True)
    rng = np.random.default_rng(2)
    for k, mask in enumerate(masks):
        picture = np.where(mask, 180, 20)[..., None] + rng.integers(-9, 9, (*mask.shape, 3))
        cv2.imwrite(str(source / "photographs" / f"turn_{k}.png"), picture.astype(np.uint8))
        cv2.imwrite(str(source / "masks" / f"turn_{k}.png"), mask * np.uint8(255))
    cells = np.empty(8, object)
    for k, camera in enumerate(cameras):
        cells[k] = camera.matrix
    savemat(source / "photographs" / "cameras.mat", {"P": cells})
    return source


def test_convert_refuses_and_its_remedy_works(folder, tmp_path):
    with pytest.raises(CaptureError) as refusal:
        convert(folder / "photographs", tmp_path / "c", mask=folder / "masks", examine=check_capture)
    (problem,) = refusal.value.problems
    assert problem.kind == "turn-reversed"
    assert "--turn reverse" in problem.remedy
    made = convert(folder / "photographs", tmp_path / "c", mask=folder / "masks", turn="reverse", examine=check_capture)
    assert not [p for p in check_capture(made.folder, level="full") if p.severity == "error"]
    capture = load_capture(made.folder)
    stated = cameras_round(8)
    for k, view in enumerate(capture.views):
        found, expected = capture.matrices[view], stated[-k % 8].matrix
        np.testing.assert_allclose(
            found / np.linalg.norm(found), expected / np.linalg.norm(expected), rtol=0, atol=1e-9
        )


def test_check_finds_the_silhouettes_that_are_not_given(folder, tmp_path):
    made = convert(folder / "photographs", tmp_path / "c")
    problems = {p.kind: p.severity for p in check_capture(made.folder, level="full")}
    assert problems["turn-reversed"] == "error"


def test_cameras_are_arranged_by_name(folder, tmp_path):
    pairs = {"turn_1": "turn_7", "turn_7": "turn_1"}
    made = convert(folder / "photographs", tmp_path / "c", camera_of=pairs)
    capture = load_capture(made.folder)
    with (made.folder / "cameras.csv").open() as file:
        rows = {row["view"]: np.array(list(row.values())[1:], float) for row in csv.DictReader(file)}
    np.testing.assert_array_equal(capture.matrices["turn_1"].ravel(), rows["turn_7"])
    np.testing.assert_array_equal(capture.matrices["turn_2"].ravel(), rows["turn_2"])
    settings = yaml.safe_load((made.folder / "capture.yaml").read_text())
    settings["turntable"]["camera_of"] = {"turn_1": "elsewhere"}
    (made.folder / "capture.yaml").write_text(yaml.safe_dump(settings))
    assert "view-unknown" in {p.kind for p in check_capture(made.folder)}


@pytest.mark.parametrize("case", ["07-inverted-masks", "03-jpeg-masks"])
def test_measured_masks(data, tmp_path, case):
    source = data / "faulty_captures" / "objects" / case
    inverted = case.startswith("07")
    try:
        convert(source / "photographs", tmp_path / "c", mask=source / "masks", examine=check_capture)
        kinds = set()
    except CaptureError as refusal:
        kinds = {p.kind for p in refusal.problems}
    assert kinds == ({"silhouette-inverted"} if inverted else set())
