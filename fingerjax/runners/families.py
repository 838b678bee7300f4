"""Effects of the catalogue as the loop knows them: families of columns."""

from __future__ import annotations

from ..effects import Effect
from ..effects.effect import Column as Way
from ..effects.effect import Data
from ..loop.subject import Column, Family

REACH = 3.0  # plausible sizes from the null to the bounds


def family(effect: Effect, data: Data) -> Family:
    """An effect's columns, without those that the data cannot show."""
    unseen = effect.unseen(data)
    columns = tuple(_column(effect, way) for way in effect.columns() if way.size.name not in unseen)
    more = tuple(_column(effect, way) for way in effect.second() if way.size.name not in unseen)
    said = (effect.acts_on, effect.leaves, effect.confused_with)
    return Family(effect.name, columns, *said, more, dear=effect.is_law, comes_with=effect.comes_with)


def _column(effect: Effect, way: Way) -> Column:
    size = way.size
    return Column(
        family=effect.name,
        name=size.name,
        unit=size.unit,
        scale=size.scale,
        lower=max(size.lower, size.null - REACH * size.scale),
        upper=min(size.upper, size.null + REACH * size.scale),
        null=size.null,
        sign=size.sign,
        step=size.step,
        fixed=dict(way.fixed),
    )


def agree(one: Column, other: Column) -> bool:
    """Whether two columns may be awake together: of one effect, only at the same point of its grid."""
    return one.family != other.family or all(other.fixed.get(name, value) == value for name, value in one.fixed.items())
