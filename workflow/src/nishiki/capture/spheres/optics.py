"""Mirror spheres in photographs: the ray that each pixel of one reflects, and where a lamp's highlight lies.

Frame of all vectors: x right, y up, z towards the camera. A perspective camera has its centre at the origin and looks
along -z; an orthographic one looks along -z from everywhere.

A sphere with centre C and radius R is seen by a perspective camera inside a cone about c = C / |C| with half angle
alpha, sin(alpha) = R / |C|. A ray r (unit) of its outline fulfils r . c = cos(alpha), or r . m = 1 with
m = c / cos(alpha): the three parameters of the outline, an ellipse. An orthographic camera sees a circle; its
parameters are column, row and radius. At a point P of the sphere with normal n and direction v to the camera the
mirror shows the lamp in direction d = 2 (n . v) n - v.
"""

from dataclasses import dataclass

import numpy as np

INSIDE = 0.97  # of the radius: highlights beyond are cut off by the outline
LEVELS = (0.5, 0.75)  # of a highlight's peak, above which it counts; the distance of both centroids is its asymmetry
ABOVE_HORIZON = 0.8  # of the radius: what lies further out is the ground, unless the camera is near
LEAST_ABOVE = 0.15  # of the largest highlight's light
STRICT_LEVELS = (0.9, 0.95)  # the same where the photograph also shows what else the sphere reflects
FINE_SIDE = 24.0  # samples across a highlight: smaller ones are interpolated before a level cuts them
LEAST_SIGMA_PX = 0.05  # of a centroid: pixels are samples


@dataclass(frozen=True)
class SphereCamera:
    """Camera that photographs the spheres."""

    rows: int  # rows, columns: size of the photographs
    columns: int
    focal_px: float | None  # focal length in pixels; None: orthographic (seen from afar)
    centre: tuple[float, float]  # principal point (column, row)

    @classmethod
    def of(cls, rows: int, columns: int, focal_px: float | None = None, centre=None) -> "SphereCamera":
        """Make a camera whose principal point is the middle of the photograph, unless given."""
        return cls(rows, columns, focal_px, centre or ((columns - 1) / 2, (rows - 1) / 2))

    def rays(self, pixels: np.ndarray) -> np.ndarray:
        """Compute unit directions (n, 3) away from a perspective camera through pixels (n, 2), column first."""
        x, y = (pixels - self.centre).T
        rays = np.column_stack([x, -y, np.full(len(pixels), -self.focal_px)])
        return rays / np.linalg.norm(rays, axis=1)[:, None]


def outline_points(parameters: np.ndarray, camera: SphereCamera, count: int = 180) -> np.ndarray:
    """Compute points (count, 2) of an outline in pixels (column, row)."""
    turn = np.linspace(0, 2 * np.pi, count, endpoint=False)
    if camera.focal_px is None:
        column, row, radius = parameters
        return np.column_stack([column + radius * np.cos(turn), row + radius * np.sin(turn)])
    length = np.linalg.norm(parameters)
    axis = parameters / length
    cosine, sine = 1 / length, np.sqrt(max(0.0, 1 - 1 / length**2))
    across = np.linalg.svd(axis[None])[2][1:]
    rays = cosine * axis + sine * (np.cos(turn)[:, None] * across[0] + np.sin(turn)[:, None] * across[1])
    return np.column_stack(
        [
            camera.centre[0] - camera.focal_px * rays[:, 0] / rays[:, 2],
            camera.centre[1] + camera.focal_px * rays[:, 1] / rays[:, 2],
        ]
    )


def circle_of(parameters: np.ndarray, camera: SphereCamera) -> tuple[float, float, float]:
    """Compute column, row and radius in pixels of the circle nearest to an outline."""
    if camera.focal_px is None:
        return float(parameters[0]), float(parameters[1]), float(parameters[2])
    edge = outline_points(parameters, camera)
    middle = (edge.min(axis=0) + edge.max(axis=0)) / 2
    return float(middle[0]), float(middle[1]), float(np.linalg.norm(edge - middle, axis=1).mean())


def sphere_of(parameters: np.ndarray, camera: SphereCamera, radius: float) -> tuple[np.ndarray, float]:
    """Compute centre (3,) and radius of the sphere with this outline, in the unit of the radius.

    For an orthographic camera the unit of a pixel is radius / radius in pixels, x and y count from the principal
    point, and z from the plane on which the sphere lies: its centre has z = radius.
    """
    if camera.focal_px is None:
        pitch = radius / parameters[2]
        x, y = (parameters[0] - camera.centre[0]) * pitch, -(parameters[1] - camera.centre[1]) * pitch
        return np.array([x, y, radius]), radius
    length = np.linalg.norm(parameters)
    return parameters / length * (radius / np.sqrt(1 - 1 / length**2)), radius


