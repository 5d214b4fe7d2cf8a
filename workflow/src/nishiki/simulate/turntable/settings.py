"""What a simulated turntable capture looks like: its settings, and where the camera stands, seen from the object."""

from dataclasses import dataclass, field

import numpy as np

from nishiki.simulate.capture import CameraSettings, check_ranges, ranged

DISTANCE_MM = 1200.0  # from the camera to the axis
ELEVATION_DEG = 20.0  # the camera looks down on the object
LAMP_MM = (52.0, 44.0, 6.0)  # in the camera's frame: x right, y up, z backwards
LAMP_RADIUS_MM = 14.0
BLUR_PIXELS = 0.7  # standard deviation of the lens's point spread
BETA = (0.395, 0.412, 0.371)  # white board with the second polariser over that without
LEAK = (0.008, 0.010, 0.013)  # share of the mirror reflection that the crossed polariser lets through
WHITE_RATIO = (0.86, 1.0, 0.78)  # what a white gives in each channel, the largest = 1
STRAY = 0.0015  # light scattered inside the lens, of a white's
CLOTH = 0.004  # the black cloth behind the object, of a white's
AIM_MM = (0.0, 86.0, 0.0)  # the point of the axis that the camera looks at
_WIDTH_MM, _HEIGHT_MM = 204.0, 200.0  # what the picture must hold, at the axis
LEAST_TRIANGLES = 3500  # with fewer, thin parts fall apart
MOST_TRIANGLES = 5_000_000  # of the object and of its scan


@dataclass(frozen=True)
class TurntableSettings:
    """Everything that decides the bytes of a simulated turntable capture.

    rows, columns : camera pixels. views : over a full turn. triangles : about how many the object has. samples : points
    a pixel in each direction. directions : rays a vertex into its hemisphere, for light from other parts of the object.
    bounces : 0 to 4. polariser : True for two pictures a view. scan_triangles : about how many the mesh in the capture
    has, None = the object's own. scan_noise_mm : standard deviation of its vertices along the normal.
    """

    rows: int = ranged(16, 20000, 384)
    columns: int = ranged(16, 20000, 384)
    views: int = ranged(2, 3600, 36)
    seed: int = ranged(0, 2**53, 1)
    triangles: int = ranged(LEAST_TRIANGLES, MOST_TRIANGLES, 30000)
    samples: int = ranged(1, 8, 4)
    directions: int = ranged(16, 4096, 256)
    bounces: int = ranged(0, 4, 2)
    polariser: bool = True
    scan_triangles: int | None = None
    scan_noise_mm: float = ranged(0.0, 5.0, 0.02)
    white_boards: int = 8
    camera: CameraSettings = field(
        default_factory=lambda: CameraSettings(full_well=40000.0, read_noise=6.0, white_level=0.5)
    )

    def __post_init__(self):
        check_ranges(
            self,
            ("scan_triangles", self.scan_triangles or LEAST_TRIANGLES, LEAST_TRIANGLES, MOST_TRIANGLES),
            ("channels", self.camera.channels, 3, 3),
        )


PRESETS = {
    "object": {},
    "object-tiny": {
        "rows": 96,
        "columns": 96,
        "views": 12,
        "triangles": 4000,
        "samples": 3,
        "directions": 64,
        "white_boards": 2,
    },
    "object-large": {"rows": 3000, "columns": 4000, "triangles": 250_000, "samples": 2, "directions": 96},
}


@dataclass(frozen=True)
class Viewpoint:
    """Describe one view."""

    name: str
    rotation: np.ndarray  # (3, 3): object to camera (x right, y down, z into the scene)
    centre: np.ndarray  # (3,): the camera, mm
    lamp: np.ndarray  # (3,): the lamp's centre, mm, object's frame
    focal: float  # pixels
    principal: tuple[float, float]  # column, row of the optical axis

    @property
    def matrix(self) -> np.ndarray:
        """(3, 4) projection: homogeneous (column, row) of object points; the top left pixel's centre is (0, 0)."""
        k = np.array([[self.focal, 0.0, self.principal[0]], [0.0, self.focal, self.principal[1]], [0.0, 0.0, 1.0]])
        return k @ np.column_stack([self.rotation, -self.rotation @ self.centre])


def place_views(settings: TurntableSettings) -> tuple[Viewpoint, ...]:
    """List the views in the order of the turn: each turns the object by 360°/views, anticlockwise from above."""
    focal = DISTANCE_MM * min(settings.columns / _WIDTH_MM, settings.rows / _HEIGHT_MM)
    principal = (0.5 * settings.columns - 0.5 + 1.7, 0.5 * settings.rows - 0.5 - 0.9)
    elevation = np.radians(ELEVATION_DEG)
    views = []
    for index in range(settings.views):
        turn = -2.0 * np.pi * index / settings.views
        back = np.array(
            [np.cos(elevation) * np.sin(turn), np.sin(elevation), np.cos(elevation) * np.cos(turn)]
        )  # from the object to the camera
        right = np.array([np.cos(turn), 0.0, -np.sin(turn)])
        up = np.cross(back, right)
        centre = np.array(AIM_MM) + DISTANCE_MM * back
        lamp = centre + LAMP_MM[0] * right + LAMP_MM[1] * up + LAMP_MM[2] * back
        views.append(Viewpoint(f"{index:03d}", np.stack([right, -up, -back]), centre, lamp, focal, principal))
    return tuple(views)
