"""Cameras of transforms.json, Metashape and Bundler become a turntable's: files written here after their descriptions.

The photographs of the faulty captures all show one jar, whose true matrices are known.
"""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
from turned_cameras import COLUMNS, ROWS, turn

from nishiki.capture.convert import convert, read_source
from nishiki.capture.folder import load_capture
from nishiki.capture.options import ConvertOptions
from nishiki.formats.picture_process import read_matlab
from nishiki.formats.problems import CaptureError
from nishiki.geometry.camera import Camera
from nishiki.observations.views import Views
from nishiki.observations.views_store import write_views
from nishiki.stages.cameras.run import use_given_cameras
from nishiki.stages.ingest import IngestSettings

FLIP = np.diag([1.0, -1.0, -1.0])
POINTS = np.random.default_rng(3).uniform(-0.6, 0.6, (20, 3))
CAMERAS = turn(9)
NAMES = [f"IMG_{i + 1}.png" for i in range(len(CAMERAS))] + ["IMG_10.png"]
NAMES = NAMES[: len(CAMERAS) - 1] + NAMES[-1:]  # the last one sorts before the others as text


def photographs(folder, names=NAMES):
    for i, name in enumerate(names):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(folder / name), np.full((ROWS, COLUMNS, 3), 20 * i + 5, np.uint8))


def to_world(camera):
    """(4, 4) from a camera's points, x right, y down, z into the scene, to the world."""
    return np.vstack([np.column_stack([camera.rotation.T, camera.centre]), [0, 0, 0, 1]])


def lens_of(camera):
    """fx, fy, cx, cy from the corner of the first pixel."""
    k = camera.intrinsics
    return float(k[0, 0]), float(k[1, 1]), float(k[0, 2] + 0.5), float(k[1, 2] + 0.5)


def write_transforms(
    folder, *, axes=FLIP, names=NAMES, cameras=CAMERAS, shared=None, frame=None, file="transforms.json"
):
    fx, fy, cx, cy = lens_of(cameras[0])
    content = {"fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy, "w": COLUMNS, "h": ROWS} if shared is None else shared
    frames = []
    for name, camera in zip(names, cameras, strict=True):
        matrix = to_world(camera) @ np.diag([*np.diag(axes), 1.0])
        frames.append({"file_path": f"./images/{name}", "transform_matrix": matrix.tolist(), **(frame or {})})
    folder.mkdir(parents=True, exist_ok=True)
    (folder / file).write_text(json.dumps({**content, "frames": frames}))


def words(values):
    return " ".join(repr(float(value)) for value in np.ravel(values))


def write_metashape(
    folder, *, terms="", world=None, labels=None, sensors=1, more="", calibration=None, attributes=None
):
    """world: scale, rotation, translation from the chunk's own world to that of CAMERAS."""
    fx, fy, cx, cy = lens_of(CAMERAS[0])
    calibration = calibration or (
        f"<f>{fy!r}</f><b1>{fx - fy!r}</b1><cx>{cx - COLUMNS / 2!r}</cx><cy>{cy - ROWS / 2!r}</cy>{terms}"
    )
    resolution = f'<resolution width="{COLUMNS}" height="{ROWS}"/>'
    initial = f'<calibration type="frame" class="initial">{resolution}<f>1</f></calibration>'
    text = (
        '<?xml version="1.0" encoding="UTF-8"?><document version="1.5.0"><chunk label="Chunk 1"><sensors next_id="1">'
    )
    for number in range(sensors):
        text += f'<sensor id="{number}" label="c" type="frame">{resolution}{initial}<calibration type="frame" '
        text += f'class="adjusted">{resolution}{calibration}</calibration></sensor>'
    component = '<components active_id="0"><component id="0" label="Component 1">'
    if world is not None:
        scale, rotation, translation = world
        component += f"<transform><rotation>{words(rotation)}</rotation><translation>{words(translation)}</translation>"
        component += f"<scale>{scale!r}</scale></transform>"
    text += f'</sensors>{component}</component></components><cameras><group id="0" label="ring">'
    for i, camera in enumerate(CAMERAS):
        placed = to_world(camera)
        if world is not None:
            placed[:3] = rotation.T @ placed[:3] - np.outer(rotation.T @ translation, [0, 0, 0, 1])
            placed[:3, 3] /= scale
        label = (labels or [name.removesuffix(".png") for name in NAMES])[i]
        text += f'<camera id="{i}" sensor_id="{i % sensors}" component_id="0" label="{label}" '
        text += f"{(attributes or {}).get(i, '')}>"
        text += f"<transform>{words(placed)}</transform></camera>"
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "cameras.xml").write_text(f"{text}</group>{more}</cameras></chunk></document>")


