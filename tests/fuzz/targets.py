"""One function a reader: bytes in, a valid result or UserError out; anything else is a finding."""

from __future__ import annotations

import atexit
import os
import re
import shutil
import tempfile
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from pathlib import Path
from types import SimpleNamespace

import numpy as np
from fuzz.corpus import FOLDER, IMAGES, LIGHTS, MESHES, STORES, TABLES, YAML, corpus, make_relight, make_store
from fuzz.watch import paused

from nishiki.artifacts.artifact import MANIFEST, open_artifact
from nishiki.capture.convert import read_source
from nishiki.capture.folder import examine, read_intensities
from nishiki.capture.frames import read_frames
from nishiki.capture.goniometer_tables import read_table
from nishiki.capture.lights import lights_from_vectors, read_lights
from nishiki.capture.options import ConvertOptions
from nishiki.capture.photogrammetry import read_bundler, read_meshroom, read_metashape, read_transforms
from nishiki.capture.relightable import SUFFIXES, open_relightable
from nishiki.capture.rti_projects import read_relight
from nishiki.capture.seal import manifest_text, read_manifest
from nishiki.capture.tables import read_cameras, read_curves, read_intrinsics, read_points
from nishiki.engine.project import load_project, load_yaml
from nishiki.errors import UserError
from nishiki.formats.images import read_codes, read_header
from nishiki.formats.masks import read_labels, read_mask
from nishiki.formats.mesh_heading import expect_mesh
from nishiki.formats.problems import CaptureError
from nishiki.formats.stored import load_arrays, open_group
from nishiki.geometry.mesh import read_points as read_scan
from nishiki.geometry.mesh import read_triangles
from nishiki.observations.plane import Observations
from nishiki.polarisation.polariser_states import read_instrument

COLOURS = ("red", "green", "blue")


@cache
def place() -> Path:
    """A folder of this process for the files that are read, in memory where that can be; removed at its end."""
    return paused(_make_place)


def _make_place() -> Path:
    folder = Path(tempfile.mkdtemp(prefix="fuzz-", dir="/dev/shm" if os.access("/dev/shm", os.W_OK) else None))
    atexit.register(shutil.rmtree, folder, True)
    named = {name.decode() for seed in corpus("tables") for name in re.findall(rb"[a-z]\w*/\w+\.png", seed)}
    for name in sorted(named):
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_bytes(b"")
    return folder


def put(name: str, content: bytes) -> Path:
    """Write the file that is to be read."""
    path = place() / name
    paused(path.write_bytes, content)
    return path


def choice(data: bytes, kinds: tuple[str, ...]) -> tuple[str, int, bytes]:
    """Which reader the first byte chooses, its further choices, and the rest."""
    first = data[0] if data else 0
    return kinds[first % len(kinds)], first // len(kinds), data[1:]


def manifest(data: bytes) -> None:
    """manifest-sha256.txt: what is read is written and read again as it was."""
    found = read_manifest(put("manifest-sha256.txt", data))
    assert read_manifest(put("manifest-sha256.txt", manifest_text(found).encode())) == found
    assert not any(name.startswith("/") or ".." in name.split("/") for name in found)


def lights(data: bytes) -> None:
    """.lp in its dialects, tables and lists of directions, Relight's files."""
    suffix, more, content = choice(data, LIGHTS)
    kind = ("direction", "position_mm")[more % 2]
    path = put(f"l{suffix}", content)
    found = read_relight(path).lights if suffix == ".relight" else read_lights(path, kind=kind, frontal=not more & 2)
    assert np.isfinite(found.directions).all()
    assert len(set(found.names)) == len(found.names) == len(found.directions)


def tables(data: bytes) -> None:
    """frames.csv of each geometry, cameras, points, intensities, spectra, reflectances, scenes, MATLAB."""
    kind, _, content = choice(data, TABLES)
    if kind in ("plane", "turntable", "goniometer"):
        for frame in read_frames(put("frames.csv", content), geometry=kind):
            assert frame.path.resolve().is_relative_to(place().resolve())
    else:
        {
            "cameras": lambda: read_cameras(put("c.csv", content), "c.csv"),
            "points": lambda: read_points(put("p.csv", content), "p.csv", ("a",)),
            "intensities": lambda: read_intensities(put("i.csv", content), _two_lights(), COLOURS),
            "spectra": lambda: read_curves(put("s.csv", content)),
            "reflectances": lambda: read_table(put("r.csv", content), "r.csv"),
            "brdf": lambda: read_table(put("r.brdf", content), "r.brdf"),
            "scenes": lambda: load_project({"scenes": str(put("scenes.tsv", content))}),
            "camera list": lambda: _alone("a_par.txt", content),
            "meshroom": lambda: read_meshroom(put("c.sfm", content)),
            "transforms": lambda: read_transforms(put("transforms.json", content), _any_pictures()),
            "metashape": lambda: read_metashape(put("c.xml", content)),
            "bundler": lambda: read_bundler(put("bundle.out", content), _any_pictures()),
            "matlab": lambda: (_alone("a.mat", content), read_instrument(put("i.mat", content))),
        }[kind]()


def _any_pictures():
    put("list.txt", b"a.png\nb.png\n")
    return SimpleNamespace(folder=place(), paths=lambda names, file: names, size=lambda name, file: (24, 32))


def _two_lights():
    return lights_from_vectors(["a", "b"], np.array([[0.0, 0, 1], [0.6, 0, 0.8]]), file="l.lp")


