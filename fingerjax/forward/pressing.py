"""Every indentation of a rig: which skin it touches, and how its readings follow the material.

The contacts are settled first, with the compliance held, outside of what is differentiated. What they ended with - the touching points and
the way in which the readings move with the material under those forces - is all that the differentiated pass needs.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..contact.footprint import Interface
from ..contact.indentation import Contact, press
from ..effects.added import Added
from ..effects.records import Push
from ..fem.body import Body
from ..fem.condensed import AbstractCondensed, Held
from ..fem.slopes import slopes_of_all
from .rigs import Rig

NOTHING, EMPTY = Added(), MappingProxyType[str, Any]({})


class Settled(eqx.Module):
    """Contacts of one rig at the values where its bodies are held.

    - `active` (cases, k): touching hats. `slopes` (cases, d, m): change of every column's reading per unit of each direction.
    """

    active: Bool[Array, "cases k"]
    slopes: Float[Array, "cases d m"]


class Known(eqx.Module):
    """What was computed before anything is differentiated: bodies held at their materials, and the contacts of every rig on them.

    `directions` (variants, d, 2, layers): orthonormal ways in which each material's Lame parameters can move.
    """

    held: tuple[Held, ...]
    rigs: tuple[Settled, ...]
    directions: Float[Array, "variants d 2 layers"]

    def away(self, lame: list[Float[Array, "2 layers"]]) -> Float[Array, "variants d"]:
        """How far each material is from where it is held, along the directions: zero, with the derivative."""
        moved = [now - jax.lax.stop_gradient(each.lame) for now, each in zip(lame, self.held, strict=True)]
        return jnp.einsum("vdij,vij->vd", self.directions, jnp.stack(moved))


Change = Callable[[int, AbstractCondensed, Float[Array, "k m"]], Float[Array, "k d m"]]
Changes = Callable[[list[Float[Array, "_ m"]]], list[Float[np.ndarray, "_ d m"]]]


def settle(
    rigs: tuple[Rig, ...],
    bodies: list[AbstractCondensed],
    body: Body,
    directions: Float[Array, "variants d 2 layers"],
    added: Added = NOTHING,
    values: Mapping[str, Any] = EMPTY,
) -> Known:
    """Decide every contact, and find how readings move with the material under the forces that it ended with."""

    def changes(forces: list[Float[Array, "_ m"]]) -> list[Float[np.ndarray, "_ d m"]]:
        return slopes_of_all(bodies, body, forces, directions)

    return _settled(rigs, bodies, directions, changes, added, values)


def settle_with(
    rigs: tuple[Rig, ...],
    bodies: list[AbstractCondensed],
    directions: Float[Array, "variants d 2 layers"],
    change: Change,
    added: Added = NOTHING,
    values: Mapping[str, Any] = EMPTY,
) -> Known:
    """The same with any `change` of the readings (k, d, m) under given forces (k, m) on the columns of a variant's body."""

    def changes(forces: list[Float[Array, "_ m"]]) -> list[Float[np.ndarray, "_ d m"]]:
        return [np.asarray(change(variant, *pair)) for variant, pair in enumerate(zip(bodies, forces, strict=True))]

    return _settled(rigs, bodies, directions, changes, added, values)


def _settled(
    rigs: tuple[Rig, ...],
    bodies: list[AbstractCondensed],
    directions: Float[Array, "variants d 2 layers"],
    changes: Changes,
    added: Added,
    values: Mapping[str, Any],
) -> Known:
    C = jnp.stack([each.held.matrix for each in bodies])
    found = [_settle(rig, C, added, dict(values)) for rig in rigs]
    slope = [np.zeros((len(forces), directions.shape[1], C.shape[1])) for _, forces in found]
    chosen = [[np.flatnonzero(np.asarray(rig.variant) == variant) for rig in rigs] for variant in range(len(bodies))]
    pushed = [jnp.concatenate([forces[cases] for (_, forces), cases in zip(found, own, strict=True)]) for own in chosen]
    for own, moved in zip(chosen, changes(pushed), strict=True):
        ends = np.cumsum([len(cases) for cases in own])[:-1]
        for each, cases, part in zip(slope, own, np.split(moved, ends), strict=True):
            each[cases] = part
    settled = tuple(Settled(active, jnp.asarray(each)) for (active, _), each in zip(found, slope, strict=True))
    return Known(tuple(each.held for each in bodies), settled, directions)


# One case after the other (lax.map): jaxlib's batched dense solves wait for one another on XLA's own threads, and two at once can take
# them all.


@eqx.filter_jit
def _settle(
    rig: Rig, C: Float[Array, "variants m m"], added: Added, values: dict[str, Any]
) -> tuple[Bool[Array, "cases k"], Float[Array, "cases m"]]:
    def one(case: tuple[Array, Array, Array]) -> tuple[Array, Array]:
        pose, imposed, variant = case
        contact = _push(rig, pose, C[variant], imposed, _geometry(rig, pose), None, added, values)
        return contact.active, jnp.zeros(C.shape[1]).at[rig.columns[pose]].add(contact.nodal_forces)

    return jax.lax.map(one, (rig.pose, rig.imposed, rig.variant))


def pressed(
    rig: Rig,
    settled: Settled,
    known: Known,
    away: Float[Array, "variants d"],
    added: Added = NOTHING,
    values: Mapping[str, Any] = EMPTY,
) -> tuple[Contact, Float[Array, "cases m"]]:
    """Every indentation of a rig, and every column's reading under it; differentiable in the material, the indenter's shape and effects."""
    C = jnp.stack([each.matrix for each in known.held])

    def one(case: tuple[Array, ...]) -> tuple[Contact, Array]:
        pose, imposed, variant, active, slope = case
        columns, geometry = rig.columns[pose], _geometry(rig, pose)
        change = away[variant] @ slope
        shifted = eqx.tree_at(lambda part: part.overlap, geometry, geometry.overlap - geometry.load.T @ change[columns])
        contact = _push(rig, pose, C[variant], imposed, shifted, active, added, values)
        return contact, C[variant][:, columns] @ contact.nodal_forces + change

    return jax.lax.map(one, (rig.pose, rig.imposed, rig.variant, settled.active, settled.slopes))


def _geometry(rig: Rig, pose: Array) -> Interface:
    return jax.tree.map(lambda leaf: leaf[pose], rig.interface)


def _push(
    rig: Rig,
    pose: Array,
    C: Array,
    imposed: Array,
    geometry: Interface,
    start: Array | None,
    added: Added,
    values: Mapping[str, Any],
) -> Contact:
    columns = rig.columns[pose]
    said = Push(imposed, geometry.overlap, geometry.area, jnp.zeros(()), rig.forced, rig.context.measurement)
    push = added.push(said, values)
    geometry = eqx.tree_at(lambda part: part.overlap, geometry, push.overlap)
    force, travel = (push.imposed, None) if rig.forced else (None, push.imposed)
    return press(C[columns[:, None], columns[None, :]], geometry, travel=travel, force=force, start=start, series=push.series)
