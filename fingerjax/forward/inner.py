"""How readings change with an internal force that the model lacks: one linear answer, whatever the force is a function of.

A force f(u) per unit of what is missing moves the free surface and every other reading by - B' K^-1 f(u); the indenter then rests on it as
on any other shift, with the contacts held as they are.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..effects.added import Effects
from ..effects.effect import Effect, Force
from ..fem.body import Body, body
from ..fem.condensed import AbstractCondensed
from ..fem.energy import internal_force
from ..fem.slopes import distinct
from ..fem.stiffness import held_by
from ..fem.tissue import AbstractTissue
from .model import Assembled, Model
from .pressing import Known, settle_with
from .readings import Instruments
from .wiring import Values

Field = Float[Array, "nodes 3"]
BLOCK = 32  # indentations whose answers are looked for at a time


def inner_slopes(model: Model, values: Values, forces: Sequence[Force]) -> Float[Array, "rows d"]:
    """Slopes of every row, measurement after measurement, in amounts of internal forces that the linear model lacks."""
    lames = [material.lame() for material in model.instruments.materials(values)]
    bodies = model.condensed(lames)

    def change(variant: int, condensed: AbstractCondensed, pushed: Float[Array, "k m"]) -> Array:
        once, which = distinct(np.asarray(pushed))
        if len(once) == 0:
            return jnp.zeros((0, len(forces), model.columns.count))
        u = condensed.displacement(jnp.asarray(once))
        found = [condensed.readings(_forces(forces, model.body, lames[variant], u[at : at + BLOCK])) for at in range(0, len(u), BLOCK)]
        return -jnp.concatenate(found).reshape(len(u), len(forces), -1)[which]

    directions = jnp.zeros((len(lames), len(forces), *lames[0].shape))
    known = settle_with(model.instruments.rigs, bodies, directions, change, model.instruments.added, values)
    return slopes_of(model.instruments, known, {name: jnp.asarray(value) for name, value in values.items()}, len(forces))


def first_order(ready: Assembled, values: Values, effects: Sequence[tuple[Effect, float]]) -> Float[np.ndarray, " rows"]:
    """What effects that are known to first order alone add to every row, each so many times the unit of it."""
    body = ready.model.body
    found = [(force, size) for effect, size in effects if (force := effect.force(body, ready.finger, ready.solid)) is not None]
    return np.asarray(inner_slopes(ready.model, values, [force for force, _ in found])) @ np.array([size for _, size in found])


def _forces(
    forces: Sequence[Force], body: Body, lame: Float[Array, "2 layers"], u: Float[Array, "k nodes 3"]
) -> Float[Array, "kd nodes 3"]:
    held = [held_by(body, lame, each) for each in u]
    return jnp.stack([force(lame, each, hold) for each, hold in zip(u, held, strict=True) for force in forces])


@eqx.filter_jit
def slopes_of(instruments: Instruments, known: Known, values: dict[str, Array], count: int) -> Float[Array, "rows d"]:
    """Slopes of every row along the known directions."""

    def readings(share: Float[Array, " d"]) -> Array:
        away = jnp.broadcast_to(share, (len(instruments.variants), count))
        return jnp.concatenate(instruments.read(known, values, away=away).readings)

    return jax.jacfwd(readings)(jnp.zeros(count))


def between(other: Body, step: float) -> Force:
    """What another body's internal force has more, per unit of the `step` to it."""

    def more(lame: Float[Array, "2 layers"], u: Field, held: Field) -> Field:
        return (held_by(other, lame, u) - held) / step

    return more


def of_law(body: Body, law: Callable[[Array], AbstractTissue], null: float) -> Force:
    """Change of the internal force with the one parameter of a law, where that is linear elasticity."""

    def more(lame: Float[Array, "2 layers"], u: Field, held: Field) -> Field:
        return _slope_of_law(body, law, jnp.asarray(null), lame, u)

    return more


@eqx.filter_jit
def _slope_of_law(body: Body, law: Callable, null: Array, lame: Float[Array, "2 layers"], u: Field) -> Field:
    return jax.jvp(lambda size: internal_force(body, law(size), lame, u), (null,), (jnp.ones(()),))[1]


def model_body(ready: Assembled, effects: Effects) -> Body:
    """The body of a study with effects on it, and nothing laid out on it."""
    bone = ready.study.model.bone_kind()
    finger = effects.shape(ready.mesh, ready.solid)
    finger = finger if bone == "elastic" else finger.without_bone()
    return effects.support(body(finger, bone=bone), finger, ready.solid)
