"""Clean meshes from elsewhere: defects are mended and counted, nothing is moved."""

from dataclasses import dataclass

import numpy as np

from nishiki.formats.stored import PlainFields
from nishiki.geometry.camera import Camera
from nishiki.geometry.mesh import Mesh, face_vectors, row_numbers
from nishiki.geometry.surface import compact, parts_of
from nishiki.geometry.visibility import rasterise


@dataclass(frozen=True)
class Defects(PlainFields):
    """Counts of the repairs of `clean`.

    merged_vertices: at the same place as another; degenerate: triangles without area or with a corner twice;
    duplicates: triangles on the same three vertices as another; crowded_edges: edges of more than two triangles,
    crowded_triangles: left out there; split_vertices: made where parts of the surface only touched in one point;
    turned: triangles turned to face as their neighbours; turned_parts: whole parts turned inside out; unreferenced:
    vertices of no triangle, left out; small_parts: left out.
    """

    merged_vertices: int = 0
    degenerate: int = 0
    duplicates: int = 0
    crowded_edges: int = 0
    crowded_triangles: int = 0
    split_vertices: int = 0
    turned: int = 0
    turned_parts: int = 0
    unreferenced: int = 0


def clean(vertices: np.ndarray, triangles: np.ndarray, *, cameras: list[Camera] | None = None) -> tuple[Mesh, Defects]:
    """Clean a mesh: at most two triangles an edge, all turned outwards; return it with the repairs.

    vertices (v, 3) finite, triangles (f, 3) integer. Outwards: positive volume of closed parts; of open parts, the side
    that the cameras see. Raises ValueError where no triangle is left.
    """
    vertices = np.asarray(vertices, np.float64)
    triangles = np.asarray(triangles, np.int64)
    unreferenced = int((np.bincount(triangles.ravel(), minlength=len(vertices)) == 0).sum())
    vertices, triangles, merged = merge_equal(vertices, triangles)
    triangles, degenerate = without_degenerate(vertices, triangles)
    _, first = np.unique(row_numbers(np.sort(triangles, axis=1)), return_index=True)  # whatever their vertices' order
    triangles, duplicates = triangles[np.sort(first)], len(triangles) - len(first)
    triangles, crowded_edges, crowded = remove_crowded(vertices, triangles)
    if not len(triangles):
        raise ValueError("no triangle with an area is left")
    neighbours = find_neighbours(triangles)
    triangles, turned = turned_alike(triangles, *neighbours)
    vertices, triangles, split = split_touching(vertices, triangles, neighbours[:2])
    triangles, turned_parts = outwards(vertices, triangles, neighbours[:2], cameras or [])
    defects = Defects(merged, degenerate, duplicates, crowded_edges, crowded, split, turned, turned_parts, unreferenced)
    return compact(vertices, triangles), defects


def merge_equal(vertices: np.ndarray, triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray, int]:
    """Merge vertices at one place (the same three numbers; -0 is 0) in the order of first use.

    Return also the number of merged vertices among those that triangles use.
    """
    used = np.flatnonzero(np.bincount(triangles.ravel()))
    inverse = row_numbers(vertices[used])
    _, first = np.unique(inverse, return_index=True)
    order = np.argsort(first, kind="stable")
    rank = np.empty(len(order), np.int64)
    rank[order] = np.arange(len(order))
    number = np.full(len(vertices), -1)
    number[used] = rank[inverse]
    return vertices[used][first[order]] + 0.0, number[triangles], len(used) - len(first)


def without_degenerate(vertices: np.ndarray, triangles: np.ndarray) -> tuple[np.ndarray, int]:
    """Select triangles with an area above rounding (relative to their longest side) and three different corners."""
    twice = np.linalg.norm(face_vectors(vertices, triangles), axis=1)
    ends = [vertices[triangles[:, k]] for k in range(3)]
    longest = np.max([np.linalg.norm(ends[k] - ends[k - 1], axis=1) for k in range(3)], axis=0)
    reach = np.abs(vertices).max(axis=1)[triangles].max(axis=1)
    # Coordinates carry float32's rounding in most files: a triangle thinner than that has no direction.
    sound = twice > longest * np.maximum(1e-9 * longest, 1e-14 * reach)
    a, b, c = triangles.T
    sound &= (a != b) & (b != c) & (c != a)
    return triangles[sound], int((~sound).sum())


def remove_crowded(vertices: np.ndarray, triangles: np.ndarray) -> tuple[np.ndarray, int, int]:
    """Keep the larger triangles so that no edge has more than two; also count those edges and the triangles removed."""
    edges, owners, counts = _edges(triangles)
    crowded = int((counts > 2).sum())
    if not crowded:
        return triangles, 0, 0
    area = np.linalg.norm(face_vectors(vertices, triangles), axis=1)
    # Rank of each triangle among those of its edge, largest first.
    order = np.lexsort((owners, -area[owners], edges))
    position = np.arange(len(order))
    starts = np.concatenate([[True], edges[order][1:] != edges[order][:-1]])
    rank = position - np.maximum.accumulate(np.where(starts, position, 0))
    gone = np.zeros(len(triangles), bool)
    gone[owners[order][rank > 1]] = True
    return triangles[~gone], crowded, int(gone.sum())


