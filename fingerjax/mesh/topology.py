"""Who touches whom in a tetrahedral mesh: edges, faces, boundary, the step from 4 nodes to 10."""

from __future__ import annotations

import numpy as np

# Midsides in the order of VTK_QUADRATIC_TETRA, and outward faces of a positively oriented tetrahedron.
EDGES = np.array([[0, 1], [1, 2], [0, 2], [0, 3], [1, 3], [2, 3]])
FACES = np.array([[1, 2, 3], [0, 3, 2], [0, 1, 3], [0, 2, 1]])
KUHN = ((0, 1, 2), (0, 2, 1), (1, 0, 2), (1, 2, 0), (2, 0, 1), (2, 1, 0))
TRIANGLE_EDGES = np.array([[0, 1], [1, 2], [2, 0]])


def _unique_rows(rows: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Unique rows of sorted vertex numbers below `count`, and where each row went (two numbers to a row)."""
    code = rows[:, 0] * np.int64(count) + rows[:, 1]
    unique, inverse = np.unique(code, return_inverse=True)
    return np.stack([unique // count, unique % count], axis=1), inverse


def edges(tets: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Edges of 4-node tetrahedra: `(m, 2)` sorted vertex numbers, and `(e, 6)` the edges of each element."""
    pairs = np.sort(tets[:, EDGES].reshape(-1, 2), axis=1)
    unique, inverse = _unique_rows(pairs, count)
    return unique, inverse.reshape(-1, 6)


def quadratic(
    vertices: np.ndarray, tets: np.ndarray, midpoints: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Ten-node elements from four-node ones.

    `midpoints`, `(m, 3)`, are the positions of the midsides in the order of `edges`; straight when not given.
    Returns all nodes `(n, 3)`, elements `(e, 10)`, and the edges `(m, 2)` whose midside is node
    `len(vertices) + i`.
    """
    pairs, of = edges(tets, len(vertices))
    if midpoints is None:
        midpoints = vertices[pairs].mean(axis=1)
    nodes = np.concatenate([vertices, midpoints])
    return nodes, np.concatenate([tets, of + len(vertices)], axis=1), pairs


def faces(tets: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """All faces of all elements `(4e, 3)` outwards, the element of each, and how many elements share it."""
    every = tets[:, FACES].reshape(-1, 3)
    _, inverse, shared = np.unique(np.sort(every, axis=1), axis=0, return_inverse=True, return_counts=True)
    return every, np.repeat(np.arange(len(tets)), 4), shared[inverse.ravel()]


def boundary(tets: np.ndarray) -> np.ndarray:
    """Faces `(f, 3)` that belong to one element only, normals outwards."""
    every, _, shared = faces(tets)
    return every[shared == 1]


def quadratic_triangles(triangles: np.ndarray, pairs: np.ndarray, count: int) -> np.ndarray:
    """Six-node triangles `(f, 6)` of a mesh whose edges are `pairs` and which has `count` vertices."""
    code = pairs[:, 0] * np.int64(count) + pairs[:, 1]
    wanted = np.sort(triangles[:, TRIANGLE_EDGES].reshape(-1, 2), axis=1)
    at = np.searchsorted(code, wanted[:, 0] * np.int64(count) + wanted[:, 1])
    return np.concatenate([triangles, (at + count).reshape(-1, 3)], axis=1)


def signed_volumes(vertices: np.ndarray, tets: np.ndarray) -> np.ndarray:
    """Volume of each straight tetrahedron, mm^3, positive when positively oriented."""
    a, b, c, d = (vertices[tets[:, i]] for i in range(4))
    return np.einsum("ei,ei->e", np.cross(b - a, c - a), d - a) / 6.0


def oriented(vertices: np.ndarray, tets: np.ndarray) -> np.ndarray:
    """The same tetrahedra with positive orientation."""
    flip = signed_volumes(vertices, tets) < 0
    out = tets.copy()
    out[flip, 2], out[flip, 3] = tets[flip, 3], tets[flip, 2]
    return out


def prism_tets(bottom: np.ndarray, top: np.ndarray, rank: np.ndarray | None = None) -> np.ndarray:
    """Three tetrahedra for each prism, diagonals chosen by rank so that neighbours agree (Dompierre et al.
    1999).

    `bottom` and `top` are `(k, 3)` vertex numbers, corner i of one below corner i of the other. The diagonal
    of each side rises from the bottom vertex of lower `rank`, `(k, 3)`, the vertex number itself when not
    given; it must order columns alike in every prism. Returns `(3k, 4)`, orientation not settled.
    """
    order = np.argsort(bottom if rank is None else rank, axis=1, kind="stable")
    b = np.take_along_axis(bottom, order, axis=1)
    t = np.take_along_axis(top, order, axis=1)
    first = np.stack([b[:, 0], b[:, 1], b[:, 2], t[:, 2]], axis=1)
    second = np.stack([b[:, 0], b[:, 1], t[:, 1], t[:, 2]], axis=1)
    third = np.stack([b[:, 0], t[:, 0], t[:, 1], t[:, 2]], axis=1)
    return np.stack([first, second, third], axis=1).reshape(-1, 4)


def kuhn_tets(divisions: tuple[int, int, int]) -> np.ndarray:
    """Six tetrahedra to each cell of a grid, all about the cell's main diagonal: neighbours conform."""
    i, j, k = (np.arange(n) for n in divisions)
    cell = np.stack(np.meshgrid(i, j, k, indexing="ij"), axis=-1).reshape(-1, 3)
    stride = np.array([(divisions[1] + 1) * (divisions[2] + 1), divisions[2] + 1, 1])
    tets = []
    for path in KUHN:
        steps = np.zeros((4, 3), int)
        for position, axis in enumerate(path):
            steps[position + 1 :, axis] += 1
        tets.append((cell[:, None] + steps) @ stride)
    return np.stack(tets, axis=1).reshape(-1, 4)


def divided(points: np.ndarray, triangles: np.ndarray, times: int) -> tuple[np.ndarray, np.ndarray]:
    """Each flat triangle cut into `times**2` alike ones; points on shared edges are shared. The old points come first."""
    i, j = (a.ravel() for a in np.meshgrid(np.arange(times + 1), np.arange(times + 1), indexing="ij"))
    i, j = i[i + j <= times], j[i + j <= times]
    weight = np.stack([times - i - j, i, j], axis=1)  # (k, 3), of a triangle's corners
    number = np.full((times + 1, times + 1), -1)
    number[i, j] = np.arange(len(i))
    upright = [(a, b) for a in range(times) for b in range(times - a)]
    small = [[number[a, b], number[a + 1, b], number[a, b + 1]] for a, b in upright]
    small += [[number[a + 1, b], number[a + 1, b + 1], number[a, b + 1]] for a, b in upright if a + b < times - 1]
    # A point is known by its corners and their weights, whichever triangle it is seen from.
    corner = np.where(weight[None] > 0, triangles[:, None, :], -1)
    order = np.argsort(corner, axis=2)
    parts = [np.take_along_axis(each, order, 2) for each in (corner, np.broadcast_to(weight, corner.shape))]
    tag = np.concatenate(parts, axis=2)
    tag = np.where(np.tile(tag[:, :, :3] < 0, 2), -1, tag).reshape(-1, 6)
    is_corner = (tag[:, 1] < 0) & (tag[:, 2] >= 0)
    _, first, inverse = np.unique(tag, axis=0, return_index=True, return_inverse=True)
    inverse = inverse.reshape(-1)
    position = np.einsum("kc,fci->fki", weight / times, points[triangles]).reshape(-1, 3)[first]
    new = np.flatnonzero(~is_corner[first])
    target = np.empty(len(first), np.int64)
    target[is_corner[first]] = tag[first[is_corner[first]], 2]
    target[new] = len(points) + np.arange(len(new))
    cut = target[inverse].reshape(len(triangles), -1)[:, np.array(small)]
    return np.concatenate([points, position[new]]), cut.reshape(-1, 3)
