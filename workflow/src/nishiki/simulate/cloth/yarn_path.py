"""The way of a yarn through the cloth: which yarn is on top at each crossing, arcs and straight parts over and under.

After Peirce, The geometry of cloth structure, J. Textile Institute 28(3), 1937: a yarn follows arcs round those that it
crosses and is straight between them. Floats may arch above.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from math import gcd

import numpy as np

from nishiki.errors import UserError


def weave_pattern(weave: str, harness: int, step: int, *, face: str = "warp") -> np.ndarray:
    """(harness, harness) bool, row = weft yarn, column = warp yarn: True where the warp lies on top.

    plain : alternating. twill : the warp passes under one weft yarn a repeat, one place on with each yarn. satin : the
    same with a step that leaves no two bindings side by side; step and harness have no common factor. face : the yarns
    that are on top mostly.
    """
    if weave == "plain":
        return (np.add.outer(np.arange(2), np.arange(2)) % 2).astype(bool)
    step = 1 if weave == "twill" else step
    if weave == "satin" and (gcd(step, harness) != 1 or step % harness in (1, harness - 1)):
        raise UserError(
            f"simulation: step {step} of a {harness}-harness satin expected 2 to {harness - 2}, no common factor; "
            "choose another, such as 2 for 5 or 3 for 8"
        )
    warp_up = np.ones((harness, harness), bool)
    yarns = np.arange(harness)
    warp_up[(step * yarns) % harness, yarns] = False
    return warp_up if face == "warp" else ~warp_up.T


SAMPLES = 96  # a crossing


@dataclass(frozen=True)
class Descent:
    """The way from one side to the other: two arcs of angle `angle` (radians) and `radius`, and between them a
    straight part of length `straight`; width along the cloth, height from extreme to extreme. Lengths in mm."""

    width: float
    height: float
    angle: float
    radius: float
    straight: float


def make_descent(*, width: float, height: float, bend: float) -> Descent:
    """bend 0: no arcs, straight from corner to corner; 1: arcs only.

    2R sin θ + l cos θ = width and 2R(1 − cos θ) + l sin θ = height give R = (width − height/tan θ)/(2 tan(θ/2)).
    """
    steep = math.atan2(height, width)
    angle = steep * (1.0 + bend)
    radius = max(width - height / math.tan(angle), 0.0) / (2.0 * math.tan(0.5 * angle))
    straight = max(height - 2.0 * radius * (1.0 - math.cos(angle)), 0.0) / math.sin(angle)
    return Descent(width, height, angle, radius, straight)


def fall(descent: Descent, s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Height (+height/2 .. −height/2) and slope at s along the cloth, measured from the middle of the descent."""
    half, r = 0.5 * descent.width, descent.radius
    u = np.clip(half - np.abs(s), 0.0, None)  # from the nearer end
    on_arc = u < r * math.sin(descent.angle)
    inside = np.sqrt(np.maximum(r * r - np.minimum(u, r) ** 2, 1e-30))
    drop = np.where(on_arc, r - inside, 0.5 * descent.height - np.abs(s) * math.tan(descent.angle))
    slope = np.where(on_arc, -u / inside, -math.tan(descent.angle))
    level = np.abs(s) >= half
    height = np.where(level, 0.5 * descent.height, 0.5 * descent.height - drop)
    return -np.sign(s) * height, np.where(level, 0.0, slope)


def centre_line(on_top: np.ndarray, *, spacing: float, amplitude: float, bend: float, rest: float, arch: float):
    """Height and slope (crossings · SAMPLES,) of the centre line over one period, and the descent that it is made of.

    on_top : (crossings,) bool, periodic. spacing : of the crossed yarns, mm. amplitude : height above the middle at a
    crossing, mm. rest : share of the spacing on which the yarn lies level. arch : steepest slope of the float's arch.
    """
    count = len(on_top)
    descent = make_descent(width=(1.0 - rest) * spacing, height=2.0 * amplitude, bend=bend)
    place = np.arange(count * SAMPLES) * (spacing / SAMPLES)
    period = count * spacing
    side = np.where(on_top, 1.0, -1.0)
    crossing = np.arange(count * SAMPLES) // SAMPLES
    height, slope = amplitude * side[crossing], np.zeros(len(place))
    changes = [k for k in range(count) if on_top[k] != on_top[k - 1]]
    for k in changes:
        s = (place - k * spacing + 0.5 * period) % period - 0.5 * period
        near = np.abs(s) <= 0.5 * spacing
        z, dz = fall(descent, s[near])
        sign = 1.0 if on_top[k - 1] else -1.0
        height[near], slope[near] = sign * z, sign * dz
    for first, last in zip(changes, [*changes[1:], *[k + count for k in changes[:1]]], strict=True):
        if on_top[first] and last - first > 1:
            length = (last - first) * spacing
            t = ((place - first * spacing) % period) / length
            bump, rate = _arch(np.clip(t, 0.0, 1.0))
            top = arch * length / _STEEPEST
            height, slope = height + top * bump, slope + top / length * rate
    return height, slope, descent


_STEEPEST = 16.0 / (3.0 * math.sqrt(3.0))


def _arch(t):
    """(1 − (2t − 1)²)² and its slope: level at both ends; steepest slope 16/(3√3)."""
    u = 2.0 * t - 1.0
    return (1.0 - u * u) ** 2, -8.0 * u * (1.0 - u * u)
