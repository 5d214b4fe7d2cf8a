"""What a simulated turntable capture looks like: one frozen set of settings, checked when it is made."""

from __future__ import annotations

from dataclasses import dataclass, field

from nishiki.simulate.settings import CameraSettings, check_ranges

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
BOARD_REFLECTANCE = 0.98
LEAST_TRIANGLES = 3500  # with fewer, thin parts fall apart


@dataclass(frozen=True)
class TurntableSettings:
    """Everything that decides the bytes of a simulated turntable capture.

    rows, columns : camera pixels. views : over a full turn. triangles : about how many the object has. samples : points
    a pixel in each direction. directions : rays a vertex into its hemisphere, for light from other parts of the object.
    bounces : 0 to 4. polariser : True for two pictures a view. scan_triangles : about how many the mesh in the capture
    has, None = the object's own. scan_noise_mm : standard deviation of its vertices along the normal.
    """

    rows: int = 384
    columns: int = 384
    views: int = 36
    seed: int = 1
    triangles: int = 30000
    samples: int = 4
    directions: int = 256
    bounces: int = 2
    polariser: bool = True
    scan_triangles: int | None = None
    scan_noise_mm: float = 0.02
    white_boards: int = 8
    camera: CameraSettings = field(
        default_factory=lambda: CameraSettings(full_well=40000.0, read_noise=6.0, white_level=0.5)
    )

    def __post_init__(self):
        check_ranges(
            [
                ("rows", self.rows, 16, 20000),
                ("columns", self.columns, 16, 20000),
                ("views", self.views, 2, 3600),
                ("seed", self.seed, 0, 2**53),
                ("triangles", self.triangles, LEAST_TRIANGLES, 5_000_000),
                ("scan_triangles", self.scan_triangles or LEAST_TRIANGLES, LEAST_TRIANGLES, 5_000_000),
                ("samples", self.samples, 1, 8),
                ("directions", self.directions, 16, 4096),
                ("bounces", self.bounces, 0, 4),
                ("scan_noise_mm", self.scan_noise_mm, 0.0, 5.0),
                *self.camera.ranges(channels=(3, 3)),
            ]
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
