"""Captures, tables, meshes and artifacts of a stranger: none reads or writes outside its folder, none runs code; each
is refused in a line that names the file. What the fuzzing of `tests/fuzz` found is here by name."""

import json
import os
import pickle
import shlex
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml
import zarr
from captures import edit_block, edit_yaml, make_capture, make_turntable, write_frame
from goniometer_captures import edit_goniometer, make_goniometer, make_table
from refusals import refused

from nishiki.artifacts.artifact import Artifact, ArtifactWriter
from nishiki.artifacts.maps import Maps
from nishiki.capture.convert import convert
from nishiki.capture.folder import load_capture
from nishiki.capture.frames import inside
from nishiki.capture.schema import read_mapping
from nishiki.capture.seal import capture_digest, manifest_text, read_manifest, seal, verify_seal
from nishiki.engine.project import load_project, load_yaml
from nishiki.engine.workflow import Workflow
from nishiki.errors import UserError, printable
from nishiki.formats.files import name_fault
from nishiki.formats.problems import CaptureError
from nishiki.formats.stored import load_arrays
from nishiki.formats.text_tables import load_plain
from nishiki.geometry.mesh import read_triangles
from nishiki.observations.check import check_capture

PROJECT = Path(__file__).resolve().parents[2]
OUTSIDE = (
    "../secret.txt",
    "/etc/hostname",
    "a/../../secret.txt",
    "..\\secret.txt",
    "C:secret.txt",
    "a\nb.png",
    "a\0.png",
)


@pytest.fixture
def secret(tmp_path):
    """A file beside the capture that nothing in it may lead to."""
    path = tmp_path / "secret.txt"
    path.write_text("0.1 0.2 0.9\n0.3 0.1 0.9\n-0.2 0.1 0.9\n")
    return path


def kinds(folder, level="full"):
    return {problem.kind for problem in check_capture(folder, level=level)}


# Names and links


@pytest.mark.parametrize("name", OUTSIDE)
def test_names_that_lead_out_are_refused(tmp_path, secret, name):
    folder = make_capture(tmp_path / "c")
    with refused(CaptureError, kind="outside-folder"):
        inside(folder, name, "frames.csv row 2")
    assert name_fault(name)
    edit_yaml(folder, mask=name)
    with pytest.raises(CaptureError):
        load_capture(folder)


def test_a_name_longer_than_a_file_system_takes_is_refused_and_not_looked_for(tmp_path):
    folder = make_capture(tmp_path / "c")
    for name in ("x" * 5000 + ".png", "a/" * 3000 + "b.png"):
        with refused(CaptureError, "frames.csv"):
            inside(folder, name, "frames.csv row 2")


@pytest.mark.parametrize("key", ["lights.file", "lights.intensities", "camera.sensitivities", "illuminant", "regions"])
def test_every_key_of_a_plane_that_names_a_file_stays_inside(tmp_path, secret, key):
    folder = make_capture(tmp_path / "c")
    (folder / "link.csv").symlink_to(secret)
    settings = yaml.safe_load((folder / "capture.yaml").read_text())
    for name in ("../secret.txt", "link.csv"):
        block, _, inner = key.rpartition(".")
        edit_yaml(folder, **({block: {**settings[block], inner: name}} if block else {inner: name}))
        with pytest.raises(CaptureError) as told:
            load_capture(folder)
        assert "outside-folder" in {problem.kind for problem in told.value.problems}


@pytest.mark.parametrize("key", ["cameras", "mesh", "correspondences", "intrinsics", "calibration"])
def test_every_key_of_a_turntable_that_names_a_file_stays_inside(tmp_path, secret, key):
    folder = make_turntable(tmp_path / "c")
    (folder / "link.ply").symlink_to(secret)
    for name in ("../secret.txt", "link.ply"):
        edit_block(folder, **{key: name})
        with pytest.raises(CaptureError) as told:
            load_capture(folder)
        assert "outside-folder" in {problem.kind for problem in told.value.problems}


@pytest.mark.parametrize("file", ["capture.yaml", "frames.csv"])
def test_the_tables_themselves_are_no_links_out(tmp_path, file):
    folder = make_capture(tmp_path / "c")
    (folder / file).rename(tmp_path / "elsewhere")
    (folder / file).symlink_to(tmp_path / "elsewhere")
    with refused(CaptureError, kind="outside-folder"):
        load_capture(folder)


