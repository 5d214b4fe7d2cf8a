"""What the fuzzing starts from: the files of the tests' small captures, whole, one or several a reader."""

from __future__ import annotations

import io
import json
import shutil
import struct
import tempfile
import zlib
from pathlib import Path

import cv2
import numpy as np
import OpenEXR
import zarr
from captures import make_capture, make_turntable
from goniometer_captures import make_goniometer, make_table
from zarr.codecs import Crc32cCodec, ZstdCodec

from nishiki.capture.seal import seal

TABLES = ("plane", "turntable", "goniometer", "cameras", "points", "intensities", "spectra", "reflectances", "brdf")
TABLES += ("scenes", "camera list", "matlab", "meshroom", "transforms", "metashape", "bundler")
FOLDER = ("info.json", "plane_0.dzi", "plane_0.tzi")
IMAGES = (".png", ".jpg", ".tif", ".exr", ".ptm", ".rti", *FOLDER)
YAML = ("plane", "turntable", "goniometer", "intrinsics", "configuration", "instrument")
LIGHTS = (".lp", ".csv", ".txt", ".relight")
MESHES = (".ply", ".obj")
STORES = ("group", "array", "chunk", "npz", "manifest", "observations")


def corpus(target: str) -> list[bytes]:
    """Seeds of a target: the first byte says which reader, see `targets`."""
    with tempfile.TemporaryDirectory() as name:
        return globals()[f"_{target}"](Path(name))


def of(kinds: tuple[str, ...], kind: str, content: bytes | str, *, more: int = 0) -> bytes:
    """A seed: its reader's number, then the file. more: further choices of the target."""
    content = content.encode() if isinstance(content, str) else content
    return bytes([kinds.index(kind) + len(kinds) * more]) + content


def _manifest(folder: Path) -> list[bytes]:
    capture = make_capture(folder / "c")
    seal(capture)
    plain = (capture / "manifest-sha256.txt").read_bytes()
    return [plain, plain.replace(b"\n", b"\r\n"), plain[:400].replace(b"data/", b"*data/%25%0A"), b"0" * 64 + b"\tx\n"]


def _lights(folder: Path) -> list[bytes]:
    lp = (make_capture(folder / "c") / "lights.lp").read_text()
    decimal = '2\r\n"C:\\a b\\1.png";0,5;0,5;0,7\r\n2.tif 0 0 1 # top\r\n'
    return [
        of(LIGHTS, ".lp", lp),
        of(LIGHTS, ".lp", decimal, more=1),
        of(LIGHTS, ".csv", "light,x,y,z\na,0.1,0.2,0.9\nb,0.3,-0.2,0.9\n"),
        of(LIGHTS, ".csv", "light,azimuth_deg,polar_deg\na,10,45\nb,100,45\n", more=2),
        of(LIGHTS, ".txt", "0.1 0.2 0.9\n0.3 -0.2 0.9\n// end\n", more=3),
        of(LIGHTS, ".relight", '{"width": 8, "lights": [0.1, 0.2, 0.9, 0.3, -0.2, 0.9]}'),
        of(
            LIGHTS,
            ".relight",
            '{"images": [{"direction": {"x": 0.1, "y": 0, "z": 1}, "filename": "a.jpg", "skip": false}]}',
        ),
    ]


def _tables(folder: Path) -> list[bytes]:
    plane, turned = (
        make_capture(folder / "p", white=True, dark=True),
        make_turntable(folder / "t", states=("off", "on")),
    )
    cloth, table = make_goniometer(folder / "g"), make_table(folder / "r")
    row = "a.png 800 0 10 0 800 10 0 0 1 1 0 0 0 1 0 0 0 1 0 0 5"
    lines = (table / "reflectances.csv").read_bytes().splitlines(keepends=True)
    curves = "wavelength_nm,red,green,blue\n" + "".join(f"{nm},1,2,3\n" for nm in range(400, 701, 20))
    return [
        of(TABLES, "plane", (plane / "frames.csv").read_bytes()),
        of(TABLES, "turntable", (turned / "frames.csv").read_bytes()),
        of(TABLES, "goniometer", (cloth / "frames.csv").read_bytes()),
        of(TABLES, "cameras", (turned / "cameras.csv").read_bytes()),
        of(TABLES, "points", "view,column,row,x,y,z\n" + "a,1,2,3,4,5\n" * 5),
        of(TABLES, "intensities", "light,red,green,blue\na,1,1,1\nb,0.9,1,1.1\n"),
        of(TABLES, "spectra", curves),
        of(TABLES, "reflectances", b"".join(lines[:6])),
        of(TABLES, "brdf", "2 500 600\n# angles\n0 0 0.5 0.1 0.2 0.3\n0.1 0 0.5 0.1 0.2 0.3\n"),
        of(TABLES, "scenes", "scene\tcapture\ttruth\tproducts\tsettings\na\tcaptures/a\t\trender,report\t\n"),
        of(TABLES, "camera list", f"1\n{row}\n"),
        of(TABLES, "matlab", matlab(packed=False)),
        of(TABLES, "matlab", matlab(packed=True)),
        of(TABLES, "meshroom", json.dumps(MESHROOM)),
        of(TABLES, "transforms", json.dumps(TRANSFORMS)),
        of(TABLES, "metashape", METASHAPE),
        of(TABLES, "bundler", "# Bundle file v0.3\n2 1\n" + 2 * BUNDLER + "0 0 0\n9 9 9\n2 0 0 1.5 2.5 1 0 1 2\n"),
    ]


