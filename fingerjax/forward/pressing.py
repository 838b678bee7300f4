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
import scipy.sparse as sp
from jaxtyping import Array, Bool, Float, Int

from ..contact.footprint import Interface
from ..contact.indentation import Contact, press_hats
from ..contact.line import sharp_compliance
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
    - `between`: what hats answer to hats in each pose, load' C load.
    """

    active: Bool[Array, "cases k"]
    slopes: Float[Array, "cases d m"]
    between: Float[Array, "variants poses k k"]


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
    between = [_between(rig, bodies) for rig in rigs]
    columns = bodies[0].held.matrix.shape[0]
    lame = jnp.stack([body.held.lame for body in bodies])
    found = [_settle(rig, hats, columns, lame, added, dict(values)) for rig, hats in zip(rigs, between, strict=True)]
    slope = [np.zeros((len(forces), directions.shape[1], columns)) for _, forces in found]
    chosen = [[np.flatnonzero(np.asarray(rig.variant) == variant) for rig in rigs] for variant in range(len(bodies))]
    acted = [np.asarray(forces) for _, forces in found]
    pushed = [jax.device_put(np.concatenate([forces[cases] for forces, cases in zip(acted, own, strict=True)])) for own in chosen]
    for own, moved in zip(chosen, changes(pushed), strict=True):
        ends = np.cumsum([len(cases) for cases in own])[:-1]
        for each, cases, part in zip(slope, own, np.split(moved, ends), strict=True):
            each[cases] = part
    together = zip(found, slope, between, strict=True)
    settled = tuple(Settled(active, jax.device_put(each), hats) for (active, _), each, hats in together)
    return Known(tuple(each.held for each in bodies), settled, directions)


def _between(rig: Rig, bodies: list[AbstractCondensed]) -> Float[Array, "variants poses k k"]:
    """What hats answer to hats in each pose of a rig: a hat loads a few nodes only, so these are sparse products; bodies in proportion
    share them.
    """
    poses = zip(np.asarray(rig.interface.load), np.asarray(rig.columns), strict=True)
    loads = [_on_columns(*pose, bodies[0].held.matrix.shape[0]) for pose in poses]
    made: dict[int, Float[np.ndarray, "poses k k"]] = {}
    found = []
    for body in bodies:
        one, times = body.unscaled
        if id(one) not in made:
            C = np.asarray(one.held.matrix)
            made[id(one)] = np.stack([load @ (load @ C).T for load in loads])
        found.append(made[id(one)] / times)
    return jax.device_put(np.stack(found))


def _on_columns(load: Float[np.ndarray, "p k"], columns: Int[np.ndarray, " p"], count: int) -> sp.csr_matrix:
    """The load of each hat (k, count) on the compliance's columns."""
    node, hat = np.nonzero(load)
    return sp.csr_matrix((load[node, hat], (hat, columns[node])), shape=(load.shape[1], count))


# One case after the other (lax.map): jaxlib's batched dense solves wait for one another on XLA's own threads, and two at once can take
# them all.


@eqx.filter_jit
def _settle(
    rig: Rig,
    between: Float[Array, "variants poses k k"],
    columns: int,
    lame: Float[Array, "variants 2 layers"],
    added: Added,
    values: dict[str, Any],
) -> tuple[Bool[Array, "cases k"], Float[Array, "cases m"]]:
    sharp = sharp_compliance(lame, rig.layer)

    def one(case: tuple[Array, Array, Array]) -> tuple[Array, Array]:
        pose, imposed, variant = case
        contact = _push(rig, pose, between[variant, pose], imposed, _geometry(rig, pose), sharp[variant], None, added, values)
        return contact.active, jnp.zeros(columns).at[rig.columns[pose]].add(contact.nodal_forces)

    return jax.lax.map(one, (rig.pose, rig.imposed, rig.variant))


def pressed(
    rig: Rig,
    settled: Settled,
    known: Known,
    away: Float[Array, "variants d"],
    added: Added = NOTHING,
    values: Mapping[str, Any] = EMPTY,
    lame: Float[Array, "variants 2 layers"] | None = None,
) -> tuple[Contact, Float[Array, "cases m"]]:
    """Every indentation of a rig, and every column's reading under it; differentiable in the material, the indenter's shape and effects.

    `lame`: of each variant, if a derivative is asked for: of what the tip of a line presses down beyond what the mesh shows.
    """
    C = jnp.stack([each.matrix for each in known.held])
    sharp = sharp_compliance(jnp.stack([each.lame for each in known.held]) if lame is None else lame, rig.layer)

    def one(case: tuple[Array, ...]) -> tuple[Contact, Array, Array]:
        pose, imposed, variant, active, slope = case
        columns, geometry = rig.columns[pose], _geometry(rig, pose)
        change = away[variant] @ slope
        shifted = eqx.tree_at(lambda part: part.overlap, geometry, geometry.overlap - geometry.load.T @ change[columns])
        contact = _push(rig, pose, settled.between[variant, pose], imposed, shifted, sharp[variant], active, added, values)
        return contact, jnp.zeros(C.shape[1]).at[columns].add(contact.nodal_forces), change

    contact, forces, change = jax.lax.map(one, (rig.pose, rig.imposed, rig.variant, settled.active, settled.slopes))
    answers = jnp.einsum("vcm,vmn->vcn", jnp.where((rig.variant == jnp.arange(len(C))[:, None])[..., None], forces, 0.0), C)
    return contact, jnp.sum(answers, axis=0) + change


def _geometry(rig: Rig, pose: Array) -> Interface:
    return jax.tree.map(lambda leaf: leaf[pose], rig.interface)


def _push(
    rig: Rig,
    pose: Array,
    between: Array,
    imposed: Array,
    geometry: Interface,
    sharp: Array,
    start: Array | None,
    added: Added,
    values: Mapping[str, Any],
) -> Contact:
    said = Push(imposed, geometry.overlap, geometry.area, jnp.zeros(()), rig.forced, rig.context.measurement)
    push = added.push(said, values)
    geometry = eqx.tree_at(lambda part: part.overlap, geometry, push.overlap)
    force, travel = (push.imposed, None) if rig.forced else (None, push.imposed)
    return press_hats(between, geometry, travel=travel, force=force, start=start, series=push.series, sharp=sharp)
