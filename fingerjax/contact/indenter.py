"""Rigid indenters: what is pressed into the skin, seen from below.

Which one?

| shape | for |
|---|---|
| `Line` | a sharp wedge whose tip is too narrow for facets to resolve; its load is a force per length |
| `Point`, `FlatCylinder` | a flat-ended circular probe with a rounded rim |
| `FlatPlate` | a plate larger than the finger |
| `Bar`, `Grating` | one straight ridge, or equal ridges in a row |
| `Step` | two flats joined by half a sinusoid |
| `Sphere`, `Cylinder` | curved probes |
| `Profile` | any measured height over position |
| `Tilted` | any of these, leaning |

The surface of an indenter whose own origin stands at (x0, z0) is `y = Y + h(x - x0, z - z0)` with `h <= 0`
and 0 at its highest point towards +y, the direction in which it is pressed. Shapes that are swept along a
line take `along`, the axis ("x", across the finger, or "z", along it) on which their height does NOT change.
Lengths are in mm.

Edges are circular fillets. Where a wall is steeper than 68 degrees it is a flank, which cannot press towards
+y: `covers` is false.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float

from fingerjax.errors import InputError

Axis = Literal["x", "z"]
Place = Float[ArrayLike, "..."]  # a coordinate in mm, one or many
Height = Float[Array, "..."]
FLANK = math.radians(68.0)  # walls steeper than this are flanks
NOTHING = -1e3  # mm: height where there is no material
STEEPEST_TILT = math.radians(20.0)


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


class Line(AbstractIndenter):
    """A sharp wedge with a flat tip of finite `width`; without one, a line carries no force in a solid."""

    width: Float[Array, ""] = eqx.field(default=0.05, converter=jnp.asarray)
    along: Axis = eqx.field(default="x", static=True)

    def __check_init__(self) -> None:
        _positive(self, "width")
        _axis(self.along)

    def surface(self, x: Place, z: Place) -> Height:
        return jnp.zeros_like(jnp.asarray(x) + z)

    def margin(self, x: Place, z: Place) -> Height:
        return 0.5 * self.width - jnp.abs(_across(self.along, x, z))

    @property
    def feature(self) -> float | None:
        return _smallest(self.width)


class Point(AbstractIndenter):
    """A flat-ended probe of small `radius`, its rim rounded inwards by `edge_radius`."""

    radius: Float[Array, ""] = eqx.field(default=0.25, converter=jnp.asarray)
    edge_radius: Float[Array, ""] = eqx.field(default=0.05, converter=jnp.asarray)

    def __check_init__(self) -> None:
        _rounded(self, "radius", 1.0)

    def surface(self, x: Place, z: Place) -> Height:
        return -_drop(_distance(x, z) - (self.radius - self.edge_radius), self.edge_radius)

    def margin(self, x: Place, z: Place) -> Height:
        return _reach(self.radius, self.edge_radius) - _distance(x, z)

    @property
    def feature(self) -> float | None:
        return _smallest(self.radius, self.edge_radius)

    @property
    def end(self) -> tuple[Height, Height, Height]:
        return _disc(_reach(self.radius, self.edge_radius))


class FlatCylinder(AbstractIndenter):
    """A flat-ended cylinder of `radius`, its rim rounded inwards by `edge_radius`."""

    radius: Float[Array, ""] = eqx.field(converter=jnp.asarray)
    edge_radius: Float[Array, ""] = eqx.field(default=0.0, converter=jnp.asarray)

    def __check_init__(self) -> None:
        _rounded(self, "radius", 1.0)

    def surface(self, x: Place, z: Place) -> Height:
        return -_drop(_distance(x, z) - (self.radius - self.edge_radius), self.edge_radius)

    def margin(self, x: Place, z: Place) -> Height:
        return _reach(self.radius, self.edge_radius) - _distance(x, z)

    @property
    def feature(self) -> float | None:
        return _smallest(self.radius, self.edge_radius)

    @property
    def end(self) -> tuple[Height, Height, Height]:
        return _disc(_reach(self.radius, self.edge_radius))


class FlatPlate(AbstractIndenter):
    """A plane without end."""

    def surface(self, x: Place, z: Place) -> Height:
        return jnp.zeros_like(jnp.asarray(x) + z)

    def margin(self, x: Place, z: Place) -> Height:
        return jnp.full_like(jnp.asarray(x) + z, -NOTHING)

    @property
    def feature(self) -> float | None:
        return None


class Bar(AbstractIndenter):
    """A rectangular bar of overall `width`, its two edges rounded inwards by `edge_radius`."""

    width: Float[Array, ""] = eqx.field(default=3.0, converter=jnp.asarray)
    edge_radius: Float[Array, ""] = eqx.field(default=0.0, converter=jnp.asarray)
    along: Axis = eqx.field(default="x", static=True)

    def __check_init__(self) -> None:
        _rounded(self, "width", 0.5)
        _axis(self.along)

    def surface(self, x: Place, z: Place) -> Height:
        s = jnp.abs(_across(self.along, x, z))
        return -_drop(s - (0.5 * self.width - self.edge_radius), self.edge_radius)

    def margin(self, x: Place, z: Place) -> Height:
        return _reach(0.5 * self.width, self.edge_radius) - jnp.abs(_across(self.along, x, z))

    @property
    def feature(self) -> float | None:
        return _smallest(self.width, self.edge_radius)


class Grating(AbstractIndenter):
    """Ridges with grooves between them that are deeper than skin reaches, a ridge centred on the origin.

    With one `ridge` and one `groove` width they repeat without end; with (n,) ridges and (n - 1,) grooves
    they follow one another towards +s, the first ridge on the origin.
    """

    ridge: Float[Array, "*n"] = eqx.field(converter=jnp.asarray)
    groove: Float[Array, "*m"] = eqx.field(converter=jnp.asarray)
    edge_radius: Float[Array, ""] = eqx.field(default=0.0, converter=jnp.asarray)
    along: Axis = eqx.field(default="x", static=True)

    def __check_init__(self) -> None:
        _rounded(self, "ridge", 0.5)
        _positive(self, "groove")
        _axis(self.along)

    def _past_edge(self, x: Place, z: Place) -> Height:
        """Distance past the nearest ridge's side, negative on a ridge."""
        s = _across(self.along, x, z)
        if self.ridge.ndim == 0:
            period = self.ridge + self.groove
            return jnp.abs(s - period * jax.lax.stop_gradient(jnp.round(s / period))) - 0.5 * self.ridge
        centre = jnp.concatenate(
            [jnp.zeros(1), jnp.cumsum(0.5 * (self.ridge[:-1] + self.ridge[1:]) + self.groove)]
        )
        return jnp.min(jnp.abs(s[..., None] - centre) - 0.5 * self.ridge, axis=-1)  # ... points, ridges

    def surface(self, x: Place, z: Place) -> Height:
        return -_drop(self._past_edge(x, z) + self.edge_radius, self.edge_radius)

    def margin(self, x: Place, z: Place) -> Height:
        return _reach(0.0, self.edge_radius) - self._past_edge(x, z)

    @property
    def feature(self) -> float | None:
        return (
            None
            if _traced(self.ridge, self.groove)
            else _smallest(*map(np.min, (self.ridge, self.groove)), self.edge_radius)
        )


