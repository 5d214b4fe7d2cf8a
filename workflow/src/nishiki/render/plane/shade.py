"""Shade a plane scene under lamps: maps in, pictures in linear XYZ or in the channels of a camera out.

The prediction is in the camera's own channels and relative to the white board, as ingest delivers observations:
I' = albedo c f + beta D F G / cos_r with c = max(n . l, 0) and the factor f of the body shading (1: Lambert), so that
no spectrum and no colour matrix stands between it and a photograph.

Tominaga and Tanaka (2004, section 6) work with normals only, and so without these.  Two ways to the same horizon:

sweep  lamps at infinity: parallel lines run across the map towards the lamp, one pixel apart; from the lamp's side each
       line keeps the upper convex hull of the heights it has passed, and the tangent from a point to that hull is the
       horizon of the point.  Constant work a pixel, however low the lamp.  A pixel between two lines takes the mean of
       theirs, weighted by nearness.
march  any lamp: each pixel walks its own ray, column by column (or row by row), until nothing on the map could rise
       above the horizon found so far.  Exact for heights interpolated along the grid lines; the work grows as
       1 / tan(elevation).

Heights that are not finite (outside the mask, no estimate) cast no shadow and receive none.  Pieces of the relief that
no chain of neighbouring heights connects cast none on each other: normals do not tell their relative level.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from nishiki.brdf.torrance_sparrow import MIRROR, transmittance
from nishiki.colour.colour import adaptation_matrix, illuminant, srgb_matrix, white_xyz, xyz_matrix
from nishiki.errors import UserError
from nishiki.render.plane import kernel
from nishiki.render.plane.scene import Ambient, Gloss, Light, PlaneScene
from nishiki.threads import over_rows


def cast_shadows(height: np.ndarray, lights: list[Light], *, pitch: float, march: bool = False) -> np.ndarray:
    """Return what each pixel sees of each lamp, 0 to 1, (lights, rows, columns) float32.

    height: (rows, columns), in the unit of `pitch`; march: lamps at infinity too, which is exact and slow. A lamp of
    angular radius 0 gives hard edges; otherwise it is a uniform disc that a straight horizon cuts. Facets that face
    away (n . l <= 0) are the shading's affair.
    """
    known = np.isfinite(height)
    surface = np.ascontiguousarray(height, np.float32)
    pieces, count = np.zeros((0, 0), np.int32), 1  # all is one piece
    if not known.all():
        from scipy import ndimage

        surface = np.where(known, surface, np.float32(np.nan))
        # connected pieces, by the neighbours that the integration joins; 0 where unknown
        numbers, found = ndimage.label(known)
        if found > 1:
            pieces, count = np.ascontiguousarray(numbers, np.int32), found + 1
    visibility = np.empty((len(lights), *height.shape), np.float32)
    for j, light in enumerate(lights):
        if march or light.position_mm is not None:
            _march_light(surface, pieces, light, pitch, visibility[j])
        else:
            visibility[j] = _sweep_light(surface, pieces, count, light, pitch)
        visibility[j][~known] = 1
    return visibility


def _sweep_light(surface, pieces, count: int, light: Light, pitch: float) -> np.ndarray:
    """Compute the visibility (rows, columns) of a lamp at infinity; the same lines from either side."""
    x, y, z = light.central_direction()
    elevation = float(np.arctan2(z, np.hypot(x, y)))
    azimuth = np.arctan2(y, x)
    toward_column, toward_row = np.cos(azimuth), -np.sin(azimuth)
    # bring the lamp to the side of growing columns, within 45 degrees
    swap = abs(toward_row) > abs(toward_column)
    along, across = (toward_row, toward_column) if swap else (toward_column, toward_row)
    flip = along < 0

    def turn(values):
        values = values.T if swap else values
        return np.ascontiguousarray(values[:, ::-1] if flip else values)

    surface, pieces = turn(surface), turn(pieces)
    # a multiple of 2^-20: lines along the grid and its diagonals then meet the pixels exactly, and the direction moves
    # by less than 1e-6
    slope = float(np.round(across / abs(along) * 2**20) / 2**20)
    rows, columns = surface.shape
    drift = slope * (columns - 1)
    first, last = int(np.floor(min(0.0, -drift))) - 1, int(np.ceil(rows - 1 + max(0.0, -drift))) + 1
    phase = (-slope * (columns - 1)) % 1.0 if flip else 0.0
    step = pitch * np.hypot(1.0, slope)
    # Horizons below the floor cannot matter: half the tangent of the lamp's lower edge, as the sweep averages two
    # lines. Not the edge itself: a line that is lit would then weigh too little against one in shadow.
    lower = elevation - light.angular_radius
    floor = 0.5 * float(np.tan(lower)) if lower > 0 else -1e30
    out = np.ones(surface.shape, np.float32)

    def lines(begin, end):
        begin, end = first + begin, first + end
        lamp = elevation, light.angular_radius, floor
        kernel.sweep(begin, end, (phase, slope, step), surface, pieces, count, lamp, out)

    over_rows(lines, last - first + 1)
    out = out[:, ::-1] if flip else out
    return out.T if swap else out


def _march_light(surface, pieces, light, pitch, out) -> None:
    source = light.homogeneous()
    rows, columns = surface.shape
    scaled = source[:3] / (pitch if source[3] else 1.0)
    # to pixels: columns to the right, rows downwards, heights in pixels too
    column, row = scaled[0], -scaled[1]
    if source[3]:
        column, row = column + (columns - 1) / 2, row + (rows - 1) / 2
    highest = float(np.nanmax(surface)) / pitch if np.any(np.isfinite(surface)) else 0.0
    lamp = column, row, scaled[2], source[3], light.angular_radius
    over_rows(kernel.march, len(surface), surface, pieces, pitch, lamp, highest, out)


FRONTAL_EYE = np.array([0.0, 0.0, 1.0, 0.0])


@dataclass(frozen=True)
class ColourGroups:
    """Lights that share a spectrum share a row: value = matrix . sigma irradiance + white . gloss."""

    matrices: np.ndarray  # (G, channels, K)
    whites: np.ndarray  # (G, channels), of a perfect white
    of_light: np.ndarray  # (L,) row of each light
    ambient: int  # row of the ambient light


@dataclass(frozen=True)
class PixelShading:
    """Values of the pixels before compositing with a background."""

    # (rows, columns, channels) float32, linear; a perfect white that faces a lamp of intensity 1 has the value 1
    values: np.ndarray
    flags: np.ndarray  # (rows, columns) uint8, bits of nishiki.render.plane.kernel


def colour_groups(scene: PlaneScene, lights: list[Light], ambient: Ambient) -> ColourGroups:
    """Compute 3 x K matrices, to XYZ, of the distinct spectra of lights and ambient (Tominaga and Tanaka 2004, eq. 19).

    Without a spectral basis, linear sRGB goes to XYZ (white point D65), then by Bradford's adaptation to the white of
    the lamp, a stand-in for spectra that are not known: an adapted eye sees no change.
    """
    spectra, rows = [], []
    for spectrum in [ambient.spectrum, *[light.spectrum for light in lights]]:
        shape = spectrum / spectrum.max()
        known = next((i for i, other in enumerate(spectra) if np.array_equal(shape, other)), None)
        rows.append(len(spectra) if known is None else known)
        if known is None:
            spectra.append(shape)
    whites = np.array([white_xyz(s) for s in spectra])
    if scene.basis is not None:
        matrices = np.array([xyz_matrix(s, scene.basis) for s in spectra])
    else:
        to_xyz, d65 = np.linalg.inv(srgb_matrix()), white_xyz(illuminant("D65"))
        matrices = np.array([adaptation_matrix(d65, white) @ to_xyz for white in whites])
    return ColourGroups(matrices, whites, np.array(rows[1:], dtype=np.int64), rows[0])


def shade_xyz(
    scene: PlaneScene,
    lights: list[Light],
    *,
    ambient: Ambient | None = None,
    visibility: np.ndarray | None = None,
    eye: np.ndarray = FRONTAL_EYE,
) -> PixelShading:
    """Shade the maps: linear XYZ (rows, columns, 3), Tominaga and Tanaka (2004), eq. 10, 19; 0 where n . l <= 0.

    visibility: (lights, rows, columns) float32, 1 lit .. 0 in cast shadow, or None; eye: homogeneous (4,), direction
    and 0 or position and 1.
    """
    ambient = Ambient() if ambient is None else ambient
    maps = PlaneMaps(scene.normals, scene.coefficients, scene.gloss, scene.shading, scene.slopes, scene.labels)
    return shade_channels(
        maps,
        lights,
        groups=colour_groups(scene, lights, ambient),
        visibility=visibility,
        plane=pixel_to_plane(scene.pitch, scene.shape),
        eye=eye,
        ambient_level=ambient.level,
    )


class PlaneMaps(NamedTuple):
    """Maps of a flat object in any channels, each as in `PlaneScene`."""

    normals: np.ndarray
    coefficients: np.ndarray  # (rows, columns, channels) float32, relative to white
    gloss: Gloss = Gloss.none()
    shading: np.ndarray | None = None
    slopes: np.ndarray | None = None
    labels: np.ndarray | None = None

    @property
    def mirrors(self) -> np.ndarray:
        """(rows, columns) bool, or (): pixels of a metal."""
        return (self.gloss.refractive_index >= MIRROR)[0 if self.labels is None else self.labels]


def shade_channels(
    maps: PlaneMaps,
    lights: list[Light],
    *,
    groups: ColourGroups,
    visibility: np.ndarray | None,
    plane: np.ndarray,
    eye: np.ndarray = FRONTAL_EYE,
    ambient_level: float = 0.0,
) -> PixelShading:
    """Shade any output channels: `groups` converts coefficients to values."""
    normals, coefficients, gloss, shading, slopes, labels = maps
    if not lights and ambient_level == 0:
        raise UserError("lights: expected at least one light or an ambient level above 0, found neither; add a light")
    lamps = np.array([_lamp(light) for light in lights]).reshape(-1, 6)
    visible = np.zeros((0, 0, 0), np.float32) if visibility is None else np.ascontiguousarray(visibility, np.float32)
    values = np.empty((*normals.shape[:2], groups.matrices.shape[1]), np.float32)
    flags = np.empty(normals.shape[:2], np.uint8)
    # beta and 1 / gamma^2 of each region's lobes (regions, 2 lobes); lobes that are 0 are dropped
    used = gloss.beta.max(axis=0) > 0 if gloss.refractive_index.max() > 1 else np.zeros(gloss.beta.shape[1], bool)
    lobes = np.stack([gloss.beta[:, used], gloss.gamma[:, used] ** -2.0], axis=-1)
    table = np.ascontiguousarray(lobes.reshape(len(gloss.beta), -1))
    arrays = (
        np.ascontiguousarray(normals, np.float32),
        np.ascontiguousarray(coefficients, np.float32),
        np.zeros((0, 0, 0), np.float32) if shading is None else np.ascontiguousarray(shading, np.float32),
        np.zeros((0, 0, 0), np.float32) if slopes is None else np.ascontiguousarray(slopes, np.float32),
        np.zeros((1, 1), np.uint8) if labels is None else np.ascontiguousarray(labels),
    )
    let_in = entering(gloss) if ambient_level else np.ones(len(gloss.refractive_index))
    over_rows(
        kernel.shade,
        len(values),
        arrays,
        (table, gloss.refractive_index, gloss.transmission, let_in),
        (lamps, groups.of_light, visible),
        (groups.matrices, groups.whites),
        (np.ascontiguousarray(plane, np.float64), np.asarray(eye, np.float64), float(ambient_level), groups.ambient),
        (values, flags),
    )
    return PixelShading(values, flags)


def pixel_to_plane(pitch: float, shape: tuple[int, int]) -> np.ndarray:
    """Return the 3 x 3 map of (column, row, 1) of maps (rows, columns) to (x, y, 1) on the painting; centre 0, y up."""
    left, top = -(shape[1] - 1) / 2, (shape[0] - 1) / 2
    return np.array([[pitch, 0, pitch * left], [0, -pitch, pitch * top], [0, 0, 1]], dtype=np.float64)


def _lamp(light: Light) -> np.ndarray:
    """Return (6,): homogeneous vector to the lamp, intensity, squared distance at which it holds (0: no fall-off)."""
    vector = light.homogeneous()
    reference2 = float(vector[:3] @ vector[:3]) if light.falloff else 0.0
    return np.concatenate([vector, [light.intensity, reference2]])


def entering(gloss: Gloss) -> np.ndarray:
    """Compute (regions,) transmission of light from all sides, relative to frontal: 2 int T(c) c dc."""
    nodes, weights = np.polynomial.legendre.leggauss(48)
    cosine = (nodes + 1) / 2
    mean = [weights @ (cosine * transmittance(cosine, index)) for index in gloss.refractive_index]
    return 1 - gloss.transmission * (1 - np.array(mean))


def predict_observations(
    maps: PlaneMaps, lights: list[Light], *, visibility: np.ndarray | None = None, pitch: float = 1.0
) -> Iterator[PixelShading]:
    """Yield one predicted photograph a light, in order, so that a stack of them need not be held in memory.

    The coefficients of the maps are the albedo, perfect white 1; pitch as in `PlaneScene`; visibility: (lights, rows,
    columns) float32 of `cast_shadows`. The spectra of the lights are not used; a white board at the same place has
    divided out intensity and fall-off, which should therefore stay 1 and False.
    """
    channels = maps.coefficients.shape[2]
    groups = ColourGroups(np.eye(channels)[None], np.ones((1, channels)), np.zeros(1, np.int64), 0)
    plane = pixel_to_plane(pitch, maps.normals.shape[:2])
    for j, light in enumerate(lights):
        lit = None if visibility is None else visibility[j : j + 1]
        yield shade_channels(maps, [light], groups=groups, visibility=lit, plane=plane)
