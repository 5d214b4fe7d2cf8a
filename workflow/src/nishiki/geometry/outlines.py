"""What a mesh looks like in a view: its outline, against a silhouette, and its shape, shaded."""

from __future__ import annotations

import numpy as np

from nishiki.geometry.camera import Camera
from nishiki.geometry.mesh import Mesh, face_vectors
from nishiki.patches.raster import rasterise

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


def known_from(loose: Mesh, camera: Camera, mask: np.ndarray, cell: float) -> tuple[np.ndarray, np.ndarray, bool]:
    """What a hull that forgives single views says of one view: pixels inside, pixels outside, and whether the view's
    mask contradicts it in more than 2 in 1000 of its pixels.

    loose: hull carved with one miss allowed, which holds the object whatever one mask says. Both bounds leave room for
    its grid (cell, world's unit) and for outlines that only this view sees.
    """
    import cv2

    covered = outline_of(loose, camera)
    depth = float(np.median(camera.project(loose.vertices)[1]))
    cell_px = cell * float(np.sqrt(abs(np.linalg.det(camera.intrinsics)))) / max(depth, 1e-300)
    reach = int(np.ceil(UNSURE_PX + 2 * cell_px))
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1, 2 * reach + 1))
    outside = cv2.dilate(covered.astype(np.uint8), kernel) == 0
    inside = cv2.erode(covered.astype(np.uint8), kernel) > 0
    wrong = int((mask & outside).sum()) + int((~mask & inside).sum())
    return inside, outside, wrong > CONTRADICTED * mask.sum()
