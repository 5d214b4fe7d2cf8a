"""A painted relief cut into overlapping fields, as maps: turned, scaled, distorted, with noise; and the truth."""

from dataclasses import dataclass

import cv2
import numpy as np
from benchmarks.cut_mosaic import picture_places, place_fields
from brush_relief import noise

from nishiki.mosaic.registration import Field, signals


@dataclass(frozen=True)
class CutMosaic:
    """truth : of each field, see `place_fields`; maps : of each field by name; fields : for registration."""

    truth: list[dict]
    maps: list[dict[str, np.ndarray]]
    fields: list[Field]

    def readers(self) -> list:
        return [lambda name, rows, maps=maps: maps[name][rows] for maps in self.maps]

    def true_places(self, i: int, points: np.ndarray) -> np.ndarray:
        return picture_places(self.truth[i], points)


def painted_relief(rows: int, columns: int, seed: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """Reflectance and normals, (rows, columns, 3) each, with detail at several sizes."""
    rng = np.random.default_rng(seed)
    layers = [noise(rng, (rows, columns), length) for length in (1.3, 2.5, 6, 20)]
    colour = np.stack([layers[0] + layers[1] + 2 * layers[3], layers[1] + layers[2] + layers[3], 2 * layers[2]], -1)
    reflectance = 0.35 * np.exp(0.25 * colour)
    height = 0.12 * noise(rng, (rows, columns), 1.6) + 0.5 * noise(rng, (rows, columns), 5)
    down, right = np.gradient(height)
    normals = np.stack([-right, down, np.ones_like(height)], -1)
    return reflectance, normals / np.linalg.norm(normals, axis=-1, keepdims=True)


def cut_relief(
    reflectance: np.ndarray,
    normals: np.ndarray,
    *,
    grid: tuple[int, int] = (2, 2),
    overlap: float = 0.3,
    seed: int = 1,
    stated: bool = True,
    error: float = 0.01,
) -> CutMosaic:
    """Cut maps into fields; error : standard deviation of noise, relative and of the normals' components."""
    rng = np.random.default_rng(seed)
    truth = place_fields(reflectance.shape[:2], grid, overlap, seed)
    maps, fields = [], []
    for field in truth:
        places = picture_places(field, np.stack(np.meshgrid(*map(np.arange, field["shape"][::-1])), -1).astype(float))
        colour, vector = (
            cv2.remap(values.astype(np.float32), places.astype(np.float32), None, cv2.INTER_LANCZOS4)
            for values in (reflectance, normals)
        )
        cosine, sine = np.cos(field["turn"]), np.sin(field["turn"])
        x, y = vector[..., 0].copy(), vector[..., 1].copy()
        vector[..., 0], vector[..., 1] = cosine * x - sine * y, sine * x + cosine * y
        colour *= 1 + error * rng.standard_normal(colour.shape)
        vector += error * rng.standard_normal(vector.shape)
        vector /= np.linalg.norm(vector, axis=-1, keepdims=True)
        size = tuple(field["shape"])
        maps.append(
            {
                "reflectance": colour.astype(np.float32),
                "normals": vector.astype(np.float32),
                "sigma": np.full(size, 2 * error + 1e-3, np.float32),
                "flags": np.zeros(size, np.uint8),
            }
        )
        fields.append(as_field(field, maps[-1], stated))
    return CutMosaic(truth, maps, fields)


def as_field(truth: dict, maps: dict[str, np.ndarray], stated: bool) -> Field:
    """A field as registration reads it."""
    seen, known = signals(maps["reflectance"], maps["normals"]), maps["flags"] == 0
    rows, columns = truth["shape"]
    return Field(
        truth["name"],
        (rows, columns),
        lambda y, x: (seen[y, x], known[y, x]),
        np.array([(columns - 1) / 2, (rows - 1) / 2]),
        np.array(truth["stated"]) if stated else None,
    )
