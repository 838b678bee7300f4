"""A finger made ready for the solvers: element geometry at quadrature points, and supports."""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..finger import Finger
from ..layers import BONE, LAYERS
from . import element
from .springs import Springs

BONES = ("rigid", "held", "elastic")
DILATATIONS = ("pointwise", "mean")
STRAIGHT = 1e-10  # midsides this close to the chord, relative to its length, make a straight element


class Material(eqx.Module):
    """Isotropic linear elasticity of each layer, outermost first.

    - `youngs_modulus`: (layers,) MPa.
    - `poisson_ratio`: (layers,) dimensionless, below 0.5.
    """

    youngs_modulus: Float[Array, " layers"]
    poisson_ratio: Float[Array, " layers"]

    def lame(self) -> Float[Array, "2 layers"]:
        """Lame's first parameter and the shear modulus of each layer, MPa: everything the stiffness is affine in."""
        E, nu = self.youngs_modulus, self.poisson_ratio
        return jnp.stack([E * nu / ((1 + nu) * (1 - 2 * nu)), E / (2 * (1 + nu))])


def material(moduli: dict[str, float], poisson_ratio: float | dict[str, float] = 0.48, bone: float = 1e3) -> Material:
    """A material from moduli by layer name, MPa; the bone's stiffness matters only where the bone is meshed."""
    ratio = poisson_ratio if isinstance(poisson_ratio, dict) else dict.fromkeys(LAYERS, poisson_ratio)
    E = [float({"bone": bone, **moduli}[name]) for name in LAYERS]
    nu = [float({"bone": 0.3, **ratio}[name]) for name in LAYERS]
    return Material(jnp.asarray(E), jnp.asarray(nu))


class Body(eqx.Module):
    """Elements, supports and geometry; every array is a leaf, so that a body is an argument of compiled code, never a constant.

    - `tets` (e, a), `layer` (e,), `free` (n,): 1 where a node moves on its own, 0 on the nail and on a rigid bone.
    - `modes` (6 or 0, n, 3): orthonormal rigid motions of a bone that the tissue carries, zero elsewhere; none where it is held.
    - `slopes` (q, a, 3): reference gradients; `inverse_along` (q or 1, k, j, e): d reference k / d position j, 1/mm;
      `weight_along` (q, e): quadrature weight times Jacobian, mm^3. Elements come last, so that arithmetic runs along them.
    - `dilatation`: the change of volume that Lame's first parameter acts on, at each quadrature point or as the mean over the element.
    - `springs`: stiffness beside that of the elements.
    - `sliding` (n, 3): 0 for the ways along x, y, z in which a node cannot move that is not held; None where there are none.
    """

    tets: Int[Array, "elements corners"]
    layer: Int[Array, " elements"]
    free: Float[Array, " nodes"]
    modes: Float[Array, "modes nodes 3"]
    nodes: Float[Array, "nodes 3"]
    slopes: Float[Array, "points corners 3"]
    inverse_along: Float[Array, "_ 3 3 elements"]
    weight_along: Float[Array, "points elements"]
    dilatation: str = eqx.field(static=True, default="pointwise")
    springs: Springs | None = None
    sliding: Float[Array, "nodes 3"] | None = None

    @property
    def moves(self) -> Float[Array, "nodes _"]:
        """(n, 1 or 3): 1 where a node moves on its own, in all ways or along x, y, z."""
        return self.free[:, None] if self.sliding is None else self.free[:, None] * self.sliding

    @property
    def inverse(self) -> Float[Array, "elements _ 3 3"]:
        return jnp.moveaxis(self.inverse_along, 3, 0)

    @property
    def weight(self) -> Float[Array, "elements points"]:
        return self.weight_along.T

    @property
    def order(self) -> int:
        return 1 if self.tets.shape[1] == 4 else 2

    @property
    def fixed(self) -> Bool[Array, " nodes"]:
        return self.free == 0


