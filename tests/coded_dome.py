"""A small coded object for the viewer: a bumpy ball with random parameters and residuals, coded as the stage does."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from nishiki.atlas.surface import texel_points, texel_triangles
from nishiki.brdf.texels.model import CaptureLamps
from nishiki.codec.allocate import EncodedObject, one_pass, pilot
from nishiki.codec.design import Design, extent_of
from nishiki.codec.entropy import Model, encode, train
from nishiki.codec.pictures import SIDE, PictureSource
from nishiki.codec.store import Residual, write_residual
from nishiki.codec.tile_code import CodedScene, Effort
from nishiki.geometry.camera import Camera, look_at
from nishiki.geometry.mesh import Mesh
from nishiki.render.object.renderer import DecodedObject
from nishiki.stages.texels import TexelsSettings
from nishiki.stages.texels.run import lay_out

VIEWS, TILE = 10, 32
LIGHTING = CaptureLamps("direction", ((0.0, 0.3, 0.954),))


def bumpy_ball(around: int = 28, high: int = 14) -> Mesh:
    """A closed surface with hollows, so that parts of it hide others."""
    theta, phi = np.meshgrid(np.linspace(0, np.pi, high + 1), np.arange(around) / around * 2 * np.pi, indexing="ij")
    radius = 1 + 0.25 * np.sin(3 * phi) * np.sin(theta) ** 2
    points = radius[..., None] * np.stack(
        [np.sin(theta) * np.cos(phi), np.cos(theta), np.sin(theta) * np.sin(phi)], axis=-1
    )
    a = (np.arange(high)[:, None] * around + np.arange(around)).reshape(-1)
    b = (np.arange(high)[:, None] * around + (np.arange(around) + 1) % around).reshape(-1)
    corners = [np.stack([a, b, b + around], 1), np.stack([a, b + around, a + around], 1)]
    grid = np.round(points.reshape(-1, 3) * 4096) / 4096
    vertices, places = np.unique(grid, axis=0, return_inverse=True)
    triangles = places.reshape(-1)[np.concatenate(corners)]
    sound = [len(set(t)) == 3 for t in triangles.tolist()]
    return Mesh.of(vertices, triangles[sound])


def cameras(rows: int = 130, columns: int = 150) -> list[Camera]:
    """A turn about the y axis with small errors of calibration and lens distortion."""
    rng, out = np.random.default_rng(3), []
    for view in range(VIEWS):
        angle = 2 * np.pi * view / VIEWS
        eye = np.array([4.5 * np.sin(angle), 1.2, 4.5 * np.cos(angle)]) + rng.normal(scale=0.01, size=3)
        camera = look_at(eye, (0, 0, 0), rows=rows, columns=columns, field_of_view=0.55, name=f"{view:03d}")
        out.append(replace(camera, distortion=(-0.05, 0.01, 0.001, -0.001, 0.0)))
    return out


def coded_dome(folder: Path, *, encoding: str = "srgb", pictures: bool = False) -> DecodedObject:
    """The object, its residual written to a folder and opened again; pictures: of the views, lit from the camera."""
    rng, mesh, views = np.random.default_rng(7), bumpy_ball(), cameras()
    atlas = lay_out(mesh, views, TexelsSettings(tile=TILE))[1]
    triangles = texel_triangles(atlas)
    turned = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    design = Design(
        TILE,
        VIEWS,
        1,
        3,
        full_turn=True,
        encoding=encoding,
        step=0.02,
        parameter_steps=(0.02, 0.02, 0.1),
        colour=tuple(map(tuple, turned)),
        parameter_means=((0.4, 0.35, 0.3), (0.05, 0.04, 0.06), (-1.2,)),
    )
    extents, parameters, residuals = [], [], []
    for tile in range(atlas.tiles):
        positions, normals, inside = (part[0] for part in texel_points(mesh, atlas, triangles, slice(tile, tile + 1)))
        facing = [((camera.centre - positions) * normals).sum(-1)[inside].max(initial=-1) > 0.5 for camera in views]
        extent = extent_of(np.array(facing), inside, full_turn=True, arcs=True)
        extents.append(extent)
        parameters.append(sparse(rng, design.parameter_shape(extent), 0.05, 3))
        residuals.append(sparse(rng, design.residual_shape(extent), 0.03, 6))
    levels = [(design.parameter_plane(e).levels, design.plane(e).levels) for e in extents]
    untrained = Model.initial()
    first = [encode(p, n[0], untrained) for p, n in zip(parameters, levels, strict=True)]
    second = [encode(r, n[1], untrained) for r, n in zip(residuals, levels, strict=True)]
    models = train(first), train(second)
    streams = [
        (encode(p, n[0], models[0]).data, encode(r, n[1], models[1]).data)
        for p, r, n in zip(parameters, residuals, levels, strict=True)
    ]
    coded = EncodedObject(design, models, extents, [None] * atlas.tiles, streams, 1, 0.0, 0.0, 0, [])
    write_residual(folder, coded, photographed(design) if pictures else None, stamp={}, report={})
    names, lighting = tuple(camera.name for camera in views), CaptureLamps("camera") if pictures else LIGHTING
    return DecodedObject(
        mesh, atlas, views, Residual(folder), lighting, triangles, encoding, 3, True, names, ("",), 1.0
    )


def photographed(design: Design, rows: int = 130, columns: int = 150) -> EncodedObject:
    """Waves that differ from view to view, as pictures of all pixels."""
    row, column = np.mgrid[:rows, :columns]

    def read(view: int) -> tuple[np.ndarray, np.ndarray]:
        waves = [np.sin(column / 7 + view + channel) * np.cos(row / 9 - channel) for channel in range(3)]
        return (0.5 + 0.3 * np.stack(waves, axis=-1)).astype(np.float32)[None], np.ones((rows, columns), bool)

    source = PictureSource(read, tuple(range(VIEWS)), VIEWS, (rows, columns), 3)
    scene = CodedScene(np.zeros((VIEWS, 3)), [LIGHTING.lamp(camera) for camera in cameras()])
    found = pilot(source, scene, replace(design, tile_size=SIDE, model=False), Effort(), threads=1)
    return one_pass(source, scene, found.at_step(0.1), Effort(), threads=1)


def sparse(rng: np.random.Generator, shape: tuple[int, ...], share: float, spread: float) -> np.ndarray:
    """Integers of which a share is not zero, a few of them large."""
    values = np.round(rng.normal(scale=spread, size=shape)) * (rng.random(shape) < share)
    values[..., 0, 0] += np.where(rng.random(shape[:-2]) < 0.1, 25, 0)
    return values.astype(np.int32)
