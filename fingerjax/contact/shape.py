"""What an indenter is to the skin: a surface and a margin; and the lengths, fillets and checks that shapes share."""

from __future__ import annotations

import math
from abc import abstractmethod
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float

from ..errors import InputError

Axis = Literal["x", "z"]
Place = Float[ArrayLike, "..."]  # a coordinate in mm, one or many
Height = Float[Array, "..."]
FLANK = math.radians(68.0)  # walls steeper than this are flanks
NOTHING = -1e3  # mm: height where there is no material


class AbstractIndenter(eqx.Module):
    """A rigid shape given by its `surface` and its `margin`; the rest follows from the two."""

    @abstractmethod
    def surface(self, x: Place, z: Place) -> Height:
        """Height in mm, at most 0, carried on past the edge at the edge's own height, for quadrature."""

    @abstractmethod
    def margin(self, x: Place, z: Place) -> Height:
        """Distance in mm, in the x-z plane, to the nearest edge: positive where material can touch."""

    @property
    @abstractmethod
    def feature(self) -> float | None:
        """The smallest length in mm that a mesh should resolve, or None where nothing is small."""

    @property
    def end(self) -> tuple[Height, Height, Height] | None:
        """Points x and z (m,) in mm all over the flat end of a probe, and the area (m,) in mm^2 that each stands for; None where a shape
        has no end that could be smaller than an element.
        """
        return None

    def covers(self, x: Place, z: Place) -> Bool[Array, "..."]:
        """Whether there is material at (x, z) that can touch."""
        return self.margin(x, z) >= 0.0

    def height(self, x: Place, z: Place) -> Height:
        """Height h in mm, at most 0; -1000 where nothing can touch."""
        return jnp.where(self.covers(x, z), self.surface(x, z), NOTHING)


def across(along: Axis, x: Place, z: Place) -> Height:
    """The coordinate on which a shape swept along `along` changes."""
    x, z = jnp.broadcast_arrays(jnp.asarray(x), jnp.asarray(z))
    return z if along == "x" else x


def distance(x: Place, z: Place) -> Height:
    """Distance from the axis, with slope 0 rather than NaN on it."""
    square = jnp.square(jnp.asarray(x)) + jnp.square(jnp.asarray(z))
    return jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1.0)), 0.0)


def disc(radius: Float[Array, ""]) -> tuple[Height, Height, Height]:
    """Points and weights of a rule on a disc, exact to degree 7: four rings of Gauss's points in the radius squared, eight to the turn."""
    node, weight = np.polynomial.legendre.leggauss(4)
    ring, turn = np.sqrt(0.5 * (1.0 + node)), 2.0 * math.pi * (np.arange(8) + 0.5) / 8
    share = np.repeat(0.5 * weight, 8) / 8
    return radius * np.outer(ring, np.cos(turn)).ravel(), radius * np.outer(ring, np.sin(turn)).ravel(), math.pi * radius**2 * share


def drop(distance: Height, radius: Float[Array, ""]) -> Height:
    """Depth of a circular fillet `distance` past its start, constant from the flank on; 0 if sharp."""
    d = jnp.clip(distance, 0.0, radius * math.sin(FLANK))
    root = jnp.sqrt(jnp.where(radius > 0, radius * radius - d * d, 1.0))
    return jnp.where(radius > 0, d * d / jnp.where(radius > 0, radius + root, 1.0), 0.0)


def reach(half_width: Float[ArrayLike, ""], edge_radius: Float[Array, ""]) -> Float[Array, ""]:
    """Distance from the middle at which the fillet turns into a flank."""
    return jnp.asarray(half_width) - edge_radius * (1.0 - math.sin(FLANK))


def traced(*values: object) -> bool:
    """Whether any is a placeholder of JAX's, of which nothing can be checked."""
    return any(isinstance(value, jax.core.Tracer) for value in values)


def smallest(*lengths: Any) -> float | None:
    """The smallest length above 0, mm."""
    return None if traced(*lengths) else min(float(length) for length in lengths if float(length) > 0)


def check_positive(shape: AbstractIndenter, *names: str) -> None:
    """**Raises:** `InputError` for a length that is not above 0."""
    for name in names:
        value = getattr(shape, name)
        if not traced(value) and not np.min(np.asarray(value)) > 0:
            remedy = "give a length above 0 mm"
            raise InputError(f"{name} of an indenter must be positive", place=name, seen=float(np.min(value)), remedy=remedy)


def check_rounded(shape: AbstractIndenter, size: str, share: float) -> None:
    """**Raises:** `InputError` for a size that is not above 0, and for an edge radius that does not fit into `share` of it."""
    check_positive(shape, size)
    width, edge = (getattr(shape, name) for name in (size, "edge_radius"))
    if traced(width, edge) or np.ndim(edge):
        return
    room = share * float(np.min(np.asarray(width)))
    if not 0.0 <= float(edge) <= room * (1.0 + 1e-12):
        limit = f"give 0 to {room:g} mm"
        raise InputError("edge_radius does not fit the indenter", place="edge_radius", seen=float(edge), remedy=limit)


def check_axis(along: str) -> None:
    """**Raises:** `InputError` for what is no axis."""
    if along not in ("x", "z"):
        raise InputError("an indenter runs along x or z", place="along", seen=along, remedy="write x or z")
