"""Normals as 16-bit TIFF and as EXR, with their convention in the file."""

from collections.abc import Iterator

import numpy as np

from nishiki.artifacts.stage import Context
from nishiki.formats.exr_bands import ExrWriter
from nishiki.formats.tiff_bands import write_tiff
from nishiki.render.display import normals_as_colours
from nishiki.stages.export.scene import ExportedScene

AXES = "x right, y up, z out of the surface towards the camera; row 0 is the top"


def write(context: Context, scene: ExportedScene) -> dict:
    """`normals.tif` and `normals.exr`; the angle that 16 bits lose."""
    down = context.settings.normals_y == "down"
    convention = (
        f"Unit normals, {'DirectX (y down)' if down else 'OpenGL (y up)'}: value = (n + 1) / 2 * 65535 of x right, "
        f"y {'down' if down else 'up'}, z out of the surface towards the camera; 0, 0, 0: no estimate. Linear data, no "
        "colour."
    )
    path = context.output.path
    largest = squares = count = 0.0
    header = {**{f"nishiki.{name}": text for name, text in context.stamp.items()}, "comments": f"Unit normals, {AXES}"}

    def bands(exr: ExrWriter) -> Iterator[np.ndarray]:
        nonlocal largest, squares, count
        for rows in scene.bands():
            normals = scene.normals(rows)
            coded = normals_as_colours(normals)
            exr.write(normals)
            angles = lost_angles(normals, coded)
            largest = max(largest, float(angles.max(initial=0)))
            squares, count = squares + float(np.sum(angles**2)), count + angles.size
            if down:
                coded[..., 1] = np.where(coded.any(axis=-1), 65535 - coded[..., 1], 0)
            yield coded

    with ExrWriter(path("exports/normals.exr"), ("N.X", "N.Y", "N.Z"), *scene.shape, header) as exr:
        write_tiff(
            path("exports/normals.tif"),
            bands(exr),
            (*scene.shape, 3),
            description=f"{convention} {stamped(context)}",
            software=software(context),
            pitch_mm=scene.pitch_mm,
        )
    return {
        "files": ["exports/normals.tif", "exports/normals.exr"],
        "largest_deg": largest,
        "rms_deg": (squares / count) ** 0.5 if count else 0.0,
    }


def lost_angles(normals: np.ndarray, coded: np.ndarray) -> np.ndarray:
    """(n,) degrees between normals (r, columns, 3) and what their 16-bit code says, where there is one."""
    known = coded.any(axis=-1)
    exact = normals[known].astype(np.float64)
    read = coded[known] / 65535 * 2 - 1
    across = np.linalg.norm(np.cross(exact, read), axis=-1)
    return np.degrees(np.arctan2(across, np.sum(exact * read, axis=-1)))


def stamped(context: Context) -> str:
    """The stamp of an artifact in words."""
    return "; ".join(f"nishiki.{name}={text}" for name, text in context.stamp.items())


def software(context: Context) -> str:
    """Program and version."""
    return f"Nishiki {context.stamp['version']}"
