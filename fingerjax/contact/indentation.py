"""Press a rigid indenter into a linear body: condensed compliance and geometry in, pressure and force out."""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from fingerjax.contact.complementarity import complementary, held
from fingerjax.contact.footprint import Interface

# Share of the force that would close a hat's gap, at which area is read off: with it Hertz's contact radius
# on 2 to 5 facet edges is right to 1 % wherever the mesh lies (1 would put it an eighth of an edge too
# small).
CLOSING = 0.45
# The same where contact is held at nodes, whose forces are gathered at vertices and so spread by half an edge.
CLOSING_AT_NODES = 0.85


class Contact(eqx.Module):
    """An indenter at rest on the skin.

    `pressure` (h,) in MPa, one for each hat; `nodal_forces` (p,) in N along +y on the pad nodes; `force` in
    N; `travel` in mm from first contact; `area` in mm^2, in the x-z plane, smooth in the travel;
    `peak_pressure` in MPa, the largest `recovered` one; `active` (k,) hats in contact and `gap` (k,) mean gap
    in mm over each, or both of nodes where contact is held there (`nodal`); `steps` solves; `settled`,
    whether contact was decided; `reached_edge`, whether what bears pressure on the border of the pad says
    that a larger pad is needed.
    """

    pressure: Float[Array, " h"]
    nodal_forces: Float[Array, " p"]
    force: Float[Array, ""]
    travel: Float[Array, ""]
    area: Float[Array, ""]
    peak_pressure: Float[Array, ""]
    active: Bool[Array, " k"]
    gap: Float[Array, " k"]
    steps: Int[Array, ""]
    settled: Bool[Array, ""]
    reached_edge: Bool[Array, ""]


def press(
    compliance_pp: Float[Array, "p p"],
    interface: Interface,
    *,
    travel: Float[Array, ""] | float | None = None,
    force: Float[Array, ""] | float | None = None,
    start: Bool[Array, " k"] | None = None,
    series: Float[Array, ""] | float = 0.0,
    sharp: Float[Array, ""] | float = 0.0,
    glued: bool = False,
    max_steps: int = 500,
) -> Contact:
    """Press to a `travel` in mm from first contact, or with a `force` in N (exactly one of the two).

    `compliance_pp` in mm/N takes forces along +y on the pad nodes to their displacements along +y. `start` is
    the active set of a neighbouring contact; `series` mm/N what the apparatus gives way, as part of the
    travel; `sharp` mm^2/N the skin's `line.sharp_compliance`, by which it gives way under the tip of a line
    beyond what the mesh shows: 0 leaves that out. With `glued` the displacement is prescribed wherever the
    undeformed skin would be overlapped, as under a line of prescribed displacement; travel must then be
    given.

    **Raises:** `ValueError` unless exactly one of travel and force is given.
    """
    between = interface.load.T @ compliance_pp @ interface.load
    return press_hats(
        between,
        interface,
        travel=travel,
        force=force,
        start=start,
        series=series,
        sharp=sharp,
        glued=glued,
        max_steps=max_steps,
    )


