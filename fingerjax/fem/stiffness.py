"""Two kinds of stiffness that a solver can undo: that of the linear body, and the tangent of a strained one. Both are symmetric."""

from __future__ import annotations

from abc import abstractmethod

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import scipy.sparse as sp
from jaxtyping import Array, Float

from . import operator
from .assembly import Assembled
from .body import Body
from .energy import moduli
from .operator import displacement_gradient, nodal_forces, spring_force
from .tissue import AbstractTissue

Field = Float[Array, "nodes 3"]


class AbstractStiffness(eqx.Module):
    """What a body's displacements cost, near some state. `lame` (2, layers), MPa, is what a preconditioner goes by."""

    body: eqx.AbstractVar[Body]
    lame: eqx.AbstractVar[Array | np.ndarray]

    @abstractmethod
    def __call__(self, u: Field) -> Field:
        """Nodal forces, N, of a small displacement, mm; between all nodes, supports among them."""

    @abstractmethod
    def matrix(self, pattern: Assembled) -> sp.csr_matrix:
        """The same between free unknowns, N/mm, as a sparse matrix on the host."""


class Elastic(AbstractStiffness):
    """The linear body's."""

    body: Body
    lame: Array | np.ndarray

    def __call__(self, u: Field) -> Field:
        elastic, springs = operator.internal_force(self.body, jnp.asarray(self.lame), u), self.body.springs
        if springs is None:
            return elastic
        constant = jnp.where(springs.layer < 0, springs.value, 0.0)
        return elastic + springs.force(constant, u)

    def matrix(self, pattern: Assembled) -> sp.csr_matrix:
        return pattern.matrix(np.asarray(self.lame), self.body)


@eqx.filter_jit
def held_by(body: Body, lame: Float[Array, "2 layers"], u: Field) -> Field:
    """The forces, N, that hold a displacement in the linear body, at supports and between all nodes."""
    return Elastic(body, lame)(u)


class Tangent(AbstractStiffness):
    """That of a strained body: `moduli` (e, q, 3, 3, 3, 3), MPa, d stress / d displacement gradient."""

    body: Body
    lame: Array | np.ndarray
    moduli: Float[Array, "elements points 3 3 3 3"]

    def __call__(self, u: Field) -> Field:
        e, q = self.body.weight.shape
        gradient = displacement_gradient(self.body, u).reshape(e, q, 9, 1)
        elements = nodal_forces(self.body, (self.moduli.reshape(e, q, 9, 9) @ gradient).reshape(e, q, 3, 3))
        return elements + spring_force(self.body, jnp.asarray(self.lame), u)

    def matrix(self, pattern: Assembled) -> sp.csr_matrix:
        return pattern.filled(np.asarray(element_tangents(self)), np.asarray(self.lame), self.body.springs)


@eqx.filter_jit
def tangent(body: Body, tissue: AbstractTissue, lame: Float[Array, "2 layers"], u: Field) -> Tangent:
    """The stiffness of a body that is displaced by `u` (n, 3), mm."""
    return Tangent(body, lame, moduli(body, tissue, lame, u))


@eqx.filter_jit
def element_tangents(tangent: Tangent) -> Float[Array, "elements corners_3 corners_3"]:
    """Element matrices K_e = sum over points of w (grad N)' (d2W/dH2) (grad N), N/mm: (e, 3a, 3a), unknowns numbered 3 node + direction."""
    body, (e, q) = tangent.body, tangent.body.weight.shape
    inverse = jnp.broadcast_to(body.inverse, (e, q, 3, 3))
    slope = jnp.einsum("qak,eqkj->eqaj", body.slopes, inverse)  # e element, q point, a and b node, i and k direction, j and l space
    right = jnp.einsum("eqijkl,eqbl->eqijbk", tangent.moduli * body.weight[..., None, None, None, None], slope)
    return jnp.einsum("eqaj,eqijbk->eaibk", slope, right).reshape(e, 3 * slope.shape[2], 3 * slope.shape[2])
