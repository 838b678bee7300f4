"""From a laboratory's columns to ours: which of its columns is the depth, and in which unit.

A quantity is found, in this order: by the `columns:` mapping, by a column of its name and a unit
(`depth_um`), by a column of its bare name whose unit is under `units:`. A unit said twice must be said
alike; one never said is an error.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import numpy as np

from .csvfile import Table
from .errors import InputError
from .spelling import choose_from
from .units import ACCEPTED, factor, internal_unit, split_unit, to_internal

QUANTITIES = {
    "depth": "length",
    "distance": "length",
    "deflection": "length",
    "displacement": "length",
    "position": "length",
    "force": "force",
    "rate": "rate",
    "time": "time",
    "sigma": "",  # the dimension of whatever was measured
}
LABELS = ("subject", "condition", "trial", "stimulus")


@dataclasses.dataclass(frozen=True)
class Tidy:
    """A table seen through our names.

    - `table`: the laboratory's own.
    - `columns`: our name, with or without a unit -> the laboratory's column.
    - `units`: the unit of a column (either's name) that does not say it.
    """

    table: Table
    columns: Mapping[str, str] = dataclasses.field(default_factory=dict)
    units: Mapping[str, str] = dataclasses.field(default_factory=dict)

    def check_columns(self) -> None:
        """**Raises** `InputError` where `columns:` has a name that is not ours, or a column that is not in
        the file.
        """
        for ours, theirs in self.columns.items():
            if split_unit(ours)[0] not in (*QUANTITIES, *LABELS):
                remedy = choose_from(ours, [*QUANTITIES, *LABELS])
                raise InputError("not one of our columns", place=ours, remedy=remedy)
            self.table.column(theirs)

    def check_units(self) -> None:
        """**Raises** `InputError` where `units:` names neither a column of the file nor one of ours."""
        known = (
            *self.table.cells,
            *self.columns,
            *(split_unit(name)[0] for name in self.columns),
            *QUANTITIES,
        )
        for name in self.units:
            if name not in known:
                raise InputError(
                    "a unit of no column", place=name, remedy=choose_from(name, dict.fromkeys(known))
                )

    def find(self, quantity: str) -> str | None:
        """The laboratory's column of a quantity or a label, or None.

        **Raises** `InputError` where more than one could be meant.
        """
        mapped = [theirs for ours, theirs in self.columns.items() if split_unit(ours)[0] == quantity]
        named = [name for name in self.table.cells if split_unit(name)[0] == quantity]
        found = mapped or named
        if len(found) > 1:
            remedy = f"say which under `columns:`, as in {quantity}: {found[0]}"
            raise InputError(
                f"more than one column of {quantity}", file=self.table.file, seen=found, remedy=remedy
            )
        return found[0] if found else None

    def needed(self, quantity: str, dimension: str) -> np.ndarray:
        """A column that must be there, (rows,), internal units. **Raises** `InputError` as `optional`, and
        where absent.
        """
        values = self.optional(quantity, dimension)
        if values is None:
            raise self._missing(quantity, dimension)
        return values

    def optional(self, quantity: str, dimension: str) -> np.ndarray | None:
        """A column as float64 (rows,) in internal units, or None where there is none.

        **Raises** `InputError` for a missing, unknown or contradictory unit, and for cells that are no
        finite number.
        """
        name = self.find(quantity)
        if name is None:
            return None
        try:
            unit = self._unit(quantity, name, dimension)
        except InputError as error:
            raise InputError(
                error.problem, file=self.table.file, place=error.place, seen=error.seen, remedy=error.remedy
            ) from None
        return to_internal(self.table.numbers(name), unit, dimension, name)

    def label(self, name: str) -> np.ndarray | None:
        """A column of words (rows,), or None where there is none."""
        found = self.find(name)
        return None if found is None else np.array(self.table.column(found), dtype=str)

    def _unit(self, quantity: str, name: str, dimension: str) -> str:
        ours = next((key for key, theirs in self.columns.items() if theirs == name), quantity)
        said = [self.units.get(name), self.units.get(ours), self.units.get(quantity)]
        said += [split_unit(name)[1], split_unit(ours)[1]]
        units = list(dict.fromkeys(unit for unit in said if unit is not None))
        if len({factor(unit, dimension, name) for unit in units or (None,)}) > 1:
            remedy = f"give column {name!r} one unit; it is converted on reading"
            raise InputError(f"column {name!r} has two units", seen=units, remedy=remedy)
        return units[0]

    def _missing(self, quantity: str, dimension: str) -> InputError:
        file, cells = self.table.file, self.table.cells
        for name in cells:
            if name.startswith(f"{quantity}_") and split_unit(name)[1] is None:
                unit = name.removeprefix(f"{quantity}_")
                problem = f"column {name!r} has a unit that is not one of {dimension}"
                return InputError(
                    problem, file=file, seen=unit, remedy=choose_from(unit, ACCEPTED[dimension])
                )
        wanted = f"{quantity}_{internal_unit(dimension)}"
        remedy = f"{choose_from(wanted, cells)}; name it under `columns:`, as in {wanted}: THEIR_NAME"
        return InputError(f"there is no column {wanted!r}", file=file, remedy=remedy)
