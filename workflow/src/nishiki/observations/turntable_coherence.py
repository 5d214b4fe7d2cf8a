"""Compare the silhouettes of a turntable with its cameras and with a given mesh, as problems with their remedies."""

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from nishiki.capture.turntable import Turntable, TurntableCapture
from nishiki.errors import UserError
from nishiki.formats.problems import Problem, error, warning
from nishiki.geometry.camera import Camera, cameras_of_matrices
from nishiki.geometry.mesh import Mesh, face_vectors, read_triangles
from nishiki.installation import is_installed

if TYPE_CHECKING:
    from nishiki.geometry.coherence import Coherence
    from nishiki.geometry.placement import MeshPlacement
    from nishiki.observations.frames import FrameReader


SOUND, LEAST = 0.9, 0.5  # overlap of sound meshes: .985 and more; the stage mesh keeps none below .5
EXPLAINED = 0.8  # overlap from which another unit or other axes explain why the mesh does not fit
AXES = "xyz"


def mesh_problems(
    capture: TurntableCapture,
    silhouettes: list[np.ndarray],
    cameras: list[Camera],
    mirror: tuple[int, ...] | None,
    *,
    sure: bool,
) -> list[Problem]:
    """Read the mesh and compare it with silhouettes (rows, columns) bool, one a camera (of pictures of that size).

    mirror: factors on the world's axes that the cameras' matrices need, see `geometry.matrices`; sure: whether the
    silhouettes are given, not found in the photographs.
    """
    from nishiki.geometry.placement import measure_placement, move_mesh  # compiled; reports read the constants above

    block = capture.settings.turntable
    if capture.mesh is None or block.mesh is None or not is_installed("trimesh"):
        return []
    try:
        vertices, triangles = read_triangles(capture.mesh)
        vertices, triangles = move_mesh(vertices, triangles, *block.mesh_placement)
        if not face_vectors(vertices, triangles).any():
            raise UserError("its triangles have no area. Remedy: export the mesh again")
    except UserError as e:
        return [error("mesh-unreadable", block.mesh, str(e).removeprefix(f"{capture.mesh}: "))]
    world = np.array(mirror or (1, 1, 1), np.float64)
    mesh = Mesh.of(vertices * world, triangles[:, ::-1] if mirror else triangles)
    found = measure_placement(mesh, silhouettes, cameras, enough=SOUND)
    if found.overlap >= SOUND:
        return []
    what = "the mesh does not lie where the photographs show the object"
    expected = f"an overlap with the silhouettes of {SOUND:g} and more"
    facts = f"{found.overlap:.2f}"
    if found.best >= EXPLAINED and found.best > found.overlap + 0.1:
        facts += f"; {found.best:.2f} in another unit or with other axes"
        return [
            error(
                "mesh-placement", block.mesh, what, expected=expected, found=facts, remedy=_remedy(block, found, world)
            )
        ]
    remedy = "Check that mesh and cameras are of one world, unit and origin, and that the silhouettes show the object"
    kind = error if sure and found.overlap < LEAST else warning
    return [kind("mesh-placement", block.mesh, what, expected=expected, found=facts, remedy=remedy)]


def _remedy(block: Turntable, found: "MeshPlacement", world: np.ndarray) -> str:
    """Return the keys that move the mesh there, in addition to given ones; world: factors on its axes."""
    scale, order, signs = block.mesh_placement
    old = list(found.order)
    signs = np.array(signs)[old] * found.signs * world * world[old]
    turns = zip(signs, (order[i] for i in old), strict=True)
    axes = ",".join(f"{'-' if sign < 0 else ''}{AXES[axis]}" for sign, axis in turns)
    keys = [f"mesh_scale: {scale * found.scale:.6g}"] if found.scale != 1 else []
    keys += [f"mesh_axes: '{axes}'"] if axes != block.mesh_axes else []
    return f"Set {' and '.join(keys)} under turntable in capture.yaml and seal a copy"


