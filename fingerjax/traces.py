"""What is done to recorded traces before they are measurements: zero at first `contact`, read `at` fewer places, repeats made `alike`.

A trace is the rows that share every label, in the order of time where that was recorded and of the table where not.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from .errors import InputError
from .spelling import choose_from
from .tidy import LABELS, QUANTITIES
from .units import internal_unit, split_unit, to_internal

Columns = dict[str, np.ndarray]
MOVED = ("displacement", "depth")


def traces(table: Mapping[str, np.ndarray]) -> Iterator[tuple[str, np.ndarray]]:
    """The name of every trace, and its rows in order."""
    length = len(next(iter(table.values())))
    labels = [table[name].astype(str) for name in LABELS if name in table]
    which = np.zeros(length, int)
    if labels:
        _, which = np.unique(np.column_stack(labels), axis=0, return_inverse=True)
        which = which.reshape(-1)
    order = np.lexsort((table.get("time", np.arange(length)), which))
    for number in range(int(which.max()) + 1):
        rows = order[which[order] == number]
        yield ", ".join(str(each[rows[0]]) for each in labels) or "the whole table", rows


def from_contact(table: Columns, rows: np.ndarray, said: Mapping[str, float]) -> tuple[Columns, np.ndarray]:
    """Displacement and time counted from first contact: where force, or displacement, last rises through a value before its largest.

    Rows from before contact, and from after the indenter has left the skin, are dropped. **Arguments:** `rows`: the line in the file of
    each row; `said`: the column and the value, as in force_mN: 0.05.
    """
    name, level = _one(said, table, ("force", *MOVED))
    moved = [each for each in MOVED if each in table]
    if not moved:
        raise InputError("nothing was moved into contact", place=name, remedy="take contact: out, or give a column of displacement")
    found, kept = {key: np.array(each) for key, each in table.items()}, []
    for trace, own in traces(table):
        values = table[name][own]
        top = int(np.argmax(values))
        below = np.flatnonzero(values[: top + 1] < level)
        if len(below) == 0 or values[top] < level:
            seen = f"{values.min():g} to {values.max():g} {internal_unit(QUANTITIES[name])} in {trace}"
            problem = "a trace does not come into contact: it does not rise through this value"
            raise InputError(problem, place=name, seen=seen, remedy="choose a value that every trace rises through")
        last = int(below[-1])
        share = (level - values[last]) / (values[last + 1] - values[last])
        for column in [*moved, *({"time"} & set(table))]:
            here = table[column][own]
            found[column][own] = here - (here[last] + share * (here[last + 1] - here[last]))
        after = own[last + 1 :]
        kept.append(after[found[moved[0]][after] >= 0])
    chosen = np.sort(np.concatenate(kept))
    return {key: each[chosen] for key, each in found.items()}, rows[chosen]


def read_at(table: Columns, rows: np.ndarray, said: Mapping[str, Sequence[float]]) -> tuple[Columns, np.ndarray]:
    """Every trace read, by straight lines between its rows, where a column that only rises has the values that are `said`."""
    name, wanted = _one(said, table, tuple(QUANTITIES))
    at = np.atleast_1d(np.asarray(wanted, float))
    if len(at) == 0 or (np.diff(at) <= 0).any():
        raise InputError("not values that rise", place=name, seen=at.tolist(), remedy="write them in order, each once")
    parts: list[Columns] = []
    lines = []
    for trace, own in traces(table):
        along = table[name][own]
        if (np.diff(along) <= 0).any():
            problem = f"{name} does not only rise in {trace}, so that it does not say where a trace is to be read"
            raise InputError(problem, place=name, remedy="say where by time, or take fewer rows with where:")
        low, high = along[0], along[-1]
        if at[0] < low or at[-1] > high:
            seen, remedy = f"{at[0]:g} to {at[-1]:g}", f"{trace} goes from {low:g} to {high:g} {internal_unit(QUANTITIES[name])}"
            raise InputError("a trace does not go so far", place=name, seen=seen, remedy=remedy)
        nearest = np.abs(along[:, None] - at[None, :]).argmin(axis=0)
        numbers = {key: np.interp(at, along, each[own]) for key, each in table.items() if _is_number(each)}
        texts = {key: each[own][nearest] for key, each in table.items() if not _is_number(each)}
        parts.append({**numbers, **texts, name: at})
        lines.append(rows[own][nearest])
    return {key: np.concatenate([part[key] for part in parts]) for key in table}, np.concatenate(lines)


def made_alike(table: Columns, said: Mapping[str, float], value: str) -> Columns:
    """Rows that differ in nothing but their trial, what was measured (`value`) and, by no more than is `said`, in these columns: they are
    repeats of one setting, and have its mean there.
    """
    limits = {}
    for key, most in said.items():
        name, limit = _one({key: most}, table, tuple(each for each in QUANTITIES if each not in (value, "sigma")))
        if limit <= 0:
            raise InputError("not a difference", place=key, seen=most, remedy="write what repeats differ by at most, above 0")
        limits[name] = limit
    apart = [each for name, each in table.items() if name not in (value, "sigma", "trial", *limits)]
    groups = [np.unique(each, return_inverse=True)[1].reshape(-1) for each in apart]
    for name, limit in limits.items():
        groups.append(_near(table[name], _numbered(groups, len(table[value])), limit))
    setting = _numbered(groups, len(table[value]))
    count = np.bincount(setting)
    return {name: np.bincount(setting, each)[setting] / count[setting] if name in limits else each for name, each in table.items()}


def _numbered(groups: Sequence[np.ndarray], length: int) -> np.ndarray:
    if not groups:
        return np.zeros(length, int)
    return np.unique(np.column_stack(groups), axis=0, return_inverse=True)[1].reshape(-1)


def _near(values: np.ndarray, group: np.ndarray, limit: float) -> np.ndarray:
    """(rows,) numbers of the sets, within each group, whose values lie within `limit` of their least; the least ones are taken first."""
    order = np.lexsort((values, group))
    found, number = np.zeros(len(values), int), -1
    first, of = -np.inf, -1
    for row in order:
        if group[row] != of or values[row] - first > limit * (1 + 1e-12):
            number, first, of = number + 1, values[row], group[row]
        found[row] = number
    return found


def _is_number(column: np.ndarray) -> bool:
    return bool(np.issubdtype(column.dtype, np.number))


def _one(said: Mapping[str, float] | Mapping[str, Sequence[float]], table: Mapping[str, np.ndarray], allowed: Sequence[str]) -> tuple:
    """(our column, what is said of it in internal units) of a key with a unit."""
    if len(said) != 1:
        raise InputError("one column is needed here", seen=list(said), remedy="write one name with its unit and its value")
    key, value = next(iter(said.items()))
    name, unit = split_unit(str(key))
    there = [each for each in allowed if each in table]
    if name not in there:
        raise InputError("no such column", place=str(key), remedy=choose_from(name, there))
    number = to_internal(value, unit, QUANTITIES[name], str(key))
    return name, float(number) if number.ndim == 0 else number
