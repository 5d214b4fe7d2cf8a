"""Planes of relightable images by relight's method (relight-cli of 2026), written anew in NumPy, for comparisons.

Input are photographs as 8-bit codes, which relight takes as they are: it knows neither masks nor saturated samples.

    ptm, hsh      least squares over all lights, no ridge: coefficients = pinv(A) codes
    rbf           principal components of the samples of all lights, red, green and blue together (mrgb), or brightness,
                  R - B and G - (R + B) / 2 each apart (mycc)
    bilinear      the same of values at the nodes of a grid over the hemisphere: node values x are those of normalised
                  Gaussians between the lights, x0 = B c, corrected until bilinear interpolation A gives the codes c
                  back: x = x0 + (A'A + r I)^-1 A' (c - A x0)

A plane's bias is its smallest value; its scale is the mean of its own range and the largest range of all planes, so
that planes of little weight get few codes and few bytes. Codes of planes and components are cut to integers, not
rounded. F. Ponchio, M. Corsini and R. Scopigno (2018), A compact representation of relightable images for the web,
Web3D.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from nishiki.formats.relight import FROM_YCOCG, bilinear_weights, gaussian_weights, grid_directions, terms_of

SIGMA, SIDE, REGULARISATION = 0.125, 8, 0.1  # defaults of relight-cli: Gaussians, nodes along a side, r above
OWN_RANGE = 0.5  # share of a plane's own range in its scale; the rest is that of the largest
LEAST_NODE_WEIGHT = 0.005  # of a light at a node, below which it is left out
SAMPLES_IN_A_ROW = 4  # one pixel of so many, by chance


@dataclass(frozen=True)
class Planes:
    """Coefficients of pixels and how a viewer shows them.

    coefficients : (n, planes), for values 0 to 1; scale, bias : (planes,); mean (nodes, 3) and components
    (planes, nodes, 3) as viewers read them, colours red, green, blue; weights : of the nodes, for one light.
    """

    kind: str
    colour_space: str
    coefficients: np.ndarray
    scale: np.ndarray
    bias: np.ndarray
    mean: np.ndarray
    components: np.ndarray
    weights: Callable[[np.ndarray], np.ndarray]

    def codes(self) -> np.ndarray:
        """(n, planes) uint8."""
        return np.clip(255 * (self.coefficients / self.scale + self.bias), 0, 255).astype(np.uint8)

    def decoded(self, codes: np.ndarray) -> np.ndarray:
        """Coefficients of codes."""
        return (codes / 255 - self.bias) * self.scale

    def transfer(self, light: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """o (3,) and T (planes, 3) for a unit vector towards the light: values = o + coefficients @ T."""
        weights = self.weights(light)
        return weights @ self.mean, np.einsum("l,plk->pk", weights, self.components)

    def shown_with(self, weights: Callable[[np.ndarray], np.ndarray]) -> Planes:
        """The same planes, with other weights of the nodes."""
        return replace(self, weights=weights)


def sampled(codes: np.ndarray, shape: tuple[int, int], seed: int = 0) -> np.ndarray:
    """A quarter of the pixels of every row, by chance. codes : (rows x columns, lights, 3)."""
    rows, columns = shape
    random = np.random.default_rng(seed)
    chosen = [random.choice(columns, columns // SAMPLES_IN_A_ROW, replace=False) + row * columns for row in range(rows)]
    return codes[np.concatenate(chosen)]


def terms_planes(kind: str, codes: np.ndarray, shape: tuple[int, int], lights: np.ndarray) -> Planes:
    """ptm (18 planes) or hsh (27) of photographs (rows x columns, lights, 3) uint8, pixels row by row."""
    terms = terms_of(kind, {"ptm": 6, "hsh": 9}[kind])
    inverse = np.linalg.pinv(terms(lights))
    fitted = np.einsum("bl,nlk->nbk", inverse, codes / 255, optimize=True).reshape(len(codes), -1)
    samples = np.einsum("bl,nlk->nbk", inverse, sampled(codes, shape) / 255, optimize=True)
    scale, bias = ranges(samples.reshape(len(samples), -1))
    each = np.eye(3)[None].repeat(len(inverse), 0)  # term, colour, colour
    components = np.einsum("bm,bkj->bkmj", np.eye(len(inverse)), each).reshape(-1, len(inverse), 3)
    mean = np.zeros((len(inverse), 3))
    return Planes(kind, "rgb", fitted, scale, bias, mean, components, lambda light: terms(light[None])[0])


def component_planes(
    kind: str, codes: np.ndarray, shape: tuple[int, int], lights: np.ndarray, planes: int, brightness: int | None = None
) -> Planes:
    """rbf or bilinear of photographs (rows x columns, lights, 3) uint8, pixels row by row.

    brightness : planes of brightness (mycc; the rest is shared by the two differences); None: mrgb.
    """
    resample = np.eye(len(lights)) if kind == "rbf" else resampling(lights)
    samples = np.einsum("sl,nlk->nsk", resample, sampled(codes, shape) / 255, optimize=True)
    to_space = np.eye(3) if brightness is None else np.linalg.inv(FROM_YCOCG)
    samples = samples @ to_space.T
    mean = np.clip(samples.mean(axis=0), 0, 1)
    if brightness is None:
        projection = principal((samples - mean).reshape(len(samples), -1), planes).reshape(planes, -1, 3)
    else:
        differences = (planes - brightness) // 2
        projection = np.zeros((planes, len(resample), 3))
        for channel, count in enumerate((brightness, differences, differences)):
            places = [3 * n + channel if n < differences else 2 * differences + n for n in range(count)]
            projection[places, :, channel] = principal((samples - mean)[..., channel], count)
    offset = np.einsum("pnk,nk->p", projection, mean)
    onto_photographs = np.einsum("pnj,jk,nl->plk", projection, to_space, resample, optimize=True)
    flat = onto_photographs.reshape(planes, -1).T
    scale, bias = ranges(sampled(codes, shape).reshape(-1, flat.shape[0]) / 255 @ flat - offset)
    span = 127 / np.abs(projection).max(axis=(1, 2), keepdims=True)
    stored = (np.floor(127 + span * projection) - 127) / span
    back = np.eye(3) if brightness is None else FROM_YCOCG
    return Planes(
        kind,
        "mrgb" if brightness is None else "mycc",
        codes.reshape(len(codes), -1) / 255 @ flat - offset,
        scale,
        bias,
        np.floor(255 * mean) / 255 @ back.T,
        stored @ back.T,
        (lambda light: gaussian_weights(lights, light, SIGMA))
        if kind == "rbf"
        else (lambda light: bilinear_weights(SIDE, light)),
    )


def principal(rows: np.ndarray, count: int) -> np.ndarray:
    """(count, variables) eigenvectors of the covariance of rows (n, variables), the largest first."""
    return np.linalg.eigh(rows.T @ rows / (len(rows) - 1))[1][:, ::-1][:, :count].T


def ranges(coefficients: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Scale and bias of planes from sample pixels (n, planes)."""
    low, high = coefficients.min(axis=0), coefficients.max(axis=0)
    scale = OWN_RANGE * (high - low) + (1 - OWN_RANGE) * (high - low).max()
    return scale, -low / scale


def resampling(lights: np.ndarray) -> np.ndarray:
    """(nodes, lights) from photographs to the values at the nodes of the grid; the module's x."""
    squares = ((grid_directions(SIDE)[:, None] - lights) ** 2).sum(axis=-1)
    near = np.exp(-(squares - squares.min(axis=1, keepdims=True)) / SIGMA**2)
    near /= near.sum(axis=1, keepdims=True)
    near[near <= LEAST_NODE_WEIGHT] = 0
    near /= near.sum(axis=1, keepdims=True)
    between = np.stack([bilinear_weights(SIDE, light) for light in lights])
    normal = between.T @ between + REGULARISATION * np.eye(SIDE**2)
    made = near + np.linalg.solve(normal, between.T @ (np.eye(len(lights)) - between @ near))
    return np.where(np.abs(made) > LEAST_NODE_WEIGHT, made, 0)