def reflected_rays(
    pixels: np.ndarray, parameters: np.ndarray, camera: SphereCamera, radius: float
) -> tuple[np.ndarray, np.ndarray]:
    """Compute points (n, 3) on a sphere at pixels (n, 2), and directions (n, 3) of their mirror reflections.

    NaN where a pixel does not show the sphere.
    """
    centre, radius = sphere_of(parameters, camera, radius)
    with np.errstate(invalid="ignore"):
        if camera.focal_px is None:
            pitch = radius / parameters[2]
            x, y = (pixels[:, 0] - parameters[0]) * pitch, -(pixels[:, 1] - parameters[1]) * pitch
            points = centre + np.column_stack([x, y, np.sqrt(radius**2 - x * x - y * y)])
            back = np.broadcast_to([0.0, 0.0, 1.0], points.shape)
        else:
            rays = camera.rays(pixels)
            along = rays @ centre
            # The nearer of the two cuts; the distance of the ray from the centre, squared, without cancellation.
            off = ((centre - along[:, None] * rays) ** 2).sum(axis=1)
            points = (along - np.sqrt(radius**2 - off))[:, None] * rays
            back = -rays
    normals = (points - centre) / radius
    return points, 2 * (normals * back).sum(axis=1)[:, None] * normals - back


def pixel_of_direction(
    direction: np.ndarray, parameters: np.ndarray, camera: SphereCamera, radius: float
) -> np.ndarray:
    """Compute the pixel (2,) (column, row) at which the sphere shows its surroundings in a direction (3,).

    The normal halves the angle between the directions to lamp and camera; for a perspective camera the latter depends
    on the point, which few repetitions settle.
    """
    centre, radius = sphere_of(parameters, camera, radius)
    back = np.array([0.0, 0.0, 1.0]) if camera.focal_px is None else -centre / np.linalg.norm(centre)
    for _ in range(1 if camera.focal_px is None else 30):
        normal = direction + back
        point = centre + radius * normal / np.linalg.norm(normal)
        if camera.focal_px is not None:
            back = -point / np.linalg.norm(point)
    if camera.focal_px is None:
        pitch = radius / parameters[2]
        return np.array([camera.centre[0] + point[0] / pitch, camera.centre[1] - point[1] / pitch])
    return np.array(camera.centre) + camera.focal_px * np.array([-point[0], point[1]]) / point[2]


@dataclass(frozen=True)
class LampImage:
    """The image of a lamp on a sphere."""

    pixel: np.ndarray  # (2,): column and row at which the sphere shows the lamp's middle
    sigma_px: float  # standard deviation of that place
    area_px: float  # pixels above half the peak
    peak: float  # largest value above what the sphere shows without the lamp
    second: float  # light of the next largest highlight relative to this one
    cut: bool  # whether it reaches the sphere's outline or the edge of the photograph


