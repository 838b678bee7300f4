"""The strain at a point as a linear reading of the displacement, recovered from a patch of elements.

Inside one quadratic element the strain is linear, jumps to the next one, and is right to h^2 only. Near a Poisson ratio of 0.5 a
receptor feels every such jump, because the small change of volume that it reads is multiplied by a large bulk modulus. So a polynomial is
fitted to the displacements of the nodes around the point, by least squares, and differentiated (polynomial-preserving recovery: Zhang &
Naga, SIAM J. Sci. Comput. 26, 2005):

    p = argmin sum_a w_a^2 |u_a - p(x_a)|^2,     epsilon = sym grad p

The polynomial is cubic, so that the strain of any cubic field is read exactly, that of any smooth one to h^3. The nearest nodes weigh
most. What is read is a weighted sum of nodal displacements, and so one more column of the condensed body.

Where layers meet strain jumps and displacement does not. The patch is made of elements of the point's own layer alone, with their nodes
on the interfaces. A layer that is one element thick has only three nodes through it: powers that these cannot tell from lower ones are
left out, and across it the fit is quadratic.

A point on an interface, or nearer to it than a mesh can tell, is read in the outer of the two layers. The preset monkey's dermis ends
where the paper puts its receptors, 0.75 mm below the skin; left to the mesh, one receptor lay in the dermis and the next below it.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp

from .body import Body
from .locate import Locator

VOIGT = ((0, 0), (1, 1), (2, 2), (1, 2), (0, 2), (0, 1))  # xx yy zz yz xz xy; shears are engineering strains
POWERS = np.array(sorted(((i, j, k) for i in range(4) for j in range(4) for k in range(4) if i + j + k <= 3), key=sum))
ENOUGH = 2  # nodes in a patch for each coefficient of a cubic
DISTINCT = 0.1  # a power of which lower ones leave less than this share is not told from them
ON_INTERFACE = 0.02  # mm; interfaces of a mesh lie so near to their own
NEARNESS = 6.0  # weight exp(-6 r^2), with r = 1 at the farthest node


class Recovery:
    """Reads strains anywhere in a body. Lives outside compiled code."""

    def __init__(self, body: Body):
        self.nodes, self.tets, self.layer = np.asarray(body.nodes), np.asarray(body.tets), np.asarray(body.layer)
        self.locate = Locator(self.nodes, self.tets)
        elements = np.repeat(np.arange(len(self.tets)), self.tets.shape[1])
        ones = np.ones(self.tets.size, np.int8)
        self._of_node = sp.csr_matrix((ones, (self.tets.ravel(), elements)), shape=(len(self.nodes), len(self.tets)))

    def strains(self, points: np.ndarray) -> tuple[sp.csc_matrix, np.ndarray]:
        """Columns (3n, 6 m) that read the strains at `points` (m, 3), mm, six each in Voigt order with engineering shears; layers (m,).

        Raises ValueError where a point lies in no element.
        """
        found = [self._at(np.asarray(point, float), None) for point in points]
        return self._columns(found), np.array([layer for *_, layer in found], dtype=int)

    def slopes(self, points: np.ndarray, directions: np.ndarray) -> sp.csc_matrix:
        """Columns (3n, 6 m) that read how the same strains change along unit `directions` (m, 3), per mm: of the same polynomials."""
        pairs = zip(np.asarray(points, float), np.asarray(directions, float), strict=True)
        return self._columns([self._at(point, direction) for point, direction in pairs])

    def patch(self, element: int) -> np.ndarray:
        """Nodes (k,) of an element, of the elements of its layer that touch it, and of theirs, until they are enough for a cubic."""
        found = np.unique(self.tets[element])
        while len(found) < ENOUGH * len(POWERS):
            touching = np.unique(self._of_node[found].indices)
            grown = np.unique(self.tets[touching[self.layer[touching] == self.layer[element]]])
            if len(grown) == len(found):
                break
            found = grown
        return found

    def _at(self, point: np.ndarray, direction: np.ndarray | None) -> tuple[np.ndarray, np.ndarray, int]:
        """Nodes (k,) around a point, their weights (k, 3) in the slopes there, and its layer."""
        element = self._holding(point)
        around = self.patch(element)
        away = self.nodes[around] - point
        size = np.linalg.norm(away, axis=1).max()
        slopes = fitted_slopes(away / size, direction) / (size if direction is None else size**2)
        return around, slopes, int(self.layer[element])

    def _holding(self, point: np.ndarray) -> int:
        """The element that holds a point; where it is nearer than `ON_INTERFACE` to a layer farther out, the nearest of that layer."""
        holds, _ = self.locate(point)
        near = self.locate.within(point, ON_INTERFACE, self.layer < self.layer[holds])
        return min(near, key=lambda element: self.layer[element], default=holds)

    def _columns(self, found: list[tuple[np.ndarray, np.ndarray, int]]) -> sp.csc_matrix:
        """Six columns for each of a few points, in one go: most maps have thousands."""
        parts = []
        for number, (around, slopes, _) in enumerate(found):
            for column, (i, j) in enumerate(VOIGT):
                at = np.full(len(around), 6 * number + column)
                parts.append((3 * around + i, at, slopes[:, j]))
                if i != j:
                    parts.append((3 * around + j, at, slopes[:, i]))
        rows, columns, data = (np.concatenate(each) for each in zip(*parts, strict=True)) if parts else (np.zeros(0, int),) * 3
        return sp.csc_matrix((data, (rows, columns)), shape=(3 * len(self.nodes), 6 * len(found)))


def strain_columns(body: Body, point: np.ndarray) -> tuple[sp.csc_matrix, int]:
    """Six columns (3n, 6) that read the strain at one `point` (3,), mm, and the layer it lies in. Raises ValueError outside the body."""
    columns, layers = Recovery(body).strains(np.asarray(point, float)[None])
    return columns, int(layers[0])


def fitted_slopes(away: np.ndarray, direction: np.ndarray | None = None) -> np.ndarray:
    """Weights (k, 3) that values at places (k, 3), none farther from the origin than 1, have in the slopes of their polynomial there.

    With a `direction` (3,), in the derivatives of those slopes along it.
    """
    weight = np.exp(-NEARNESS * np.sum(away**2, axis=1))
    powers = np.prod(away[:, None, :] ** POWERS, axis=2) * weight[:, None]  # k place, c power
    kept, basis = _told_apart(powers)
    coefficients = np.zeros((len(POWERS), len(away)))
    coefficients[kept] = np.linalg.solve(basis.T @ powers[:, kept], basis.T * weight)
    axes = np.eye(3, dtype=int)
    if direction is None:
        return coefficients[[_power(axis) for axis in axes]].T
    second = [[(1 + (i == j)) * coefficients[_power(axes[i] + axes[j])] for j in range(3)] for i in range(3)]
    return np.einsum("ijk,j->ki", np.array(second), direction)


def _power(wanted: np.ndarray) -> int:
    return int(np.flatnonzero((wanted == POWERS).all(axis=1))[0])


def _told_apart(powers: np.ndarray) -> tuple[list[int], np.ndarray]:
    """Columns that those before them do not make up, lowest degrees first, and an orthonormal basis (k, c) of them."""
    kept: list[int] = []
    basis = np.zeros((len(powers), 0))
    for c, column in enumerate(powers.T):
        rest = column - basis @ (basis.T @ column)
        rest -= basis @ (basis.T @ rest)  # twice is enough (Kahan, in Parlett 1980)
        if np.linalg.norm(rest) > DISTINCT * np.linalg.norm(column):
            kept.append(c)
            basis = np.column_stack([basis, rest / np.linalg.norm(rest)])
    return kept, basis
