"""A view of the object as light: rays through every pixel, the lamp's shadow, gloss, body and bounced light."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numba
import numpy as np

from nishiki.simulate.randomness import hash_uint, subkey, uniform
from nishiki.simulate.rows import over_rows
from nishiki.simulate.turntable.interreflection import OFFSET_MM, Surroundings, bounced, look_around, mirrored
from nishiki.simulate.turntable.materials import NUMBERS, describe
from nishiki.simulate.turntable.optics import INDEX, metal_fresnel, reflect
from nishiki.simulate.turntable.rays import STACK, Tree, make_tree, nearest
from nishiki.simulate.turntable.settings import LAMP_RADIUS_MM, TurntableSettings
from nishiki.simulate.turntable.surface import Surface, make_surface
from nishiki.simulate.turntable.viewpoints import AIM_MM, Viewpoint

_LAMP_POINTS = 8  # lamp points a vertex, for the light that bounces


@dataclass(frozen=True)
class Scene:
    """The object, ready to be seen: its triangles, the tree over them, what every vertex sees, the key of its paint."""

    surface: Surface
    tree: Tree
    around: Surroundings
    key: int


@dataclass(frozen=True)
class Light:
    """What comes from the object to the camera, relative to a perfect white at the axis that faces the lamp.

    diffuse : (rows, columns, 3) float32, light that has lost its polarisation (body, bounced light, the object's mirror
    image in itself). specular : likewise, the lamp's mirror reflection. coverage : (rows, columns) float32, share of
    the pixel that the object fills. depth : mm along the optical axis; normals : (rows, columns, 3), unit, of the
    smooth surface in the object's frame; albedo : (rows, columns, 3); part : uint8 (255 = none), all float32 and means
    over the samples that meet the object (part: the first), 0 where none does.
    """

    diffuse: np.ndarray
    specular: np.ndarray
    coverage: np.ndarray
    depth: np.ndarray
    normals: np.ndarray
    albedo: np.ndarray
    part: np.ndarray


def make_scene(settings: TurntableSettings) -> Scene:
    """The object that the settings describe; the same for any number of threads."""
    surface = make_surface(settings.triangles)
    tree = make_tree(surface.vertices, surface.triangles)
    around = look_around(surface, tree, directions=settings.directions, seed=settings.seed)
    return Scene(surface, tree, around, subkey(settings.seed, "turntable paint"))


@numba.njit(cache=True)
def lamp_point(lamp, x, y, z, radius, a, b):
    """Direction and distance from (x, y, z) to a point of the lamp's disc, which faces the object; a, b in [0, 1)."""
    dx, dy, dz = lamp[0] - x, lamp[1] - y, lamp[2] - z
    length = math.sqrt(dx * dx + dy * dy + dz * dz)
    # Two directions across the light: any pair will do, for the disc is round.
    ux, uy, uz = dz / length, 0.0, -dx / length
    flat = math.sqrt(ux * ux + uz * uz)
    ux, uz = ux / flat, uz / flat
    wx, wy, wz = (dy * uz - dz * uy) / length, (dz * ux - dx * uz) / length, (dx * uy - dy * ux) / length
    r, turn = radius * math.sqrt(a), 6.283185307179586 * b
    p, q = r * math.cos(turn), r * math.sin(turn)
    dx, dy, dz = dx + p * ux + q * wx, dy + p * uy + q * wy, dz + p * uz + q * wz
    length = math.sqrt(dx * dx + dy * dy + dz * dz)
    return dx / length, dy / length, dz / length, length


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _irradiate(start, stop, vertices, normals, boxes, links, triangles, lamp, radius, reference, points, offset, out):
    """Irradiance of every vertex by the lamp, shadows included; 1 for a surface at the axis that faces the lamp."""
    stack = np.empty(STACK, np.int32)
    for p in range(start, stop):
        n, total = normals[p], 0.0
        x, y, z = vertices[p, 0] + offset * n[0], vertices[p, 1] + offset * n[1], vertices[p, 2] + offset * n[2]
        for k in range(points):
            turn = (k * 0.6180339887498949) % 1.0
            lx, ly, lz, length = lamp_point(lamp, x, y, z, radius, (k + 0.5) / points, turn)
            cosine = n[0] * lx + n[1] * ly + n[2] * lz
            if cosine <= 0.0:
                continue
            if nearest(boxes, links, triangles, stack, x, y, z, lx, ly, lz, length, True)[1] < 0:
                total += cosine * reference / (length * length)
        out[p] = total / points


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _see(
    start, stop, columns, samples, vertices, normals, parts, faces, boxes, links, triangles, order, rotation, centre,
    lens, lamp, radius, reference, offset, indirect, mirror, key, diffuse, specular, coverage, depth, geometry, albedo,
    part,
):  # fmt: skip
    stack = np.empty(STACK, np.int32)
    m, slope, mixed = np.empty(NUMBERS), np.empty(2), np.empty(parts.shape[1])
    body, gloss, n, bounce, image = np.empty(3), np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    share = 1.0 / (samples * samples)
    for row in range(start, stop):
        for column in range(columns):
            bits = hash_uint(np.uint64(key), np.uint64(row * columns + column))
            first = True
            for sample in range(samples * samples):
                a, b = uniform(bits, np.uint64(4 * sample)), uniform(bits, np.uint64(4 * sample + 1))
                u = (column - 0.5 + (sample % samples + a) / samples - lens[1]) / lens[0]
                v = (row - 0.5 + (sample // samples + b) / samples - lens[2]) / lens[0]
                length = math.sqrt(1.0 + u * u + v * v)
                dx = (rotation[0, 0] * u + rotation[1, 0] * v + rotation[2, 0]) / length
                dy = (rotation[0, 1] * u + rotation[1, 1] * v + rotation[2, 1]) / length
                dz = (rotation[0, 2] * u + rotation[1, 2] * v + rotation[2, 2]) / length
                t, hit, w1, w2 = nearest(
                    boxes, links, triangles, stack, centre[0], centre[1], centre[2], dx, dy, dz, 1e9, False
                )
                if hit < 0:
                    continue
                i, j, k = faces[order[hit], 0], faces[order[hit], 1], faces[order[hit], 2]
                w0 = 1.0 - w1 - w2
                for q in range(3):
                    n[q] = w0 * normals[i, q] + w1 * normals[j, q] + w2 * normals[k, q]
                    bounce[q] = w0 * indirect[i, q] + w1 * indirect[j, q] + w2 * indirect[k, q]
                    image[q] = w0 * mirror[i, q] + w1 * mirror[j, q] + w2 * mirror[k, q]
                for q in range(mixed.size):
                    mixed[q] = w0 * parts[i, q] + w1 * parts[j, q] + w2 * parts[k, q]
                size = math.sqrt(n[0] * n[0] + n[1] * n[1] + n[2] * n[2])
                n[0], n[1], n[2] = n[0] / size, n[1] / size, n[2] / size
                x, y, z = centre[0] + t * dx, centre[1] + t * dy, centre[2] + t * dz
                describe(mixed, x, y, z, n[0], n[1], n[2], key, m, slope)
                # The lamp's share of this sample: one point of its disc, the disc being covered by the pixel's samples.
                turn = (uniform(bits, np.uint64(2)) + sample * 0.6180339887498949) % 1.0
                ring = (sample + uniform(bits, np.uint64(4 * sample + 3))) * share
                x0, y0, z0 = x + offset * n[0], y + offset * n[1], z + offset * n[2]
                lx, ly, lz, away = lamp_point(lamp, x0, y0, z0, radius, ring, turn)
                strength = reference / (away * away)
                facing = n[0] * lx + n[1] * ly + n[2] * lz
                body[0] = body[1] = body[2] = gloss[0] = gloss[1] = gloss[2] = 0.0
                if facing > 0.0:
                    shadow = nearest(boxes, links, triangles, stack, x0, y0, z0, lx, ly, lz, away, True)[1]
                    if shadow < 0:
                        reflect(m, lx, ly, lz, -dx, -dy, -dz, body, gloss)
                cosine = max(-(m[9] * dx + m[10] * dy + m[11] * dz), 0.0)
                # Schlick for the surroundings' image too: its rays come from many sides, the exact curve gains nothing.
                glass = metal_fresnel(cosine, ((INDEX - 1.0) / (INDEX + 1.0)) ** 2)
                for q in range(3):
                    shine = metal_fresnel(cosine, m[3 + q]) if m[3] > 0.0 else glass
                    light = body[q] * strength + m[q] * bounce[q] * (1.0 - glass) + shine * image[q]
                    diffuse[row, column, q] += np.float32(share * light)
                    specular[row, column, q] += np.float32(share * strength * gloss[q])
                    albedo[row, column, q] += np.float32(m[q])
                    geometry[row, column, q] += np.float32(n[q])
                depth[row, column] += np.float32(t / length)
                coverage[row, column] += np.float32(1.0)
                if first:
                    first = False
                    nearest_part = 0
                    for q in range(1, mixed.size):
                        if mixed[q] < mixed[nearest_part]:
                            nearest_part = q
                    part[row, column] = nearest_part
            if coverage[row, column] > 0.0:
                met = coverage[row, column]
                depth[row, column] /= met
                length = math.sqrt(
                    geometry[row, column, 0] ** 2 + geometry[row, column, 1] ** 2 + geometry[row, column, 2] ** 2
                )
                for q in range(3):
                    albedo[row, column, q] /= met
                    geometry[row, column, q] /= np.float32(max(length, 1e-12))
                coverage[row, column] = met * share


def see(scene: Scene, view: Viewpoint, settings: TurntableSettings) -> Light:
    """The light of one view; pixels are means over their area, without blur and noise."""
    surface, tree = scene.surface, scene.tree
    reference = float(np.sum((view.lamp - AIM_MM) ** 2))
    direct = np.empty(len(surface.vertices))
    over_rows(
        _irradiate, len(direct), surface.vertices, surface.normals, tree.boxes, tree.links, tree.triangles,
        view.lamp, LAMP_RADIUS_MM, reference, _LAMP_POINTS, OFFSET_MM, direct,
    )  # fmt: skip
    indirect, radiosity = bounced(scene.around, direct, settings.bounces)
    mirror = np.zeros_like(indirect)
    if settings.bounces:
        mirror = mirrored(surface, scene.around, radiosity, view.centre)
    shape = (settings.rows, settings.columns)
    light = Light(
        *(np.zeros((*shape, 3), np.float32) for _ in range(2)),
        *(np.zeros(shape, np.float32) for _ in range(2)),
        *(np.zeros((*shape, 3), np.float32) for _ in range(2)),
        np.full(shape, 255, np.uint8),
    )
    lens = np.array([view.focal, *view.principal])
    over_rows(
        _see, settings.rows, settings.columns, settings.samples, surface.vertices, surface.normals, surface.parts,
        surface.triangles, tree.boxes, tree.links, tree.triangles, tree.order, view.rotation, view.centre, lens,
        view.lamp, LAMP_RADIUS_MM, reference, OFFSET_MM, indirect, mirror, np.uint64(scene.key), light.diffuse,
        light.specular, light.coverage, light.depth, light.normals, light.albedo, light.part,
    )  # fmt: skip
    return light
