"""Read and write tables of reflectances: databases MERL (`.binary`), UTIA (`.bin`), and Dupuy and Jakob (`.bsdf`).

MERL: three int32 (90, 90, 180), then doubles (colour, theta_h, theta_d, phi_d), lowest byte first, in steps of
MERL_SCALE. theta_h, from the normal to the half vector, is spaced by squares: cell k begins at 90 (k / 90)^2 degrees.
theta_d, from the half vector to the light, and phi_d, around it from the plane of the normal, are spaced by one degree;
phi_d and phi_d + 180 are the same. Values below 0: light or view is below the surface (W. Matusik, H. Pfister, M. Brand
and L. McMillan (2003), A data-driven reflectance model, ACM Transactions on Graphics 22 (3)).

`.bsdf` (2018): `tensor_file`, a zero byte, version 1 0, number of arrays (uint32); of each array the length of its name
(uint16), its name, number of axes (uint16), kind (uint8), place in the file (uint64) and sizes (uint64); then the
arrays, lowest byte first. UTIA: doubles without a heading, (channel, theta_i, phi_i, theta_r, phi_r) (J. Filip and R.
Vavra (2014), Template-based sampling of anisotropic BRDFs, Computer Graphics Forum 33 (7)).
"""

import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from nishiki.artifacts.stage import Context
from nishiki.brdf.torrance_sparrow import MIRROR, body_factor, specular, transmittance
from nishiki.formats.files import Refused, read_bytes
from nishiki.formats.problems import Problem, warning
from nishiki.goniometry.directions import unit

MERL_SHAPE = (90, 90, 180)
MERL_SCALE = np.array([1.0, 1.15, 1.66]) / 1500
MERL_HIDDEN = -1.0
"""Value of a table where light or view is below the surface."""
MERL_BYTES = 12 + 8 * 3 * int(np.prod(MERL_SHAPE))


def read_merl(path: Path, name: str) -> np.ndarray:
    """Read (90, 90, 180, 3) float64 of BRDF values in 1/sr, red, green, blue. Refused for any other file.

    Values below 0 are those of the file; values that are not finite are refused.
    """
    content = read_bytes(path, "reflectances_bytes", name=name)
    if len(content) != MERL_BYTES or tuple(np.frombuffer(content, "<i4", 3)) != MERL_SHAPE:
        found = f"{len(content)} bytes that begin with {np.frombuffer(content[:12].ljust(12), '<i4').tolist()}"
        expected = f"{MERL_BYTES} bytes that begin with {list(MERL_SHAPE)}, as a table of the MERL database has"
        remedy = "Give a .binary file of the MERL database, or the measurements as .csv"
        raise Refused(name, "not such a table", expected=expected, found=found, remedy=remedy)
    stored = np.frombuffer(content, "<f8", offset=12).reshape(3, *MERL_SHAPE)
    broken = stored.size - np.count_nonzero(np.isfinite(stored))
    if broken:
        remedy = "Copy the file again from where it came"
        raise Refused(name, "values that are not finite", found=f"{broken} of {stored.size}", remedy=remedy)
    return np.moveaxis(stored, 0, -1) * MERL_SCALE


