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
from collections.abc import Callable, Mapping, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..errors import InputError
from .shape import (
    FLANK,
    NOTHING,
    AbstractIndenter,
    Axis,
    Height,
    Place,
    across,
    check_axis,
    check_positive,
    check_rounded,
    disc,
    distance,
    drop,
    reach,
    smallest,
    traced,
)

STEEPEST_TILT = math.radians(20.0)


class Line(AbstractIndenter):
    """A sharp wedge with a flat tip of finite `width`; without one, a line carries no force in a solid."""

    width: Float[Array, ""] = eqx.field(default=0.05, converter=jnp.asarray)
    along: Axis = eqx.field(default="x", static=True)

    def __check_init__(self) -> None:
        check_positive(self, "width")
        check_axis(self.along)

    def surface(self, x: Place, z: Place) -> Height:
        return jnp.zeros_like(jnp.asarray(x) + z)

    def margin(self, x: Place, z: Place) -> Height:
        return 0.5 * self.width - jnp.abs(across(self.along, x, z))

    @property
    def feature(self) -> float | None:
        return smallest(self.width)


class Point(AbstractIndenter):
    """A flat-ended probe of small `radius`, its rim rounded inwards by `edge_radius`."""

    radius: Float[Array, ""] = eqx.field(default=0.25, converter=jnp.asarray)
    edge_radius: Float[Array, ""] = eqx.field(default=0.05, converter=jnp.asarray)

    def __check_init__(self) -> None:
        check_rounded(self, "radius", 1.0)

    def surface(self, x: Place, z: Place) -> Height:
        return -drop(distance(x, z) - (self.radius - self.edge_radius), self.edge_radius)

    def margin(self, x: Place, z: Place) -> Height:
        return reach(self.radius, self.edge_radius) - distance(x, z)

    @property
    def feature(self) -> float | None:
        return smallest(self.radius, self.edge_radius)

    @property
    def end(self) -> tuple[Height, Height, Height]:
        return disc(reach(self.radius, self.edge_radius))