def test_a_folder_that_is_a_link_out_gives_no_photographs(tmp_path):
    folder = make_capture(tmp_path / "c")
    (folder / "frames").rename(tmp_path / "elsewhere")
    (folder / "frames").symlink_to(tmp_path / "elsewhere")
    with refused(CaptureError, kind="outside-folder"):
        load_capture(folder)
    assert "seal-link" in kinds(folder)


def test_endless_files_are_not_read(tmp_path, quick):
    """A link to /dev/zero was hashed for ever; a pipe waited for a writer."""
    folder = make_capture(tmp_path / "c")
    os.mkfifo(folder / "pipe.png")
    (folder / "zero.png").symlink_to("/dev/zero")
    assert kinds(folder, "quick") >= {"seal-link", "file-special"}
    with pytest.raises(CaptureError, match="link"):
        seal(folder)
    with pytest.raises(CaptureError, match="link"):
        capture_digest(folder)
    (folder / "zero.png").unlink()
    with refused(CaptureError, kind="file-special"):
        seal(folder)


def test_links_put_into_a_sealed_capture_are_reported(tmp_path, secret, quick):
    folder = make_capture(tmp_path / "c")
    seal(folder)
    photograph = next((folder / "data/frames").iterdir())
    photograph.unlink()
    photograph.symlink_to("/dev/zero")
    assert {problem.kind for problem in verify_seal(folder)} == {"seal-link"}
    (folder / "manifest-sha256.txt").unlink()
    (folder / "manifest-sha256.txt").symlink_to(secret)
    with refused(CaptureError, kind="seal-manifest"):
        capture_digest(folder)


def test_sealing_writes_through_no_link(tmp_path, secret):
    """An interrupted sealing is finished; one that a stranger prepared had a link in place of a temporary file."""
    before = secret.read_bytes()
    half = tmp_path / "c.sealing"
    make_capture(half / "data")
    (half / ".bagit.txt.part").symlink_to(secret)
    with pytest.raises(CaptureError, match="link"):
        seal(tmp_path / "c")
    assert secret.read_bytes() == before


@pytest.mark.parametrize("name", ["data/../../x", "/etc/hostname", "../x"])
def test_manifests_name_files_of_the_bag_only(tmp_path, name):
    path = tmp_path / "manifest-sha256.txt"
    path.write_text(f"{'0' * 64}  {name}\n")
    with refused(CaptureError, kind="seal-manifest"):
        read_manifest(path)


def test_a_manifest_is_read_as_it_was_written_whatever_the_names(tmp_path):
    """Line ends of other alphabets split the lines of names that held them; a name in two lines had two digests."""
    names = {
        f"data/{middle}.png": "0" * 64 for middle in ("a\u2028b", "a\x85b", "a\x0cb", "a%0Ab", "a\nb", "a\rb", " *")
    }
    path = tmp_path / "manifest-sha256.txt"
    path.write_bytes(manifest_text(names).encode())
    assert read_manifest(path) == names
    path.write_text(f"{'0' * 64}  data/a\n{'1' * 64}  data/a\n")
    with refused(CaptureError, kind="seal-manifest"):
        read_manifest(path)
    path.write_text(f"{'0' * 64}  **data/a\n")
    with pytest.raises(CaptureError, match="line 1"):
        read_manifest(path)


@pytest.mark.parametrize("name", ["../../../x", "a/b", "a\nb", "x" * 300])
def test_names_that_become_file_names_have_no_folders_in_them(tmp_path, name):
    """Pictures are called after views, models after regions: such names led out of the results."""
    turned = make_turntable(tmp_path / "t", views=2)
    for file in ("frames.csv", "cameras.csv"):
        text = (turned / file).read_text()
        (turned / file).write_text(text.replace("v0", '"' + name + '"'))
    with pytest.raises(CaptureError) as told:
        load_capture(turned)
    assert {problem.kind for problem in told.value.problems} & {"name-unusable", "frames-unreadable", "camera-values"}
    cloth = make_goniometer(tmp_path / "g")
    edit_goniometer(cloth, regions="r.png", region_names={name: 1})
    with refused(CaptureError, kind="wrong-value"):
        load_capture(cloth)


def test_no_file_of_an_artifact_lies_outside_it(tmp_path):
    with ArtifactWriter(tmp_path / "results/s/cloth_brdf/0123456789ab") as output:
        for name in ("../x", "models/../../x", "/tmp/x", "models//x"):
            with refused(UserError, by="_expect_inside"):
                output.path(name)
        assert output.path("models/cloth/ward.npz").parent.is_dir()
    with refused(UserError, by="_expect_inside"):
        Artifact(tmp_path, {}).path("../x")