def _edges(triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Index each triangle side by its edge (3 f,), with its triangle (3 f,), and count each edge's triangles (e,)."""
    sides = np.sort(np.concatenate([triangles[:, [k, (k + 1) % 3]] for k in range(3)]), axis=1)
    number = row_numbers(sides)
    return number, np.tile(np.arange(len(triangles)), 3), np.bincount(number)


def find_neighbours(triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Find pairs of triangles (p,), (p,) that share an edge, and whether both run along it in the same sense (p,)."""
    number, owners, _ = _edges(triangles)
    forward = np.concatenate([triangles[:, k] < triangles[:, (k + 1) % 3] for k in range(3)])
    order = np.argsort(number, kind="stable")
    pairs = np.flatnonzero(number[order][1:] == number[order][:-1])
    first, second = order[pairs], order[pairs + 1]
    return owners[first], owners[second], forward[first] == forward[second]


def turned_alike(
    triangles: np.ndarray, first: np.ndarray, second: np.ndarray, same: np.ndarray
) -> tuple[np.ndarray, int]:
    """Turn triangles so that neighbours, as from `find_neighbours`, run along their edge in opposite senses.

    The smaller number of each part is turned; a Moebius strip keeps a seam.
    """
    if not same.any():
        return triangles, 0
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import breadth_first_order, connected_components

    count = len(triangles)
    weights = np.where(same, 2.0, 1.0)
    graph = coo_matrix(
        (np.tile(weights, 2), (np.concatenate([first, second]), np.concatenate([second, first]))), (count, count)
    ).tocsr()
    parts, labels = connected_components(graph, directed=False)
    flip = np.zeros(count, bool)
    for part in range(parts):
        root = int(np.argmax(labels == part))
        order, parents = breadth_first_order(graph, root, directed=False)
        for face in order[1:]:
            parent = parents[face]
            flip[face] = flip[parent] ^ (graph[parent, face] == 2.0)
        mine = labels == part
        if 2 * flip[mine].sum() > mine.sum():
            flip[mine] = ~flip[mine]
    out = triangles.copy()
    out[flip] = out[flip][:, ::-1]
    return out, int(flip.sum())


def split_touching(vertices: np.ndarray, triangles: np.ndarray, pairs: tuple) -> tuple[np.ndarray, np.ndarray, int]:
    """Give each fan its own vertex where several fans of triangles touch in one point; count new vertices."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    # Corners of triangles are one fan where they share an edge at their vertex.
    (first, second), starts, ends = pairs, [], []
    for k in range(3):
        for m in range(3):
            equal = triangles[first, k] == triangles[second, m]
            starts.append(3 * first[equal] + k)
            ends.append(3 * second[equal] + m)
    starts, ends = np.concatenate(starts), np.concatenate(ends)
    corners = 3 * len(triangles)
    graph = coo_matrix((np.ones(len(starts), np.int8), (starts, ends)), (corners, corners))
    fans, labels = connected_components(graph, directed=False)
    owner = np.empty(fans, np.int64)
    owner[labels] = triangles.reshape(-1)
    # The first fan of a vertex keeps its number.
    _, keeper = np.unique(owner, return_index=True)
    target = np.full(fans, -1)
    target[keeper] = owner[keeper]
    extra = np.flatnonzero(target < 0)
    target[extra] = len(vertices) + np.arange(len(extra))
    return np.concatenate([vertices, vertices[owner[extra]]]), target[labels].reshape(-1, 3), len(extra)


def outwards(vertices: np.ndarray, triangles: np.ndarray, pairs: tuple, cameras: list) -> tuple[np.ndarray, int]:
    """Turn the triangles of parts that are inside out, and count these parts."""
    parts, mine = parts_of(triangles, len(vertices))
    normals = face_vectors(vertices, triangles)
    middle = vertices[triangles].mean(axis=1)
    shared = sum(np.bincount(each, minlength=len(triangles)) for each in pairs)
    closed = np.bincount(mine, weights=shared, minlength=parts) == 3 * np.bincount(mine, minlength=parts)
    centre = np.stack([np.bincount(mine, weights=middle[:, k], minlength=parts) for k in range(3)], axis=1)
    centre = centre / np.bincount(mine, minlength=parts)[:, None]
    volume = np.bincount(mine, weights=np.einsum("ij,ij->i", normals, middle - centre[mine]), minlength=parts)
    seen = np.zeros(parts)
    if not closed.all():
        seen = np.bincount(mine, weights=facing(vertices, triangles, cameras), minlength=parts)
    wrong = np.where(closed | (seen == 0), volume < 0, seen < 0)
    out = triangles.copy()
    out[wrong[mine]] = out[wrong[mine]][:, ::-1]
    return out, int(wrong.sum())


def facing(vertices: np.ndarray, triangles: np.ndarray, cameras: list[Camera]) -> np.ndarray:
    """Count the pixels of each triangle's face less those of its back (f,) float64, over up to 12 cameras."""
    mesh = Mesh.of(vertices, triangles)
    normals, middle = face_vectors(vertices, triangles), vertices[triangles].mean(axis=1)
    total = np.zeros(len(triangles))
    for camera in cameras[:: max(1, len(cameras) // 12)]:
        shown = rasterise(mesh, camera).triangle
        pixels = np.bincount(shown[shown >= 0], minlength=len(triangles))
        total += pixels * np.sign(np.einsum("ij,ij->i", normals, camera.centre - middle))
    return total