class Step(AbstractIndenter):
    """Two flats `amplitude` apart, joined by half a sinusoid `wavelength`/2 long and centred on the origin.

        h(s) = -amplitude/2 (1 + sin(2 pi s / wavelength))    for |s| <= wavelength/4

    The high flat (h = 0) is the proximal one, s < 0 (Dandekar et al. 2003, the steps of Figs. 12 and 13).
    """

    amplitude: Float[Array, ""] = eqx.field(converter=jnp.asarray)
    wavelength: Float[Array, ""] = eqx.field(converter=jnp.asarray)
    along: Axis = eqx.field(default="x", static=True)

    def __check_init__(self) -> None:
        _positive(self, "amplitude", "wavelength")
        _axis(self.along)

    def _phase(self, x: Place, z: Place) -> Height:
        return 2.0 * math.pi * _across(self.along, x, z) / self.wavelength

    def surface(self, x: Place, z: Place) -> Height:
        phase = jnp.clip(self._phase(x, z), -0.5 * math.pi, 0.5 * math.pi)
        return -0.5 * self.amplitude * (1.0 + jnp.sin(phase))

    def margin(self, x: Place, z: Place) -> Height:
        # |h'| = pi amplitude/wavelength |cos(phase)| exceeds tan 68 deg only within arccos(...) of the middle
        # of a steep step.
        steepest = jnp.maximum(math.pi * self.amplitude / self.wavelength, math.tan(FLANK))
        half = (
            jnp.arccos(jnp.minimum(math.tan(FLANK) / steepest, 1.0 - 1e-15))
            * self.wavelength
            / (2.0 * math.pi)
        )
        outside = jnp.abs(_across(self.along, x, z)) - half
        return jnp.where(steepest > math.tan(FLANK), outside, -NOTHING)

    @property
    def feature(self) -> float | None:
        return None if _smallest(self.wavelength) is None else 0.25 * float(self.wavelength)