def _alone(name: str, content: bytes):
    folder = place() / "round"
    paused(shutil.rmtree, folder, True)
    paused(folder.mkdir)
    for picture in ("a.png", "b.png"):
        put(f"round/{picture}", picture.encode())
    put(f"round/{name}", content)
    return read_source(folder, ConvertOptions())


def images(data: bytes) -> None:
    """PNG, JPEG, TIFF, OpenEXR: header, pixels, mask, labels; relightable images; the texts of a folder of relight."""
    suffix, _, content = choice(data, IMAGES)
    path = put(f"x{suffix}", content) if suffix not in FOLDER else _relight_folder(suffix, content)
    if suffix in SUFFIXES or suffix in FOLDER:
        assert np.isfinite(open_relightable(path).relight(np.array([0.6, 0.0, 0.8]))).all()
        return
    header = read_header(path)
    names = header.names or tuple(f"c{i}" for i in range(header.channels - header.alpha))
    codes = read_codes(path, names, header=header)
    assert codes.shape == (header.rows, header.columns, len(names))
    assert str(codes.dtype) == header.sample
    assert read_mask(path).shape == codes.shape[:2]
    with suppress(CaptureError):  # several channels
        read_labels(path)


def _relight_folder(name: str, content: bytes) -> Path:
    folder = place() / "relight"
    paused(shutil.rmtree, folder, True)
    paused(make_relight, folder)
    if name.endswith(".tzi"):  # a deep zoom is taken before it
        paused((folder / "plane_0.dzi").unlink)
    return put(f"relight/{name}", content).parent


def yaml(data: bytes) -> None:
    """capture.yaml of each geometry, intrinsics, the configuration, an instrument's calibration."""
    kind, _, content = choice(data, YAML)
    path = put("x.yaml", content)
    if kind == "configuration":
        put("scenes.tsv", b"scene\tcapture\n")
        values = load_yaml(path)
        load_project({**values, "scenes": str(place() / "scenes.tsv")} if isinstance(values, dict) else values)
    elif kind in ("intrinsics", "instrument"):
        read_intrinsics(path, "x.yaml") if kind == "intrinsics" else read_instrument(path)
    else:
        folder = place() / "capture"
        paused(lambda: folder.mkdir(exist_ok=True))
        put("capture/capture.yaml", content)
        examine(folder)


def meshes(data: bytes) -> None:
    """PLY and OBJ, as meshes and as scans."""
    suffix, _, content = choice(data, MESHES)
    path = put(f"m{suffix}", content)
    with suppress(CaptureError):
        expect_mesh(path, path.name, "capture.yaml", scan=False)
    with suppress(UserError):
        vertices, triangles = read_triangles(path)
        assert np.isfinite(vertices).all()
        assert triangles.min() >= 0
        assert triangles.max() < len(vertices)
    read_scan(path)


def stores(data: bytes) -> None:
    """Metadata and chunks of a Zarr store, .npz, artifact.json, what is stored beside ingested frames."""
    kind, _, content = choice(data, STORES)
    if kind == "npz":
        load_arrays(put("x.npz", content))
    elif kind == "manifest":
        paused(lambda: (place() / "artifact").mkdir(exist_ok=True))
        open_artifact(put(f"artifact/{MANIFEST}", content))
    elif kind == "observations":
        Observations(_observed(content))
    else:
        for name, sound in _sound_store().items():
            put(f"s.zarr/{name}", sound)
        put({"group": "s.zarr/zarr.json", "array": "s.zarr/a/zarr.json", "chunk": "s.zarr/a/c/0/0"}[kind], content)
        group = open_group(place() / "s.zarr")
        dict(group.attrs)
        try:
            group["a"][...]
        except (KeyError, ValueError, RuntimeError, OSError):
            assert kind in ("chunk", "array", "group")  # a chunk that is damaged: told by its checksum or its codec


@cache
def _sound_store() -> dict[str, bytes]:
    """The files of the store before one of them is changed."""
    paused(make_store, place() / "s.zarr")
    return {name: (place() / "s.zarr" / name).read_bytes() for name in ("zarr.json", "a/zarr.json", "a/c/0/0")}


def _observed(attributes: bytes) -> Path:
    """A store of ingested frames with these attributes, as JSON text."""
    path = place() / "frames.zarr"
    if not path.exists():
        paused(make_store, path)
        paused(os.rename, path / "b", path / "codes")
    text = b'{"zarr_format": 3, "node_type": "group", "attributes": ' + attributes + b"}"
    put("frames.zarr/zarr.json", text)
    return path


TARGETS: dict[str, Callable[[bytes], None]] = {
    target.__name__: target for target in (manifest, lights, tables, images, yaml, meshes, stores)
}
TOKENS = (
    b"..", b"/", b"\\", b"\0", b"\n", b"\r\n", b'"', b"%0A", b"&a ", b"*a", b"!!python/object:", b"<<: ", b"nan",
    b"inf", b"1e999", b"-1", b"0", b"99999999999999999999", b"18446744073709551615", b"4294967295", b"2147483647",
    b"[", b"{", b"\xef\xbb\xbf", b"\xed\xa0\x80", b"\xff\xff\xff\xff", b"\x00\x00\x00\x00", b"\xff\xd8", b"\xff\xd9",
    b"\xff\xda", b"element vertex 4000000000", b"property list uint double x", b"f 1 2 999999999", b"$(touch x)", b"`",
    b";", b"null", b"true", b"1_0", b"\xc2\xb2", b"2024-13-45", b"0x", b"zstd", b"shape", b"chunk_shape", b'"pickle"',
    b"../../x",
)  # fmt: skip
"""Words that readers look for, or trip over: the dictionary of the fuzzing."""
