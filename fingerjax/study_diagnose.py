"""What a study says under `diagnose:`, checked against its measurements: conditions held out, and effects that differ between labels."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from .csvfile import same
from .errors import InputError
from .measurements import Measurement
from .spelling import choose_from
from .study_keys import DiagnoseKeys
from .study_records import MEASUREMENT, Diagnose, HeldOut, Reach
from .tidy import LABELS, QUANTITIES
from .units import internal_unit, split_unit, to_internal
from .yamlfile import Origin, located


def read_diagnose(said: DiagnoseKeys, names: Sequence[str], measurements: Sequence[Measurement], origin: Origin) -> Diagnose:
    """Check what was written. `names`: of all measurements of the study, also of those whose data are not there.

    **Raises** `InputError` for a measurement, a column or a value that is not there, and for rows that do not say whose amount of an
    effect they see.
    """
    by_name = {one.name: one for one in measurements}
    held = []
    for index, one in enumerate(said.hold_out):
        with located(origin, "hold_out", index):
            if one.measurement not in names:
                remedy = choose_from(one.measurement, names)
                raise InputError("no such measurement", place="measurement", seen=one.measurement, remedy=remedy)
        if one.measurement in by_name:
            with located(origin, "hold_out", index, "where"):
                held.append(_held_out(by_name[one.measurement], one.where))
    for effect, column in said.per.items():
        if column != MEASUREMENT:
            _check_labels(effect, column, measurements, origin)
    effects = said.effects if isinstance(said.effects, str) else tuple(said.effects)
    form = {"deflection_profile": said.model_error.profile, "force_displacement": said.model_error.force}
    form |= {"spike_rate": said.model_error.rate}
    reach = Reach(said.pairs, said.together)
    return Diagnose(effects, tuple(held), form, said.placement_mm, said.nodes, reach, dict(said.per), tuple(said.without))


def _check_labels(effect: str, column: str, measurements: Sequence[Measurement], origin: Origin) -> None:
    at, where = origin(("per", effect))
    if column not in LABELS:
        raise InputError("no column of labels", file=at, place=where, seen=column, remedy=choose_from(column, [MEASUREMENT, *LABELS]))
    for one in measurements:
        if column not in one.table:
            problem = f"rows of {one.name} do not say their {column}, by which {effect} differs"
            raise InputError(problem, file=at, place=where, remedy=f"add the column to {one.file}, or take {effect} out of diagnose.per")


def _held_out(measurement: Measurement, where: Mapping[str, Any]) -> HeldOut:
    """The condition in internal units. **Raises** `InputError` for a column or a value that the measurement lacks."""
    taken = {}
    for key, wanted in where.items():
        base, unit = split_unit(key)
        if base not in measurement.table:
            raise InputError("no such column", place=key, remedy=choose_from(key, [_with_unit(name) for name in measurement.table]))
        values = list(wanted) if isinstance(wanted, (list, tuple)) else [wanted]
        taken[base] = tuple(_value(measurement.table[base], base, unit, key, value) for value in values)
    return HeldOut(measurement.name, taken)


def _with_unit(name: str) -> str:
    dimension = QUANTITIES.get(name)
    return f"{name}_{internal_unit(dimension)}" if dimension else name


def _value(column: np.ndarray, base: str, unit: str | None, key: str, value: Any) -> float | str:
    present = dict.fromkeys(column.tolist())
    if column.dtype.kind != "f":
        found = next((str(cell) for cell in present if same(str(cell), value)), None)
        if found is None:
            raise InputError("no row has this value", place=key, seen=value, remedy=choose_from(value, map(str, present)))
        return found
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise InputError("not a number", place=key, seen=value, remedy="write a number")
    number = float(to_internal(value, unit, QUANTITIES[base], key))
    if not np.isclose(column, number, rtol=1e-6, atol=1e-9).any():
        shown = ", ".join(f"{cell:g}" for cell in sorted(present))
        raise InputError("no row has this value", place=key, seen=value, remedy=f"rows have: {shown}")
    return number
