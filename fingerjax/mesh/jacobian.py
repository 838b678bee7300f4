"""Volume element of ten-node tetrahedra: det(dx/dxi) at points of the reference element.

x(xi) = sum_a N_a(xi) x_a, N the quadratic shape functions in VTK's order. Quadrature: 14 points, exact to
degree 5 (Walkington 2000); the determinant has degree 3.
"""

from __future__ import annotations

import itertools

import numpy as np

from fingerjax.mesh.topology import EDGES, edges


def _walkington() -> tuple[np.ndarray, np.ndarray]:
    """Barycentric points `(14, 4)` and weights `(14,)` that sum to 1."""
    points, weights = [], []
    for a, w in ((0.3108859192633006, 0.11268792571801585), (0.09273525031089123, 0.07349304311636195)):
        points += [np.where(np.arange(4) == i, 1.0 - 3.0 * a, a) for i in range(4)]
        weights += [w] * 4
    a = 0.04550370412564965
    for i, j in EDGES:
        points.append(np.where(np.isin(np.arange(4), [i, j]), a, 0.5 - a))
        weights.append(0.042546020777081466)
    return np.array(points), np.array(weights)


POINTS, WEIGHTS = _walkington()
CORNERS = np.eye(4)
EVERYWHERE = np.concatenate([POINTS, CORNERS])
WORST = 0.05  # of an element's straight determinant, that none of its own may be below


def gradients(points: np.ndarray) -> np.ndarray:
    """dN_a/dxi_i, `(q, 10, 3)`, at barycentric points `(q, 4)`; xi are the last three of these."""
    slope = np.concatenate([-np.ones((1, 3)), np.eye(3)])  # d lambda_a / d xi_i
    corner = (4.0 * points - 1.0)[:, :, None] * slope
    i, j = EDGES.T
    side = 4.0 * (points[:, i, None] * slope[j] + points[:, j, None] * slope[i])
    return np.concatenate([corner, side], axis=1)


def determinants(nodes: np.ndarray, tets: np.ndarray, points: np.ndarray = POINTS) -> np.ndarray:
    """det(dx/dxi), `(e, q)` mm^3, of ten-node elements at barycentric points; six volumes when straight."""
    jacobian = np.einsum("qai,eaj->eqij", gradients(points), nodes[tets], optimize=True)
    return np.asarray(np.linalg.det(jacobian))


def volumes(nodes: np.ndarray, tets: np.ndarray) -> np.ndarray:
    """Volume of each curved element, `(e,)` mm^3."""
    return determinants(nodes, tets) @ WEIGHTS / 6.0


def relaxed(nodes: np.ndarray, tets: np.ndarray, count: int, worst: float = WORST) -> tuple[np.ndarray, int]:
    """Nodes with midsides pulled straight where an element is nearly turned inside out, and how many midsides
    were.

    `count` vertices come first in `nodes`, then the midsides. An element is bad when its smallest
    determinant, at the quadrature points and the corners, is below `worst` times its straight volume's. Its
    midsides go half-way to straight, for all elements that share them, until none is bad; after six rounds
    they are made straight outright, which ends, as an element whose sides are straight is not bad.
    """
    nodes, pull = pulled(nodes, tets, count, worst)
    return nodes, int(np.sum(pull > 0))


def pulled(nodes: np.ndarray, tets: np.ndarray, count: int, worst: float = WORST) -> tuple[np.ndarray, np.ndarray]:
    """As `relaxed`; and for each midside the share of the way to straight that it was pulled."""
    pairs, _ = edges(tets[:, :4], count)
    straight = nodes[pairs].mean(axis=1)
    nodes, left = nodes.copy(), np.ones(len(pairs))
    flat = determinants(np.concatenate([nodes[:count], straight]), tets, POINTS[:1])[:, 0]
    suspects = np.arange(len(tets))
    for halving in itertools.count():
        low = determinants(nodes, tets[suspects], EVERYWHERE).min(axis=1)
        bad = tets[suspects[low < worst * flat[suspects]]]
        sides = np.unique(bad[:, 4:]) - count
        if not left[sides].any():
            break
        pull = 0.5 if halving < 6 else 1.0
        left[sides] *= 1.0 - pull
        nodes[count + sides] += pull * (straight[sides] - nodes[count + sides])
        moved = np.zeros(len(nodes), bool)
        moved[count + sides] = True
        suspects = np.flatnonzero(moved[tets[:, 4:]].any(axis=1))
    return nodes, 1.0 - left