def merl_values(table: np.ndarray, light: np.ndarray, view: np.ndarray) -> np.ndarray:
    """Interpolate values (n, 3) of a table for unit vectors (n, 3) to light and view, the normal being z.

    Linear between the middles of the cells. Below 0 where one of the cells around has no value.
    """
    from scipy.ndimage import map_coordinates

    half = light + view
    half = half / np.linalg.norm(half, axis=1, keepdims=True)
    along = np.clip((light * half).sum(axis=1), -1, 1)
    polar = np.arctan2(np.hypot(half[:, 0], half[:, 1]), half[:, 2])
    # Around the half vector from the plane through it and the normal: `across` lies in that plane.
    turn = np.arctan2(half[:, 1], half[:, 0])
    across = np.stack([np.cos(polar) * np.cos(turn), np.cos(polar) * np.sin(turn), -np.sin(polar)], axis=1)
    aside = np.stack([-np.sin(turn), np.cos(turn), np.zeros_like(turn)], axis=1)
    around = np.mod(np.arctan2((light * aside).sum(axis=1), (light * across).sum(axis=1)), np.pi)
    cells = np.stack([90 * np.sqrt(polar / (np.pi / 2)), np.degrees(np.arccos(along)), np.degrees(around)]) - 0.5
    cells[2] += 1  # of the table continued by one cell at both ends
    continued = np.concatenate([table[:, :, -1:], table, table[:, :, :1]], axis=2)
    known = np.where(continued < 0, -np.inf, continued)
    with np.errstate(invalid="ignore"):  # 0 times infinity
        values = np.stack([map_coordinates(known[..., k], cells, order=1, mode="nearest") for k in range(3)], axis=1)
    return np.where(np.isfinite(values).all(axis=1, keepdims=True), values, MERL_HIDDEN)


MERL_LIGHTS = ((0.0, 0.0), *((15.0 * k, phi) for k in range(1, 6) for phi in (0.0, 45.0, 90.0)))
MERL_VIEWS = ((0.0, 0.0), *((3.0 * k, 7.5 * step) for k in range(1, 27) for step in range(48)))
"""theta and phi in degrees at which tables of the MERL database are read: as densely as a cloth is photographed."""


def read_merl_rows(path: Path, name: str) -> tuple[np.ndarray, Problem]:
    """Read a table as rows (n, 7) of theta_i, phi_i, theta_r, phi_r in degrees and red, green, blue; and a note."""
    stored = read_merl(path, name)
    angles = np.array([(*light, *view) for light in MERL_LIGHTS for view in MERL_VIEWS])
    values = merl_values(stored, *(unit(*np.radians(each).T) for each in (angles[:, :2], angles[:, 2:])))
    what = f"an isotropic table, read at {len(MERL_LIGHTS)} directions of light and {len(MERL_VIEWS)} of view"
    found = f"views up to {MERL_VIEWS[-1][0]:g} degrees; highlights narrower than the steps of 3 degrees are lost"
    return np.column_stack([angles, values]), warning("table-resampled", name, what, found=found)


def merl_directions() -> tuple[np.ndarray, np.ndarray]:
    """Compute unit vectors (90, 90, 180, 3) to light and view in the middles of the cells; the normal is z."""
    half_index, difference, turn = (np.arange(count) + 0.5 for count in MERL_SHAPE)
    half = np.radians(half_index**2 / 90)[:, None, None]
    difference, turn = np.radians(difference)[:, None], np.radians(turn)
    x, y, z = np.broadcast_arrays(
        np.sin(difference) * np.cos(turn), np.sin(difference) * np.sin(turn), np.cos(difference)
    )
    sine, cosine = np.sin(half), np.cos(half)
    light = np.stack(np.broadcast_arrays(cosine * x + sine * z, y, cosine * z - sine * x), axis=-1)
    middle = np.stack(np.broadcast_arrays(sine, 0.0, cosine), axis=-1)
    return light, 2 * (light * middle).sum(axis=-1, keepdims=True) * middle - light


def merl_bytes(brdf: np.ndarray) -> bytes:
    """Encode BRDF values (90, 90, 180, 3) in 1/sr, at `merl_directions`."""
    scaled = np.where(brdf >= 0, brdf / MERL_SCALE, brdf)
    return np.array(MERL_SHAPE, "<i4").tobytes() + np.ascontiguousarray(np.moveaxis(scaled, -1, 0), "<f8").tobytes()


