"""Force and travel were recorded on two clocks, one of them started later than the other."""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp
from jaxtyping import Array, Float

from .effect import Amount, Effect, Size
from .needs import timed_force
from .records import Context, Reading


class ClockOffset(Effect):
    """The force of a row is that of `delay` earlier, by straight lines between the rows of its trace; before the first, that of the first.

    A filter (force_lag) rounds every corner of the force; this leaves corners as sharp as they are, in the wrong place.
    """

    name = "clock_offset"
    acts_on = "instrument"
    leaves = "Force goes on rising when travel has stopped, and begins to fall when withdrawal is well under way; long holds are right."
    confused_with = "force_lag, relaxation with a short time."
    parameters = (Size("delay", "s", 0.05, -0.15, 0.15),)
    absent = staticmethod(timed_force)

    def read(self, reading: Reading, amount: Amount) -> Reading:
        if not reading.is_force or "time" not in reading.context.table:
            return reading
        return dataclasses.replace(reading, value=_earlier(reading.context, reading.value, jnp.asarray(amount["delay"], float)))


def _earlier(context: Context, value: Float[Array, " r"], delay: Float[Array, ""]) -> Float[Array, " r"]:
    """What was read `delay` before each row, in its own trace."""
    time, trace = context.table["time"], context.trace
    begins = trace.astype(time.dtype) * (2 * (jnp.max(time) - jnp.min(time)) + 1.0)  # traces one after the other on one axis
    first = jnp.full(len(time), jnp.inf).at[trace].min(time)[trace]
    last = jnp.full(len(time), -jnp.inf).at[trace].max(time)[trace]
    then = time - delay
    asked = begins + jnp.where(then <= first, first, jnp.where(then >= last, last, then))
    at = (begins + time)[context.order]
    ordered = value[context.order]
    after = jnp.clip(jnp.searchsorted(at, asked, side="left"), 0, len(at) - 1)
    before = jnp.maximum(after - 1, 0)
    span = at[after] - at[before]
    share = jnp.where(span > 0, (at[after] - asked) / jnp.where(span > 0, span, 1.0), 0.0)
    return ordered[after] - share * (ordered[after] - ordered[before])
