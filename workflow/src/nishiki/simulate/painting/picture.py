"""Plan a picture; the default one is a mountain and a red gate over a lake at sunrise, brocade and patches.

All positions are in units of the picture's height: u to the right from the left edge, v downwards from the top edge.
"""

from dataclasses import dataclass

import numpy as np

from nishiki.simulate.painting.settings import REGION
from nishiki.simulate.randomness import fractal_noise, subkey
from nishiki.threads import strips


@dataclass
class CanvasMap:
    """A painter's plan, per camera pixel (rows, columns)."""

    region: np.ndarray  # uint8 index of the paint
    tone: np.ndarray  # float32 0..1 along its ramp
    direction: np.ndarray  # float32 radians, brush direction from the right, clockwise in the picture
    body: np.ndarray  # float32, thickness of the strokes relative to usual
    group: np.ndarray  # uint8; a stroke never crosses from one group into another
    size: np.ndarray  # float32, stroke width relative to usual

    @classmethod
    def blank(cls, rows: int, columns: int) -> "CanvasMap":
        """Make a plan of bare ground."""
        shape = (rows, columns)
        return cls(
            np.zeros(shape, np.uint8),
            np.full(shape, 0.5, np.float32),
            np.zeros(shape, np.float32),
            np.ones(shape, np.float32),
            np.zeros(shape, np.uint8),
            np.ones(shape, np.float32),
        )

    def rows_of(self, band: slice) -> "CanvasMap":
        """Return a view of some rows."""
        return CanvasMap(*(getattr(self, name)[band] for name in self.__dataclass_fields__))

    def paint(self, where, region, *, tone=None, direction=None, body=None, group=None, size=None) -> None:
        """Assign values where the boolean array `where` is set; arrays are taken at those pixels."""
        values = {"tone": tone, "direction": direction, "body": body, "group": group, "size": size}
        self.region[where] = REGION[region] if isinstance(region, str) else region[where]
        for name, value in values.items():
            if value is not None:
                getattr(self, name)[where] = value[where] if isinstance(value, np.ndarray) else value


HORIZON = 0.545  # height in the picture, from its lower edge
HEM_TOP, HEM_BOTTOM, PATCH_TOP = 0.815, 0.928, 0.940
SKY, MOUNTAIN, HILLS, WATER, MEADOW, GATE, BRANCH, HEM, PATCHES = 0, 1, 2, 3, 4, 5, 6, 20, 60
SUN = (0.735, 0.235)  # as share of the width, and v
GATE_AT = (0.60, 0.655)
_CLOUDS = ((0.10, 0.30, 0.16, 0.020), (0.24, 0.345, 0.13, 0.018), (0.92, 0.405, 0.15, 0.018), (0.80, 0.44, 0.11, 0.014))
_PATCH_NAMES = (
    *(f"grey {index}" for index in range(1, 7)),
    *(f"patch {name}" for name in ("red", "orange", "yellow", "green", "blue", "violet")),
)


def plan_landscape(rows: int, columns: int, *, seed: int) -> CanvasMap:
    """Plan the picture; bands of rows keep the memory of the intermediate arrays bounded."""
    plan = CanvasMap.blank(rows, columns)
    for band in strips(rows):
        u, v = np.meshgrid((np.arange(columns) + 0.5) / rows, (np.arange(rows)[band] + 0.5) / rows)
        _plan_band(plan.rows_of(band), u, v, columns / rows, seed)
    return plan


def _plan_band(plan, u, v, width, seed):
    def noise(name, scale, octaves=3, stretch=1.0):
        return fractal_noise(u * scale, v * scale * stretch, key=subkey(seed, name), octaves=octaves) - 0.5

    # A slight warp keeps outlines from looking ruled.
    wu, wv = u + 0.010 * noise("warp u", 14.0), v + 0.010 * noise("warp v", 14.0)
    _sky(plan, wu, wv, width, noise)
    _mountain(plan, wu, wv, width, noise)
    _hills(plan, wu, wv, width, noise)
    _lake(plan, wu, wv, width, noise)
    _gate(plan, u, v, width)
    _meadow(plan, wu, wv, width, noise)
    _branch(plan, wu, wv, noise)
    _hem(plan, u, v, noise)
    _patches(plan, u, v, width)