def test_convert_takes_nothing_from_outside_its_source(tmp_path, secret):
    source = tmp_path / "photographs"
    source.mkdir()
    for i in range(3):
        write_frame(source / f"{i}.png", np.full((4, 5, 3), 1000.0 * i))
    (source / "l.lp").write_text("3\n0.png 0.1 0 0.9\n1.png 0 0.1 0.9\n2.png -0.1 -0.1 0.9\n")
    (source / "2.png").unlink()
    (source / "2.png").symlink_to(secret)
    with refused(CaptureError, kind="outside-folder"):
        convert(source, tmp_path / "c")
    (source / "2.png").unlink()
    (source / "l.lp").rename(source / "light_directions.txt")
    (source / "light_directions.txt").write_text("0.1 0 0.9\n0 0.1 0.9\n-0.1 -0.1 0.9\n")
    (source / "filenames.txt").write_text("0.png\n1.png\n../secret.txt\n")
    with refused(CaptureError, kind="outside-folder"):
        convert(source, tmp_path / "c")
    assert not (tmp_path / "c").exists()


@pytest.mark.parametrize("name", [b"a\nb.png", b"a\x1b[2Jb.png", b"a\xff.png"])
def test_photographs_with_names_that_no_table_can_hold(tmp_path, name, capsys):
    source = tmp_path / "photographs"
    source.mkdir()
    write_frame(source / "0.png", np.full((4, 5, 3), 1000.0))
    (source / "light_directions.txt").write_text("0.1 0 0.9\n")
    os.rename(source / "0.png", os.fsencode(source) + b"/" + name)
    with pytest.raises(CaptureError) as told:
        convert(source, tmp_path / "c")
    assert told.value.problems[0].kind == "name-unusable"
    str(told.value).encode()
    folder = make_capture(tmp_path / "d")
    with open(os.fsencode(folder) + b"/" + name, "wb"):
        pass
    for problem in check_capture(folder, level="quick"):
        assert printable(str(problem)) == str(problem)
        print(problem)
    if name != b"a\nb.png":  # which a manifest can hold
        with refused(CaptureError, kind="name-unusable"):
            seal(folder)
    else:
        seal(folder)
        assert not verify_seal(folder)


def test_messages_do_not_speak_to_the_terminal():
    text = str(UserError("a\x1b[31m\u202eb\ud800\nsecond line"))
    assert text.splitlines()[0] == "a\\x1b[31m\\u202eb\\ud800"


def test_a_mesh_opens_no_other_file(tmp_path, secret):
    """Materials and textures may be named by any path; none is used, so none is opened."""
    heading = "ply\nformat ascii 1.0\ncomment TextureFile ../secret.txt\nelement vertex 3\nproperty float x\n"
    heading += (
        "property float y\nproperty float z\nelement face 1\nproperty list uchar int vertex_indices\nend_header\n"
    )
    (tmp_path / "m").mkdir()
    (tmp_path / "m/a.ply").write_text(heading + "0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n")
    (tmp_path / "m/a.obj").write_text(
        "mtllib ../secret.txt\nusemtl x\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nf 1/1 2/1 3/1\n"
    )
    opened = []
    _watch_opening(opened)
    for name in ("a.ply", "a.obj"):
        assert len(read_triangles(tmp_path / "m" / name)[1]) == 1
    assert not [path for path in opened if "secret" in path]
    (tmp_path / "m/a.ply").read_bytes()
    assert any("a.ply" in path for path in opened), "the watch sees what is opened"


def _watch_opening(opened: list[str]) -> None:
    """Audit hooks cannot be taken away again: this one only appends to a list."""
    sys.addaudithook(lambda event, args: opened.append(str(args[0])) if event == "open" else None)


# Code


