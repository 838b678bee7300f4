"""How readings change with an internal force that the model lacks: one linear answer, whatever the force is a function of.

A force f(u) per unit of what is missing moves the free surface and every other reading by - B' K^-1 f(u); the indenter then rests on it as
on any other shift, with the contacts held as they are. Another body with the same skin and the same supports is such a force too, and may
read the same displacement otherwise.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse as sp
from jaxtyping import Array, Float

from ..effects.added import Effects
from ..effects.effect import Effect, Force
from ..fem.body import Body, body
from ..fem.condensed import AbstractCondensed
from ..fem.energy import internal_force
from ..fem.operator import spring_force
from ..fem.slopes import distinct
from ..fem.stiffness import held_by
from ..fem.tissue import AbstractTissue, Linear
from ..side_by_side import side_by_side
from .model import Assembled, Model
from .pressing import Known, settle_with
from .readings import Instruments
from .rigs import lay, plans
from .wiring import Values

Field = Float[Array, "nodes 3"]
BLOCK = 32  # indentations whose answers are looked for at a time


class Beside(NamedTuple):
    """Another `body` with the same skin and supports, and the `step` of an effect to it.

    - `columns`: how much more its columns (3n, m) read per unit of the effect; None where they read the same.
    - `elements`, `springs`: whether they are others. `turned`: change (modes, n, 3) of the rigid motions of a carried
      bone per unit of the effect; None where there is none.
    """

    body: Body
    step: float
    columns: sp.csc_matrix | None
    elements: bool
    springs: bool
    turned: Float[Array, "modes nodes 3"] | None

    @property
    def pushes(self) -> bool:
        """Whether it holds a displacement by other forces; else it is read otherwise, and no more."""
        return self.elements or self.springs

    def reads(self, u: Float[np.ndarray, "k _"], m: int) -> Float[np.ndarray, "k m"]:
        """What all m columns read more of displacements (k, 3n), mm, per unit of the effect."""
        return np.zeros((len(u), m)) if self.columns is None else (self.columns.T @ u.T).T


def inner_slopes(model: Model, values: Values, lacking: Sequence[Force | Beside]) -> Float[Array, "rows d"]:
    """Slopes of every row, measurement after measurement, in amounts of internal forces that the linear model lacks, or towards bodies."""
    pushing = [number for number, each in enumerate(lacking) if not isinstance(each, Beside) or each.pushes]
    those = [lacking[number] for number in pushing]
    forces = [_between(model.body, each) if isinstance(each, Beside) else each for each in those]
    lames = [material.lame() for material in model.instruments.materials(values)]
    bodies = model.condensed(lames)

    def change(variant: int, condensed: AbstractCondensed, pushed: Float[Array, "k m"]) -> Array:
        once, which = distinct(np.asarray(pushed))
        moved = np.zeros((len(once), len(lacking), model.columns.count))
        if len(once) == 0:
            return jnp.asarray(moved)
        u = condensed.displacement(jnp.asarray(once))
        for at in range(0, len(u) if forces else 0, BLOCK):
            found = condensed.readings(_forces(forces, model.body, lames[variant], u[at : at + BLOCK]))
            moved[at : at + BLOCK, pushing] = -np.asarray(found).reshape(-1, len(forces), moved.shape[2])
        for number, each in enumerate(lacking):
            if isinstance(each, Beside):
                moved[:, number] += each.reads(np.asarray(u).reshape(len(u), -1), moved.shape[2])
        return jnp.asarray(moved[which])

    directions = jnp.zeros((len(lames), len(lacking), *lames[0].shape))
    known = settle_with(model.instruments.rigs, bodies, directions, change, model.instruments.added, values)
    return slopes_of(model.instruments, known, {name: jnp.asarray(value) for name, value in values.items()}, len(lacking))


def first_order(ready: Assembled, values: Values, effects: Sequence[tuple[Effect, float]]) -> Float[np.ndarray, " rows"]:
    """What effects that are known to first order alone add to every row, each so many times the unit of it."""
    body = ready.model.body
    found = [(force, size) for effect, size in effects if (force := effect.force(body, ready.finger, ready.solid)) is not None]
    return np.asarray(inner_slopes(ready.model, values, [force for force, _ in found])) @ np.array([size for _, size in found])


def _forces(
    forces: Sequence[Force], body: Body, lame: Float[Array, "2 layers"], u: Float[Array, "k nodes 3"]
) -> Float[Array, "kd nodes 3"]:
    def of(each: Field) -> list[Array]:
        held = held_by(body, lame, each)
        return [force(lame, each, held).block_until_ready() for force in forces]

    return jnp.stack([one for each in side_by_side(of, list(u)) for one in each])


@eqx.filter_jit
def slopes_of(instruments: Instruments, known: Known, values: dict[str, Array], count: int) -> Float[Array, "rows d"]:
    """Slopes of every row along the known directions."""

    def readings(share: Float[Array, " d"]) -> Array:
        away = jnp.broadcast_to(share, (len(instruments.variants), count))
        return jnp.concatenate(instruments.read(known, values, away=away).readings)

    return jax.jacfwd(readings)(jnp.zeros(count))


def _between(body: Body, other: Beside) -> Force:
    """What another body's internal force has more, per unit of the step to it."""

    def more(lame: Float[Array, "2 layers"], u: Field, held: Field) -> Field:
        return _towards(Linear(), lame, body, other.body, jnp.asarray(other.step), u, held, other.elements, other.turned)

    return more


