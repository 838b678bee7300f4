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
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp

from .body import Body
from .locate import locate

VOIGT = ((0, 0), (1, 1), (2, 2), (1, 2), (0, 2), (0, 1))  # xx yy zz yz xz xy; shears are engineering strains
POWERS = np.array(sorted(((i, j, k) for i in range(4) for j in range(4) for k in range(4) if i + j + k <= 3), key=sum))
ENOUGH = 2  # nodes in a patch for each coefficient of a cubic
DISTINCT = 0.1  # a power of which lower ones leave less than this share is not told from them
NEARNESS = 6.0  # weight exp(-6 r^2), with r = 1 at the farthest node


def strain_columns(body: Body, point: np.ndarray) -> tuple[sp.csc_matrix, int]:
    """Six columns (3n, 6) that read the strain at `point` (3,), mm, in Voigt order with engineering shears, and the layer it lies in.

    Raises ValueError where the point lies in no element.
    """
    element, _ = locate(body, point)
    around = patch(np.asarray(body.tets), np.asarray(body.layer), element)
    away = np.asarray(body.nodes)[around] - point
    size = np.linalg.norm(away, axis=1).max()
    slopes = fitted_slopes(away / size) / size
    columns = sp.lil_matrix((3 * len(body.free), 6))
    for row, (i, j) in enumerate(VOIGT):
        columns[3 * around + i, row] = slopes[:, [j]]
        if i != j:
            columns[3 * around + j, row] = slopes[:, [i]]
    return columns.tocsc(), int(np.asarray(body.layer)[element])


def patch(tets: np.ndarray, layer: np.ndarray, element: int) -> np.ndarray:
    """Nodes (k,) of an element, of the elements of its layer that touch it, and of theirs, until they are enough for a cubic."""
    own = tets[layer == layer[element]]
    found = np.unique(tets[element])
    while len(found) < ENOUGH * len(POWERS):
        grown = np.unique(own[np.isin(own[:, :4], found).any(axis=1)])
        if len(grown) == len(found):
            break
        found = grown
    return found


def fitted_slopes(away: np.ndarray) -> np.ndarray:
    """Weights (k, 3) that values at places (k, 3), none farther from the origin than 1, have in the slopes of their polynomial there."""
    weight = np.exp(-NEARNESS * np.sum(away**2, axis=1))
    powers = np.prod(away[:, None, :] ** POWERS, axis=2) * weight[:, None]  # k place, c power
    kept, basis = _told_apart(powers)
    coefficients = np.linalg.solve(basis.T @ powers[:, kept], basis.T * weight)
    linear = [kept.index(int(np.flatnonzero((POWERS == axis).all(axis=1))[0])) for axis in np.eye(3, dtype=int)]
    return coefficients[linear].T


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
