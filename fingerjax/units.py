"""The door for units: every outside number becomes mm, N, MPa, s, rad or Hz here, and nowhere else.

A unit is said by the end of a column's name (`force_gf`) or by a sidecar, and is converted by pint. What may
be written is listed in `ACCEPTED`, because pint understands far more than a laboratory means: to pint `px`
is 1/96 inch.
"""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
import pint

from .errors import InputError
from .spelling import choose_from

# The first unit of each dimension is the internal one.
ACCEPTED: dict[str, tuple[str, ...]] = {
    "length": ("mm", "um", "µm", "cm", "m", "inch"),
    "force": ("N", "mN", "uN", "kN", "gf", "kgf"),
    "pressure": ("MPa", "kPa", "Pa", "GPa", "N/mm^2", "N/m^2"),
    "time": ("s", "ms", "us", "min", "h"),
    "angle": ("rad", "deg"),
    "rate": ("Hz", "kHz", "ips", "impulses/s", "spikes/s", "1/s"),
    "speed": ("mm/s", "um/s", "cm/s", "m/s"),
    "stiffness": ("N/mm", "N/m", "mN/mm", "gf/mm"),
    "foundation": ("MPa/mm", "kPa/mm", "N/mm^3"),
    "gain": ("Hz/MPa", "Hz/kPa", "Hz/Pa"),
    "pixel": ("px",),
    "number": ("1", "-", "%"),
}
_SPELLED = {"ips": "Hz", "impulses/s": "Hz", "spikes/s": "Hz", "-": "1", "%": "percent", "px": "1"}
_SUFFIXES = {unit for units in ACCEPTED.values() for unit in units if unit.isalpha()}


@functools.cache
def _registry() -> pint.UnitRegistry:
    return pint.UnitRegistry()


def internal_unit(dimension: str) -> str:
    """The unit used inside for a dimension: `length` -> `mm`. KeyError for a dimension that is not in
    `ACCEPTED`.
    """
    return ACCEPTED[dimension][0]


def dimension_of(unit: str) -> str | None:
    """Which dimension a unit belongs to: `gf` -> `force`; None for one that is not accepted."""
    return next((dimension for dimension, units in ACCEPTED.items() if unit in units), None)


def split_unit(column: str) -> tuple[str, str | None]:
    """Cut the unit off a name: `force_gf` -> (`force`, `gf`), `subject` -> (`subject`, None).

    Only accepted units are cut off, so `depth_furlong` keeps its whole name and has no unit.
    """
    name, _, unit = column.rpartition("_")
    return (name, unit) if name and unit in _SUFFIXES else (column, None)


@functools.cache
def _factor(unit: str, internal: str) -> float:
    quantity = _registry().Quantity(1.0, _SPELLED.get(unit, unit))
    return float(quantity.to(_SPELLED.get(internal, internal)).magnitude)


def factor(unit: str | None, dimension: str, column: str = "value") -> float:
    """How many internal units one `unit` is: `factor("gf", "force")` is 9.80665e-3 (N).

    **Raises** `InputError` naming `column` and the accepted units, where the unit is missing, not
    understood, or of another dimension.
    """
    allowed = ACCEPTED[dimension]
    if unit is None or unit == "":
        raise InputError(
            f"column {column!r} has no unit",
            remedy=f"end its name with one (as in {column}_{allowed[0]}) or say it under `units:`; "
            f"accepted for a {dimension}: {', '.join(allowed)}",
        )
    if unit not in allowed:
        problem = f"column {column!r} has a unit that is not one of {dimension}"
        raise InputError(problem, seen=unit, remedy=choose_from(unit, allowed))
    return _factor(unit, allowed[0])


def to_internal(values: Any, unit: str | None, dimension: str, column: str = "value") -> np.ndarray:
    """Turn outside numbers into internal ones.

    **Arguments:**

    - `values`: a number or an array of any shape, in `unit`.
    - `unit`: what they are in: one of `ACCEPTED[dimension]`.
    - `dimension`: what is needed: a key of `ACCEPTED`.
    - `column`: the name to put into the message.

    **Returns** a float64 array of the same shape, in `internal_unit(dimension)`.

    **Raises** `InputError` as `factor` does.
    """
    return np.asarray(np.asarray(values, dtype=np.float64) * factor(unit, dimension, column))


def read_quantity(text: object, dimension: str, column: str = "value") -> float:
    """A number with its unit as a person writes it, `"17 GPa"`, in internal units; without a unit it is
    internal.

    **Raises** `InputError` where there is no finite number, or its unit is not one of the dimension.
    """
    if isinstance(text, (int, float)) and not isinstance(text, bool):
        return float(text)
    number, _, unit = str(text).strip().partition(" ")
    try:
        value = float(number)
        if not np.isfinite(value):
            raise ValueError
    except ValueError:
        remedy = f"write a number, or a number and its unit: 1.0 {internal_unit(dimension)}"
        raise InputError(f"{column!r} is not a quantity", seen=text, remedy=remedy) from None
    return value * factor(unit.strip(), dimension, column) if unit else value