WORKING_SIDE = 480
"""Longer side in pixels of the photographs in which the check searches for silhouettes."""
GUESSED_OUTLINE = 2.0
"""Separation of the two sides of an outline, in spreads of the background, below which the outline is a guess."""
DOUBTFUL, INCOHERENT = 0.06, 0.10
"""Unexplained contradiction that raises a warning, and an error. Sound captures gave up to 0.015, dark ones of 8
bits 0.037, a chair of thin parts 0.039; with half of the views moved by 4 % of the object it is 0.08 to 0.16."""
FEWEST_VIEWS = 4  # views


class DisplayPictures:
    """Small display pictures of the views, for finding silhouettes where none are given."""

    def __init__(self, capture: TurntableCapture):
        self.capture, self.masks, self.dark = capture, {}, None
        usable = capture.matrices is not None and len(capture.views) >= FEWEST_VIEWS
        self.wanted = set() if not usable or capture.silhouette_of(capture.views[0]) else set(capture.views)

    def add(self, view: str, codes: np.ndarray, reader: "FrameReader") -> None:
        """Find the silhouette in the first photograph of a view; codes (rows, columns, channels) of the reader."""
        if view not in self.wanted:
            return
        import cv2

        from nishiki.colour.colour import decode
        from nishiki.geometry.silhouettes import display, segment

        self.wanted.discard(view)
        step = max(1, max(codes.shape[:2]) // (2 * WORKING_SIDE))  # an outline is found as well on every n-th pixel
        codes = codes[::step, ::step]
        factor = min(1.0, WORKING_SIDE / max(codes.shape[:2]))
        size = tuple(max(2, round(n * factor)) for n in codes.shape[1::-1])
        if self.dark is None:
            dark = next(iter(self.capture.frames_of("dark")), None)
            self.dark = 0.0 if dark is None else float(reader.read(dark).mean())
        values = np.maximum(codes[..., :3].astype(np.float32) - self.dark, 0) / reader.full
        small = cv2.resize(values, size, interpolation=cv2.INTER_AREA)
        small = np.nan_to_num(small.reshape(size[1], size[0], -1))
        linear = decode(small, "srgb") if self.capture.settings.camera.encoding == "srgb" else small
        found = segment(display(linear), background=self.capture.settings.turntable.background)
        if found.separation >= GUESSED_OUTLINE and found.mask.any():
            self.masks[view] = found.mask

    def problems(self, rows: int, columns: int) -> list[Problem]:
        """List contradictions of the silhouettes found; none where a quarter of the views' outlines are guesses."""
        if len(self.masks) < max(FEWEST_VIEWS, 0.75 * len(self.capture.views)):
            return []
        return capture_problems(self.capture, self.masks, rows, columns)


def capture_problems(
    capture: TurntableCapture, silhouettes: dict[str, np.ndarray], rows: int, columns: int
) -> list[Problem]:
    """List contradictions between silhouettes by view, (rows, columns) bool or smaller, and a capture's cameras.

    Silhouettes found in photographs whose background is not plain may contradict each other with sound cameras: where
    the surface does not come from them, only a contradiction that a correction explains is reported.
    """
    from nishiki.geometry.coherence import measure_coherence  # the limits of a plan need no compiled code
    from nishiki.geometry.hull import usual_misses

    views = [view for view in capture.views if view in silhouettes]
    if capture.matrices is None or len(views) < FEWEST_VIEWS or any(v not in capture.matrices for v in views):
        return []
    try:
        world = cameras_of_matrices({v: capture.matrices[v] for v in views}, rows=rows, columns=columns)
    except UserError:
        return []  # the stage cameras reports it
    cameras = [replace(camera, distortion=capture.distortion_of(camera.name)) for camera in world.cameras]
    cameras = [camera.resize(*silhouettes[camera.name].shape) for camera in cameras]
    given = capture.silhouette_of(views[0]) is not None
    needed = given or not (capture.mesh or capture.scans)
    named = {view: frame.silhouette for view in views if (frame := capture.silhouette_of(view))}
    misses = 0 if given else usual_misses(len(views))
    found = measure_coherence([silhouettes[view] for view in views], list(cameras), misses=misses)
    problems = describe_coherence(found, cameras, named) if needed or found.correction else []
    if problems or capture.mesh is None:
        return problems
    return mesh_problems(capture, [silhouettes[view] for view in views], cameras, world.mirror, sure=given)


def describe_coherence(found: "Coherence", cameras: list[Camera], files: dict[str, str]) -> list[Problem]:
    """Describe a coherence as at most one problem; files: given silhouette of each view, empty where found."""
    names = [camera.name for camera in cameras]
    facts = f"{100 * found.contradiction:.1f} % of the outlines miss the hull of the other views"
    expected = "silhouettes and cameras that agree"
    fix = found.correction
    if fix is None:
        if found.contradiction < DOUBTFUL:
            return []
        worst = ", ".join(names[k] for k in np.argsort(found.by_view)[::-1][:5])
        what = "silhouettes and cameras contradict each other, and no single mistake explains it"
        remedy = "Check the cameras and the silhouettes, and whether the camera or the object was moved. Begin with "
        remedy += f"the views that contradict the others most: {worst}"
        kind = error if found.contradiction > INCOHERENT else warning
        return [kind("views-contradict", "cameras.csv", what, expected=expected, found=facts, remedy=remedy)]
    facts += f"; {100 * (found.corrected or 0):.1f} % with the remedy"
    concerned = ", ".join(names[k] for k in fix.views[:8])
    pairs = [(names[k], names[camera]) for k, camera in enumerate(fix.order or ()) if camera != k]
    arranged = f"Convert again with --camera-of {','.join(f'{view}={camera}' for view, camera in pairs)}, or set "
    arranged += "camera_of: {" + ", ".join(f"'{view}': '{camera}'" for view, camera in pairs) + "} under turntable in "
    arranged += "capture.yaml and seal a copy"
    if fix.kind == "silhouette-inverted":
        file = files.get(names[fix.views[0]], names[fix.views[0]])
        what = f"silhouettes of {len(fix.views)} of {len(names)} views show the background instead of the object"
        remedy = f"Exchange black and white in the silhouettes of {concerned}"
        return [error(fix.kind, file, what, expected=expected, found=facts, remedy=remedy)]
    if fix.kind == "view-contradicts":
        what = f"the views {concerned} contradict all others, which agree with each other"
        remedy = (
            "Check their photographs, silhouettes and cameras, or remove their rows from frames.csv and cameras.csv"
        )
        return [warning(fix.kind, "frames.csv", what, expected=expected, found=facts, remedy=remedy)]
    what, remedy = {
        "turn-reversed": (
            "the object turned against the order of the cameras",
            "Convert again with --turn reverse, or set turn: reverse under turntable in capture.yaml and seal a copy. "
            "Photographs that are mirrored left to right give the same contradiction; if these are, mirror them back",
        ),
        "cameras-order": ("the photographs are in another order than the cameras", arranged),
        "views-exchanged": (
            f"the views {concerned} are exchanged",
            f"{arranged}; where only their silhouettes are exchanged, exchange their names instead",
        ),
        "pictures-mirrored": (
            f"the pictures are mirrored against the cameras: {fix.detail}",
            "Turn or mirror photographs and silhouettes back",
        ),
        "camera-scale": (
            f"the pictures are {fix.detail} times as large as those of the cameras",
            "Use the photographs in the size for which the cameras were computed, or multiply the first two rows of "
            f"every matrix by {fix.detail}",
        ),
        "focal-length": (
            f"the focal length is wrong: about {fix.detail} times the stated one fits",
            "Calibrate the lens again, or compute the cameras again with that focal length",
        ),
        "turn-angles": (
            f"the object turned by other steps than the cameras state: {fix.detail} times those steps fit",
            "Compute the cameras again with these steps",
        ),
    }[fix.kind]
    return [error(fix.kind, "cameras.csv", what, expected=expected, found=facts, remedy=remedy)]