TURNED = [[1, 0, 0, 0.5], [0, 1, 0, 0], [0, 0, 1, 5], [0, 0, 0, 1]]
TRANSFORMS = {"fl_x": 40.0, "k1": 0.1, "frames": [{"file_path": f"{n}.png", "transform_matrix": TURNED} for n in "ab"]}
METASHAPE = (
    '<document><chunk><sensors><sensor id="0"><calibration type="frame"><resolution width="32" height="24"/>'
    "<f>40</f><k1>.1</k1></calibration></sensor></sensors><components><component id='0'><transform><rotation>1 0 0 0 1 "
    "0 0 0 1</rotation><translation>0 0 1</translation><scale>2</scale></transform></component></components><cameras>"
    '<camera id="0" sensor_id="0" component_id="0" label="a"><transform>1 0 0 0 0 1 0 0 0 0 1 -5 0 0 0 1</transform>'
    '</camera><camera id="1" sensor_id="0" label="b"/></cameras></chunk></document>'
)
BUNDLER = "40 .1 0\n1 0 0\n0 1 0\n0 0 1\n0 0 -5\n"
MESHROOM = {
    "version": ["1", "2", "8"],
    "views": [{"viewId": "1", "poseId": "1", "intrinsicId": "2", "path": "/x/a.png"}],
    "intrinsics": [
        {"intrinsicId": "2", "width": "4", "height": "3", "sensorWidth": "36", "type": "radial3", "focalLength": "30",
         "pixelRatio": "1", "principalPoint": ["0.5", "0"], "distortionParams": ["0.1", "0", "0"]}
    ],
    "poses": [{"poseId": "1", "pose": {"transform": {"rotation": list("100010001"), "center": ["0", "0", "-5"]}}}],
}  # fmt: skip


def matlab(*, packed: bool) -> bytes:
    """A MATLAB file of level 5 with a cell array P of two 3 x 4 matrices and a number k_1_g."""
    from scipy.io import savemat

    cells = np.empty((1, 2), object)
    cells[0, 0], cells[0, 1] = np.eye(3, 4) + 0.5, np.eye(3, 4)
    stream = io.BytesIO()
    savemat(stream, {"P": cells, **dict.fromkeys(("k_1_g", "k_2_g", "k_1_a", "k_2_a"), 700.5)}, do_compression=packed)
    return stream.getvalue()