class Sphere(AbstractIndenter):
    """A ball of `radius`; its sides steeper than 68 degrees are flanks."""

    radius: Float[Array, ""] = eqx.field(converter=jnp.asarray)

    def __check_init__(self) -> None:
        _positive(self, "radius")

    def surface(self, x: Place, z: Place) -> Height:
        return -_drop(_distance(x, z), self.radius)

    def margin(self, x: Place, z: Place) -> Height:
        return self.radius * math.sin(FLANK) - _distance(x, z)

    @property
    def feature(self) -> float | None:
        return _smallest(self.radius)


class Cylinder(AbstractIndenter):
    """A round bar of `radius` lying in the x-z plane, its axis `along` x or z."""

    radius: Float[Array, ""] = eqx.field(converter=jnp.asarray)
    along: Axis = eqx.field(default="x", static=True)

    def __check_init__(self) -> None:
        _positive(self, "radius")
        _axis(self.along)

    def surface(self, x: Place, z: Place) -> Height:
        return -_drop(jnp.abs(_across(self.along, x, z)), self.radius)

    def margin(self, x: Place, z: Place) -> Height:
        return self.radius * math.sin(FLANK) - jnp.abs(_across(self.along, x, z))

    @property
    def feature(self) -> float | None:
        return _smallest(self.radius)


class Profile(AbstractIndenter):
    """A measured height over position, straight between its points and swept along the other axis.

    `position` (n,) in mm, strictly increasing; `elevation` (n,) in mm, counted towards +y and shifted so that
    its top is 0. Pieces steeper than 68 degrees are flanks; there is no material beyond the ends.
    """

    position: Float[Array, " n"] = eqx.field(converter=jnp.asarray)
    elevation: Float[Array, " n"] = eqx.field(converter=jnp.asarray)
    along: Axis = eqx.field(default="x", static=True)

    def __check_init__(self) -> None:
        _axis(self.along)
        if self.position.ndim != 1 or self.position.shape != self.elevation.shape or self.position.size < 2:
            raise InputError(
                "a profile needs two or more positions and as many heights",
                place="position, elevation",
                seen=(self.position.shape, self.elevation.shape),
            )
        if not _traced(self.position) and np.any(np.diff(np.asarray(self.position)) <= 0):
            raise InputError("positions of a profile must increase", place="position", remedy="sort the rows")

    def surface(self, x: Place, z: Place) -> Height:
        s = _across(self.along, x, z)
        return jnp.interp(s, self.position, self.elevation) - jnp.max(self.elevation)

    def margin(self, x: Place, z: Place) -> Height:
        s = _across(self.along, x, z)
        left, right = self.position[:-1], self.position[1:]
        steep = jnp.abs(jnp.diff(self.elevation)) > math.tan(FLANK) * (right - left)
        past = jnp.maximum(left - s[..., None], s[..., None] - right)  # ... points, pieces
        clear = jnp.min(jnp.where(steep, past, -NOTHING), axis=-1)
        return jnp.minimum(clear, jnp.minimum(s - self.position[0], self.position[-1] - s))

    @property
    def feature(self) -> float | None:
        return None if _traced(self.position) else float(np.min(np.diff(np.asarray(self.position))))


