"""Which rows of a laboratory's table are used, and what each of them says: `every`, joined labels, turned signs, `where` and `drop`.

All of this is done to text, before any number is read: a row that is not used is never judged.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Mapping
from decimal import Decimal, InvalidOperation
from typing import Any

from .csvfile import Table
from .errors import InputError
from .spelling import choose_from
from .tidy import LABELS, QUANTITIES
from .units import split_unit
from .yamlfile import Origin, located

JOINED = " + "
NUMBER = r"\d+(?:\.\d*)?"


def _check_ours(name: str) -> None:
    if split_unit(name)[0] not in (*QUANTITIES, *LABELS):
        raise InputError("not one of our columns", place=name, remedy=choose_from(name, [*QUANTITIES, *LABELS]))


def repeated(table: Table, every: Mapping[str, float | str], origin: Origin) -> Table:
    """The table with a column for each key of `every`."""
    for name in every:
        with located(origin, "every"):
            _check_ours(name)
            if name in table.cells:
                raise InputError("the table has this column itself", place=name, remedy="leave it out of every")
    said = {name: [str(value)] * len(table) for name, value in every.items()}
    return dataclasses.replace(table, cells={**table.cells, **said})


def joined(table: Table, columns: Mapping[str, str | list[str]], origin: Origin) -> tuple[Table, dict[str, str]]:
    """The table with a column for every label that several columns make together, as in trial: [sample, repeat], and for every one that
    is counted the other way or from elsewhere, as in position_mm: -x_mm, 3.2 - x_mm or x_mm - 3.2; and `columns` without lists.
    """
    plain: dict[str, str] = {}
    for ours, theirs in columns.items():
        if isinstance(theirs, str):
            plain[ours] = theirs
            if theirs not in table.cells and (counted := _counted(theirs, table)) is not None:
                table = dataclasses.replace(table, cells={**table.cells, theirs: counted})
            continue
        with located(origin, "columns"):
            if ours not in LABELS or len(theirs) < 2:
                remedy = f"write one column, or join two or more to one of {', '.join(LABELS)}"
                raise InputError("columns are joined to labels only", place=ours, seen=theirs, remedy=remedy)
            name, parts = JOINED.join(theirs), [table.column(one) for one in theirs]
        plain[ours] = name
        table = dataclasses.replace(table, cells={**table.cells, name: [" ".join(cells) for cells in zip(*parts, strict=True)]})
    return table, plain


_OTHERWISE = re.compile(rf"(?:(?P<start>{NUMBER})\s*)?-\s*(?P<turned>\S+)|(?P<column>\S+)\s*-\s*(?P<end>{NUMBER})")


def _counted(said: str, table: Table) -> list[str] | None:
    """The cells of `-x`, `3.2 - x` or `x - 3.2`, with x a column of the table; None where it is not so written."""
    found = _OTHERWISE.fullmatch(said.strip())
    if found is None or (name := found["turned"] or found["column"]) not in table.cells:
        return None
    if found["turned"] is None:
        return [_from(cell, "", "-" + found["end"]) for cell in table.cells[name]]
    return [_from(cell, "-", found["start"] or "0") for cell in table.cells[name]]


def _from(cell: str, sign: str, add: str) -> str:
    """The number of a cell, turned and moved; a cell that is no number as it is, for whoever reads it to refuse."""
    try:
        value = Decimal(cell.strip())
    except InvalidOperation:
        return cell
    return str(Decimal(add) + (-value if sign else value))


def chosen_rows(table: Table, where: Mapping[str, Any], drop: Mapping[str, Any] | list[dict[str, Any]], origin: Origin) -> Table:
    """The rows that `where` takes and `drop` leaves: a row is dropped where all keys of a `drop` fit it."""
    with located(origin, "where"):
        mask = table.matching(where, needed=True)
    for one in drop if isinstance(drop, list) else [drop]:
        with located(origin, "drop"):
            mask &= ~table.matching(one, needed=False) if one else True
    if not mask.any():
        file, place = origin(("where",) if where else ("drop",))
        remedy = "take more rows, or drop fewer"
        raise InputError("no row of the table is left", file=file, place=place, remedy=remedy)
    return table.take(mask)