def press_hats(
    between: Float[Array, "k k"],
    interface: Interface,
    *,
    travel: Float[Array, ""] | float | None = None,
    force: Float[Array, ""] | float | None = None,
    start: Bool[Array, " k"] | None = None,
    series: Float[Array, ""] | float = 0.0,
    sharp: Float[Array, ""] | float = 0.0,
    glued: bool = False,
    max_steps: int = 500,
) -> Contact:
    """`press` where the answer of hats to hats is at hand: `between` = load' C load, mm^3 of gap under each per MPa on each."""
    if (travel is None) == (force is None) or (glued and travel is None):
        raise ValueError("give press() either travel= or force=, and travel= when glued")
    present = interface.area > 0
    area = jnp.where(present, interface.area, 1.0)
    # Unknowns are hat forces and mean gaps: newtons and millimetres, whatever the size of a hat.
    compliance = between / (area[:, None] * area)
    compliance = 0.5 * (compliance + compliance.T) + series
    if interface.narrow is not None:
        compliance = compliance + jnp.diag(sharp * interface.narrow)
    overlap = jnp.where(present, interface.overlap / area, -1e3)
    if glued and travel is not None:
        found = held(compliance, overlap, travel)
    else:
        travel, force = (None if value is None else jnp.asarray(value, float) for value in (travel, force))
        found = complementary(
            compliance, overlap, present, travel=travel, force=force, start=start, max_steps=max_steps
        )
    closing = CLOSING if interface.gathered is None else CLOSING_AT_NODES
    pull = found.force - closing * found.gap / jnp.where(present, jnp.diagonal(compliance), 1.0)
    if interface.gathered is None:
        pressure, pull = found.force / area, jnp.where(present, pull / area, jnp.nan)
    else:
        bears = jnp.any((interface.gathered > 0) & present, axis=1)
        pressure, pull = interface.gathered @ found.force, jnp.where(bears, interface.gathered @ pull, jnp.nan)
    return Contact(
        pressure=pressure,
        nodal_forces=interface.load @ (found.force / area),
        force=jnp.sum(found.force),
        travel=found.travel,
        area=_area(interface, pull),
        peak_pressure=jnp.max(recovered(interface, pressure)),
        active=found.active,
        gap=found.gap,
        steps=found.steps,
        settled=found.settled,
        reached_edge=jnp.any(found.active & interface.rim),
    )


def recovered(interface: Interface, pressure: Float[Array, " k"]) -> Float[Array, " k"]:
    """Pressure in MPa at the vertices, from the one of each hat: half of it and half of the mean pressure over the hat.

    A sum of hats that comes nearest to a pressure with a curvature lies above its summit, on a regular lattice by as much as the means
    over the hats lie below it. So half of both is exact for a quadratic pressure; and a ripple from hat to hat is halved.
    """
    at, corners = pressure[interface.pieces], interface.pieces.shape[1]
    share = interface.covered[:, None] / corners
    zero = jnp.zeros_like(pressure)
    whole = zero.at[interface.pieces].add(jnp.broadcast_to(share, at.shape))
    total = zero.at[interface.pieces].add(share * (at + jnp.sum(at, axis=1, keepdims=True)) / (corners + 1))
    mean = total / jnp.where(whole > 0, whole, 1.0)
    return jnp.where(whole > 0, 0.5 * (pressure + mean), pressure)


def _area(interface: Interface, pull: Float[Array, " k"]) -> Float[Array, ""]:
    """Area in mm^2 in contact: where the piecewise linear function through `pull` is positive.

    `pull` is a hat's pressure where it touches and, where it does not, minus a share of the pressure that
    would close its gap: it grows with travel through 0 as a hat comes into contact, so the area changes
    smoothly. NaN marks a hat that is off the indenter; the skin beside it goes with its neighbours.
    """
    at = pull[interface.pieces]
    at = jnp.where(jnp.isnan(at), jnp.max(jnp.where(jnp.isnan(at), -jnp.inf, at), axis=1, keepdims=True), at)
    at = jnp.where(jnp.isfinite(at), at, -1.0)
    return jnp.sum(interface.covered * (_positive_length(at) if at.shape[1] == 2 else _positive_area(at)))


def _positive_length(at: Float[Array, "r 2"]) -> Float[Array, " r"]:
    """Share of a segment on which a linear function with these end values is positive."""
    high, low = jnp.max(at, axis=1), jnp.min(at, axis=1)
    mixed = (high > 0) & (low < 0)
    return jnp.where(
        mixed,
        high / jnp.where(mixed, high - low, 1.0),
        jnp.where(low >= 0, jnp.where(high > 0, 1.0, 0.0), 0.0),
    )


def _positive_area(at: Float[Array, "r 3"]) -> Float[Array, " r"]:
    """Share of a triangle on which a linear function with these corner values is positive."""
    low, middle, high = jnp.sort(at, axis=1).T
    one, two = (middle <= 0) & (high > 0), (low < 0) & (middle > 0)
    tip = high * high / jnp.where(one, (high - low) * (high - middle), 1.0)
    missing = low * low / jnp.where(two, (high - low) * (middle - low), 1.0)
    return jnp.where(one, tip, jnp.where(two, 1.0 - missing, jnp.where((low >= 0) & (high > 0), 1.0, 0.0)))