class Tilted(AbstractIndenter):
    """Another shape that leans by small angles in rad about its own origin.

        h(x, z) = shape(x, z) + tan(roll) x + tan(pitch) z

    `pitch` lifts its distal end into the skin, `roll` its +x end. A plane is leaned exactly; of other shapes the rotation's second order
    is left out, so that a leaning of 5 degrees misplaces what stands 1 mm off the origin by some 4 micrometres. Edges stay where they are
    in the x-z plane. The origin, not the highest point, has the shape's own height.
    """

    shape: AbstractIndenter
    pitch: Float[Array, ""] = eqx.field(default=0.0, converter=jnp.asarray)
    roll: Float[Array, ""] = eqx.field(default=0.0, converter=jnp.asarray)

    def __check_init__(self) -> None:
        for name in ("pitch", "roll"):
            angle = getattr(self, name)
            if not _traced(angle) and not abs(float(angle)) <= STEEPEST_TILT:
                remedy = f"give -{STEEPEST_TILT:.3g} to {STEEPEST_TILT:.3g} rad"
                raise InputError("an indenter cannot lean so far", place=name, seen=float(angle), remedy=remedy)
        if isinstance(self.shape, Line):
            raise InputError("a line has no width to lean with", place="shape", remedy="tilt a bar or a profile instead")

    def surface(self, x: Place, z: Place) -> Height:
        return self.shape.surface(x, z) + jnp.tan(self.roll) * x + jnp.tan(self.pitch) * z

    def margin(self, x: Place, z: Place) -> Height:
        return self.shape.margin(x, z)

    @property
    def feature(self) -> float | None:
        return self.shape.feature

    @property
    def end(self) -> tuple[Height, Height, Height] | None:
        return self.shape.end


def from_spec(
    shape: str,
    dimensions: Mapping[str, float],
    along: str = "x",
    lists: Mapping[str, Sequence[float]] | None = None,
) -> AbstractIndenter:
    """The indenter that a sidecar names.

    **Arguments:**

    - `shape`: one of `SHAPES`.
    - `dimensions`: its lengths in mm by name, without units (`radius`, `width`, `edge_radius`, `amplitude`,
      ...).
    - `along`: "x" or "z", the axis on which a swept shape's height does not change; round shapes ignore it.
    - `lists`: `position` and `height` of a profile, or `ridge` and `groove` of a grating that does not
      repeat, in mm.

    **Raises:** `InputError` for an unknown shape, an unknown, missing or impossible dimension.
    """
    if shape not in SHAPES:
        raise InputError(
            "unknown indenter shape", place="shape", seen=shape, remedy=f"use one of {', '.join(SHAPES)}"
        )
    kind, required, optional = SHAPES[shape]
    said: dict[str, object] = {name: float(value) for name, value in dimensions.items()}
    said.update({name: np.asarray(values, float) for name, values in (lists or {}).items()})
    for name in said:
        if name not in required + optional:
            allowed = ", ".join(required + optional) or "no dimensions"
            raise InputError(f"a {shape} has no such dimension", place=name, remedy=f"it takes {allowed}")
    for name in required:
        if name not in said:
            raise InputError(f"a {shape} needs its {name}", place=name, remedy=f"add {name}")
    if shape == "profile":
        said["elevation"] = said.pop("height")
    return kind(**said, along=along) if shape in SWEPT else kind(**said)