def write_merl(context: Context, scene: Any) -> dict:
    """Write a table for each region of an `ExportedScene`: its lobes, and the mean of its body colour and shading."""
    gloss = scene.gloss
    beta, gamma, index, lost = gloss.beta, gloss.gamma, gloss.refractive_index, gloss.transmission
    labels = scene.regions(slice(0, scene.shape[0])) if len(index) > 1 else None
    light, view = merl_directions()
    spreads = []
    for region in range(len(index)):
        colour, shading, spread = mean_body(scene, labels, region)
        if colour is None:
            continue
        brdf = brdf_of(light, view, colour, shading, beta[region], gamma[region], index[region], lost[region])
        context.output.path(f"exports/merl/region-{region}.binary").write_bytes(merl_bytes(brdf))
        spreads.append(spread)
    return {"colour_spread": spreads}


def mean_body(scene: Any, labels: np.ndarray | None, region: int) -> tuple[np.ndarray | None, np.ndarray, float]:
    """Compute mean linear sRGB (3,) and body-shading terms (3,) of a region, and the spread of its colour.

    The spread is the root mean square distance from the mean, relative to it. None where no pixel has an estimate.
    """
    count, colours, squares, shadings = 0, np.zeros(3), np.zeros(3), np.zeros(3)
    for rows in scene.bands():
        chosen = scene.read_known(rows)
        if labels is not None:
            chosen &= labels[rows] == region
        colour = scene.srgb(rows)[chosen].astype(np.float64)
        count += len(colour)
        colours += colour.sum(axis=0)
        squares += (colour**2).sum(axis=0)
        shadings += scene.body_terms(rows)[chosen].sum(axis=0, dtype=np.float64)
    if not count:
        return None, shadings, 0.0
    mean = colours / count
    spread = np.sqrt(max(float((squares / count - mean**2).sum()), 0.0)) / max(float(np.linalg.norm(mean)), 1e-9)
    return mean, shadings / count, float(spread)


def brdf_of(light, view, colour, shading, beta, gamma, index, transmission) -> np.ndarray:
    """Compute the BRDF (..., 3) per steradian; `MERL_HIDDEN` where light or view is below the surface.

    light, view (..., 3): unit vectors; colour (3,), shading (3,): of the body; beta, gamma (lobes,); index: of
    refraction; transmission: share of the surface's loss that the body's light suffers.
    """
    normal = np.array([0.0, 0.0, 1.0])
    towards_light, towards_view = light[..., 2], view[..., 2]
    middle = light + view
    along = middle[..., 2] / np.linalg.norm(middle, axis=-1)
    seen = (towards_light > 0) & (towards_view > 0)
    passed = [1 + transmission * (transmittance(cosine, index) - 1) for cosine in (towards_light, towards_view)]
    body = passed[0] * passed[1] * body_factor(shading, np.maximum(towards_light, 0), np.maximum(along, 0))
    gloss = sum(
        specular(normal, light, view, beta=b, gamma=g, refractive_index=index) for b, g in zip(beta, gamma, strict=True)
    )
    gloss = gloss / np.maximum(towards_light, 1e-9)
    if index >= MIRROR:  # a metal mirrors in its colour
        body, gloss = gloss, 0 * gloss
    values = (body[..., None] * colour + gloss[..., None]) / np.pi
    return np.where(seen[..., None], values, MERL_HIDDEN)


KINDS = {np.dtype("u1"): 1, np.dtype("<f4"): 10}
HEADING = b"tensor_file\0" + bytes([1, 0])


def bsdf_bytes(arrays: dict[str, np.ndarray]) -> bytes:
    """Encode arrays of uint8 or float32."""
    headings = [
        (
            name.encode(),
            struct.pack("<HB", array.ndim, KINDS[array.dtype]),
            struct.pack(f"<{array.ndim}Q", *array.shape),
        )
        for name, array in arrays.items()
    ]
    place = len(HEADING) + 4 + sum(2 + len(name) + len(kind) + 8 + len(shape) for name, kind, shape in headings)
    top, contents = [HEADING, struct.pack("<I", len(arrays))], []
    for (name, kind, shape), array in zip(headings, arrays.values(), strict=True):
        place += (gap := -place % 8)
        top += [struct.pack("<H", len(name)), name, kind, struct.pack("<Q", place), shape]
        contents += [bytes(gap), array.tobytes()]
        place += array.nbytes
    return b"".join(top + contents)


