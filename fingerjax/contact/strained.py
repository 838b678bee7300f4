"""Press a rigid indenter into tissue of any law: every iteration of Newton's is one contact with the linearised tissue, decided exactly.

Near a state u the tissue answers contact forces l with the displacement

    u + K^-1 (B l - f(u)),     so that     gap = C l - (overlap - B'(u - K^-1 f(u))) - travel,     C = B' K^-1 B

which is the problem of `indentation.press` with the overlap shifted. The gap is measured over the undeformed x-z plane, as in the linear
engine: constraints are linear, and a state between two that obey them obeys them too.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse as sp
from jaxtyping import Array, Float

from ..fem.columns import Columns, columns_from_matrix
from ..fem.condensed import AbstractCondensed, Fields
from ..fem.equilibrium import AbstractLoading, Near, State
from .footprint import Interface, only
from .indentation import Contact, press


def _number(value: float | Array | None) -> Array | None:
    return None if value is None else jnp.asarray(value, float)


class Indenting(AbstractLoading):
    """An indenter brought to a travel, mm, or pressed with a force, N (exactly one of the two).

    `columns`: the y-displacements on which `interface.load` acts; `sharp`, mm^2/N, by which skin gives way under the tip of a line
    (`line.sharp_compliance`). The state's `detail` is a `Contact`.
    """

    columns: Columns
    interface: Interface
    travel: Float[Array, ""] | None = eqx.field(default=None, converter=_number)
    force: Float[Array, ""] | None = eqx.field(default=None, converter=_number)
    sharp: Float[Array, ""] = eqx.field(default=0.0, converter=jnp.asarray)

    def __check_init__(self) -> None:
        if (self.travel is None) == (self.force is None):
            raise ValueError("give Indenting either travel= or force=")

    @property
    def moves(self) -> bool:
        return self.force is None

    def answer(self, near: Near, state: State, start: State, share: float) -> State | None:
        condensed = near.solver.reduce(near.tangent, self.columns)
        if not condensed.held.converged:
            return None
        contact = _contact(
            condensed.held.matrix,
            self.interface,
            self._free(near, condensed, state),
            None if self.travel is None else start.travel + share * (self.travel - start.travel),
            None if self.force is None else (1 - share) * _pushed(start) + share * self.force,
            self.sharp,
        )
        load = self.columns.load(contact.nodal_forces)
        step = near.undo((load - near.force)[None])
        return None if step is None else State(state.displacement + step[0], load, contact.travel, contact)

    def work(self, state: State, goal: State) -> Float[Array, ""]:
        return jnp.zeros(()) if self.moves else _pushed(goal) * state.travel

    def respond(self, near: Near, state: State, loads: Fields) -> State | None:
        condensed = near.solver.reduce(near.tangent, self.columns)
        forces, travel = contact_slopes(
            condensed.held.matrix,
            self.interface,
            self._free(near, condensed, state),
            condensed.readings(loads),
            state.travel if self.moves else None,
            None if self.moves else _pushed(state),
            self.sharp,
        )
        change = jnp.stack([self.columns.load(each) for each in forces])
        moved = near.undo(loads + change)
        return None if moved is None else State(moved, change, travel)

    def settled(self, state: State) -> bool:
        return bool(state.detail.settled)

    def _free(self, near: Near, condensed: AbstractCondensed, state: State) -> Float[Array, " p"]:
        """Where the skin would be, mm along y, if the indenter let go of the linearised tissue."""
        return self.columns.read(state.displacement) - condensed.readings(near.force[None])[0]


def on_hats(columns: Columns, interface: Interface) -> tuple[Columns, Interface]:
    """The pressures themselves as columns, a quarter as many as the nodes that they press on; hats off the indenter are left out."""
    kept = np.flatnonzero(np.asarray(interface.area) > 0)
    pressures = columns.matrix() @ sp.csc_matrix(np.asarray(interface.load)[:, kept])
    return columns_from_matrix(pressures), only(interface, kept, jnp.eye(len(kept)))


def _pushed(state: State) -> Float[Array, ""]:
    """Total force of the indenter, N along +y."""
    return jnp.sum(state.force[:, 1])


Number = Float[Array, ""]


@eqx.filter_jit
def _contact(
    C: Float[Array, "p p"],
    interface: Interface,
    free: Float[Array, " p"],
    travel: Number | None,
    force: Number | None,
    sharp: Number,
) -> Contact:
    """The contact with linearised tissue of compliance C, mm/N, whose free surface has moved already."""
    shifted = eqx.tree_at(lambda part: part.overlap, interface, interface.overlap - interface.load.T @ free)
    return press(C, shifted, travel=travel, force=force, sharp=sharp)


@eqx.filter_jit
def contact_slopes(
    C: Float[Array, "p p"],
    interface: Interface,
    free: Float[Array, " p"],
    moved: Float[Array, "d p"],
    travel: Number | None,
    force: Number | None,
    sharp: Number,
) -> tuple[Float[Array, "d p"], Float[Array, " d"]]:
    """Change of the contact's nodal forces, N, and of its travel, mm, when the free surface moves in each of a few ways."""

    def ends(free: Float[Array, " p"]) -> tuple[Array, Array]:
        contact = _contact(C, interface, free, travel, force, sharp)
        return contact.nodal_forces, contact.travel

    return jax.lax.map(lambda way: jax.jvp(ends, (free,), (way,))[1], moved)
