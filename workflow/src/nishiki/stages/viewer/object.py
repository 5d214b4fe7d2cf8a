"""Write a page on which the coded object is decoded and rendered from any view, data beside it or inside it.

Nothing is coded anew. The page holds the streams of the stage `residual` byte for byte and decodes them with the same
integer arithmetic; mesh and charts come as integers, wavelets as sparse matrices, cameras and lamps as numbers.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from nishiki.artifacts.stage import Context
from nishiki.codec.compact import mesh_step
from nishiki.codec.design import view_matrix
from nishiki.codec.store import CodedReader
from nishiki.codec.transform import PlaneTransform
from nishiki.geometry.turn import fit_turn
from nishiki.observations.views import Views
from nishiki.render.object.renderer import DecodedObject
from nishiki.render.object.shots import ball_around, shadow_lift
from nishiki.report.viewer.page import Blocks, pack_arrays, write_page

PAGE = Path(__file__).with_suffix(".js")


def run(context: Context) -> dict:
    """Write the decoder's data and the coded streams, then the page around them."""
    decoded = DecodedObject.open(context.inputs)
    blocks = Blocks(context.output, inline_bytes=int(context.settings.inline_mb * 1e6))
    about = {
        **context.stamp,
        "title": context.inputs["ingest"].diagnostics["capture"]["title"],
        "unit": Views(context.inputs["ingest"].folder).unit,
    }
    return write_object(decoded, blocks, about, without=decoded.numbers(context.settings.hold_out))


def write_object(decoded: DecodedObject, blocks: Blocks, about: dict, *, without: frozenset[int]) -> dict:
    """Write blocks and page of an object; return sizes in bytes. about: title, stamp, unit; without: omitted views."""
    described = pack_arrays(decoder_arrays(decoded))
    blocks.add("object", described)
    streams, coded_bytes = [], 0
    for part, data in stream_parts(decoded):
        blocks.add(part["name"], data)
        streams.append(part)
        coded_bytes += len(data)
    manifest = {"format": 1, "chain": "object", **about, "streams": streams}
    sizes = write_page(blocks, manifest | object_manifest(decoded, without=without), PAGE)
    return {
        **sizes,
        "stream_bytes": coded_bytes,
        "decoder_bytes": len(described),
        "coded_object_bytes": decoded.residual.bytes["total"],
    }


NORMAL_STEPS = 32767  # of a normal's coordinate from 0 to 1
CHART_STEPS = 256  # steps of a texel: places on the charts are rounded to these
PART_BYTES = 256 << 10  # of the streams of several tiles that are loaded together


def object_manifest(decoded: DecodedObject, *, without: frozenset[int]) -> dict:
    """Return the part of the page's manifest specific to objects, as plain data."""
    design, turn = decoded.residual.design, fit_turn(list(decoded.cameras), full_turn=decoded.full_turn)
    centre, radius = ball_around(decoded.mesh)
    return {
        "views": [camera.as_dict() for camera in decoded.cameras],
        "lights": list(decoded.lights),
        "without": sorted(without),
        "turn": {
            "axis": turn.axis.tolist(),
            "point": turn.point.tolist(),
            "position": turn.position.tolist(),
            "length": turn.length,
            "closed": bool(turn.closed),
        },
        "lighting": decoded.lighting.as_dict(),
        "ceiling": decoded.ceiling,
        "centre": centre.tolist(),
        "radius": radius,
        "lift": shadow_lift(decoded.mesh),
        "chart_steps": CHART_STEPS,
        "normal_steps": NORMAL_STEPS,
        "mesh_step": mesh_step(decoded.mesh, list(decoded.cameras)),
        "design": design.as_dict(),
        "pictures": decoded.residual.pictures and decoded.residual.pictures.design.as_dict(),
    }


