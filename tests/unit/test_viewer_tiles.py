"""Tiles and codes of the viewer: the same however the rows come in, and back to the values within their steps."""

import base64
import json
import re
import struct
import zlib
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from nishiki.artifacts.provenance import program_of
from nishiki.report.viewer.encoding import NormalCode, PrincipalCode
from nishiki.report.viewer.page import PAGE, Blocks, webp_stack, write_page
from nishiki.report.viewer.pyramid import BORDER, MOST, TILE, Pyramid, encode


def tiles(values: np.ndarray, band_rows: int) -> dict:
    made = {}
    pyramid = Pyramid(*values.shape, lambda *place: made.update({place[:3]: place[3]}))
    for first in range(0, len(values), band_rows):
        pyramid.push(values[first : first + band_rows])
    return made


def test_tiles_do_not_depend_on_the_bands_and_hold_the_map():
    rng = np.random.default_rng(1)
    values = rng.random((TILE + 37, TILE + 11, 3), dtype=np.float32)
    values[..., 0] = 1
    some, others = tiles(values, 64), tiles(values, 101)
    assert set(some) == set(others) == {(0, 0, 0), (0, 0, 1), (0, 1, 0), (0, 1, 1), (1, 0, 0)}
    assert all(np.array_equal(some[place], others[place]) for place in some)
    inner = some[0, 0, 0][BORDER:, BORDER:]
    assert np.array_equal(inner[: TILE + BORDER], values[: TILE + BORDER, : TILE + BORDER])
    assert some[1, 0, 0][BORDER, BORDER, 1] == pytest.approx(values[:4, :4, 1].mean(), abs=1e-6)


def test_normals_come_back_within_their_step_and_flat_ones_exactly():
    rng = np.random.default_rng(2)
    normals = np.concatenate([rng.normal(0, 0.2, (500, 2)), np.ones((500, 1))], axis=1)
    normals[0] = 0, 0, 1
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    code = NormalCode.of(normals, 0.003)
    t = np.stack(code.encode(normals.astype(np.float32)), axis=-1) / 127.0 - 1
    s = code.width * t * (code.fineness + (1 - code.fineness) * t * t)
    back = np.concatenate([2 * s, 1 - (s * s).sum(axis=-1, keepdims=True)], axis=-1)
    back /= np.linalg.norm(back, axis=-1, keepdims=True)
    assert back[0].tolist() == [0, 0, 1]
    angles = np.degrees(np.arccos(np.clip((back * normals).sum(axis=1), -1, 1)))
    assert np.percentile(angles, 99) < 0.5


def test_principal_codes_drop_what_no_step_shows():
    rng = np.random.default_rng(3)
    vectors = rng.normal(0, [1.0, 0.3, 1e-5], (2000, 3))
    code = PrincipalCode.of(vectors, np.eye(3), 0.02)
    assert len(code.planes) == 2
    steps = zip(code.planes, code.components, code.encode(vectors.astype(np.float32)), strict=True)
    shares = [(plane.low + codes[:, None] * (plane.high - plane.low) / 255) * axis for plane, axis, codes in steps]
    assert np.abs(code.mean + sum(shares) - vectors)[:, :2].mean() < 0.02


def test_pictures_of_a_tile_are_lossless():
    planes = list(np.random.default_rng(4).integers(0, 256, (4, 16, 16), dtype=np.uint8))
    data, shown = webp_stack(planes), []
    while data:
        (length,) = struct.unpack("<I", data[:4])
        picture = cv2.imdecode(np.frombuffer(data[4 : 4 + length], np.uint8), cv2.IMREAD_COLOR)
        shown += list(np.moveaxis(picture[..., ::-1], -1, 0))
        data = data[4 + length :]
    assert np.array_equal(shown[:4], planes)


def test_a_block_of_every_byte_is_a_line_of_script(tmp_path):
    blocks = Blocks(SimpleNamespace(path=lambda name: tmp_path / name.split("/")[-1]), inline_bytes=0)
    blocks.add("all", bytes(range(256)) * 2)
    script = (tmp_path / "all.js").read_bytes()
    assert script.startswith(b'nishikiData("all",512,"')
    assert script.count(b"\n") == 1
    assert script.count(b"\r") == 0


