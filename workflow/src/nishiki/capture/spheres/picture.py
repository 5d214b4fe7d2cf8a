"""A photograph with the mirror spheres, their highlights and the circles that were none drawn into it."""

from __future__ import annotations

import numpy as np

from nishiki.capture.spheres.findings import Findings
from nishiki.capture.spheres.optics import SphereCamera, outline_points

WIDEST = 1200
GREEN, RED, GREY = (90, 220, 90), (255, 90, 40), (150, 150, 150)


def draw_findings(findings: Findings) -> np.ndarray:
    """Draw the brightest of all photographs (rows, columns, 3) uint8, reduced.

    Green: outlines of spheres, with their numbers; red: highlights; grey: examined circles that are none.
    """
    import cv2

    scale = min(1.0, WIDEST / max(findings.brightest.shape))
    codes = cv2.resize(display_codes(findings.brightest), None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    factor = scale / findings.factor

    def place(points: np.ndarray) -> np.ndarray:
        return np.round(((points + 0.5) * factor - 0.5) * 16).astype(np.int32)

    for circle, _ in findings.rejected:
        rim = outline_points(np.array(circle[:3]), SphereCamera.of(*findings.brightest.shape))
        cv2.polylines(codes, [place(rim).reshape(-1, 1, 2)], True, GREY, 1, cv2.LINE_AA, 4)
    for k, outline in enumerate(findings.outlines):
        rim = outline_points(outline.parameters, findings.camera)
        cv2.polylines(codes, [place(rim).reshape(-1, 1, 2)], True, GREEN, 1, cv2.LINE_AA, 4)
        corner = tuple(int(v) for v in place(rim.max(axis=0)) // 16)
        cv2.putText(codes, str(k + 1), corner, cv2.FONT_HERSHEY_SIMPLEX, 0.5, GREEN, 1, cv2.LINE_AA)
    for highlight in findings.highlights.values():
        if highlight is not None:
            cv2.drawMarker(codes, tuple(int(v) for v in place(highlight.pixel) // 16), RED, cv2.MARKER_CROSS, 5, 1)
    return codes


def draw_sphere(findings: Findings, sphere: int, side: int = 480) -> np.ndarray:
    """Draw the brightest of all photographs around one sphere, with its outline and highlights: (.., .., 3) uint8."""
    import cv2

    brightest, corner = findings.crops[sphere]
    zoom = max(1, int(np.ceil(side / max(brightest.shape))))
    codes = cv2.resize(display_codes(brightest), None, fx=zoom, fy=zoom, interpolation=cv2.INTER_NEAREST)

    def place(points: np.ndarray) -> np.ndarray:
        return np.round(((np.atleast_2d(points) - corner + 0.5) * zoom - 0.5) * 16).astype(np.int32)

    curve = place(outline_points(findings.outlines[sphere].parameters, findings.camera))
    cv2.polylines(codes, [curve.reshape(-1, 1, 2)], True, GREEN, 1, cv2.LINE_AA, 4)
    for (_, k), highlight in findings.highlights.items():
        if k == sphere and highlight is not None:
            column, row = place(highlight.pixel)[0]
            cv2.drawMarker(codes, (int(column / 16), int(row / 16)), RED, cv2.MARKER_CROSS, 9, 1)
    return codes


def display_codes(light: np.ndarray) -> np.ndarray:
    """Convert light to grey codes (rows, columns, 3) uint8, brightened by a square root."""
    top = float(np.percentile(light, 99.8)) or 1.0
    return np.repeat((255 * np.sqrt(np.clip(light / top, 0, 1))).astype(np.uint8)[..., None], 3, axis=2)