def decoder_arrays(decoded: DecodedObject) -> dict[str, np.ndarray]:
    """Return mesh and charts, and the arrays of what is coded on texels and as `pictures/`.

    Vertices lie on their grid; each point of the charts has its vertex, chart and place; triangles have corners.
    """
    mesh, atlas = decoded.mesh, decoded.atlas
    grid = np.round(mesh.vertices / mesh_step(mesh, list(decoded.cameras))).astype(np.int64)
    lowest = grid.min(axis=0)
    places = np.round(atlas.corners.astype(np.float64) * CHART_STEPS).astype(np.int64).reshape(-1, 2)
    charts = np.repeat(atlas.chart.astype(np.int64), 3)
    points, corners = np.unique(
        np.column_stack([charts, mesh.triangles.reshape(-1).astype(np.int64), places]), axis=0, return_inverse=True
    )
    arrays = {
        "lowest": lowest.astype(np.int32),
        "vertices": smallest(grid - lowest),
        "normals": np.rint(mesh.normals * NORMAL_STEPS).astype(np.int16),
        "point_chart": points[:, 0].astype(np.int16),
        "point_vertex": smallest(points[:, 1]),
        "point_place": points[:, 2:].astype(np.int32),
        "corners": smallest(corners.reshape(-1, 3)),
        "chart_grid": atlas.chart_grid.astype(np.int32),
        "cells": atlas.cells.astype(np.int32),
        **coded_arrays(decoded.residual),
    }
    if decoded.residual.pictures is not None:
        arrays |= {f"pictures/{name}": values for name, values in coded_arrays(decoded.residual.pictures).items()}
    return arrays


def coded_arrays(coded: CodedReader) -> dict[str, np.ndarray]:
    """Return the index of the streams, start states of the coder, a level of synthesis per length, view transforms."""
    extents = [extent.row_of_numbers() for extent in coded.extents]
    lengths = [coded.stream_bytes(tile) for tile in range(coded.tiles)]
    arrays = {"extents": np.array(extents, np.uint16), "lengths": np.array(lengths, np.uint32)}
    for name, model in zip(("parameters", "residual"), coded.models, strict=True):
        if coded.design.model or name == "residual":
            arrays[f"{name}/chance"] = model.chance.astype(np.uint32)
            arrays[f"{name}/seen"] = model.seen.astype(np.uint8)
            arrays[f"{name}/weights"] = model.weights.astype(np.int32)
    design = coded.design
    used = [extent for extent in coded.extents if extent.length]
    arrays["along/lights"] = view_matrix(design.light_transform, design.lights).astype(np.float32)
    for length in sorted({extent.length for extent in used}):
        arrays[f"along/views/{length}"] = view_matrix(design.view_transform, length).astype(np.float32)
    for extent in used:
        arrays |= plane_arrays("plane", design.plane(extent))
        if design.model:
            arrays |= plane_arrays("parameter_plane", design.parameter_plane(extent))
    return arrays


def plane_arrays(name: str, plane: PlaneTransform) -> dict[str, np.ndarray]:
    """Return sparse rows of each level's synthesis, and lengths of its basis vectors, for both axes of a plane."""
    arrays = {}
    for axis in (plane.down, plane.across):
        for level in range(plane.levels):
            length = axis.length >> level
            index, weight = (rows[level, :length] for rows in (axis.synthesis.index, axis.synthesis.weight))
            used = weight.any(axis=0)
            arrays[f"{name}/{length}/index"] = index[:, used].astype(np.uint16)
            arrays[f"{name}/{length}/weight"] = weight[:, used].astype(np.float32)
            for band, basis in (("low", axis.smooth[level]), ("high", axis.detail[level])):
                norms = np.sqrt((basis**2).sum(axis=0)).astype(np.float32)
                arrays[f"{name}/{axis.length}/{band}/{level}"] = norms
    return arrays


def stream_parts(decoded: DecodedObject) -> Iterator[tuple[dict[str, Any], bytes]]:
    """Yield the coded streams of the tiles first .. stop - 1, byte for byte, in parts that are loaded one by one.

    First come the parameters' streams (0), then the residual's or, in its place, those of views coded as pictures.
    """
    residual, pictures = decoded.residual, decoded.residual.pictures
    of_views = ("pictures", pictures) if pictures is not None else ("residual", residual)
    for (kind, coded), streams in ((("parameters", residual), slice(0, 1)), (of_views, slice(1, None))):
        first, held = 0, []
        for tile in range(coded.tiles):
            held.append(b"".join(coded.stream(tile, n) for n in range(len(coded.stream_bytes(tile)))[streams]))
            if sum(map(len, held)) >= PART_BYTES or tile + 1 == coded.tiles:
                yield {"name": f"{kind}-{first}", "first": first, "stop": tile + 1}, b"".join(held)
                first, held = tile + 1, []


def smallest(values: np.ndarray) -> np.ndarray:
    """Convert non-negative integers to uint16 where they fit and to uint32 otherwise."""
    return values.astype(np.uint16 if values.max(initial=0) < 1 << 16 else np.uint32)