def write_bundler(folder, *, names=NAMES, distortion=(0.0, 0.0), points=(), list_file="list.txt", unplaced=()):
    """Cameras as Bundler can say them: one focal length, the principal point in the middle."""
    lines = ["# Bundle file v0.3", f"{len(CAMERAS)} {len(points)}"]
    for i, camera in enumerate(CAMERAS):
        rotation, translation = FLIP @ camera.rotation, FLIP @ camera.translation
        if i in unplaced:
            lines += ["0 0 0"] * 5
            continue
        lines += [f"260.0 {distortion[0]!r} {distortion[1]!r}", *map(words, rotation), words(translation)]
    for place, seen in points:
        lines += [
            words(place),
            "200 200 200",
            f"{len(seen)} " + " ".join(f"{view} 0 {x!r} {y!r}" for view, x, y in seen),
        ]
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "bundle.out").write_text("\n".join(lines) + "\n")
    (folder / list_file).write_text("".join(f"{name}\n" for name in names))


def read_source_of(folder):
    return read_source(folder, ConvertOptions())


def kinds(notes):
    return {note.kind for note in notes} - {"encoding-assumed"}


def pixels(matrix, distortion):
    camera = Camera.from_matrix("v", matrix, rows=ROWS, columns=COLUMNS)
    return replace(camera, distortion=tuple(distortion)).project(POINTS)[0]


def expect_cameras(layout, cameras=CAMERAS, *, atol=1e-7):
    """The photographs in the order of their numbers, each with its camera."""
    assert [path.name for path in layout.photographs] == NAMES[: len(cameras)]
    assert layout.full_turn
    distortions = np.zeros((len(cameras), 5)) if layout.distortions is None else layout.distortions
    for matrix, distortion, camera in zip(layout.matrices, distortions, cameras, strict=True):
        np.testing.assert_allclose(pixels(matrix, distortion), camera.project(POINTS)[0], atol=atol)


@pytest.mark.parametrize(
    "case",
    [
        "01-colmap-no-blank-lines",
        "08-transforms-json",
        "10-metashape-xml",
        "11-bundler-out",
        "14-colmap-backslashes",
        "15-colmap-unpadded-names",
    ],
)
def test_all_programs_give_the_true_cameras_of_the_jar(data, case):
    objects = data / "faulty_captures" / "objects"
    true = read_matlab(objects / "03-jpeg-masks/photographs/cameras.mat", ("P",))["P"].ravel()
    layout = read_source_of(objects / case)
    assert layout.full_turn
    assert len(layout.photographs) == 12
    assert kinds(layout.warnings) == set()
    for found, matrix in zip(layout.matrices, true, strict=True):
        scale = np.linalg.norm(found[2, :3]) / np.linalg.norm(matrix[2, :3])
        np.testing.assert_allclose(found, scale * matrix, atol=1e-4)  # of up to 17,000, written with ten digits


def test_a_newer_model_of_colmap_is_a_lens_that_is_not_read(data):
    with pytest.raises(CaptureError) as refused:
        read_source_of(data / "faulty_captures/objects/12-colmap-newer-model")
    assert [problem.kind for problem in refused.value.problems] == ["cameras-distorted"]


def test_transforms_become_a_turntable(tmp_path):
    photographs(tmp_path / "s" / "images")
    photographs(tmp_path / "s" / "images_2")  # smaller copies lie beside them
    write_transforms(tmp_path / "s")
    made = convert(tmp_path / "s", tmp_path / "c")
    assert (made.layout.split()[-1], kinds(made.warnings)) == ("transforms.json", set())
    assert load_capture(tmp_path / "c").settings.turntable.full_turn
    expect_cameras(read_source_of(tmp_path / "s"))


