"""Pictures, stores, tables and meshes of a stranger that would take memory or time without end, or that claim more than
they hold: each is refused in a line that names the file. What the fuzzing of `tests/fuzz` found is here by name."""

import io
import json
import pickle
import struct
import zipfile
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
import zarr
from captures import make_turntable
from fuzz.corpus import make_store, matlab, tiff
from goniometer_captures import HEADING
from refusals import refused
from zarr.codecs import ZstdCodec

from nishiki.capture.convert import recognise
from nishiki.capture.folder import load_capture
from nishiki.capture.frames import read_frames
from nishiki.capture.goniometer_tables import read_table
from nishiki.capture.layouts import natural_key
from nishiki.capture.lights import read_lights
from nishiki.capture.options import ConvertOptions
from nishiki.capture.seal import read_manifest
from nishiki.engine.project import load_project
from nishiki.errors import UserError
from nishiki.formats.files import BOUNDS, bound, read_json
from nishiki.formats.images import read_codes, read_header
from nishiki.formats.picture_process import read_matlab
from nishiki.formats.problems import CaptureError
from nishiki.formats.stored import load_arrays, open_array, open_group
from nishiki.geometry.mesh import read_triangles
from nishiki.observations.plane import Observations

PROJECT = Path(__file__).resolve().parents[2]


def png(rows, columns, depth=8, colour=2):
    def chunk(tag, data):
        return struct.pack(">I", len(data)) + tag + data + struct.pack(">I", zlib.crc32(tag + data))

    heading = struct.pack(">IIBBBBB", columns, rows, depth, colour, 0, 0, 0)
    body = zlib.compress(b"\0" * 100)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", heading) + chunk(b"IDAT", body) + chunk(b"IEND", b"")


def jpeg(rows, columns):
    data = bytearray(cv2.imencode(".jpg", np.zeros((16, 16, 3), np.uint8))[1].tobytes())
    place = data.index(b"\xff\xc0") + 5
    data[place : place + 4] = struct.pack(">HH", rows, columns)
    return bytes(data)


def exr(window=(0, 0, 4, 3), *, channels=3, attribute=b"", flags=0):
    def entry(name, kind, value):
        return name + b"\0" + kind + b"\0" + struct.pack("<i", len(value)) + value

    listed = b"".join(b"c%04d\0" % i + struct.pack("<iB3xii", 2, 0, 1, 1) for i in range(channels)) + b"\0"
    heading = entry(b"channels", b"chlist", listed) + entry(b"compression", b"compression", b"\3") + attribute
    heading += entry(b"dataWindow", b"box2i", struct.pack("<iiii", *window))
    return b"\x76\x2f\x31\x01" + struct.pack("<I", 2 | flags) + heading + b"\0" + b"\0" * 64


def tiff_with(**values):
    """A small TIFF in which some fields, by number as f258, say something else."""
    data = bytearray(tiff("plain"))
    start = struct.unpack("<I", data[4:8])[0]
    for i in range(struct.unpack("<H", data[start : start + 2])[0]):
        place = start + 2 + 12 * i
        tag = struct.unpack("<H", data[place : place + 2])[0]
        if f"f{tag}" in values:
            data[place + 8 : place + 12] = struct.pack("<I", values[f"f{tag}"])
        if f"n{tag}" in values:
            data[place + 4 : place + 8] = struct.pack("<I", values[f"n{tag}"])
    return bytes(data)