@eqx.filter_jit
def _held(law: AbstractTissue, body: Body, lame: Float[Array, "2 layers"], u: Field) -> Field:
    return held_by(body, lame, u) if isinstance(law, Linear) else internal_force(body, law, lame, u)


def towards(law: AbstractTissue, lame: Float[Array, "2 layers"], body: Body, other: Beside, u: Field) -> Field:
    """The change of the internal force (n, 3), N, of tissue of any law at a displacement (n, 3), mm, per unit of the step to another body.

    Where the bone is elsewhere in the other body, its rigid motions R are others: a bone that keeps its motion R q moves by R' q more, and
    what holds it works on R' too.
    """
    held = _held(law, body, lame, u)
    return _towards(law, lame, body, other.body, jnp.asarray(other.step), u, held, other.elements, other.turned)


@eqx.filter_jit
def _towards(
    law: AbstractTissue,
    lame: Float[Array, "2 layers"],
    body: Body,
    other: Body,
    step: Array,
    u: Field,
    held: Field,
    elements: bool,
    turned: Float[Array, "modes nodes 3"] | None,
) -> Field:
    if not elements:
        return (spring_force(other, lame, u) - spring_force(body, lame, u)) / step
    more = (_held(law, other, lame, u) - held) / step
    if turned is None:
        return more
    flat, turned = body.modes.reshape(-1, u.size), turned.reshape(-1, u.size)
    moved = ((flat @ u.ravel()) @ turned).reshape(u.shape)
    lifted = ((turned @ held.ravel()) @ flat).reshape(u.shape)
    return more + jax.jvp(lambda at: _held(law, body, lame, at), (u,), (moved,))[1] + lifted


def of_law(body: Body, law: Callable[[Array], AbstractTissue], null: float) -> Force:
    """Change of the internal force with the one parameter of a law, where that is linear elasticity."""

    def more(lame: Float[Array, "2 layers"], u: Field, held: Field) -> Field:
        return _slope_of_law(body, law, jnp.asarray(null), lame, u)

    return more


@eqx.filter_jit
def _slope_of_law(body: Body, law: Callable, null: Array, lame: Float[Array, "2 layers"], u: Field) -> Field:
    return jax.jvp(lambda size: internal_force(body, law(size), lame, u), (null,), (jnp.ones(()),))[1]


def beside(ready: Assembled, effects: Effects, step: float) -> Beside | None:
    """The body of a study with other effects on it, and its receptors where they are then, `step` away from what it has; None where the
    skin that is touched, its supports, its indenters or the layers of its receptors are others.

    **Raises** `ValueError` where an effect turns elements over.
    """
    planned = [plan.changed(effects) for plan in plans(ready.study.measurements, ready.solid, ready.model.wired)]
    if ready.skin is None or not ready.skin.serves(planned):
        return None
    bone, here = ready.study.model.bone_kind(), ready.model.body
    finger = effects.shape(ready.mesh, ready.solid)
    finger = finger if bone == "elastic" else finger.without_bone()
    there = effects.support(body(finger, bone=bone, dilatation=here.dilatation), finger, ready.solid)
    if not np.array_equal(there.free, here.free) or not ready.skin.is_alike(finger, ready.finger):
        return None
    laid = lay(planned, finger, there, ready.solid, ready.skin)
    if tuple(laid.receptor_layer.items()) != ready.model.instruments.receptor_layer:
        return None
    read = sp.csc_matrix(laid.columns - ready.model.columns.matrix())
    elements = not all(np.array_equal(getattr(there, part), getattr(here, part)) for part in ("weight_along", "inverse_along"))
    springs = not eqx.tree_equal(there.springs, here.springs)
    turned = None if np.array_equal(there.modes, here.modes) else (there.modes - here.modes) / step
    return Beside(there, step, read / step if abs(read).max() > 0 else None, elements, springs, turned)
