"""Chebyshev smoothing of the errors that a coarser level cannot see."""

from __future__ import annotations

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from .groups import Groups
from .krylov import Field
from .operator import Lame

Reach = tuple[int, float]  # degree and width of a polynomial


class Smoother(eqx.Module):
    """Chebyshev polynomial of the stiffness preconditioned by its strong groups (Adams, Brezina, Hu & Tuminaro, 2003).

    It acts on eigenvalues from the largest down to the largest over `width`, and costs `degree` products with the stiffness.
    """

    groups: Groups
    inverse: Float[Array, "g b b"]
    largest: Float[Array, ""]
    degree: int = eqx.field(static=True)
    width: float = eqx.field(static=True)

    def __call__(self, operate: Callable[[Field], Field], load: Field, start: Field | None) -> Field:
        """Approximate `K^-1 load` from `start` (zero where None); the same polynomial before and after keeps the cycle symmetric."""
        upper, lower = 1.1 * self.largest, self.largest / self.width
        theta, delta = (upper + lower) / 2, (upper - lower) / 2
        u = jnp.zeros_like(load) if start is None else start
        r = load if start is None else load - operate(start)

        def advance(_: Int[Array, ""] | int, state: tuple) -> tuple:
            u, r, d, rho = state
            u, r = u + d, r - operate(d)
            following = 1 / (2 * theta / delta - rho)
            return u, r, following * rho * d + (2 * following / delta) * self._scale(r), following

        u, _, d, _ = jax.lax.fori_loop(0, self.degree - 1, advance, (u, r, self._scale(r) / theta, delta / theta))
        return u + d

    def _scale(self, r: Field) -> Field:
        return self.groups.apply(self.inverse, r)


def smoother(groups: Groups, operate: Callable[[Field], Field], lame: Lame, precision: type, reach: Reach) -> Smoother:
    """Inverse groups, and the largest eigenvalue of the preconditioned stiffness by a dozen power steps."""
    inverse = groups.inverse(lame).astype(precision)

    def step(v: Field, _: None) -> tuple[Field, Float[Array, ""]]:
        w = groups.apply(inverse, operate(v))
        size = jnp.linalg.norm(w)
        return w / size, size

    start = jax.random.normal(jax.random.key(0), (groups.slot.shape[0], 3), precision)
    start = jnp.where((groups.slot < groups.members.size)[:, None], start, jnp.zeros((), precision))
    _, sizes = jax.lax.scan(step, start / jnp.linalg.norm(start), None, length=12)
    return Smoother(groups, inverse, sizes[-1], *reach)