IMAGES = {
    "png of 4 gigapixels": ("x.png", png(65535, 65535)),
    "png larger than its file can hold": ("x.png", png(9000, 9000)),
    "png one pixel high": ("x.png", png(1, 1 << 31)),
    "png of 16 bits": ("x.png", png(30000, 17000, 16, 6)),
    "jpeg of 4 gigapixels": ("x.jpg", jpeg(65500, 65500)),
    "jpeg larger than its file can hold": ("x.jpg", jpeg(20000, 20000)),
    "tiff of 16 exapixels": ("x.tif", tiff_with(f256=0xFFFFFFFF, f257=0xFFFFFFFF)),
    "tiff larger than its file": ("x.tif", tiff_with(f256=5000, f257=5000, f278=5000)),
    "tiff of a million pieces": ("x.tif", tiff_with(n273=1 << 23, n279=1 << 23)),
    "tiff of many fields": ("x.tif", tiff_with(n258=1 << 24)),
    "tiff with strips without rows": ("x.tif", tiff_with(f278=0)),
    "tiff of many samples": ("x.tif", tiff_with(f277=1 << 31)),
    "exr of 16 exapixels": ("x.exr", exr((-(1 << 31), -(1 << 31), (1 << 31) - 1, (1 << 31) - 1))),
    "exr larger than its file": ("x.exr", exr((0, 0, 9999, 9999))),
    "exr of many channels": ("x.exr", exr(channels=5000)),
    "exr with an attribute of 2 gigabytes": ("x.exr", exr(attribute=b"a\0string\0" + struct.pack("<i", 0x7FFFFFFF))),
    "exr with an attribute of less than nothing": ("x.exr", exr(attribute=b"a\0string\0" + struct.pack("<i", -5))),
    "exr of several samples a pixel": ("x.exr", exr(flags=0x800)),
}


@pytest.mark.parametrize("name", IMAGES)
def test_absurd_pictures_are_refused_before_they_are_decoded(tmp_path, name, quick):
    file, content = IMAGES[name]
    path = tmp_path / file
    path.write_bytes(content)
    before = _peak_mb()
    with pytest.raises(CaptureError) as told:
        read_codes(path, tuple(f"c{i}" for i in range(read_header(path).channels)))
    assert told.value.problems[0].kind in ("image-absurd", "image-truncated")
    assert _peak_mb() - before < 200


