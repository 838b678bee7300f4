"""Meshes and integrals that the mechanics tests share: a cube cut into tetrahedra, loads and errors by quadrature."""

from __future__ import annotations

import itertools

import numpy as np

from fingerjax.fem import element
from fingerjax.fem.body import Body, assemble_body


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


def cube_body(divisions: int, *, order: int = 2, held=lambda x: x[:, 1] > 1 - 1e-9, layers: int = 1, warp=None, degree: int = 2) -> Body:
    """A unit cube as a body; `held` picks the supported nodes, layers are slabs of equal thickness along y, `warp` moves the nodes."""
    nodes, tets = cube(divisions)
    if order == 1:
        used = np.unique(tets[:, :4])
        nodes, tets = nodes[used], tets[:, :4]
    layer = np.minimum((nodes[tets[:, :4]].mean(axis=1)[:, 1] * layers).astype(int), layers - 1)
    supported = held(nodes)
    return assemble_body(nodes if warp is None else warp(nodes), tets, layer, supported, degree)


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


def quadratic(residuals) -> bool:
    """Whether Newton's last step left no more than some times the square of the residual before it, small as that was; or rounding."""
    before, last = residuals[-2:]
    return before < 1e-4 and last <= max(100 * before**2, 1e-12)