def _images(folder: Path) -> list[bytes]:
    codes = (np.random.default_rng(1).random((9, 7, 3)) * 65535).astype(np.uint16)
    eight, seeds = (codes >> 8).astype(np.uint8), []
    for suffix, pixels in (
        (".png", codes),
        (".png", eight[..., :1]),
        (".jpg", eight),
        (".tif", codes),
        (".tif", eight),
    ):
        seeds.append(of(IMAGES, suffix, cv2.imencode(suffix, pixels)[1].tobytes()))
    seeds.append(of(IMAGES, ".jpg", cv2.imencode(".jpg", eight, [cv2.IMWRITE_JPEG_PROGRESSIVE, 1])[1].tobytes()))
    for number, compression in enumerate((OpenEXR.ZIP_COMPRESSION, OpenEXR.PIZ_COMPRESSION, OpenEXR.NO_COMPRESSION)):
        path = folder / f"{number}.exr"
        header = {"compression": compression, "type": OpenEXR.scanlineimage}
        with OpenEXR.File(header, {"RGB": (codes / 65535).astype(np.float16)}) as file:
            file.write(str(path))
        seeds.append(of(IMAGES, ".exr", path.read_bytes()))
    seeds += [of(IMAGES, ".ptm", polynomials(packed=packed)) for packed in (False, True)]
    seeds.append(of(IMAGES, ".rti", b"#HSH1.2\n3\n2 3 3\n4 2 1\n" + bytes(8 * 4) + bytes(range(72))))
    make_relight(folder / "relight")
    seeds += [of(IMAGES, name, (folder / "relight" / name).read_bytes()) for name in FOLDER]
    info = json.loads((folder / "relight/info.json").read_text()) | {"type": "bilinear", "colorspace": "mycc"}
    info |= {"resolution": 2, "yccplanes": [1, 1, 1], "basis": list(range(100, 148))}
    seeds += [of(IMAGES, "info.json", json.dumps(info))]
    return [*seeds, *(of(IMAGES, ".tif", tiff(kind)) for kind in ("planes", "deflate", "pages"))]


def make_relight(folder: Path) -> None:
    """A folder of relight with Gaussians between two lights, its plane of 4 x 3 pixels a single tile, in both forms."""
    tile = folder / "plane_0_files/0/0_0.jpg"
    tile.parent.mkdir(parents=True)
    tile.write_bytes(cv2.imencode(".jpg", np.full((3, 4, 3), 90, np.uint8))[1].tobytes())
    size = '<Size Width="4" Height="3"/>'
    (folder / "plane_0.dzi").write_text(f'<Image Format="jpg" Overlap="1" TileSize="254">{size}</Image>')
    joined = {"tilesize": 254, "overlap": 1, "width": 4, "height": 3, "nlevels": 1, "offsets": [0, tile.stat().st_size]}
    (folder / "plane_0.tzi").write_text(json.dumps(joined))
    (folder / "plane_0.tzb").write_bytes(tile.read_bytes())
    material = {"scale": [0.5, 1, 2], "bias": [0.5, 0, 0.25], "range": [100, 200, 300]}
    info = {"width": 4, "height": 3, "type": "rbf", "colorspace": "mrgb", "nplanes": 3, "materials": [material]}
    info |= {"lights": [0, 0, 1, 0.6, 0, 0.8], "sigma": 0.4, "basis": list(range(100, 124))}
    (folder / "info.json").write_text(json.dumps(info))


def polynomials(*, packed: bool) -> bytes:
    """A polynomial texture map of 4 x 3 pixels, its nine planes as bytes or as JPEG streams."""
    layout = "PTM_FORMAT_JPEG_LRGB" if packed else "PTM_FORMAT_LRGB"
    start = f"PTM_1.2\n{layout}\n4\n3\n1 1 1 1 1 1\n0 0 0 0 0 0\n".encode()
    if not packed:
        return start + bytes(range(108))
    stream = cv2.imencode(".jpg", np.full((3, 4), 90, np.uint8))[1].tobytes()
    nine = " 0" * 9
    order, references = " 1 0 2 3 4 5 6 7 8", " 1" + " -1" * 8
    lists = [nine, nine, nine, order, references, f" {len(stream)}" * 9, " 5" + " 0" * 8]
    return start + b"90\n" + "\n".join(lists).encode() + b"\n" + stream + b"\0\0\0\2\7" + stream * 8


def tiff(kind: str, *, rows: int = 4, columns: int = 5, channels: int = 6) -> bytes:
    """A TIFF that OpenCV does not read: planes apart, six channels packed, or two pages of such."""
    apart, packed = kind == "planes", kind == "deflate"
    values = np.arange(rows * columns * channels, dtype="<u2")
    pieces = [values[i::channels].tobytes() for i in range(channels)] if apart else [values.tobytes()]
    pieces = [zlib.compress(piece) for piece in pieces] if packed else pieces
    data, offsets = bytearray(b"II*\0\0\0\0\0"), []
    for piece in pieces:
        offsets.append(len(data))
        data += piece
    place = len(data)
    data += struct.pack(f"<{len(pieces)}I", *offsets) + struct.pack(f"<{len(pieces)}I", *map(len, pieces))
    fields = [(256, columns), (257, rows), (258, 16), (259, 8 if packed else 1), (262, 1)]
    fields += [(273, place if len(pieces) > 1 else offsets[0]), (277, channels), (278, rows)]
    fields += [(279, place + 4 * len(pieces) if len(pieces) > 1 else len(pieces[0])), (284, 2 if apart else 1)]
    start = len(data)
    pages = 2 if kind == "pages" else 1
    size = 2 + 12 * len(fields) + 4
    for page in range(pages):
        data += struct.pack("<H", len(fields))
        for tag, value in fields:
            data += struct.pack("<HHII", tag, 4, len(pieces) if tag in (273, 279) else 1, value)
        data += struct.pack("<I", start + size * (page + 1) if page + 1 < pages else 0)
    data[4:8] = struct.pack("<I", start)
    return bytes(data)