def _peak_mb():
    import resource

    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def test_a_tiff_tile_is_no_larger_than_its_picture(tmp_path):
    """Tiles of 2^31 x 2^31 in a picture of 4 x 5 made the decoder ask for their size."""
    data = bytearray(tiff("plain"))
    start = struct.unpack("<I", data[4:8])[0]
    fields = bytearray(data[start + 2 : -4])
    fields += struct.pack("<HHII", 322, 4, 1, 1 << 31) + struct.pack("<HHII", 323, 4, 1, 1 << 31)
    fields += struct.pack("<HHII", 324, 4, 1, 8) + struct.pack("<HHII", 325, 4, 1, 240)
    path = tmp_path / "x.tif"
    path.write_bytes(bytes(data[:start]) + struct.pack("<H", len(fields) // 12) + bytes(fields) + b"\0\0\0\0")
    with pytest.raises(CaptureError, match="tiles"):
        read_header(path)


def test_a_jpeg_of_very_many_scans_is_not_decoded(tmp_path, quick):
    """Each scan is a pass over the whole picture; an empty one has 14 bytes."""
    whole = cv2.imencode(".jpg", np.zeros((64, 64, 3), np.uint8), [cv2.IMWRITE_JPEG_PROGRESSIVE, 1])[1].tobytes()
    place = whole.rindex(b"\xff\xda")
    path = tmp_path / "x.jpg"
    path.write_bytes(whole[:-2] + whole[place:-2] * 5000 + b"\xff\xd9")
    with pytest.raises(CaptureError, match="scans"):
        read_codes(path, ("red", "green", "blue"))


def test_a_bound_is_raised_by_name(tmp_path, monkeypatch):
    path = tmp_path / "x.png"
    cv2.imwrite(str(path), np.zeros((100, 100), np.uint8))
    monkeypatch.setenv("NISHIKI_BOUNDS", "image_pixels=9999")
    with refused(CaptureError, "9999", "NISHIKI_BOUNDS=image_pixels", kind="image-absurd"):
        read_header(path)
    monkeypatch.setenv("NISHIKI_BOUNDS", "image_pixels=10000, image_side=100")
    assert read_header(path).rows == 100
    for wrong in ("pixels=3", "image_pixels", "image_pixels=-1", "image_pixels=1e9"):
        monkeypatch.setenv("NISHIKI_BOUNDS", wrong)
        with pytest.raises(UserError, match="NISHIKI_BOUNDS"):
            bound("image_pixels")


def test_the_page_tells_every_bound():
    page = (PROJECT / "docs/notes/strangers.md").read_text()
    missing = [
        name for name, b in BOUNDS.items() if f"| `{name}` | {b.value:,} {b.unit} |".replace(",", " ") not in page
    ]
    assert not missing


def zipped(shape, dtype="<f8", body=b""):
    """An .npz file whose one array claims this shape."""
    member = io.BytesIO()
    np.lib.format.write_array_header_1_0(member, {"descr": dtype, "fortran_order": False, "shape": shape})
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("a.npy", member.getvalue() + body)
    return stream.getvalue()


def test_arrays_claim_no_more_than_they_hold(tmp_path, monkeypatch, quick):
    path = tmp_path / "x.npz"
    for content in (zipped((1 << 40,)), zipped((-1, 4)), zipped((3,), "|O", pickle.dumps(1)), b"PK\3\4", b""):
        path.write_bytes(content)
        with pytest.raises(UserError, match=r"x\.npz"):
            load_arrays(path)
    monkeypatch.setenv("NISHIKI_BOUNDS", "arrays_bytes=1000000")
    path.write_bytes(zipped((1 << 20,), "|u1", b"\0" * (1 << 20)))
    assert path.stat().st_size < 3000
    with refused(UserError, "x.npz"):
        load_arrays(path)


def edited(path, **changes):
    node = json.loads(path.read_text())
    path.write_text(json.dumps(node | changes))


def test_stores_claim_no_more_than_they_hold(tmp_path, quick):
    chunked = {"name": "regular", "configuration": {"chunk_shape": [1 << 20, 1 << 20]}}
    zstd, plain = {"name": "zstd", "configuration": {}}, {"name": "bytes", "configuration": {"endian": "little"}}
    wrong = {
        "a huge array": {"shape": [1 << 40, 1 << 40]},
        "a huge chunk": {"shape": [1 << 20, 1 << 20], "chunk_grid": chunked},
        "an array without its chunks": {"shape": [1 << 22, 5]},
        "another codec": {"codecs": [plain, {"name": "blosc", "configuration": {}}]},
        "code as codec": {"codecs": [{"name": "numcodecs.pickle"}, plain]},
        "many codecs": {"codecs": [plain, *[zstd] * 100]},
        "objects": {"data_type": "object"},
        "another kind": {"data_type": {"name": "numpy.datetime64"}},
        "less than nothing": {"shape": [-1, 5]},
        "one shape too many": {"shape": [[6], 5]},
        "an unknown setting": {"codecs": [plain, {"name": "zstd", "configuration": {"threads": 5}}]},
        "a transformer": {"storage_transformers": [{"name": "x"}]},
    }
    for name, changes in wrong.items():
        make_store(tmp_path / "s.zarr")
        edited(tmp_path / "s.zarr/a/zarr.json", **changes)
        with pytest.raises(UserError, match="zarr"):
            print(name, open_group(tmp_path / "s.zarr"))


def test_a_chunk_unpacks_to_no_more_than_its_array_says(tmp_path, quick):
    """A zstd frame of 20 kilobytes may hold a gigabyte; frames may follow each other, or not tell their size."""
    from numcodecs.zstd import Zstd

    bomb, small = (bytes(Zstd(level=1).encode(b"\0" * size)) for size in (1 << 28, 40))
    make_store(tmp_path / "s.zarr")
    chunk = tmp_path / "s.zarr/a/c/0/0"
    good = chunk.read_bytes()
    array = open_group(tmp_path / "s.zarr")["a"]
    assert array[...].shape == (6, 5)
    before = _peak_mb()
    for content in (bomb, good + bomb, good + small, small, good[:6], good[:-5], b"\x28\xb5\x2f\xfd\x00\x58" + good[6:],
                    b"\0" * 50, b"", b"\0" * (1 << 20)):  # fmt: skip
        chunk.write_bytes(content)
        with refused(UserError, "s.zarr"):
            array[...]
    assert _peak_mb() - before < 50
    chunk.unlink()
    chunk.symlink_to("/dev/zero")
    with pytest.raises(UserError, match="link"):
        open_group(tmp_path / "s.zarr")


@pytest.mark.parametrize("size", [1, 100, 300, 70_000, 200_000, 3 << 20])
def test_chunks_of_any_size_are_read(tmp_path, size):
    for data in (np.zeros(size, np.uint8), np.frombuffer(np.random.default_rng(size).bytes(size), np.uint8)):
        for checksum in (False, True):
            store = zarr.create_array(
                tmp_path / "a.zarr", shape=(size,), chunks=(size,), dtype="uint8", overwrite=True,
                compressors=[ZstdCodec(checksum=checksum)],
            )  # fmt: skip
            store[...] = data
            np.testing.assert_array_equal(open_array(tmp_path / "a.zarr")[...], data)


@pytest.mark.parametrize("text", ["[" * 200_000, "{}x", "[]", "\xff", '{"a": ' + "1" * 5000 + "}"])
def test_json_that_is_none(tmp_path, text, quick):
    (tmp_path / "x.json").write_bytes(text.encode("latin-1"))
    with pytest.raises(UserError, match="JSON"):
        read_json(tmp_path / "x.json")


def test_frames_of_an_artifact_that_are_described_wrongly(tmp_path):
    """An entry that was missing in what stands beside the frames was an error of Python."""
    make_store(tmp_path / "frames.zarr")
    (tmp_path / "frames.zarr/b").rename(tmp_path / "frames.zarr/codes")
    edited(tmp_path / "frames.zarr/zarr.json", attributes={"format": 1, "lights": ["a"], "files": 5})
    with pytest.raises(UserError, match="damaged"):
        Observations(tmp_path)


def mat(cells=None, *, packed=True, size=None):
    """A MATLAB file with one packed element of zeros, or with a cell array that claims many cells."""
    heading = b"x" * 124 + struct.pack("<H", 0x0100) + b"IM"
    body = zlib.compress(b"\0" * (size or 100))
    if cells:
        flags, dims = struct.pack("<IIII", 6, 8, 1, 0), struct.pack("<IIii", 5, 8, *cells)
        inner = flags + dims + struct.pack("<HH4s", 1, 1, b"P")
        element = struct.pack("<II", 14, len(inner)) + inner
        body = zlib.compress(element)
        return heading + (struct.pack("<II", 15, len(body)) + body if packed else element)
    return heading + struct.pack("<II", 15, len(body)) + body


@pytest.mark.parametrize(
    "content",
    [
        mat((1 << 30, 1 << 30)),
        mat((1 << 30, 1 << 30), packed=False),
        mat((1 << 14, 1 << 14), packed=False),
        mat((-3, 4)),
        mat(size=1 << 28),
        b"x" * 124 + struct.pack("<H", 0x0100) + b"IM" + struct.pack("<II", 14, 0xFFFFFFF0),
        b"x" * 128,
        b"x" * 124 + struct.pack("<H", 0x0200) + b"IM",
        b"",
    ],
)
def test_matlab_files_claim_no_more_than_they_hold(tmp_path, content, quick):
    path = tmp_path / "x.mat"
    path.write_bytes(content)
    before = _peak_mb()
    with pytest.raises(ValueError, match=r"\S"):
        read_matlab(path, ("P",))
    assert _peak_mb() - before < 200


@pytest.mark.parametrize("packed", [False, True])
def test_matlab_files_as_the_reference_reads_them(tmp_path, packed):
    from scipy.io import loadmat, savemat

    values = {"a": np.arange(12).reshape(3, 4).astype(np.int16), "b": np.float32(2.5), "P": np.empty((1, 3), object)}
    values |= {
        "t": "text",
        "s": {"inner": 1},
        "c": np.zeros((2, 3, 4)),
        "many": np.random.default_rng(1).random((50, 7)),
    }
    for i in range(3):
        values["P"][0, i] = np.random.default_rng(i).random((3, 4))
    savemat(tmp_path / "x.mat", values, do_compression=packed)
    expected, found = loadmat(tmp_path / "x.mat"), read_matlab(tmp_path / "x.mat", ("a", "b", "P", "c", "many", "no"))
    assert set(found) == {"a", "b", "P", "c", "many"}
    for name in ("a", "b", "c", "many"):
        np.testing.assert_array_equal(found[name], expected[name])
    assert found["P"].shape == (1, 3)
    for mine, theirs in zip(found["P"].ravel(), expected["P"].ravel(), strict=True):
        np.testing.assert_array_equal(mine, theirs)
    with refused(ValueError, "'t'"):
        read_matlab(tmp_path / "x.mat", ("t",))
    assert matlab(packed=packed)


@pytest.mark.parametrize(
    ("suffix", "text"),
    [
        (".ply", "element vertex 4000000000\nproperty float x\n"),
        (
            ".ply",
            "element vertex 3\nproperty float x\nelement face 4000000000\nproperty list uchar int vertex_indices\n",
        ),
        (".ply", "element vertex 9999999999999999999999\nproperty float x\n"),
        (".ply", "element vertex 1000000000\n"),
        (".ply", "property float x\n"),
        (".ply", "element vertex 3\n" + "property float x\n" * 300),
        (".ply", "element vertex 3\nproperty list float int x\n"),
        (".obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 999999999999\n"),
        (".obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 2000000000\n"),
        (".obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf -1 -2 -2000000000\n"),
    ],
)
def test_meshes_claim_no_more_than_they_hold(tmp_path, suffix, text, quick):
    path = tmp_path / f"x{suffix}"
    for form in ("ascii", "binary_little_endian"):
        path.write_text(f"ply\nformat {form} 1.0\n{text}end_header\n0 0 0\n" if suffix == ".ply" else text)
        before = _peak_mb()
        with pytest.raises(UserError):
            read_triangles(path)
        assert _peak_mb() - before < 300


TABLES = {
    "ten thousand rows whose file is there": ("a.png,sample,a\n" * 10_000, "frame-duplicate"),
    "very many rows": ("a.png,sample,a\n" * 30_000, "frames-many"),
    "a cell of 200 000 letters": ("x" * 200_000 + ",sample,a\n", "frames-unreadable"),
    "a quote that never ends": ('"' + "a\n" * 100_000, "frames-unreadable"),
    "not text": ("\xff\xfe", "frames-unreadable"),
}


@pytest.mark.parametrize("name", TABLES)
def test_tables_of_photographs(tmp_path, name, quick):
    rows, kind = TABLES[name]
    (tmp_path / "a.png").write_bytes(b"")
    (tmp_path / "frames.csv").write_bytes(b"file,role,light\n" + rows.encode("latin-1"))
    with pytest.raises(CaptureError) as told:
        read_frames(tmp_path / "frames.csv")
    assert kind in {problem.kind for problem in told.value.problems}


def test_tables_larger_than_their_bound_are_not_read(tmp_path, monkeypatch):
    monkeypatch.setenv("NISHIKI_BOUNDS", "table_bytes=1000,lights=3,reflectances_values=20")
    (tmp_path / "l.lp").write_text("2000\n" + "0.1 0.2 0.9\n" * 2000)
    with refused(CaptureError, kind="lights-unreadable"):
        read_lights(tmp_path / "l.lp")
    (tmp_path / "l.txt").write_text("0.1 0.2 0.9\n" * 4)
    with refused(CaptureError, "3", kind="lights-many"):
        read_lights(tmp_path / "l.txt")
    (tmp_path / "r.csv").write_text("theta_i_deg,phi_i_deg,theta_r_deg,phi_r_deg,red\n" + "0,0,0,0,1\n" * 5)
    with refused(CaptureError, kind="table-many"):
        read_table(tmp_path / "r.csv", "r.csv")
    (tmp_path / "r.brdf").write_text("1 500\n" + "0 0 0 0 1\n" * 5)
    with refused(CaptureError, kind="table-many"):
        read_table(tmp_path / "r.brdf", "r.brdf")


def test_long_lines_take_time_in_proportion(tmp_path, quick):
    for line in ("a #" * 300_000, "1," * 400_000, "\t" * 900_000 + "x", "\\" * 900_000, "0.1 " * 200_000 + "a"):
        (tmp_path / "l.lp").write_text(f"1\n{line}\n")
        with pytest.raises(CaptureError):
            read_lights(tmp_path / "l.lp")
    (tmp_path / "m.txt").write_text("0" * 64 + " \t" * 500_000 + "\n")
    with pytest.raises(CaptureError):
        read_manifest(tmp_path / "m.txt")


def test_a_table_in_which_every_photograph_is_of_another_view_and_light(tmp_path, quick):
    """3000 views under 3000 lights lack nine million photographs; each was a message of its own."""
    folder = make_turntable(tmp_path / "t", views=2, cameras=False, silhouettes=False)
    picture = (folder / "frames/0_0_0.png").read_bytes()
    rows = ["file,role,view,light"]
    for i in range(3000):
        (folder / f"frames/p{i}.png").write_bytes(picture)
        rows.append(f"frames/p{i}.png,sample,v{i},l{i}")
    (folder / "frames.csv").write_text("\n".join(rows) + "\n")
    with pytest.raises(CaptureError) as told:
        load_capture(folder)
    assert len(told.value.problems) < 300


def test_thousands_of_lights_and_boards_are_compared_at_once(tmp_path, quick):
    from nishiki.capture.frames import Frame
    from nishiki.capture.goniometer import goniometer_problems

    frames = []
    for i in range(4000):
        light = (i * 0.02, i * 0.07)
        frames.append(Frame(f"s{i}", tmp_path, "sample", row=i, angles_deg=(*light, 10.0, 10.0)))
        frames.append(Frame(f"w{i}", tmp_path, "white", row=i, angles_deg=(*light, None, None)))
    assert {p.kind for p in goniometer_problems(tuple(frames))} <= {"normal-few", "white-grazing", "white-cosine"}
    assert HEADING


# Findings of the fuzzing


def test_lights_at_infinite_angles(tmp_path):
    """`inf` degrees: the sine has no value there (found in lights, table of angles)."""
    (tmp_path / "l.csv").write_text("light,azimuth_deg,polar_deg\na,10,45\nb,100,inf\n")
    with refused(CaptureError, kind="lights-unreadable"):
        read_lights(tmp_path / "l.csv")


def test_a_count_of_lights_of_5000_digits(tmp_path):
    (tmp_path / "l.lp").write_text("1" * 5000 + "\n0 0 1\n")
    with pytest.raises(CaptureError):
        read_lights(tmp_path / "l.lp")


def test_superscripts_are_no_numbers(tmp_path):
    """'²'.isdigit() is true, int('²') an error: in file names, and in the count of a list of cameras."""
    assert natural_key(Path("²1.png")) < natural_key(Path("²10.png"))
    (tmp_path / "a_par.txt").write_text("²\na.png " + "1 " * 21 + "\n")
    assert recognise(tmp_path, ConvertOptions()) is None


def test_a_short_row_of_a_scene_table(tmp_path):
    (tmp_path / "scenes.tsv").write_text("capture\tscene\nonly\n")
    with refused(UserError, "scenes.tsv"):
        load_project({"scenes": str(tmp_path / "scenes.tsv")})


def test_settings_of_a_scene_that_are_no_block(tmp_path):
    (tmp_path / "own.yaml").write_text("- a\n- b\n")
    (tmp_path / "scenes.tsv").write_text(f"scene\tcapture\tsettings\na\tc\t{tmp_path}/own.yaml\n")
    with pytest.raises(UserError, match="expected a block"):
        load_project({"scenes": str(tmp_path / "scenes.tsv")})