def _sky(plan, u, v, width, noise):
    du, dv = u - SUN[0] * width, v - SUN[1]
    radius = np.hypot(du, dv)
    swirl = noise("swirl", 3.0)
    height = v / HORIZON + 0.30 * swirl + 0.05 * np.sin(9.0 * u + 14.0 * v)
    near_sun = np.exp(-((radius / 0.22) ** 2))
    height = height + 0.55 * near_sun
    # Brush strokes circle the sun and run level elsewhere; directions are averaged as doubled angles.
    around, level = np.arctan2(du, -dv), 1.6 * swirl
    weight = np.exp(-((radius / 0.30) ** 2))
    direction = 0.5 * np.arctan2(
        weight * np.sin(2 * around) + (1 - weight) * np.sin(2 * level),
        weight * np.cos(2 * around) + (1 - weight) * np.cos(2 * level),
    )
    everywhere = np.ones(u.shape, bool)

    def share(low, high):
        return np.clip((height - low) / (high - low), 0, 1)

    plan.paint(everywhere, "sky high", tone=share(-0.15, 0.42), direction=direction, group=SKY, body=0.9, size=1.0)
    plan.paint(height > 0.42, "sky middle", tone=share(0.42, 0.78))
    plan.paint(height > 0.78, "sky low", tone=share(0.78, 1.25))
    rings = 0.5 - 0.5 * np.cos(2 * np.pi * (radius - 0.078) / 0.052)
    plan.paint(
        (radius < 0.185) & (rings > 0.30 + 2.2 * (radius - 0.08)), "halo", tone=np.clip(radius / 0.19, 0, 1), body=1.3
    )
    plan.paint(radius < 0.078, "sun", tone=radius / 0.078, body=1.6, size=0.7)
    for centre, level_v, half, thick in _CLOUDS:
        along = np.maximum(np.abs(u - centre * width) - half, 0.0)
        lobes = thick * (1.0 + 0.35 * np.cos((u - centre * width) * 60.0))
        inside = np.hypot(along, v - level_v) < lobes
        rim = np.hypot(along, v - level_v) > 0.72 * lobes
        plan.paint(inside, "cloud", tone=np.clip(0.9 - 14.0 * (v - level_v), 0, 1), direction=0.0, body=1.1, size=0.55)
        plan.paint(inside & rim, "gold cloud", tone=0.6, size=0.45)


def _mountain(plan, u, v, width, noise):
    offset = u - 0.335 * width
    reach = np.clip((np.abs(offset) - 0.018) / 0.50, 0, 1)
    profile = 0.135 + (HORIZON - 0.135) * (1 - np.exp(-2.0 * reach)) / (1 - np.exp(-2.0))
    inside = (v > profile) & (v < HORIZON + 0.01)
    lit = offset + 0.10 * noise("ridge", 22.0, 2) > 0.25 * (v - 0.135) * (0.3 + noise("ridge 2", 9.0))
    slope = np.where(offset > 0, 0.85, np.pi - 0.85).astype(np.float32)
    tone = np.clip(0.5 + 1.3 * noise("rock", 16.0), 0, 1)
    plan.paint(inside & lit, "mountain lit", tone=tone, direction=slope, group=MOUNTAIN, size=0.75, body=1.0)
    plan.paint(inside & ~lit, "mountain shade", tone=tone, direction=slope, group=MOUNTAIN, size=0.75, body=1.0)
    zigzag = np.abs(((u * 17.0) % 1.0) - 0.5)
    snow = inside & (v < 0.235 + 0.075 * zigzag + 0.10 * noise("snow", 18.0))
    plan.paint(snow & lit, "snow lit", tone=tone, body=1.3, size=0.6)
    plan.paint(snow & ~lit, "snow shade", tone=tone, body=1.2, size=0.6)


def _hills(plan, u, v, width, noise):
    for index, (name, level, swing, scale, phase) in enumerate(
        (
            ("far hills", 0.470, 0.020, 5.2, 0.4),
            ("middle hills", 0.505, 0.022, 4.1, 2.3),
            ("near hills", 0.535, 0.018, 6.3, 4.0),
        )
    ):
        ridge = 0.6 * np.sin(scale * u + phase) + 0.4 * np.sin(2.3 * scale * u + 1.7 * phase)
        edge = level - swing * ridge - 0.05 * np.abs(u / width - 0.5)
        inside = (v > edge) & (v < HORIZON + 0.012)
        tone = np.clip(0.75 - 9.0 * (v - edge) + 0.8 * noise(f"hill {index}", 20.0), 0, 1)
        slope = np.arctan(
            -swing * scale * (0.6 * np.cos(scale * u + phase) + 0.9 * np.cos(2.3 * scale * u + 1.7 * phase))
        )
        plan.paint(inside, name, tone=tone, direction=slope, group=HILLS, size=0.6, body=1.0)


