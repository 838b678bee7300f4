"""A finger made ready for the solvers: element geometry at quadrature points, supports, and the order of accumulation."""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..finger import Finger
from ..layers import BONE, LAYERS
from . import element

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


class Incidence(eqx.Module):
    """Which rows of the element forces meet at each node, as padded gathers: XLA's scatter is serial on a CPU.

    Nodes are split in groups of similar valence, so that a corner shared by forty elements does not pad a midside shared by six.
    """

    rows: tuple[Int[Array, "_ _"], ...]
    order: Int[Array, " nodes"]

    def accumulate(self, values: Float[Array, "rows 3"]) -> Float[Array, "nodes 3"]:
        padded = jnp.concatenate([values, jnp.zeros((1, values.shape[1]), values.dtype)])
        return jnp.concatenate([padded[rows].sum(axis=1) for rows in self.rows])[self.order]


def incidence(connectivity: np.ndarray, nodes: int, groups: int = 5) -> Incidence:
    """The gathers that add element rows (element-major, as `connectivity.ravel()`) to `nodes` nodes."""
    flat = connectivity.ravel()
    valence = np.bincount(flat, minlength=nodes)
    by_node = np.argsort(flat, kind="stable")
    start = np.concatenate([[0], np.cumsum(valence)])
    sorted_nodes = np.argsort(valence, kind="stable")
    rows = tuple(_padded_rows(part, by_node, start, valence, len(flat)) for part in np.array_split(sorted_nodes, groups) if len(part))
    return Incidence(rows, jnp.asarray(np.argsort(sorted_nodes), jnp.int32))


def _padded_rows(part: np.ndarray, by_node: np.ndarray, start: np.ndarray, valence: np.ndarray, padding: int) -> Array:
    slot = np.arange(max(int(valence[part].max()), 1))
    index = np.minimum(start[part][:, None] + slot, len(by_node) - 1)
    rows = np.where(slot < valence[part][:, None], by_node[index], padding)
    return jnp.asarray(rows, jnp.int32)


class Body(eqx.Module):
    """Elements, supports and geometry; every array is a leaf, so that a body is an argument of compiled code, never a constant.

    - `tets` (e, a), `layer` (e,), `free` (n,): 1 where a node may move, 0 on the nail and on a rigid bone.
    - `slopes` (q, a, 3): reference gradients; `inverse` (e, q or 1, 3, 3): d reference / d position, 1/mm;
      `weight` (e, q): quadrature weight times Jacobian, mm^3.
    """

    tets: Int[Array, "elements corners"]
    layer: Int[Array, " elements"]
    free: Float[Array, " nodes"]
    nodes: Float[Array, "nodes 3"]
    slopes: Float[Array, "points corners 3"]
    inverse: Float[Array, "elements _ 3 3"]
    weight: Float[Array, "elements points"]
    incidence: Incidence

    @property
    def order(self) -> int:
        return 1 if self.tets.shape[1] == 4 else 2

    @property
    def fixed(self) -> Bool[Array, " nodes"]:
        return self.free == 0


def body(finger: Finger, *, bone: str = "rigid", order: int = 2, degree: int = 2) -> Body:
    """Prepare a finger for the solvers.

    **Arguments:**

    - `bone`: `"rigid"` holds the bone's surface still and leaves its elements out, which saves two thirds of the iterations;
      `"elastic"` meshes it and holds the nail alone. A stiff bone that is held gives the same forces as a rigid one to 1e-5, one that
      is free to move with the finger does not: under a plate it makes the finger up to half as soft again.
    - `order`: 2 for quadratic tetrahedra, 1 for linear ones on the same corners.
    - `degree`: of the quadrature; 2 (four points) is exact where elements are straight and keeps the order of convergence where not.
    """
    if jnp.ones(()).dtype != jnp.float64:
        raise RuntimeError("fingerjax computes in float64: call jax.config.update('jax_enable_x64', True) before anything else")
    finger = finger.without_bone() if bone == "rigid" else finger
    held = finger.nail | finger.bone if bone == "rigid" else finger.nail
    tets, nodes = (finger.tets, finger.nodes) if order == 2 else _corners_only(finger)
    held = held if order == 2 else held[np.unique(finger.tets[:, :4])]
    return assemble_body(nodes, tets, finger.layer, held, degree)


def _corners_only(finger: Finger) -> tuple[np.ndarray, np.ndarray]:
    used, tets = np.unique(finger.tets[:, :4], return_inverse=True)
    return tets.reshape(-1, 4), finger.nodes[used]


def assemble_body(nodes: np.ndarray, tets: np.ndarray, layer: np.ndarray, held: np.ndarray, degree: int = 2) -> Body:
    """A body from bare arrays: nodes (n, 3) mm, tets (e, 4 or 10), layer (e,), held (n,) bool."""
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
        free=jnp.asarray(~np.asarray(held), float),
        nodes=jnp.asarray(nodes),
        slopes=jnp.asarray(slopes),
        inverse=jnp.asarray(inverse),
        weight=jnp.asarray(determinant * weights),
        incidence=incidence(tets, len(nodes)),
    )


def without_load_on_supports(body: Body, load: Float[Array, "nodes 3"]) -> Float[Array, "nodes 3"]:
    return load * body.free[:, None]


__all__ = ["BONE", "Body", "Incidence", "Material", "assemble_body", "body", "incidence", "material"]
