"""The indenter and the supports that skin slides on rub: to first order, Coulomb's friction against the way the skin slides without it.

    t = - mu p u_t / |u_t|

A sliding surface that is drawn along does work, so rubbing stiffens: at a given travel d the force grows by mu/d times the integral of
p |u_t|. Where the skin would stick instead this is too much: sizes beyond some tenths say "much", not how much. Nothing is remembered of
the way, so that a withdrawn indenter rubs as if it were going in.
"""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..fem.body import Body
from ..fem.operator import Lame
from ..finger import Finger
from ..geometry.solid import AbstractSolid
from .effect import Effect, Force, Size

STILL = 1e-2  # share of the farthest slide below which rubbing fades: its way is not known where nothing slides


class Friction(Effect):
    name = "friction"
    acts_on = "contact"
    leaves = "Wide and flat indenters meet more force, the more the wider they are beside what they squeeze; sharp ones notice nothing."
    confused_with = "finite_strain, contact_offset, indenter_tilt, skin_poisson."
    parameters = (Size("coefficient", "1", 0.3, 0.0, 1.0, sign=1),)

    def force(self, body: Body, finger: Finger, solid: AbstractSolid) -> Force:
        """What holds the skin back where it slides under pressure, N, per unit of the coefficient."""

        def drag(lame: Lame, u: Float[Array, "nodes 3"], held: Float[Array, "nodes 3"]) -> Float[Array, "nodes 3"]:
            return _drag(body, u, held)

        return drag


@eqx.filter_jit
def _drag(body: Body, u: Float[Array, "nodes 3"], held: Float[Array, "nodes 3"]) -> Float[Array, "nodes 3"]:
    moves = jnp.broadcast_to(body.moves, u.shape)
    slides = u * moves * jnp.array([1.0, 0.0, 1.0])
    size = jnp.linalg.norm(slides, axis=1)
    # An indenter pushes towards +y; a support on which tissue slides pushes inwards.
    height = body.nodes[:, 1]
    against = jnp.where((moves[:, 1] == 0) & (height > jnp.mean(height)), -1.0, 1.0)
    pressed = against * held[:, 1]
    farthest = jnp.max(size)
    return (pressed / jnp.sqrt(size**2 + (STILL * jnp.where(farthest > 0, farthest, 1.0)) ** 2))[:, None] * slides
