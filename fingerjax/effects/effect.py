"""What an effect is: one thing that a layered linear fingertip under an ideal instrument lacks, with numbers that say how much of it.

An effect acts on one or more of the records that the forward model hands on, each by a method that is left alone where it does nothing:

| record | method | derivative in the effect's numbers |
|---|---|---|
| the meshed finger | `shape` | exact where the skin stays and so do receptors' layers, by differences else |
| an indenter, its poses and the receptor | `place` | of the receptor exact, by differences else |
| elements and supports | `support` | exact |
| tissue law | `law` | exact |
| an internal force alone, to first order | `force` | exact in its size, by differences in all else |
| elastic constants | `material` | exact |
| one push of an indenter | `push` | exact |
| what a receptor feels | `feel` | exact |
| what an instrument or an afferent reads | `read` | exact |

At its null an effect changes nothing, to the last bit.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

from ..fem.body import Body, Material
from ..fem.tissue import AbstractTissue
from ..finger import Finger
from ..geometry.solid import AbstractSolid
from .records import Felt, Measured, Placed, Push, Reading

ACTS_ON = ("finger", "tissue", "support", "contact", "time", "instrument", "afferent")
Amount = Mapping[str, Any]  # the numbers of one effect, by name
Data = Sequence[Measured]
Force = Callable[[Any, Any, Any], Any]  # (Lame parameters, displacement, forces that hold it) -> nodal forces


@dataclass(frozen=True)
class Size:
    """One number of an effect.

    - `name`, `unit`; `null`: where it changes nothing; `scale`: a plausible size, the standard deviation of its prior about the null.
    - `lower`, `upper`: beyond these it is not plausible. `sign`: 1 or -1 where physics allows one side only, 0 for both.
    - `step`: how far to go for its first-order column where the slope at the null vanishes or misleads; None takes the slope.
    """

    name: str
    unit: str
    scale: float
    lower: float
    upper: float
    sign: int = 0
    null: float = 0.0
    step: float | None = None


@dataclass(frozen=True)
class Column:
    """One way into an effect: which of its numbers moves, and where its others stand meanwhile."""

    size: Size
    fixed: Mapping[str, float] = field(default_factory=dict)


class Effect:
    """Base of every effect; what it leaves in a residual and what that is mistaken for is told in two sentences."""

    name: ClassVar[str]
    acts_on: ClassVar[str]
    leaves: ClassVar[str]
    confused_with: ClassVar[str]
    parameters: ClassVar[tuple[Size, ...]]
    grid: ClassVar[Mapping[str, tuple[float, ...]]] = {}  # numbers that mean nothing at the null, and where to try them
    grid_units: ClassVar[Mapping[str, str]] = {}
    comes_with: ClassVar[tuple[str, ...]] = ()  # effects that are there, by an unknown amount, where this one is: intervals count them

    def absent(self, data: Data) -> str | None:
        """Why these measurements cannot show this effect, in words; None where they can."""
        return None

    def unseen(self, data: Data) -> tuple[str, ...]:
        """Those of its numbers that these measurements cannot show, though they show others."""
        return ()

    def lacking(self, finger: Finger) -> str | None:
        """Why this body cannot show this effect, in words: a cylinder has no bone; None where it can."""
        return None

    def columns(self) -> tuple[Column, ...]:
        """Every column by which the effect is looked for: each of its numbers, at each point of its grid."""
        grids: list[dict[str, float]] = [{}]
        for name, values in self.grid.items():
            grids = [{**each, name: value} for each in grids for value in values]
        return tuple(Column(size, each) for each in grids for size in self.parameters)

    def second(self) -> tuple[Column, ...]:
        """Columns of a second term of the same effect, as of a second time of relaxation; none where there is no such thing."""
        return ()

    def null(self) -> dict[str, float]:
        return {size.name: size.null for size in self.parameters} | {name: values[0] for name, values in self.grid.items()}

    @property
    def traced(self) -> bool:
        """Whether all that it does is done in compiled code, with exact derivatives."""
        return not any(self._has(method) for method in ("shape", "place", "support", "law", "force"))

    @property
    def first_order(self) -> bool:
        """Whether all that is known of it is the internal force that a unit of it adds: any size is so many times that. It has
        one number, 0 at its null.
        """
        return self._has("force") and self.inner and not self.reshapes

    @property
    def reshapes(self) -> bool:
        """Whether it changes elements or supports, so that what was factorised without it is of no use."""
        return self._has("shape") or self._has("support")

    @property
    def is_law(self) -> bool:
        """Whether it is a law of the tissue, with an equilibrium to be found anew."""
        return self._has("law")

    @property
    def inner(self) -> bool:
        """Whether all that it does is to add an internal force, linear in the displacement."""
        return not self._has("place") and self.passive

    @property
    def passive(self) -> bool:
        """Whether it leaves the law of the tissue and all that is compiled alone: a force, another body, or other places."""
        return not any(self._has(method) for method in ("law", "material", "push", "feel", "read"))

    def _has(self, method: str) -> bool:
        return getattr(type(self), method) is not getattr(Effect, method)

    def shape(self, finger: Finger, solid: AbstractSolid, amount: Amount) -> Finger:
        """The meshed finger, changed."""
        return finger

    def place(self, placed: Placed, amount: Amount) -> Placed:
        """The indenter, its poses or the receptor, changed."""
        return placed

    def support(self, body: Body, finger: Finger, solid: AbstractSolid, amount: Amount) -> Body:
        """Elements and supports, changed."""
        return body

    def force(self, body: Body, finger: Finger, solid: AbstractSolid) -> Force | None:
        """The internal force (n, 3), N, per unit of the effect at its null: of Lame parameters (2, layers), a displacement (n, 3), mm, and
        the forces (n, 3), N, that hold it in the body without the effect, reactions of supports among them.

        None where another model says it: the difference between two bodies, or a secant where that tells more than the slope at the null.
        """
        return None

    def law(self, law: AbstractTissue, amount: Amount) -> AbstractTissue:
        """The tissue's law, changed."""
        return law

    def material(self, material: Material, amount: Amount) -> Material:
        """Elastic constants, changed."""
        return material

    def push(self, push: Push, amount: Amount) -> Push:
        """One push, changed."""
        return push

    def feel(self, felt: Felt, amount: Amount) -> Felt:
        """What a receptor feels, changed."""
        return felt

    def read(self, reading: Reading, amount: Amount) -> Reading:
        """What an instrument or an afferent reads, changed."""
        return reading