SHAPES: dict[str, tuple[Callable[..., AbstractIndenter], tuple[str, ...], tuple[str, ...]]] = {
    "line": (Line, (), ("width",)),
    "point": (Point, ("radius",), ("edge_radius",)),
    "flat_plate": (FlatPlate, (), ()),
    "bar": (Bar, ("width",), ("edge_radius",)),
    "step": (Step, ("amplitude", "wavelength"), ()),
    "sphere": (Sphere, ("radius",), ()),
    "cylinder": (Cylinder, ("radius",), ()),
    "flat_cylinder": (FlatCylinder, ("radius",), ("edge_radius",)),
    "grating": (Grating, ("ridge", "groove"), ("edge_radius",)),
    "profile": (Profile, ("position", "height"), ()),
}
SWEPT = ("line", "bar", "step", "cylinder", "grating", "profile")


def _across(along: Axis, x: Place, z: Place) -> Height:
    """The coordinate on which a shape swept along `along` changes."""
    x, z = jnp.broadcast_arrays(jnp.asarray(x), jnp.asarray(z))
    return z if along == "x" else x


def _distance(x: Place, z: Place) -> Height:
    """Distance from the axis, with slope 0 rather than NaN on it."""
    square = jnp.square(jnp.asarray(x)) + jnp.square(jnp.asarray(z))
    return jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1.0)), 0.0)


def _disc(radius: Float[Array, ""]) -> tuple[Height, Height, Height]:
    """Points and weights of a rule on a disc, exact to degree 7: four rings of Gauss's points in the radius squared, eight to the turn."""
    node, weight = np.polynomial.legendre.leggauss(4)
    ring, turn = np.sqrt(0.5 * (1.0 + node)), 2.0 * math.pi * (np.arange(8) + 0.5) / 8
    share = np.repeat(0.5 * weight, 8) / 8
    return radius * np.outer(ring, np.cos(turn)).ravel(), radius * np.outer(ring, np.sin(turn)).ravel(), math.pi * radius**2 * share


def _drop(distance: Height, radius: Float[Array, ""]) -> Height:
    """Depth of a circular fillet `distance` past its start, constant from the flank on; 0 if sharp."""
    d = jnp.clip(distance, 0.0, radius * math.sin(FLANK))
    root = jnp.sqrt(jnp.where(radius > 0, radius * radius - d * d, 1.0))
    return jnp.where(radius > 0, d * d / jnp.where(radius > 0, radius + root, 1.0), 0.0)


def _reach(half_width: Float[ArrayLike, ""], edge_radius: Float[Array, ""]) -> Float[Array, ""]:
    """Distance from the middle at which the fillet turns into a flank."""
    return jnp.asarray(half_width) - edge_radius * (1.0 - math.sin(FLANK))


def _traced(*values: object) -> bool:
    return any(isinstance(value, jax.core.Tracer) for value in values)


def _smallest(*lengths: Any) -> float | None:
    return None if _traced(*lengths) else min(float(length) for length in lengths if float(length) > 0)


def _positive(shape: AbstractIndenter, *names: str) -> None:
    for name in names:
        value = getattr(shape, name)
        if not _traced(value) and not np.min(np.asarray(value)) > 0:
            remedy = "give a length above 0 mm"
            raise InputError(f"{name} of an indenter must be positive", place=name, seen=float(np.min(value)), remedy=remedy)


def _rounded(shape: AbstractIndenter, size: str, share: float) -> None:
    """Check a size and the edge radius that must fit into `share` of it."""
    _positive(shape, size)
    width, edge = (getattr(shape, name) for name in (size, "edge_radius"))
    if _traced(width, edge) or np.ndim(edge):
        return
    room = share * float(np.min(np.asarray(width)))
    if not 0.0 <= float(edge) <= room * (1.0 + 1e-12):
        limit = f"give 0 to {room:g} mm"
        raise InputError(
            "edge_radius does not fit the indenter", place="edge_radius", seen=float(edge), remedy=limit
        )


def _axis(along: str) -> None:
    if along not in ("x", "z"):
        raise InputError("an indenter runs along x or z", place="along", seen=along, remedy="write x or z")
