"""Tetrahedra: shape functions, their gradients and quadrature, on the reference element with corners 0, e1, e2, e3.

Which one: quadratic (`order=2`, ten nodes) for every reported force, modulus and receptor quantity; linear (`order=1`) stiffens
at a Poisson ratio of 0.48 and overstates forces by a third at the paper's mesh size. It stays for speed and for comparison.
"""

from __future__ import annotations

import numpy as np
from scipy.special import roots_jacobi

# Midside nodes follow the corners in the order of VTK's quadratic tetrahedron and triangle.
EDGES = np.array([[0, 1], [1, 2], [0, 2], [0, 3], [1, 3], [2, 3]])
FACE_EDGES = EDGES[:3]
CORNER_SLOPES = np.array([[-1.0, -1.0, -1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])


def quadrature(degree: int) -> tuple[np.ndarray, np.ndarray]:
    """Points (q, 3) and weights (q,) that integrate polynomials of `degree` over the reference tetrahedron (volume 1/6).

    One point for degree 1, the symmetric four-point rule for degree 2 (Hammer, Marlowe & Stroud, 1956), products of
    Gauss-Jacobi rules in collapsed coordinates above that (Stroud, 1971).
    """
    if degree <= 1:
        return np.full((1, 3), 0.25), np.array([1.0 / 6.0])
    if degree == 2:
        near, far = (5.0 - np.sqrt(5.0)) / 20.0, (5.0 + 3.0 * np.sqrt(5.0)) / 20.0
        points = np.full((4, 3), near)
        points[1:][np.diag_indices(3)] = far
        return points, np.full(4, 1.0 / 24.0)
    return _collapsed_quadrature(degree // 2 + 1)


def _collapsed_quadrature(count: int) -> tuple[np.ndarray, np.ndarray]:
    rules = [roots_jacobi(count, alpha, 0.0) for alpha in (2.0, 1.0, 0.0)]
    (a, wa), (b, wb), (c, wc) = [((1.0 + x) / 2.0, w / 2.0 ** (alpha + 1)) for (x, w), alpha in zip(rules, (2, 1, 0), strict=True)]
    a, b, c = (grid.ravel() for grid in np.meshgrid(a, b, c, indexing="ij"))
    weights = np.einsum("i,j,k->ijk", wa, wb, wc).ravel()
    return np.stack([a, b * (1 - a), c * (1 - a) * (1 - b)], axis=1), weights


def barycentric(points: np.ndarray) -> np.ndarray:
    """Barycentric coordinates (q, d + 1) of reference points (q, d)."""
    return np.concatenate([1.0 - points.sum(axis=1, keepdims=True), points], axis=1)


def shape(points: np.ndarray, order: int) -> np.ndarray:
    """Values (q, a) of the shape functions at reference points (q, 3), or (q, 2) for a face of the tetrahedron."""
    corner = barycentric(points)
    if order == 1:
        return corner
    edges = EDGES if points.shape[1] == 3 else FACE_EDGES
    return np.concatenate([corner * (2 * corner - 1), 4 * corner[:, edges[:, 0]] * corner[:, edges[:, 1]]], axis=1)


def slopes(points: np.ndarray, order: int) -> np.ndarray:
    """Reference gradients (q, a, d) of the shape functions at reference points (q, d)."""
    dimension = points.shape[1]
    corner, slope = barycentric(points), CORNER_SLOPES[: dimension + 1, :dimension]
    if order == 1:
        return np.broadcast_to(slope, (len(points), *slope.shape)).copy()
    i, j = (EDGES if dimension == 3 else FACE_EDGES).T
    at_corners = (4 * corner - 1)[:, :, None] * slope
    at_midsides = 4 * (corner[:, i, None] * slope[j] + corner[:, j, None] * slope[i])
    return np.concatenate([at_corners, at_midsides], axis=1)