def _yaml(folder: Path) -> list[bytes]:
    made = {"plane": make_capture, "turntable": make_turntable, "goniometer": make_goniometer}
    seeds = [of(YAML, k, (make(folder / k) / "capture.yaml").read_bytes()) for k, make in made.items()]
    configuration = "scenes: config/scenes.tsv\nresults: results\nproducts: [render]\nnormals:\n  lights: all\n"
    return [
        *seeds,
        of(YAML, "intrinsics", "fx: 800.0\nfy: 800.0\ncx: 1\ncy: 2\ndistortion: [0, 0, 0, 0, 0]\n"),
        of(YAML, "configuration", configuration),
        of(
            YAML, "instrument", "kind: polarimeter\ngenerator: {retardance_deg: 90.0}\nanalyser: {dispersion: [1, 2]}\n"
        ),
        of(YAML, "plane", "format: 1\nlights: {file: a.lp}\ndate: 2024-05-01\nobject_id: 0x10\nnotes: |\n  text\n"),
    ]


def _meshes(folder: Path) -> list[bytes]:
    import trimesh

    ball = trimesh.creation.icosphere(0, 2.0)
    square = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvt 0 0\nvt 1 1\nvn 0 0 1\no a\nusemtl m\nf 1/1/1 2/2/1 3//1 -1\n"
    return [
        of(MESHES, ".ply", trimesh.exchange.ply.export_ply(ball)),
        of(MESHES, ".ply", trimesh.exchange.ply.export_ply(ball, encoding="ascii")),
        of(MESHES, ".obj", trimesh.exchange.obj.export_obj(ball)),
        of(MESHES, ".obj", "mtllib ../../secret.mtl\n" + square),
    ]


def _stores(folder: Path) -> list[bytes]:
    make_store(folder / "s.zarr")
    arrays = io.BytesIO()
    np.savez_compressed(arrays, a=np.arange(6.0).reshape(2, 3), b=np.zeros(4, np.int32))
    manifest = {"format": 1, "scene": "s", "stage": "normals", "key": "0" * 12, "settings": {}, "upstream": {}}
    manifest |= {"files": {"maps.zarr/zarr.json": {"bytes": 3, "sha256": "0" * 64}}, "diagnostics": {}}
    return [
        of(STORES, "group", (folder / "s.zarr/zarr.json").read_bytes()),
        of(STORES, "array", (folder / "s.zarr/a/zarr.json").read_bytes()),
        of(STORES, "chunk", (folder / "s.zarr/a/c/0/0").read_bytes()),
        of(STORES, "npz", arrays.getvalue()),
        of(STORES, "manifest", json.dumps(manifest)),
        of(STORES, "observations", json.dumps(OBSERVED)),
    ]


OBSERVED = {
    "format": 1, "lights": ["a"], "files": ["a.png"], "roles": ["sample"], "directions": [[0, 0, 1]],
    "positions_mm": None, "channels": ["red"], "band_rows": 4, "pixel_pitch_mm": None, "image_centre": [2.0, 2.0],
    "white_board": False, "white_block": 16, "compression": "none", "saturation_code": 255, "clip_code": 0,
}  # fmt: skip


def make_store(path: Path) -> None:
    """A small Zarr store as the stages write them: one array packed with zstd, one with a checksum only."""
    shutil.rmtree(path, ignore_errors=True)
    group = zarr.create_group(path, attributes={"stamp": {"scene": "s"}})
    for name, codecs in (("a", [ZstdCodec(level=1, checksum=True)]), ("b", [Crc32cCodec()])):
        array = group.create_array(name, shape=(6, 5), chunks=(4, 5), dtype="float32", compressors=codecs, filters=None)
        array[...] = np.arange(30.0, dtype=np.float32).reshape(6, 5)