class FlatCylinder(AbstractIndenter):
    """A flat-ended cylinder of `radius`, its rim rounded inwards by `edge_radius`."""

    radius: Float[Array, ""] = eqx.field(converter=jnp.asarray)
    edge_radius: Float[Array, ""] = eqx.field(default=0.0, converter=jnp.asarray)

    def __check_init__(self) -> None:
        check_rounded(self, "radius", 1.0)

    def surface(self, x: Place, z: Place) -> Height:
        return -drop(distance(x, z) - (self.radius - self.edge_radius), self.edge_radius)

    def margin(self, x: Place, z: Place) -> Height:
        return reach(self.radius, self.edge_radius) - distance(x, z)

    @property
    def feature(self) -> float | None:
        return smallest(self.radius, self.edge_radius)

    @property
    def end(self) -> tuple[Height, Height, Height]:
        return disc(reach(self.radius, self.edge_radius))


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
        check_rounded(self, "width", 0.5)
        check_axis(self.along)

    def surface(self, x: Place, z: Place) -> Height:
        s = jnp.abs(across(self.along, x, z))
        return -drop(s - (0.5 * self.width - self.edge_radius), self.edge_radius)

    def margin(self, x: Place, z: Place) -> Height:
        return reach(0.5 * self.width, self.edge_radius) - jnp.abs(across(self.along, x, z))

    @property
    def feature(self) -> float | None:
        return smallest(self.width, self.edge_radius)


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
        check_rounded(self, "ridge", 0.5)
        check_positive(self, "groove")
        check_axis(self.along)

    def _past_edge(self, x: Place, z: Place) -> Height:
        """Distance past the nearest ridge's side, negative on a ridge."""
        s = across(self.along, x, z)
        if self.ridge.ndim == 0:
            period = self.ridge + self.groove
            return jnp.abs(s - period * jax.lax.stop_gradient(jnp.round(s / period))) - 0.5 * self.ridge
        centre = jnp.concatenate(
            [jnp.zeros(1), jnp.cumsum(0.5 * (self.ridge[:-1] + self.ridge[1:]) + self.groove)]
        )
        return jnp.min(jnp.abs(s[..., None] - centre) - 0.5 * self.ridge, axis=-1)  # ... points, ridges

    def surface(self, x: Place, z: Place) -> Height:
        return -drop(self._past_edge(x, z) + self.edge_radius, self.edge_radius)

    def margin(self, x: Place, z: Place) -> Height:
        return reach(0.0, self.edge_radius) - self._past_edge(x, z)

    @property
    def feature(self) -> float | None:
        return (
            None
            if traced(self.ridge, self.groove)
            else smallest(*map(np.min, (self.ridge, self.groove)), self.edge_radius)
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
        check_positive(self, "amplitude", "wavelength")
        check_axis(self.along)

    def _phase(self, x: Place, z: Place) -> Height:
        return 2.0 * math.pi * across(self.along, x, z) / self.wavelength

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
        outside = jnp.abs(across(self.along, x, z)) - half
        return jnp.where(steepest > math.tan(FLANK), outside, -NOTHING)

    @property
    def feature(self) -> float | None:
        return None if smallest(self.wavelength) is None else 0.25 * float(self.wavelength)


class Sphere(AbstractIndenter):
    """A ball of `radius`; its sides steeper than 68 degrees are flanks."""

    radius: Float[Array, ""] = eqx.field(converter=jnp.asarray)

    def __check_init__(self) -> None:
        check_positive(self, "radius")

    def surface(self, x: Place, z: Place) -> Height:
        return -drop(distance(x, z), self.radius)

    def margin(self, x: Place, z: Place) -> Height:
        return self.radius * math.sin(FLANK) - distance(x, z)

    @property
    def feature(self) -> float | None:
        return smallest(self.radius)


class Cylinder(AbstractIndenter):
    """A round bar of `radius` lying in the x-z plane, its axis `along` x or z."""

    radius: Float[Array, ""] = eqx.field(converter=jnp.asarray)
    along: Axis = eqx.field(default="x", static=True)

    def __check_init__(self) -> None:
        check_positive(self, "radius")
        check_axis(self.along)

    def surface(self, x: Place, z: Place) -> Height:
        return -drop(jnp.abs(across(self.along, x, z)), self.radius)

    def margin(self, x: Place, z: Place) -> Height:
        return self.radius * math.sin(FLANK) - jnp.abs(across(self.along, x, z))

    @property
    def feature(self) -> float | None:
        return smallest(self.radius)


class Profile(AbstractIndenter):
    """A measured height over position, straight between its points and swept along the other axis.

    `position` (n,) in mm, strictly increasing; `elevation` (n,) in mm, counted towards +y and shifted so that
    its top is 0. Pieces steeper than 68 degrees are flanks; there is no material beyond the ends.
    """

    position: Float[Array, " n"] = eqx.field(converter=jnp.asarray)
    elevation: Float[Array, " n"] = eqx.field(converter=jnp.asarray)
    along: Axis = eqx.field(default="x", static=True)

    def __check_init__(self) -> None:
        check_axis(self.along)
        if self.position.ndim != 1 or self.position.shape != self.elevation.shape or self.position.size < 2:
            raise InputError(
                "a profile needs two or more positions and as many heights",
                place="position, elevation",
                seen=(self.position.shape, self.elevation.shape),
            )
        if not traced(self.position) and np.any(np.diff(np.asarray(self.position)) <= 0):
            raise InputError("positions of a profile must increase", place="position", remedy="sort the rows")

    def surface(self, x: Place, z: Place) -> Height:
        s = across(self.along, x, z)
        return jnp.interp(s, self.position, self.elevation) - jnp.max(self.elevation)

    def margin(self, x: Place, z: Place) -> Height:
        s = across(self.along, x, z)
        left, right = self.position[:-1], self.position[1:]
        steep = jnp.abs(jnp.diff(self.elevation)) > math.tan(FLANK) * (right - left)
        past = jnp.maximum(left - s[..., None], s[..., None] - right)  # ... points, pieces
        clear = jnp.min(jnp.where(steep, past, -NOTHING), axis=-1)
        return jnp.minimum(clear, jnp.minimum(s - self.position[0], self.position[-1] - s))

    @property
    def feature(self) -> float | None:
        return None if traced(self.position) else float(np.min(np.diff(np.asarray(self.position))))


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
            if not traced(angle) and not abs(float(angle)) <= STEEPEST_TILT:
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
