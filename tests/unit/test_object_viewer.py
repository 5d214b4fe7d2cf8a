"""What the page of an object is given, read back in Python: arrays, surface, streams and tables of the decoder."""

import json
import struct
import zlib

import numpy as np
import pytest
from coded_dome import coded_dome

from nishiki.codec.store import head_length
from nishiki.codec.transform import Block
from nishiki.formats.stored import open_array
from nishiki.report.viewer.page import pack_arrays
from nishiki.stages.viewer.object import CHART_STEPS, decoder_arrays, object_manifest, stream_parts


@pytest.fixture(scope="module")
def decoded(tmp_path_factory):
    return coded_dome(tmp_path_factory.mktemp("object"))


def unpacked(data):
    raw = zlib.decompress(data)
    length = struct.unpack("<I", raw[:4])[0]
    out, at = {}, 4 + length
    for entry in json.loads(raw[4:at]):
        count, size = int(np.prod(entry["shape"])), np.dtype(entry["type"]).itemsize
        planes = np.frombuffer(raw, np.uint8, count * size, at).reshape(size, count)
        values = np.ascontiguousarray(planes.T).view(np.dtype(entry["type"]).newbyteorder("<"))
        out[entry["name"]] = values.reshape(entry["shape"])
        at += count * size
    assert at == len(raw)
    return out


def test_arrays_come_back_as_they_were(decoded):
    arrays = decoder_arrays(decoded)
    back = unpacked(pack_arrays(arrays))
    assert list(back) == list(arrays)
    for name, values in arrays.items():
        np.testing.assert_array_equal(back[name], values)


def test_surface_is_that_of_mesh_and_atlas(decoded):
    arrays, step = decoder_arrays(decoded), object_manifest(decoded, without=frozenset())["mesh_step"]
    corners = arrays["corners"].astype(int)
    vertices = (arrays["vertices"].astype(int) + arrays["lowest"]) * step
    np.testing.assert_array_equal(arrays["point_vertex"][corners], decoded.mesh.triangles)
    np.testing.assert_array_equal(vertices, decoded.mesh.vertices)  # the ball's vertices lie on a grid
    np.testing.assert_array_equal(arrays["point_chart"][corners], np.repeat(decoded.atlas.chart[:, None], 3, axis=1))
    places = arrays["point_place"][corners] / CHART_STEPS
    np.testing.assert_allclose(places, decoded.atlas.corners, atol=0.5 / CHART_STEPS)


def test_the_page_holds_the_coded_streams_byte_for_byte(decoded):
    residual, parts = decoded.residual, list(stream_parts(decoded))
    assert [part["name"].split("-")[0] for part, _ in parts] == ["parameters", "residual"]
    whole = np.asarray(open_array(residual.path)[:]).tobytes()
    streams = whole[head_length(whole) :]
    at = {"parameters": 0, "residual": 0}
    for tile in range(residual.tiles):
        for (part, data), length in zip(
            parts, (residual.stream_bytes(tile)[0], sum(residual.stream_bytes(tile)[1:])), strict=True
        ):
            name = part["name"].split("-")[0]
            assert data[at[name] : at[name] + length] == streams[:length]
            streams, at[name] = streams[length:], at[name] + length
    assert streams == b""


def test_synthesis_by_the_tables_is_that_of_the_transform(decoded):
    arrays, design = decoder_arrays(decoded), decoded.residual.design
    extent = max(decoded.residual.extents, key=lambda one: one.rows * one.columns)
    plane = design.plane(extent)
    coefficients = np.random.default_rng(1).normal(size=(extent.rows, extent.columns))
    gains = np.ones(coefficients.shape)
    for level in range(plane.levels):
        norms = [
            np.concatenate([arrays[f"plane/{side}/{band}/{level}"] for band in ("low", "high")])
            for side in coefficients.shape
        ]
        rows, columns = (len(each) for each in norms)
        gains[:rows, :columns] = np.outer(*norms)
    samples = coefficients / gains
    for level in range(plane.levels - 1, -1, -1):
        down, across = (matrix(arrays, side >> level) for side in coefficients.shape)
        rows, columns = len(down), len(across)
        samples[:rows, :columns] = down @ samples[:rows, :columns] @ across.T
    want = Block(plane, np.eye(1), np.eye(1)).inverse(coefficients[None, None, None])[0, 0, 0]
    np.testing.assert_allclose(samples, want, atol=1e-5)


def matrix(arrays, length):
    out = np.zeros((length, length))
    for row, (index, weight) in enumerate(
        zip(arrays[f"plane/{length}/index"], arrays[f"plane/{length}/weight"], strict=True)
    ):
        np.add.at(out[row], index.astype(int), weight)
    return out
