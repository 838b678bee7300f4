"""Meshes and integrals that the mechanics tests share: a cube cut into tetrahedra, loads and errors by quadrature."""

from __future__ import annotations

import itertools
from collections.abc import Callable

import numpy as np
import scipy.sparse.linalg as spla

from fingerjax.contact.triangle import SHAPES, SLOPES, WEIGHTS
from fingerjax.fem import element
from fingerjax.fem.assembly import Assembled
from fingerjax.fem.body import Body, assemble_body
from fingerjax.mesh.topology import FACES, kuhn_tets, oriented, quadratic


def cube(divisions: int, size: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """Nodes (n, 3) and quadratic tetrahedra (e, 10) of a cube, six tetrahedra to a cell (Kuhn's subdivision)."""
    axis = np.linspace(0.0, size, divisions + 1)
    corners = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    index = np.arange(len(corners)).reshape((divisions + 1,) * 3)
    tets = np.concatenate([_kuhn(index, divisions, order) for order in itertools.permutations(range(3))])
    volume = np.linalg.det(corners[tets[:, 1:]] - corners[tets[:, :1]])
    tets[volume < 0] = tets[volume < 0][:, [0, 2, 1, 3]]
    edges, inverse = np.unique(np.sort(tets[:, element.EDGES].reshape(-1, 2), axis=1), axis=0, return_inverse=True)
    nodes = np.concatenate([corners, corners[edges].mean(axis=1)])
    return nodes, np.concatenate([tets, len(corners) + inverse.reshape(-1, 6)], axis=1)


def _kuhn(index: np.ndarray, divisions: int, order: tuple[int, ...]) -> np.ndarray:
    offsets = np.concatenate([[np.zeros(3, int)], np.cumsum(np.eye(3, dtype=int)[list(order)], axis=0)])
    return np.stack([index[tuple(slice(o, o + divisions) for o in offset)].ravel() for offset in offsets], axis=1)


def cube_body(
    divisions: int,
    *,
    order: int = 2,
    held=lambda x: x[:, 1] > 1 - 1e-9,
    layers: int = 1,
    warp=None,
    degree: int = 2,
    dilatation: str = "pointwise",
) -> Body:
    """A unit cube as a body; `held` picks the supported nodes, layers are slabs of equal thickness along y, `warp` moves the nodes."""
    nodes, tets = cube(divisions)
    if order == 1:
        used = np.unique(tets[:, :4])
        nodes, tets = nodes[used], tets[:, :4]
    layer = np.minimum((nodes[tets[:, :4]].mean(axis=1)[:, 1] * layers).astype(int), layers - 1)
    supported = held(nodes)
    return assemble_body(nodes if warp is None else warp(nodes), tets, layer, supported, degree, dilatation=dilatation)


def integrate(body: Body, degree: int = 6):
    """Positions (e, q, 3), weights (e, q), shape values (q, a) and gradients (e, q, a, 3) of a fine rule."""
    points, weights = element.quadrature(degree)
    nodes, tets = np.asarray(body.nodes), np.asarray(body.tets)
    values, slopes = element.shape(points, body.order), element.slopes(points, body.order)
    jacobian = np.einsum("eai,qaj->eqij", nodes[tets], slopes)
    gradient = np.einsum("qak,eqkj->eqaj", slopes, np.linalg.inv(jacobian))
    return np.einsum("qa,eai->eqi", values, nodes[tets]), np.linalg.det(jacobian) * weights, values, gradient


def consistent_load(body: Body, force) -> np.ndarray:
    """Nodal forces of a body force `force(x (k, 3)) -> (k, 3)`, N/mm^3."""
    position, weight, values, _ = integrate(body)
    density = np.asarray(force(position.reshape(-1, 3))).reshape(position.shape)
    element_load = np.einsum("eq,qa,eqi->eai", weight, values, density)
    load = np.zeros(body.nodes.shape)
    np.add.at(load, np.asarray(body.tets), element_load)
    return load


def structured(divisions: tuple[int, int, int], place: Callable[[np.ndarray], np.ndarray], dilatation: str = "pointwise") -> Body:
    """A unit cube cut into quadratic tetrahedra, all of its nodes moved by `place` (n, 3) -> (n, 3), and held nowhere."""
    axes = [np.linspace(0.0, 1.0, count + 1) for count in divisions]
    corners = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    nodes, tets, _ = quadratic(corners, oriented(place(corners), kuhn_tets(divisions)))
    return assemble_body(place(nodes), tets, np.zeros(len(tets), int), np.zeros(len(nodes), bool), dilatation=dilatation)


def outer_faces(body: Body, on: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    """Quadratic triangles (f, 6) of the boundary whose corners all lie where `on` (n, 3) -> (n,) is true; normals outwards."""
    edge = {frozenset(pair): 4 + number for number, pair in enumerate(element.EDGES.tolist())}
    local = np.array([[*face, *(edge[frozenset(pair)] for pair in itertools.pairwise([*face, face[0]]))] for face in FACES.tolist()])
    every = np.asarray(body.tets)[:, local].reshape(-1, 6)
    _, first, count = np.unique(np.sort(every[:, :3], axis=1), axis=0, return_index=True, return_counts=True)
    faces = every[first[count == 1]]
    return faces[on(np.asarray(body.nodes))[faces[:, :3]].all(axis=1)]


def face_load(body: Body, faces: np.ndarray, traction: np.ndarray | float) -> np.ndarray:
    """Nodal forces (n, 3) of a traction (3,), MPa, on quadratic triangles, or of a pressure, MPa, against them."""
    nodes = np.asarray(body.nodes)
    tangent = np.einsum("qda,fai->fqdi", SLOPES, nodes[faces])  # f face, q point, d direction, a node, i space
    normal = np.cross(tangent[:, :, 0], tangent[:, :, 1])
    area = np.linalg.norm(normal, axis=-1, keepdims=True)
    density = area * np.asarray(traction) if np.ndim(traction) else -traction * normal
    load = np.zeros(nodes.shape)
    np.add.at(load, faces, np.einsum("q,qa,fqi->fai", WEIGHTS, SHAPES, density))
    return load


def constrained(body: Body, lame: np.ndarray, held: np.ndarray, load: np.ndarray, imposed: np.ndarray | None = None) -> np.ndarray:
    """Displacement (n, 3) of a body that is held, `held` (n, 3) bool, in single directions, or moved there by `imposed` (n, 3), mm."""
    assert np.all(np.asarray(body.free) > 0), "hand in a body without supports of its own"
    K, free = Assembled(body, upper=False).matrix(np.asarray(lame)), np.flatnonzero(~held.ravel())
    u = np.zeros(load.size) if imposed is None else np.where(held, imposed, 0.0).ravel()
    u[free] = spla.spsolve(K[free][:, free].tocsc(), (load.ravel() - K @ u)[free])
    return u.reshape(-1, 3)


def converged_quadratically(residuals) -> bool:
    """Whether Newton's last step left no more than some times the square of the residual before it, small as that was; or rounding."""
    before, last = residuals[-2:]
    return before < 1e-4 and last <= max(100 * before**2, 1e-12)