def _lake(plan, u, v, width, noise):
    inside = v > HORIZON + 0.006 * noise("shore", 12.0)
    depth = (v - HORIZON) / 0.22
    waves = np.sin(190.0 * (v - HORIZON) / (0.35 + 2.2 * depth.clip(0)) + 7.0 * noise("waves", 6.0, 2))
    mirror = np.exp(-(((u - 0.335 * width) / 0.20) ** 2)) * (depth < 0.75)  # the mountain stands on its head
    tone = np.clip(0.62 - 0.30 * depth + 0.28 * waves - 0.30 * mirror, 0, 1)
    plan.paint(inside, "lake", tone=tone, direction=0.12 * waves, group=WATER, size=0.55, body=0.9)
    path = np.abs(u - SUN[0] * width + 0.02 * waves) < 0.022 + 0.20 * (v - HORIZON)
    sparkle = noise("sparkle", 22.0, 2, 4.0) + 0.12 * waves > -0.02
    plan.paint(inside & path & sparkle, "glitter", tone=np.clip(0.9 - 1.1 * depth, 0, 1), body=1.6, size=0.5)


def _gate(plan, u, v, width):
    x, foot = u - GATE_AT[0] * width, GATE_AT[1]
    top = foot - 0.205
    lean = 0.010 * (v - top) / 0.2
    pillars = (np.abs(np.abs(x) - 0.072 - lean) < 0.0105) & (v > top) & (v < foot)
    beam = (np.abs(x) < 0.098) & (np.abs(v - (foot - 0.150)) < 0.0085)
    bow = top - 0.006 - 0.9 * x * x
    lintel = (np.abs(x) < 0.128) & (np.abs(v - bow) < 0.0115)
    cap = (np.abs(x) < 0.134) & (v < bow - 0.0075) & (v > bow - 0.0175)
    strut = (np.abs(x) < 0.007) & (v > bow) & (v < foot - 0.150)
    upright = pillars | strut
    shade = np.clip(0.5 + 24.0 * (np.abs(x) - 0.072), 0, 1)
    plan.paint(upright, "torii", tone=shade, direction=np.pi / 2, group=GATE, size=0.32, body=1.2)
    plan.paint((beam | lintel) & ~upright, "torii", tone=0.7, direction=0.0, group=GATE, size=0.32, body=1.2)
    plan.paint(cap, "black line", tone=0.5, direction=0.0, group=GATE, size=0.3, body=1.2)
    ripple = 0.006 * np.sin(330.0 * v)
    mirror = (np.abs(np.abs(x + ripple) - 0.082) < 0.009) & (v > foot + 0.006) & (v < foot + 0.075)
    mirror &= np.sin(420.0 * v) > -0.2
    plan.paint(mirror, "torii", tone=0.1, direction=0.0, group=WATER, size=0.4, body=0.9)


def _meadow(plan, u, v, width, noise):
    edge = 0.745 - 0.055 * np.sin(2.6 * u + 0.5) + 0.05 * (u / width - 0.5)
    inside = v > edge
    depth = (v - edge) / 0.12
    rows = np.sin(26.0 * (u - 0.5 * width) / (0.35 + depth.clip(0)) + 2.0 * noise("furrow", 5.0))
    fan = np.arctan2(0.35 + depth, (u - 0.5 * width) * 2.5).astype(np.float32)
    tone = np.clip(0.45 + 0.30 * rows + 0.7 * noise("grass", 18.0), 0, 1)
    plan.paint(inside, "meadow", tone=tone, direction=fan, group=MEADOW, size=0.6, body=1.2)
    flowers = inside & (depth > 0.12) & (rows + 2.0 * noise("rape", 7.0) > 0.35)
    plan.paint(flowers, "rape field", tone=np.clip(0.6 + noise("petals", 30.0), 0, 1), size=0.5, body=1.5)
    poppies = inside & (noise("poppies", 26.0, 2) > 0.20) & (depth > 0.05)
    plan.paint(poppies, "poppies", tone=np.clip(0.5 + 2.0 * noise("petals", 30.0), 0, 1), size=0.45, body=1.7)


BRANCHES = (
    ((-0.02, 0.03), (0.20, 0.135), (0.47, 0.085), 0.0125),
    ((0.12, 0.085), (0.18, 0.20), (0.33, 0.225), 0.0080),
    ((0.25, 0.105), (0.33, 0.06), (0.43, 0.022), 0.0065),
)