UTIA_THETA_DEG, UTIA_PHI_DEG = np.arange(0, 90, 15.0), np.arange(0, 360, 7.5)
UTIA_SHAPE = (3, len(UTIA_THETA_DEG), len(UTIA_PHI_DEG), len(UTIA_THETA_DEG), len(UTIA_PHI_DEG))
UTIA_BYTES = 8 * int(np.prod(UTIA_SHAPE))


def read_utia(path: Path, name: str) -> tuple[np.ndarray, Problem]:
    """Read rows (58081, 7) float64 of theta_i, phi_i, theta_r, phi_r in degrees, red, green, blue; and a note.

    Values that differ only in the azimuth of a direction along the normal are averaged. Refused where the file is not
    as long as such a table.
    """
    content = read_bytes(path, "reflectances_bytes", name=name)
    if len(content) != UTIA_BYTES:
        expected, found = f"{UTIA_BYTES} bytes, as a table of the UTIA database has", f"{len(content)}"
        remedy = "Give a .bin file of the UTIA database, or the measurements as .csv"
        raise Refused(name, "not such a table", expected=expected, found=found, remedy=remedy)
    stored = np.moveaxis(np.frombuffer(content, "<f8").reshape(UTIA_SHAPE), 0, -1)
    by_light = np.concatenate([stored[:1].mean(axis=1), stored[1:].reshape(-1, *stored.shape[2:])])
    values = np.concatenate([by_light[:, :1].mean(axis=2), by_light[:, 1:].reshape(len(by_light), -1, 3)], axis=1)
    directions = np.array([(0.0, 0.0), *((theta, phi) for theta in UTIA_THETA_DEG[1:] for phi in UTIA_PHI_DEG)])
    count = len(directions)
    what = "the values of a UTIA table are taken to be in 1/sr"
    note = warning("table-scale", name, what, remedy="Check their scale: the file does not state it")
    angles = [np.repeat(directions, count, axis=0), np.tile(directions, (count, 1))]
    return np.column_stack([*angles, values.reshape(-1, 3)]), note


def utia_planes(brdf) -> np.ndarray:
    """Sample the table of the UTIA BRDF database, (3, 6, 48, 6, 48) float64: channel, theta_i, phi_i, theta_r, phi_r.

    theta 0 .. 75 degrees by 15, phi by 7.5; written as little-endian doubles in this order it is a `.bin` file that
    readers of that database open (ALTA among them).  One channel is written three times.  Values are 1 / sr.
    """
    directions = unit(*np.radians(np.meshgrid(UTIA_THETA_DEG, UTIA_PHI_DEG, indexing="ij")))
    values = brdf.evaluate(directions[:, :, None, None], directions[None, None])
    values = np.broadcast_to(values, (*values.shape[:-1], 3)) if values.shape[-1] == 1 else values[..., :3]
    return np.ascontiguousarray(np.moveaxis(values, -1, 0)).astype("<f8")


def write_utia(context: Context, brdf, suffix: str, channels) -> None:
    """Write the `.bin` file of a cloth's model."""
    context.output.path(f"brdf{suffix}_utia.bin").write_bytes(utia_planes(brdf).tobytes())


class BinaryTable(NamedTuple):
    """A kind of table without a heading."""

    size: int  # bytes of a file
    read: Callable[[Path, str], tuple[np.ndarray, Problem]]  # from path and name to rows of angles and values; a note


BINARY_TABLES = {".bin": BinaryTable(UTIA_BYTES, read_utia), ".binary": BinaryTable(MERL_BYTES, read_merl_rows)}
"""Kinds of tables by suffix."""