def test_every_photograph_keeps_the_lens_that_it_has(tmp_path):
    """Programs find a distortion for each photograph; the order of the turn is not that of the file."""
    cameras = [replace(c, distortion=(0.01 * i, -0.02, 0.001, 0.0, 0.0)) for i, c in enumerate(CAMERAS)]
    photographs(tmp_path / "images")
    write_transforms(tmp_path)
    content = json.loads((tmp_path / "transforms.json").read_text())
    for frame, camera in zip(content["frames"], cameras, strict=True):
        frame |= dict(zip(("k1", "k2", "p1", "p2"), camera.distortion[:4], strict=True))
    content["frames"] = content["frames"][::2] + content["frames"][1::2]
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    expect_cameras(read_source_of(tmp_path), cameras)
    convert(tmp_path, tmp_path / "capture")
    capture = load_capture(tmp_path / "capture")
    assert [capture.distortion_of(view) for view in capture.views] == [camera.distortion for camera in cameras]
    (tmp_path / "ingest").mkdir()
    write_views(capture, tmp_path / "ingest", settings=IngestSettings())
    for ours, theirs in zip(use_given_cameras(Views(tmp_path / "ingest"), None)[0], cameras, strict=True):
        np.testing.assert_allclose(ours.project(POINTS)[0], theirs.project(POINTS)[0], atol=1e-7)


def test_transforms_in_parts_with_an_angle_of_view_and_names_without_suffix(tmp_path):
    """As Blender's sets of scenes have them; one focal length and the principal point in the middle."""
    cameras = [
        Camera(
            c.name, np.array([[260, 0, 79.5], [0, 260, 59.5], [0, 0, 1.0]]), c.rotation, c.translation, ROWS, COLUMNS
        )
        for c in CAMERAS
    ]
    photographs(tmp_path / "images")
    angle = {"camera_angle_x": 2 * np.arctan(COLUMNS / 2 / 260)}
    stems = [name.removesuffix(".png") for name in NAMES]
    write_transforms(tmp_path, shared=angle, names=stems[:5], cameras=cameras[:5], file="transforms_train.json")
    write_transforms(tmp_path, shared=angle, names=stems[5:], cameras=cameras[5:], file="transforms_test.json")
    expect_cameras(read_source_of(tmp_path), cameras)