def branch_curve(points, t):
    """Compute positions (u, v) on a quadratic Bézier curve at the parameters t."""
    (x0, y0), (x1, y1), (x2, y2) = points
    s = 1.0 - t
    return s * s * x0 + 2 * s * t * x1 + t * t * x2, s * s * y0 + 2 * s * t * y1 + t * t * y2


def _branch(plan, u, v, noise):
    for *points, thick in BRANCHES:
        nearest = np.full(u.shape, np.inf)
        angle = np.zeros(u.shape)
        reach = np.zeros(u.shape)
        x, y = branch_curve(points, np.linspace(0, 1, 40))
        if y.min() > v.max() + 0.05 or y.max() < v.min() - 0.05:
            continue
        for index, (cu, cv) in enumerate(zip(x, y, strict=True)):
            distance = np.hypot(u - cu, v - cv)
            closer = distance < nearest
            nearest[closer], reach[closer] = distance[closer], index / 39.0
            step = min(index, 38)
            angle[closer] = np.arctan2(y[step + 1] - y[step], x[step + 1] - x[step])
        inside = nearest < thick * (1.0 - 0.75 * reach)
        plan.paint(
            inside,
            "branch",
            tone=np.clip(0.5 + noise("bark", 40.0), 0, 1),
            direction=angle,
            group=BRANCH,
            size=0.4,
            body=1.3,
        )


def _hem(plan, u, v, noise):
    """Paint overlapping fans (seigaiha) in the brocade's colours, between two lines of gold."""
    inside = (v > HEM_TOP) & (v < HEM_BOTTOM)
    if not inside.any():
        return
    radius = 0.0465
    tone = np.clip(0.5 + noise("thread", 30.0), 0, 1)
    paints = [REGION[f"brocade {name}"] for name in ("red", "indigo", "green", "violet")]
    pending = inside.copy()
    row_step = radius / 2
    last = int((HEM_BOTTOM - HEM_TOP) / row_step) + 3
    for row in range(last, -1, -1):  # the front row lies lowest and hides the others
        centre_v = HEM_TOP + row * row_step
        shift = radius if row % 2 else 0.0
        cell = np.floor((u - shift) / (2 * radius) + 0.5)
        centre_u = cell * 2 * radius + shift
        distance = np.hypot(u - centre_u, v - centre_v) / radius
        here = pending & (distance < 1.0) & (v < centre_v + 1e-9)
        ring = np.minimum((distance * 5).astype(int), 4)
        ground = np.array(paints, np.uint8)[((cell + 2 * (row // 2) + row).astype(int)) % 4]
        region = np.where(ring == 4, REGION["brocade gold"], np.where(ring == 2, REGION["brocade cream"], ground))
        region = np.where(ring == 0, REGION["brocade gold"], region).astype(np.uint8)
        along = np.arctan2(u - centre_u, -(v - centre_v)).astype(np.float32)
        group = (HEM + ring + 5 * (row % 4)).astype(np.uint8)
        body = np.where((ring == 4) | (ring == 0), 1.5, 0.7).astype(np.float32)
        plan.paint(here, region, tone=tone, direction=along, group=group, size=0.33, body=body)
        pending &= ~here
    plan.paint(pending, "brocade gold", tone=0.3, direction=0.0, group=HEM, size=0.33, body=0.7)
    for level in (HEM_TOP, HEM_BOTTOM):
        plan.paint(
            np.abs(v - level) < 0.006, "brocade gold", tone=0.8, direction=0.0, group=HEM + 25, size=0.35, body=1.5
        )


def _patches(plan, u, v, width):
    count = len(_PATCH_NAMES)
    index = np.clip((u / width * count).astype(int), 0, count - 1)
    inside = v > PATCH_TOP - 0.006
    plan.paint(inside, "black line", tone=0.5, direction=0.0, group=PATCHES, size=0.3, body=0.5)
    within = np.abs((u / width * count) % 1.0 - 0.5) * width / count < 0.5 * width / count - 0.0035
    within &= (v > PATCH_TOP) & (v < 0.994)
    region = np.array([REGION[name] for name in _PATCH_NAMES], np.uint8)[index]
    group = (PATCHES + 1 + index).astype(np.uint8)
    plan.paint(within, region, tone=0.5, direction=0.0, group=group, size=0.9, body=0.35)
