"""Node positions of a column mesh as a function of how thick its layers are, differentiable by JAX.

Every node lies on a straight ray from its foot P on the skin to a point A of the bone's axis,

    x = P + s(t) (A - P),

where s runs linearly between the shares s_k of the ray at which the interfaces are met. Thicker layers move the s_k,

    s_1 = f_e s_1^0,   s_2 = s_1 + f_d (s_2^0 - s_1^0),   s_3 = s_4 - f_f (s_4 - s_3^0),

and with them, linearly, the nodes; skin, nail, bone and cut stay where they are, and adipose tissue gives way.
"""

from __future__ import annotations

from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fingerjax.errors import InputError
from fingerjax.layers import BONE
from fingerjax.mesh.columns import INSIDE, Columns, thickened
from fingerjax.mesh.jacobian import pulled
from fingerjax.mesh.topology import edges, quadratic

LAYERS_MOVED = ("epidermis", "dermis", "fibrous")


@dataclass(frozen=True, eq=False)
class NodeMap:
    """Where the nodes of a column mesh are, in the order of its `Finger`.

    - `feet`: `(n, 3)` mm, skin point above each node, or the node itself inside the bone. `reach`: `(n, 3)` mm, from there to the axis.
    - `met`: `(n, 5)` shares of the ray at which skin and interfaces are met. `t`: `(n,)` depth, 0 to 4.
    - `pairs`: `(m, 2)` ends of each midside, the last m nodes. `pull`: `(m,)` share of the way to straight that it was pulled.
    """

    feet: np.ndarray
    reach: np.ndarray
    met: np.ndarray
    t: np.ndarray
    pairs: np.ndarray
    pull: np.ndarray

    def positions(self, factors: Float[Array, " 3"]) -> Float[Array, "n 3"]:
        """Nodes, mm, where epidermis, dermis and fibrous matrix are `factors` times as thick as they were meshed."""
        met = jnp.stack(thickened(jnp.asarray(self.met).T, factors), axis=1)
        below = np.clip(np.floor(self.t), 0, BONE - 1).astype(int)
        row = np.arange(len(self.t))
        share = met[row, below] + (self.t - below) * (met[row, below + 1] - met[row, below])
        free = jnp.asarray(self.feet) + share[:, None] * jnp.asarray(self.reach)
        straight = 0.5 * (free[self.pairs[:, 0]] + free[self.pairs[:, 1]])
        first = len(self.t) - len(self.pairs)
        return free.at[first:].add(jnp.asarray(self.pull)[:, None] * (straight - free[first:]))

    def check(self, factors: np.ndarray) -> None:
        """**Raises** `InputError` where adipose tissue would be left no thickness."""
        met = np.stack(thickened(self.met.T, np.asarray(factors)), axis=1)
        if (np.diff(met, axis=1) < 0).any():
            raise InputError(
                "layers cross: no adipose tissue is left",
                place="thickness factors",
                seen=tuple(float(f) for f in factors),
                remedy="make epidermis, dermis or fibrous matrix thinner",
            )


def node_map(mesh: Columns) -> NodeMap:
    """The map of a column mesh, and of its midsides as `finger_from_columns` puts them."""
    count = len(mesh.vertices)
    pairs, _ = edges(mesh.tets, count)
    feet, t, middle = mesh.midpoints(pairs)
    nodes, tets, _ = quadratic(mesh.vertices, mesh.tets, middle)
    _, pull = pulled(nodes, tets, count)
    feet, t = np.concatenate([mesh.feet, feet]), np.concatenate([mesh.t, t])
    soft = t < INSIDE
    met = np.tile(np.linspace(0.0, 1.0, BONE + 1), (len(t), 1))
    met[soft], _ = mesh.rays.depths(feet[soft])
    reach = np.zeros_like(feet)
    reach[soft] = mesh.rays.axis(mesh.rays.aim(feet[soft, 2])) - feet[soft]
    return NodeMap(feet, reach, met, np.where(soft, t, 0.0), pairs, pull)