def test_frames_of_transforms_have_lenses_of_their_own(tmp_path):
    photographs(tmp_path / "images")
    fx, fy, cx, cy = lens_of(CAMERAS[0])
    own = {"fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy, "k1": 0.1, "k2": -0.02, "p1": 0.001, "p2": 0.002}
    write_transforms(tmp_path, shared={"fl_x": 1.0, "k1": 0.3, "camera_model": "OPENCV"}, frame=own)
    expect_cameras(read_source_of(tmp_path), turn(9, distortion=(0.1, -0.02, 0.001, 0.002, 0)))


@pytest.mark.parametrize("inverted", [False, True])
def test_transforms_of_another_convention_are_read_by_where_the_cameras_look(tmp_path, inverted):
    photographs(tmp_path / "images")
    write_transforms(tmp_path, axes=np.eye(3))
    if inverted:  # from world to camera
        content = json.loads((tmp_path / "transforms.json").read_text())
        for frame in content["frames"]:
            frame["transform_matrix"] = np.linalg.inv(frame["transform_matrix"]).tolist()
        (tmp_path / "transforms.json").write_text(json.dumps(content))
    layout = read_source_of(tmp_path)
    expect_cameras(layout)
    assert kinds(layout.warnings) == {"cameras-convention"}


@pytest.mark.parametrize(
    ("more", "kind"),
    [
        ({"fl_x": 260, "camera_model": "OPENCV_FISHEYE"}, "cameras-distorted"),
        ({"fl_x": 260, "k4": 0.1}, "cameras-distorted"),
        ({"fl_x": 260, "is_fisheye": True}, "cameras-distorted"),
        ({"fl_x": 260, "camera_angle_x": 1.2}, "camera-values"),
        ({"fl_x": 260, "cx": 320.0, "cy": 240.0}, "camera-values"),
        ({"fl_x": 1040, "w": 4 * COLUMNS, "h": 4 * ROWS}, "camera-values"),
        ({"fl_x": float("nan")}, "camera-values"),
        ({}, "camera-values"),
    ],
)
def test_lenses_of_transforms_that_are_not_of_the_photographs_are_refused(tmp_path, more, kind):
    photographs(tmp_path / "images")
    write_transforms(tmp_path, shared=more)
    with pytest.raises(CaptureError) as refused:
        read_source_of(tmp_path)
    assert {problem.kind for problem in refused.value.problems} == {kind}


@pytest.mark.parametrize("labels", [None, NAMES])
@pytest.mark.parametrize("moved", [False, True])
def test_cameras_of_metashape_become_a_turntable(tmp_path, labels, moved):
    photographs(tmp_path)
    turned = cv2.Rodrigues(np.array([0.3, -0.5, 0.8]))[0]
    write_metashape(tmp_path, labels=labels, world=(2.5, turned, np.array([1.0, -2.0, 3.0])) if moved else None)
    layout = read_source_of(tmp_path)
    expect_cameras(layout)
    assert kinds(layout.warnings) == set()


def test_metashape_names_two_terms_of_its_distortion_the_other_way(tmp_path):
    photographs(tmp_path)
    terms = "<k1>0.1</k1><k2>-0.02</k2><k3>0.003</k3><p1>0.002</p1><p2>0.001</p2>"
    cameras = turn(9, distortion=(0.1, -0.02, 0.001, 0.002, 0.003))
    write_metashape(tmp_path, terms=terms)
    expect_cameras(read_source_of(tmp_path), cameras)
    fx, fy, cx, cy = lens_of(CAMERAS[0])
    older = f"<fx>{fx!r}</fx><fy>{fy!r}</fy><cx>{cx!r}</cx><cy>{cy!r}</cy><skew>0</skew>"
    terms = "<k1>0.1</k1><k2>-0.02</k2><k3>0.003</k3><p1>0.001</p1><p2>0.002</p2>"
    write_metashape(tmp_path, calibration=older + terms)
    expect_cameras(read_source_of(tmp_path), cameras)


def test_cameras_of_metashape_that_are_off_or_unaligned_are_left_out_by_name(tmp_path):
    photographs(tmp_path, [*NAMES, "late.png"])
    write_metashape(tmp_path, more='<camera id="99" sensor_id="0" label="late"/>', attributes={8: 'enabled="false"'})
    layout = read_source_of(tmp_path)
    assert [path.name for path in layout.photographs] == NAMES[:8]
    assert kinds(layout.warnings) == {"photograph-unlisted"}
    assert {word for note in layout.warnings for word in note.found.split(", ")} >= {"late", "IMG_10"}


def test_geocentric_cameras_of_metashape_keep_their_digits(tmp_path):
    photographs(tmp_path)
    write_metashape(tmp_path, world=(1.0, np.eye(3), -np.array([4e6, 5e5, 4.9e6])))
    text = (tmp_path / "cameras.xml").read_text()
    write_metashape(tmp_path)
    (tmp_path / "cameras.xml").write_text(
        (tmp_path / "cameras.xml")
        .read_text()
        .replace("</component>", text[text.index("<transform>") : text.index("</component>")] + "</component>")
    )
    layout = read_source_of(tmp_path)
    assert kinds(layout.warnings) == {"cameras-far"}
    centres = [-np.linalg.solve(matrix[:, :3], matrix[:, 3]) for matrix in layout.matrices]
    assert np.abs(centres).max() < 10


@pytest.mark.parametrize("terms", ["<k4>0.1</k4>", "<p3>0.1</p3>"])
def test_lenses_of_metashape_with_further_terms_are_refused(tmp_path, terms):
    photographs(tmp_path)
    write_metashape(tmp_path, terms=terms)
    with pytest.raises(CaptureError) as refused:
        read_source_of(tmp_path)
    assert refused.value.problems[0].kind == "cameras-distorted"


@pytest.mark.parametrize("list_file", ["list.txt", "bundle.out.list.txt"])
@pytest.mark.parametrize("prefix", ["", "./", "C:\\turn\\", "/mnt/turn/"])
def test_cameras_of_bundler_become_a_turntable(tmp_path, list_file, prefix):
    photographs(tmp_path)
    write_bundler(tmp_path, names=[f"{prefix}{name} 0 5202.3" for name in NAMES], list_file=list_file)
    layout = read_source_of(tmp_path)
    cameras = [
        Camera(
            c.name, np.array([[260, 0, 79.5], [0, 260, 59.5], [0, 0, 1.0]]), c.rotation, c.translation, ROWS, COLUMNS
        )
        for c in CAMERAS
    ]
    expect_cameras(layout, cameras)
    write_bundler(tmp_path, names=NAMES, list_file=list_file, distortion=(0.1, -0.02), unplaced=(8,))
    layout = read_source_of(tmp_path)
    np.testing.assert_array_equal(layout.distortions, [[0.1, -0.02, 0, 0, 0]] * 8)
    assert [path.name for path in layout.photographs] == NAMES[:8]
    assert kinds(layout.warnings) == {"photograph-unlisted"}


def test_points_of_bundler_show_that_photographs_have_another_size(tmp_path):
    photographs(tmp_path)
    inside, outside = (0, 79.0, -58.0), (0, 300.0, 10.0)
    write_bundler(tmp_path, points=[([0, 0, 0], [inside])])
    read_source_of(tmp_path)
    write_bundler(tmp_path, points=[([0, 0, 0], [inside]), ([0, 0, 0], [outside])])
    with pytest.raises(CaptureError) as refused:
        read_source_of(tmp_path)
    assert [(p.kind, p.file) for p in refused.value.problems] == [("camera-values", NAMES[0])]


def test_photographs_are_found_by_the_ends_of_their_paths_or_refused(tmp_path):
    photographs(tmp_path, ["a/IMG_1.png", "b/IMG_1.png"])
    write_bundler(tmp_path, names=[*["IMG_1.png"] * 9])
    for names, kind in ((["IMG_1.png"] * 9, "photograph-ambiguous"), (["IMG_2.png"] * 9, "photograph-missing")):
        write_bundler(tmp_path, names=names)
        with pytest.raises(CaptureError) as refused:
            read_source_of(tmp_path)
        assert refused.value.problems[0].kind == kind
    (tmp_path / "list.txt").unlink()
    with pytest.raises(CaptureError) as refused:
        read_source_of(tmp_path)
    assert refused.value.problems[0].kind == "photographs-count"


def test_cameras_that_look_outward_are_named(tmp_path):
    photographs(tmp_path)
    content = [Camera(c.name, c.intrinsics, FLIP @ c.rotation, FLIP @ c.translation, ROWS, COLUMNS) for c in CAMERAS]
    write_bundler(tmp_path)
    lines = (tmp_path / "bundle.out").read_text().splitlines()
    for i, camera in enumerate(content):
        lines[3 + 5 * i : 7 + 5 * i] = [*map(words, FLIP @ camera.rotation), words(FLIP @ camera.translation)]
    (tmp_path / "bundle.out").write_text("\n".join(lines))
    assert kinds(read_source_of(tmp_path).warnings) == {"cameras-outward"}


@pytest.mark.parametrize(
    ("write", "file"),
    [(write_transforms, "transforms.json"), (write_metashape, "cameras.xml"), (write_bundler, "bundle.out")],
)
def test_files_that_end_anywhere_are_refused(tmp_path, write, file):
    photographs(tmp_path / "images")
    write(tmp_path)
    content = (tmp_path / file).read_bytes().rstrip()
    for length in range(20, len(content) - 2, 97):
        (tmp_path / file).write_bytes(content[:length])
        try:
            read_source_of(tmp_path)
        except CaptureError:
            continue
        assert file == "bundle.out"  # a number that is cut short is another number
        assert len(content) - length < 30