def find_highlight(
    picture: np.ndarray, noise: float, outline: np.ndarray, camera: SphereCamera, corner=(0, 0), *, levels=LEVELS
) -> LampImage | None:
    """Find the highlight of a lamp on a sphere; None where there is none.

    picture (rows, columns) float32: crop of a photograph less what the sphere shows without the lamp; noise: its
    standard deviation; outline: the sphere's parameters; corner: column and row of the crop's corner; levels: see
    `LEVELS`. A mirror sphere shows equal solid angles on (nearly) equal areas, so the mean of the directions that its
    pixels show, weighted by their light, is the middle of an extended lamp, saturated or not; the mean of the pixels
    themselves is not.
    """
    import cv2

    corner = np.asarray(corner, float)
    column, row, radius = circle_of(outline, camera)
    rows, columns = np.indices(picture.shape)
    from_middle = np.hypot(columns + corner[0] - column, rows + corner[1] - row)
    within = from_middle < radius - 0.5
    smooth = cv2.GaussianBlur(picture, (0, 0), max(0.7, 0.004 * radius))
    smooth = np.where(within, smooth, 0.0)
    peak = float(smooth.max())
    if not peak > 6 * noise:
        return None
    count, labels = cv2.connectedComponents((smooth > levels[0] * peak).astype(np.uint8), connectivity=8)
    light = np.bincount(labels.ravel(), weights=smooth.ravel(), minlength=count)
    light[0] = 0
    # Towards the rim a ball shows the ground, which may mirror the lamp once more.
    away = np.bincount(labels.ravel(), weights=from_middle.ravel(), minlength=count) / np.bincount(labels.ravel())
    above = (away < ABOVE_HORIZON * radius) & (light > LEAST_ABOVE * light.max())
    light = np.where(above, light, 0) if above.any() else light
    first = int(np.argmax(light))
    chosen = labels == first
    second = float(np.sort(light)[-2] / light[first]) if count > 2 else 0.0
    x, y, fine = _finer(smooth, chosen)
    places = []
    for level in levels:
        weight = np.maximum(fine - level * peak, 0.0)
        used = weight > 0
        pixels = np.column_stack([x[used], y[used]]) + corner
        _, directions = reflected_rays(pixels, outline, camera, 1.0)
        good = np.isfinite(directions).all(axis=1)
        if not good.any():
            return None
        mean = weight[used][good] @ directions[good]
        places.append(pixel_of_direction(mean / np.linalg.norm(mean), outline, camera, 1.0))
    area = float(chosen.sum())
    asymmetry = float(np.linalg.norm(places[0] - places[1])) / 2
    # Of a centroid of `area` pixels with equal noise: sigma^2 = noise^2 sum((p - mean)^2) / sum(weight)^2.
    random = noise / peak * np.sqrt(area / 6)
    border = (rows == 0) & (corner[1] <= 0) | (columns == 0) & (corner[0] <= 0)
    border |= (rows + corner[1] >= camera.rows - 1) | (columns + corner[0] >= camera.columns - 1)
    cut = bool((chosen & ((from_middle > INSIDE * radius) | border)).any())
    # a small sharp highlight lies anywhere within the one pixel that it lights: variance 1 / 12
    sigma = float(np.sqrt(LEAST_SIGMA_PX**2 + asymmetry**2 + random**2 + 1 / (12 * area**2)))
    return LampImage(places[0], sigma, area, peak, second, cut)


def _finer(smooth: np.ndarray, chosen: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Interpolate columns, rows and values of a highlight of a few pixels.

    A level cuts through pixels: of a highlight of five pixels the centroid above it is wrong by 0.2 pixels.
    """
    import cv2

    rows, columns = np.nonzero(chosen)
    top, left = max(0, rows.min() - 4), max(0, columns.min() - 4)
    box = (slice(top, rows.max() + 5), slice(left, columns.max() + 5))
    near = cv2.dilate(chosen[box].astype(np.uint8), np.ones((3, 3), np.uint8))
    factor = int(np.clip(np.ceil(FINE_SIDE / np.sqrt(len(rows))), 1, 12))
    values = cv2.resize(smooth[box], None, fx=factor, fy=factor, interpolation=cv2.INTER_LANCZOS4)
    near = cv2.resize(near, None, fx=factor, fy=factor, interpolation=cv2.INTER_NEAREST) > 0
    y, x = (np.indices(values.shape) + 0.5) / factor - 0.5
    return x + left, y + top, np.where(near, values, 0.0)


def direction_from_sphere(image: np.ndarray, centre: tuple[float, float], radius: float) -> np.ndarray:
    """Measure the unit direction (3,) float64 of the lamp from a mirror sphere in a single photograph.

    image (rows, columns) of any scale; centre (row, column) and radius of the sphere's outline in pixels, seen from
    afar along z. ValueError where no highlight lies on the sphere.
    """
    top, left = (max(0, int(c - radius)) for c in centre)
    bottom, right = (int(c + radius) + 2 for c in centre)
    part = np.asarray(image[top:bottom, left:right], dtype=np.float32)
    camera = SphereCamera.of(*image.shape)
    outline = np.array([centre[1], centre[0], radius])
    rows, columns = np.ogrid[top : top + part.shape[0], left : left + part.shape[1]]
    inside = np.hypot(rows - centre[0], columns - centre[1]) < radius
    if not inside.any():
        raise ValueError("the sphere lies outside the picture")
    rest = part - np.median(part[inside])
    highlight = find_highlight(
        rest, float(np.median(np.abs(rest[inside]))), outline, camera, (left, top), levels=STRICT_LEVELS
    )
    if highlight is None:
        raise ValueError("no highlight on the sphere")
    return reflected_rays(highlight.pixel[None], outline, camera, 1.0)[1][0]