def body(finger: Finger, *, bone: str = "rigid", order: int = 2, degree: int = 2, dilatation: str = "pointwise") -> Body:
    """Prepare a finger for the solvers. The nail is held in every case, as it was glued to the table.

    **Arguments:**

    - `bone`: `"rigid"` moves as one piece, carried by the tissue around it, and its elements are left out; `"held"` is rigid and does
      not move at all; `"elastic"` meshes it. A rigid bone gives the forces of a very stiff elastic one, a held one does not: under a
      plate it makes the finger about half as stiff again (the table of drivers has the figure).
    - `order`: 2 for quadratic tetrahedra, 1 for linear ones on the same corners.
    - `degree`: of the quadrature; 2 (four points) is exact where elements are straight and keeps the order of convergence where not.
    - `dilatation`: `"mean"` lets pressure be constant in each element (Nagtegaal, Parks & Rice, 1974): one volume is kept
      there instead of one at every point, which frees quadratic tetrahedra near a Poisson ratio of 0.5. docs/locking.md compares them.
    """
    if jnp.ones(()).dtype != jnp.float64:
        raise RuntimeError("fingerjax computes in float64: call jax.config.update('jax_enable_x64', True) before anything else")
    if bone not in BONES:
        raise ValueError(f"unknown bone {bone!r}; choose one of {', '.join(BONES)}")
    finger = finger if bone == "elastic" else finger.without_bone()
    tets, nodes, nail, hard, rollers = finger.tets, finger.nodes, finger.nail, finger.bone, finger.rollers
    if order == 1:
        used, tets = np.unique(finger.tets[:, :4], return_inverse=True)
        tets, nodes, nail, hard = tets.reshape(-1, 4), nodes[used], nail[used], hard[used]
        rollers = None if rollers is None else rollers[used]
    carried = hard & ~nail if bone == "rigid" else np.zeros(len(nodes), bool)
    held = nail | hard if bone == "held" else nail
    if not held.any() and rollers is None:
        raise ValueError(f"nothing holds the body {finger.name!r}: mark its nail, or hold its bone with bone='held'")
    return assemble_body(nodes, tets, finger.layer, held, degree, carried, dilatation, rollers)


def rigid_modes(nodes: np.ndarray, carried: np.ndarray) -> np.ndarray:
    """Orthonormal rigid motions (6, n, 3) of the marked nodes (n,), zero on all others; none (0, n, 3) where no node is marked."""
    modes = np.zeros((6 if carried.any() else 0, len(nodes), 3))
    if carried.any():
        arm = nodes[carried] - nodes[carried].mean(axis=0)
        turns = [np.cross(axis, arm) for axis in np.eye(3)]
        shifts = [np.broadcast_to(axis, arm.shape) for axis in np.eye(3)]
        basis, _ = np.linalg.qr(np.stack([*shifts, *turns]).reshape(6, -1).T)
        modes[:, carried] = basis.T.reshape(6, -1, 3)
    return modes


def assemble_body(
    nodes: np.ndarray,
    tets: np.ndarray,
    layer: np.ndarray,
    held: np.ndarray,
    degree: int = 2,
    carried: np.ndarray | None = None,
    dilatation: str = "pointwise",
    rollers: np.ndarray | None = None,
) -> Body:
    """A body from bare arrays: nodes (n, 3) mm, tets (e, 4 or 10), layer (e,), held (n,) bool; `carried` nodes move as one rigid piece,
    others not in the ways marked in `rollers` (n, 3).
    """
    if dilatation not in DILATATIONS:
        raise ValueError(f"unknown dilatation {dilatation!r}; choose one of {', '.join(DILATATIONS)}")
    carried = np.zeros(len(nodes), bool) if carried is None else np.asarray(carried)
    order = 1 if tets.shape[1] == 4 else 2
    points, weights = element.quadrature(1 if order == 1 else degree)
    slopes = element.slopes(points, order)
    jacobian = np.einsum("eai,qaj->eqij", nodes[tets], slopes)
    determinant = np.linalg.det(jacobian)
    if determinant.min() <= 0:
        worst = int(determinant.min(axis=1).argmin())
        raise ValueError(f"element {worst} is inverted (Jacobian {determinant.min():.3g}); remesh, or reorder its corners")
    inverse = np.linalg.inv(jacobian)
    if np.abs(inverse - inverse[:, :1]).max() <= STRAIGHT * np.abs(inverse).max():
        inverse = inverse[:, :1]
    return Body(
        tets=jnp.asarray(tets, jnp.int32),
        layer=jnp.asarray(layer, jnp.int32),
        free=jnp.asarray(~(np.asarray(held) | carried), float),
        modes=jnp.asarray(rigid_modes(nodes, carried)),
        nodes=jnp.asarray(nodes),
        slopes=jnp.asarray(slopes),
        inverse_along=jnp.asarray(np.moveaxis(inverse, 0, 3).copy()),
        weight_along=jnp.asarray((determinant * weights).T.copy()),
        dilatation=dilatation,
        sliding=None if rollers is None else jnp.asarray(~np.asarray(rollers), float),
    )



def reinforced(body: Body, springs: Springs) -> Body:
    """A body with more stiffness beside that of its elements."""
    together = springs if body.springs is None else body.springs + springs
    return eqx.tree_at(lambda one: one.springs, body, together, is_leaf=lambda leaf: leaf is None)


__all__ = ["BONE", "Body", "Material", "assemble_body", "body", "material", "reinforced"]
