"""Stiffness beside that of the elements: films on the skin, beds under held skin, fibres in a layer; as entries of a sparse matrix."""

from __future__ import annotations

from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse as sp
from jaxtyping import Array, Float, Int


class Springs(eqx.Module):
    """Entries (m,) of a symmetric matrix between the 3n unknowns, numbered 3 node + direction.

    - `value`: N/mm; where `layer` is not negative, mm, to be multiplied by that layer's shear modulus.
    """

    row: Int[Array, " m"]
    column: Int[Array, " m"]
    value: Float[Array, " m"]
    layer: Int[Array, " m"]

    @property
    def stay(self) -> bool:
        """Whether some of them do not follow the moduli. Outside of compiled code."""
        return bool(np.any(np.asarray(self.layer) < 0))

    def at(self, lame: Float[Array, "2 layers"], *, fixed: bool = True) -> Float[Array, " m"]:
        """N/mm at these moduli; without `fixed`, only what follows the moduli."""
        return self.value * jnp.where(self.layer < 0, 1.0 if fixed else 0.0, jnp.asarray(lame)[1][self.layer])

    def force(self, values: Float[Array, " m"], u: Float[Array, "nodes 3"]) -> Float[Array, "nodes 3"]:
        """Nodal forces, N, of a displacement, mm."""
        return jnp.zeros_like(u).reshape(-1).at[self.row].add(values * u.reshape(-1)[self.column]).reshape(u.shape)

    def __add__(self, other: Springs) -> Springs:
        return jax.tree.map(lambda one, more: jnp.concatenate([one, more]), self, other)


def springs(matrix: sp.spmatrix, layer: int = -1) -> Springs:
    """The springs of a sparse matrix (3n, 3n)."""
    found = sp.coo_matrix(matrix)
    found.sum_duplicates()
    row, column = (jnp.asarray(each, jnp.int32) for each in (found.row, found.col))
    return Springs(row, column, jnp.asarray(found.data), jnp.full(found.nnz, layer, jnp.int32))


@dataclass(frozen=True)
class Facets:
    """Quadratic triangles (f, 6) of a surface, and at quadrature points: shape values, slopes along two tangents, area."""

    triangles: np.ndarray
    shape: np.ndarray  # (q, 6)
    slope: np.ndarray  # (f, q, 6, 2) 1/mm
    tangent: np.ndarray  # (f, q, 2, 3)
    area: np.ndarray  # (f, q) mm^2, quadrature weights

    def assembled(self, local: np.ndarray, nodes: int) -> sp.csr_matrix:
        """Sum of matrices (f, 6, 3, 6, 3)."""
        unknowns = (3 * self.triangles[:, :, None] + np.arange(3)).reshape(len(self.triangles), 18)
        row = np.repeat(unknowns, 18, axis=1).ravel()
        column = np.tile(unknowns, (1, 18)).ravel()
        return sp.coo_matrix((local.reshape(-1), (row, column)), shape=(3 * nodes, 3 * nodes)).tocsr()


# Degree 4 (Dunavant 1985), which squares of quadratic shape functions need: with three points a bed has motions that it does not feel.
_NEAR, _FAR = 0.445948490915965, 0.091576213509771
POINTS = np.array([pair for a in (_NEAR, _FAR) for pair in ((a, a), (1 - 2 * a, a), (a, 1 - 2 * a))])
WEIGHTS = np.repeat([0.223381589678011, 0.109951743655322], 3)


def facets(nodes: np.ndarray, triangles: np.ndarray) -> Facets:
    """Geometry of surface triangles (f, 6), three corners and the midsides of 01, 12, 20, with nodes (n, 3), mm."""
    a, b = POINTS.T
    c = 1 - a - b
    shape = np.stack([c * (2 * c - 1), a * (2 * a - 1), b * (2 * b - 1), 4 * c * a, 4 * a * b, 4 * b * c], axis=1)
    zero = np.zeros_like(a)
    along_a = np.stack([1 - 4 * c, 4 * a - 1, zero, 4 * (c - a), 4 * b, -4 * b], axis=1)
    along_b = np.stack([1 - 4 * c, zero, 4 * b - 1, -4 * a, 4 * a, 4 * (c - b)], axis=1)
    local = np.stack([along_a, along_b], axis=2)  # q, 6, 2
    jacobian = np.einsum("fni,qnk->fqik", nodes[triangles], local)
    first = jacobian[..., 0] / np.linalg.norm(jacobian[..., 0], axis=-1, keepdims=True)
    normal = np.cross(jacobian[..., 0], jacobian[..., 1])
    size = np.linalg.norm(normal, axis=-1)
    second = np.cross(normal / size[..., None], first)
    tangent = np.stack([first, second], axis=2)
    flat = np.einsum("fqti,fqik->fqtk", tangent, jacobian)
    slope = np.einsum("qnk,fqkt->fqnt", local, np.linalg.inv(flat))
    return Facets(triangles, shape, slope, tangent, 0.5 * WEIGHTS * size)


FACES = ((0, 2, 1, 6, 5, 4), (0, 1, 3, 4, 8, 7), (1, 2, 3, 5, 9, 8), (0, 3, 2, 7, 9, 6))  # of a quadratic tetrahedron, normals outwards


def faces_on(tets: np.ndarray, marked: np.ndarray) -> np.ndarray:
    """Quadratic triangles (f, 6) of tetrahedra (e, 10) that have all their nodes among the marked ones (n,)."""
    every = tets[:, np.array(FACES)].reshape(-1, 6)
    return every[marked[every].all(axis=1)]


def bed(on: Facets, nodes: int) -> sp.csr_matrix:
    """Per unit of a bed's stiffness in MPa/mm, alike in all directions: integral of N_a N_b over the surface, mm^2."""
    mass = np.einsum("fq,qa,qb->fab", on.area, on.shape, on.shape)
    return on.assembled(np.einsum("fab,ij->faibj", mass, np.eye(3)), nodes)


def tension(on: Facets, nodes: int) -> sp.csr_matrix:
    """Per unit of an isotropic tension in N/mm: integral of grad N_a . grad N_b over the surface, for each direction of motion."""
    local = np.einsum("fq,fqat,fqbt->fab", on.area, on.slope, on.slope)
    return on.assembled(np.einsum("fab,ij->faibj", local, np.eye(3)), nodes)


def film(on: Facets, nodes: int, poisson_ratio: float) -> sp.csr_matrix:
    """Per unit of E t in N/mm: an elastic membrane in plane stress that follows the surface."""
    move = np.einsum("fqas,fqti->fqstai", on.slope, on.tangent)  # derivative along s of the displacement's component t
    strain = 0.5 * (move + np.swapaxes(move, 2, 3))
    trace = strain[:, :, 0, 0] + strain[:, :, 1, 1]
    alike = np.einsum("fq,fqstai,fqstbj->faibj", on.area, strain, strain, optimize=True)
    round_ = np.einsum("fq,fqai,fqbj->faibj", on.area, trace, trace, optimize=True)
    nu = poisson_ratio
    return on.assembled(((1 - nu) * alike + nu * round_) / (1 - nu**2), nodes)