class Bomb:
    """Unpickled, it writes a file."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return (Path.write_text, (Path(self.path), "ran"))


def test_pickles_in_stores_are_not_loaded(tmp_path):
    """A Zarr store of the older format may name `pickle` as the codec of its chunks: reading a map ran it."""
    ran = tmp_path / "ran"
    store = tmp_path / "maps.zarr"
    (store / "normals").mkdir(parents=True)
    (store / ".zgroup").write_text('{"zarr_format": 2}')
    array = {"zarr_format": 2, "shape": [1], "chunks": [1], "dtype": "|O", "fill_value": None, "order": "C"}
    (store / "normals/.zarray").write_text(json.dumps({**array, "compressor": None, "filters": [{"id": "pickle"}]}))
    (store / "normals/0").write_bytes(pickle.dumps(np.array([Bomb(ran)], object)))
    with pytest.raises((UserError, FileNotFoundError)):
        Maps(tmp_path)
    zarr.create_group(tmp_path / "both" / "maps.zarr")
    (store / "normals").rename(tmp_path / "both/maps.zarr/normals")
    with refused(UserError, "maps.zarr"):
        Maps(tmp_path / "both")
    np.savez(tmp_path / "x.npz", a=np.array([Bomb(ran)], object))
    with refused(UserError, "a.npy"):
        load_arrays(tmp_path / "x.npz")
    assert not ran.exists()


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("a: !!python/object/apply:os.system ['touch ran']\n", "tags"),
        ("a: !include /etc/passwd\n", "tags"),
        ("a: &x [1]\nb: *x\n", "anchors"),
        ("a: " + "[" * 5000 + "]" * 5000 + "\n", "nested"),
        ("a: 2024-13-45\n", "month"),
        ("a: " + "1" * 5000 + "\n", "bits"),
        ("a: 0x" + "f" * 5000 + "\n", "bits"),
        ('a: "\\ud800"\n', "surrogates|valid|character"),
        ("a: [" + "1," * 3000 + "]\n", "1000"),
    ],
    ids=["code", "include", "alias", "deep", "month 13", "digits", "hexadecimal", "surrogate", "many"],
)
def test_yaml_is_plain_data(tmp_path, text, said, quick, monkeypatch):
    monkeypatch.setenv("NISHIKI_BOUNDS", "settings_values=1000")
    path = tmp_path / "capture.yaml"
    path.write_text(text)
    with pytest.raises(CaptureError, match=said):
        read_mapping(path)
    with pytest.raises(UserError, match=said):
        load_yaml(path)


def test_a_billion_laughs_are_not_laughed(tmp_path, quick):
    lines = ["a0: &a0 [x, x, x, x, x, x, x, x, x]"]
    lines += [f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]" for i in range(1, 12)]
    path = tmp_path / "capture.yaml"
    path.write_text("format: 1\n" + "\n".join(lines) + "\nlights: *a11\n")
    with pytest.raises(CaptureError, match=r"line 2.*anchors"):
        read_mapping(path)
    assert load_plain("a: [1, 2]\nb: 'text & more * !'\n") == {"a": [1, 2], "b": "text & more * !"}


@pytest.mark.slow
def test_the_shell_sees_one_argument_whatever_a_capture_is_called(tmp_path, monkeypatch):
    """The command of the ingest rule as Snakemake forms it, run by its shell: obeyed, it would make a file."""
    monkeypatch.chdir(tmp_path)
    name = "-c a'b\"$(touch ran)`touch ran`;touch ran & {x} {{y}}"
    make_table(tmp_path / name)
    seal(tmp_path / name)
    table = "scene\tcapture\n" + f's\t"{name.replace(chr(34), chr(34) * 2)}"\n'
    (tmp_path / "scenes.tsv").write_text(table)
    (tmp_path / "config.yaml").write_text("scenes: scenes.tsv\nresults: out put's\n")
    flow = Workflow(load_yaml(Path("config.yaml")))
    arguments = shlex.split(flow.source("s", "ingest"))
    assert arguments[:2] == ["--capture", f"./{name}"]
    command = [sys.executable, "-m", "snakemake", "--snakefile", str(PROJECT / "Snakefile"), "--cores", "1", "--quiet"]
    command += ["--configfile", "config.yaml", "--until", "ingest"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    assert len(list(Path("out put's/s/ingest").glob("*/artifact.json"))) == 1
    assert not Path("ran").exists()


@pytest.mark.parametrize(
    ("row", "said"),
    [
        ("-rf\tc\n", "-rf"),
        ("a/../b\tc\n", "scenes.tsv"),
        ("$(x)\tc\n", "scenes.tsv"),
        ('a\t"c\x1b[2J"\n', "scenes.tsv"),
        ("a\t" + "c" * 200_000 + "\n", "scenes.tsv"),
        (b"a\t\xff\n", "UTF-8"),
    ],
)
def test_scene_tables(tmp_path, row, said):
    path = tmp_path / "scenes.tsv"
    path.write_bytes(b"scene\tcapture\n" + (row if isinstance(row, bytes) else row.encode()))
    with pytest.raises(UserError, match=said):
        load_project({"scenes": str(path)})


def test_results_are_no_pattern(tmp_path):
    for name in ("a{scene}", "a\nb", ""):
        with pytest.raises(UserError, match="results"):
            load_project({"results": name})
