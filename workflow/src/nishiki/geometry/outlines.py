"""What a mesh looks like in a view: its outline, against a silhouette, and its shape, shaded."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from nishiki.geometry.camera import Camera
from nishiki.geometry.mesh import Mesh, face_vectors
from nishiki.geometry.raster import rasterise

UNSURE_PX = 2.0
CONTRADICTED = 2e-3


def outline_of(mesh: Mesh, camera: Camera) -> np.ndarray:
    """(rows, columns) bool: pixel centres that the mesh covers."""
    return rasterise(mesh, camera).triangle >= 0


def agreement(first: np.ndarray, second: np.ndarray) -> float:
    """Intersection over union of two masks; 1 where both are empty."""
    union = int((first | second).sum())
    return int((first & second).sum()) / union if union else 1.0


def shaded(mesh: Mesh, camera: Camera) -> np.ndarray:
    """(rows, columns) uint8: the mesh lit from the camera, triangles flat; dark grey where there is none."""
    seen = rasterise(mesh, camera).triangle
    faces = face_vectors(mesh.vertices, mesh.triangles)
    faces /= np.maximum(np.linalg.norm(faces, axis=1, keepdims=True), 1e-300)
    middle = mesh.vertices[mesh.triangles].mean(axis=1)
    ray = camera.centre - middle
    ray /= np.maximum(np.linalg.norm(ray, axis=1, keepdims=True), 1e-300)
    light = np.clip(np.einsum("ij,ij->i", faces, ray), 0, 1)
    return np.where(seen >= 0, 30 + 225 * np.sqrt(light[seen]), 20).astype(np.uint8)


@dataclass(frozen=True)
class Known:
    """What the other views say of one view. inside, outside (rows, columns) bool: pixels on the object, off it; beyond:
    pixels of its mask that lie outside, lost: pixels inside that its mask lacks, of the mask's pixels."""

    inside: np.ndarray
    outside: np.ndarray
    beyond: float
    lost: float


def known_from(loose: Mesh, camera: Camera, mask: np.ndarray, cell: float) -> Known:
    """What a hull that forgives single views says of one view and its mask (rows, columns) bool.

    loose: hull carved with one miss allowed at least, which holds the object whatever one mask says. Both bounds leave
    room for its grid (cell, world's unit) and for the outline itself.
    """
    import cv2

    covered = outline_of(loose, camera)
    depth = float(np.median(camera.project(loose.vertices)[1]))
    cell_px = cell * float(np.sqrt(abs(np.linalg.det(camera.intrinsics)))) / max(depth, 1e-300)
    reach = int(np.ceil(UNSURE_PX + 2 * cell_px))
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1, 2 * reach + 1))
    outside = cv2.dilate(covered.astype(np.uint8), kernel) == 0
    inside = cv2.erode(covered.astype(np.uint8), kernel) > 0
    size = max(1, int(mask.sum()))
    return Known(inside, outside, int((mask & outside).sum()) / size, int((~mask & inside).sum()) / size)


def contradicted(known: list[Known]) -> list[bool]:
    """Which masks the other views contradict: more than 2 in 1000 of its pixels are confirmed by no other view, or it
    lacks that much and four times the median of all views more.

    Between few views the forgiving hull is thicker than the object in every one of them: only the odd one is wrong.
    """
    usual = float(np.median([each.lost for each in known])) if known else 0.0
    return [each.beyond > CONTRADICTED or each.lost > CONTRADICTED + 4 * usual for each in known]
