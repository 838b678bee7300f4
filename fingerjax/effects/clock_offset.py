"""Force and travel were recorded on two clocks, one of them started later than the other."""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from .effect import Amount, Effect, Size
from .needs import timed_force
from .records import Context, Reading


class ClockOffset(Effect):
    """The force of a row is that of `delay` earlier, by monotone cubics between the rows of its trace (Fritsch & Butland 1984, SIAM J. Sci.
    Stat. Comput. 5, 300), which have a slope everywhere and add no bumps; before the first row it is that of the first.

    Channels that were started by hand, or saved apart, are some tenths of a second from each other. A filter (force_lag) rounds every
    corner of the force; this leaves corners as sharp as they are, in the wrong place.
    """

    name = "clock_offset"
    acts_on = "instrument"
    leaves = "Force goes on rising when travel has stopped, and begins to fall when withdrawal is well under way; long holds are right."
    confused_with = "force_lag, relaxation with a short time."
    parameters = (Size("delay", "s", 0.1, -0.3, 0.3),)
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
    at, ordered = (begins + time)[context.order], value[context.order]
    after = jnp.clip(jnp.searchsorted(at, asked, side="left"), 1, len(at) - 1)
    return _between(at, ordered, _slopes(at, ordered, trace[context.order]), asked, after - 1, after)


def _slopes(at: Float[Array, " r"], value: Float[Array, " r"], trace: Int[Array, " r"]) -> Float[Array, " r"]:
    """Of the monotone cubics at their ends: the weighted harmonic mean of the secants on either side, nothing where these differ in sign,
    and the one secant where a trace begins or ends.
    """
    gap = jnp.diff(at)
    inside = (jnp.diff(trace) == 0) & (gap > 0)
    secant = jnp.where(inside, jnp.diff(value) / jnp.where(inside, gap, 1.0), 0.0)
    left, right = (jnp.pad(inside, pad) for pad in ((1, 0), (0, 1)))
    before, behind = jnp.pad(secant, (1, 0)), jnp.pad(secant, (0, 1))
    short, long = jnp.pad(gap, (1, 0)), jnp.pad(gap, (0, 1))
    alike = left & right & (before * behind > 0)
    one, other = long + long + short, long + short + short
    mean = (one + other) / (one / jnp.where(alike, before, 1.0) + other / jnp.where(alike, behind, 1.0))
    return jnp.where(alike, mean, jnp.where(left & right, 0.0, before + behind))


def _between(
    at: Float[Array, " r"],
    value: Float[Array, " r"],
    slope: Float[Array, " r"],
    asked: Float[Array, " m"],
    before: Int[Array, " m"],
    after: Int[Array, " m"],
) -> Float[Array, " m"]:
    """Hermite's cubics."""
    gap = at[after] - at[before]
    length = jnp.where(gap > 0, gap, 1.0)
    s = jnp.where(gap > 0, (asked - at[before]) / length, 1.0)
    ends = value[after] - value[before]
    bend = length * (slope[before] * (1 - s) - slope[after] * s) - ends * (1 - 2 * s)
    return value[before] + s * ends + s * (1 - s) * bend
