"""What effects are handed on the way from a push to a reading. All arrays are in mm, N, MPa, s and Hz."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..contact.shape import AbstractIndenter
from ..measure.receptor import Receptor


@runtime_checkable
class Measured(Protocol):
    """What effects look at in a measurement to tell whether it could show them."""

    def __len__(self) -> int: ...
    @property
    def kind(self) -> str: ...
    @property
    def controlled(self) -> str: ...
    @property
    def table(self) -> Mapping[str, np.ndarray]: ...
    @property
    def indenters(self) -> Mapping[str, Any]: ...


@dataclass(frozen=True)
class Placed:
    """One indenter of one measurement, before there is a mesh.

    - `origins` (poses, 2): where it stands, (x, z) mm. `deeper`, `along`: mm by which the receptor lies below and distal of its place.
    """

    indenter: AbstractIndenter
    origins: np.ndarray
    kind: str
    deeper: float = 0.0
    along: float = 0.0


class Context(eqx.Module):
    """What the rows of one indenter of one measurement say of themselves.

    - `table`: every column of numbers, by name without unit, (rows,).
    - `order` (rows,): rows by trace, and in each by time; `previous` (rows,): the row before in the same trace, itself for a first one.
    """

    table: dict[str, Float[Array, " r"]]
    order: Int[Array, " r"]
    previous: Int[Array, " r"]
    trace: Int[Array, " r"]
    measurement: str = eqx.field(static=True)
    kind: str = eqx.field(static=True)
    forced: bool = eqx.field(static=True)

    @property
    def first(self) -> Bool[Array, " r"]:
        return self.previous == jnp.arange(len(self.previous))

    def step(self, given: Float[Array, " r"]) -> Float[Array, " r"]:
        """What was added since the row before; nothing in a first row."""
        return given - given[self.previous]

    def speed(self, given: Float[Array, " r"]) -> Float[Array, " r"]:
        """What was added since the row before, per second; nothing in a first row."""
        span = self.step(self.table["time"])
        return jnp.where(span > 0, self.step(given) / jnp.where(span > 0, span, 1.0), 0.0)

    def since_start(self) -> Float[Array, " r"]:
        """Seconds since the trace began: at its clock's zero, unless the first row is later after that than the trace is long, as by the
        clock of a session; then at the first row. Traces of one instant, as rates under conditions that are named after their times, are
        asked together whether their clocks begin at zero.
        """
        time = self.table["time"]
        first = jnp.full(len(self.trace), jnp.inf).at[self.trace].min(time)[self.trace]
        last = jnp.full(len(self.trace), -jnp.inf).at[self.trace].max(time)[self.trace]
        instant = first == last
        earliest = jnp.where(instant, jnp.min(time, where=instant, initial=jnp.inf), first)
        latest = jnp.where(instant, jnp.max(time, where=instant, initial=-jnp.inf), last)
        return time - jnp.where((earliest >= 0) & (earliest <= latest - earliest), 0.0, first)

    def fading(self, given: Float[Array, " r"], time: Float[Array, ""], *, from_rest: bool) -> Float[Array, " r"]:
        """What is left of a quantity's changes when each of them fades as exp(-t/time); linear between rows.

        `from_rest`: the first row of a trace was reached in one step from zero; otherwise it had been there for ever.
        """
        span = self.step(self.table["time"]) / time
        # The mean of exp(-s) over the ramp of the last row.
        mean = jnp.where(span > 1e-6, -jnp.expm1(-span) / jnp.where(span > 1e-6, span, 1.0), 1 - span / 2)
        new = jnp.where(self.first, given if from_rest else 0.0, self.step(given) * mean)

        def row(left: Array, each: tuple[Array, ...]) -> tuple[Array, Array]:
            keep, added, first = each
            left = jnp.where(first, 0.0, left) * keep + added
            return left, left

        ordered = tuple(part[self.order] for part in (jnp.exp(-span), new, self.first))
        _, left = jax.lax.scan(row, jnp.zeros(()), ordered)
        return jnp.zeros_like(given).at[self.order].set(left)

    def retreating(self) -> Float[Array, " r"]:
        """1 where the travel is less than in the row before, else 0."""
        return (self.step(self.table["displacement"]) < 0).astype(float)


class Push(eqx.Module):
    """One push of an indenter.

    - `imposed`: mm of travel, or N of force where `context.forced`. `overlap` (k,), mm^3: what each hat of the skin is in the way.
    - `area` (k,), mm^2, of each hat. `series`: compliance of the apparatus, mm/N.
    """

    imposed: Float[Array, ""]
    overlap: Float[Array, " k"]
    area: Float[Array, " k"]
    series: Float[Array, ""]
    forced: bool = eqx.field(static=True)
    measurement: str = eqx.field(static=True)


class Felt(eqx.Module):
    """The receptor quantity of every row, MPa or a strain, and the state of strain and stress behind it."""

    quantity: Float[Array, " r"]
    receptor: Receptor
    context: Context


class Reading(eqx.Module):
    """What is read in every row, in the measurement's own unit, under the contact force (rows,), N, and travel (rows,), mm.

    `growth` (rows,): mm^2 of contact that each mm of travel adds, or each N where the force is imposed.
    """

    value: Float[Array, " r"]
    force: Float[Array, " r"]
    travel: Float[Array, " r"]
    growth: Float[Array, " r"]
    context: Context

    @property
    def is_force(self) -> bool:
        return self.context.kind == "force_displacement" and not self.context.forced