def decoded(block: bytes, code: dict, shape: tuple[int, int]) -> np.ndarray:
    """Codes of a block of heights, pixel by pixel as the head of heights.py says."""
    streams = []
    while block:
        (length,) = struct.unpack("<I", block[:4])
        streams.append(zlib.decompress(block[4 : 4 + length]))
        block = block[4 + length :]
    *streams, large = [iter(each) for each in (*streams[:-1], np.frombuffer(streams[-1], np.uint8).reshape(2, -1).T)]
    codes, seen = np.zeros(shape, np.int64), np.zeros((shape[0] + 1, shape[1] + 2), np.int64)
    for row, column in np.ndindex(shape):
        around = 2 * seen[row + 1, column] + 2 * seen[row, column + 1] + seen[row, column] + seen[row, column + 2]
        z = next(streams[sum(int(around) > most for most in code["thresholds"])])
        seen[row + 1, column + 1] = z
        if z == MOST:
            low, high = next(large)
            z = int(low) + 256 * int(high)
        west = codes[row, column - 1] if column else codes[row - 1, 0] if row else 0
        predicted = west
        if row > 1 and 1 < column < shape[1] - 1:
            places = ((1, 0), (1, 1), (1, -1), (0, 2), (2, 0))
            changes = [codes[row - up, column - left] - west for up, left in places]
            change = sum(w * each for w, each in zip(code["weights"], changes, strict=True))
            predicted = west + ((change + 128) >> 8)
        codes[row, column] = (predicted + (-(z + 1) // 2 if z & 1 else z // 2) + 32768) % 65536 - 32768
    return codes


@pytest.mark.parametrize("shape", [(1, 1), (2, 9), (3, 4), (9, 3), (40, 300), (520, 20)])
def test_heights_come_back_from_their_block(shape):
    rng = np.random.default_rng(5)
    smooth = np.cumsum(rng.integers(-300, 301, shape), axis=1)
    codes = np.clip(smooth + 9000 * np.sin(np.arange(shape[0]))[:, None], -32500, 32500).astype(np.int16)
    codes[rng.random(shape) < 0.05] = -32768
    block, code = encode(codes)
    assert np.array_equal(decoded(block, code, shape), codes)


def test_heights_take_less_than_deflated_differences():
    rng = np.random.default_rng(6)
    spread = np.repeat([2.0, 40.0], 100)[:, None]
    codes = np.cumsum(np.cumsum(rng.normal(0, spread, (200, 300)), axis=0) * 0.2, axis=1).clip(-32000, 32000)
    codes = codes.astype(np.int16)
    change = np.diff(np.diff(codes, axis=0, prepend=np.int16(0)), axis=1, prepend=np.int16(0))
    plain = zlib.compress(np.ascontiguousarray(change.view(np.uint8).reshape(-1, 2).T).tobytes(), 9)
    assert len(encode(codes)[0]) < 0.8 * len(plain)


@pytest.mark.parametrize("stage", ["viewer", "object_viewer", "cloth_viewer"])
def test_a_page_holds_every_module_that_its_modules_name(tmp_path, stage):
    blocks = Blocks(SimpleNamespace(path=lambda name: tmp_path / name), inline_bytes=100)
    write_page(blocks, {"title": "T", "version": ""}, program_of(stage).with_suffix(".js"))
    page = (tmp_path / "index.html").read_text()
    modules = json.loads(re.search(r'<script type="importmap"[^>]*>(.*?)</script>', page, re.S).group(1))["imports"]
    named = {"viewer/page", "viewer/main"}
    for address in modules.values():
        text = base64.b64decode(address.split(",")[1]).decode()
        named |= {f"viewer/{name}" for name in re.findall(r"""["']viewer/(\w+)["']""", text)}
    assert named == set(modules)
    assert len(named) > 10


def test_every_text_that_a_page_names_is_there():
    named = {key for path in PAGE.glob("*.js") for key in re.findall(r'\btext\("([\w.]+)"', path.read_text())}
    assert len(named) > 40
    assert named <= set(json.loads((PAGE / "texts.en.json").read_text()))
