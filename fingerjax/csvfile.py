"""Tables as laboratories keep them: CSV, UTF-8, one row per observation, `#` comment lines allowed.

Cells stay text until a column is asked for as numbers, so a row that is not used is never judged.
"""

from __future__ import annotations

import csv
import dataclasses
import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from .errors import InputError
from .spelling import choose_from
from .yamlfile import read_text

_NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?")


@dataclasses.dataclass(frozen=True)
class Table:
    """The cells of a table.

    - `file`: where they were read from; None for rows written into a study.
    - `cells`: text of every column, by its name in the file.
    - `rows`: the number of the line of each row in the file, from 1.
    """

    file: Path | None
    cells: dict[str, list[str]]
    rows: list[int]

    def __len__(self) -> int:
        return len(self.rows)

    def column(self, name: str) -> list[str]:
        """The text of a column. **Raises** `InputError` naming the nearest column where there is none of
        that name.
        """
        if name not in self.cells:
            raise InputError(
                f"there is no column {name!r}", file=self.file, remedy=choose_from(name, self.cells)
            )
        return self.cells[name]

    def refuse(self, index: int, column: str, problem: str, remedy: str) -> InputError:
        """The refusal of one cell: file, line, column, what is in it."""
        at = f"row {self.rows[index]}, column {column!r}"
        return InputError(problem, file=self.file, place=at, seen=self.cells[column][index], remedy=remedy)

    def numbers(self, name: str) -> np.ndarray:
        """A column as float64. **Raises** `InputError` for a cell that is empty, no number, or not finite."""
        cells = self.column(name)
        bad = next((index for index, cell in enumerate(cells) if not _is_number(cell)), None)
        if bad is not None:
            raise self.refuse(bad, name, *_what_is_wrong(cells[bad]))
        return np.array([float(cell) for cell in cells], dtype=np.float64)

    def matching(self, wanted: Mapping[str, Any], *, needed: bool) -> np.ndarray:
        """Which rows have the wanted value, or one of a list of them, in every column named.

        **Raises** `InputError` for a column that is not there and, where `needed`, for a value that no row
        has.
        """
        mask = np.ones(len(self), dtype=bool)
        for name, values in wanted.items():
            cells = self.column(name)
            hits = np.zeros(len(self), dtype=bool)
            for value in values if isinstance(values, (list, tuple)) else [values]:
                hit = np.array([same(cell, value) for cell in cells], dtype=bool)
                if needed and not hit.any():
                    raise InputError(
                        f"no row has this value in column {name!r}",
                        file=self.file,
                        seen=value,
                        remedy=choose_from(value, dict.fromkeys(cells)),
                    )
                hits |= hit
            mask &= hits
        return mask

    def take(self, mask: np.ndarray) -> Table:
        """The rows where `mask` is true."""
        kept = np.flatnonzero(mask)
        cells = {name: [column[index] for index in kept] for name, column in self.cells.items()}
        return Table(self.file, cells, [self.rows[index] for index in kept])


def same(cell: str, value: object) -> bool:
    """Whether a cell holds a value: the same text, or the same number (`1` is `1.0`)."""
    text = str(value).strip()
    if cell == text:
        return True
    return _is_number(cell) and _is_number(text) and math.isclose(float(cell), float(text), rel_tol=1e-9)


def _is_number(cell: str) -> bool:
    return _NUMBER.fullmatch(cell) is not None and math.isfinite(float(cell))


def _what_is_wrong(cell: str) -> tuple[str, str]:
    if cell == "":
        return "a number is missing", "fill it in, or leave the row out with `drop:` or a # before it"
    if cell.lower().lstrip("+-") in ("nan", "inf", "infinity", "na", "n/a", "null", "none"):
        return "a finite number is needed", "leave the row out with `drop:` or a # before it"
    return "not a number", "write it with a decimal point and no unit, as in 0.25"


def read_table(file: Path) -> Table:
    """Read a CSV file.

    **Raises** `InputError` with file and line: not there, not UTF-8, empty, no rows, a column without a name
    or with a name twice, a row with more or fewer cells than the header.
    """
    numbered = [(number, line) for number, line in enumerate(read_text(file).splitlines(), start=1)]
    kept = [(number, line) for number, line in numbered if line.strip() and not line.lstrip().startswith("#")]
    if not kept:
        remedy = "write a line of column names and one row per observation"
        raise InputError("the file is empty", file=file, remedy=remedy)
    reader = csv.reader((line for _, line in kept), skipinitialspace=True)
    header = _header(file, kept[0][0], [name.strip() for name in next(reader)])
    rows: list[int] = []
    cells: dict[str, list[str]] = {name: [] for name in header}
    for row in reader:
        rows.append(kept[reader.line_num - 1][0])
        _check_length(file, rows[-1], row, header)
        for name, cell in zip(header, row, strict=True):
            cells[name].append(cell.strip())
    if not rows:
        remedy = "write one row per observation below the names"
        raise InputError("the file has column names but no rows", file=file, remedy=remedy)
    return Table(file, cells, rows)


def _header(file: Path, line: int, names: list[str]) -> list[str]:
    at = f"row {line}"
    for index, name in enumerate(names):
        if not name:
            raise InputError(
                "a column has no name", file=file, place=f"{at}, column {index + 1}", remedy="name it"
            )
        if name in names[:index]:
            raise InputError("two columns have one name", file=file, place=at, seen=name, remedy="rename one")
    if len(names) == 1 and (";" in names[0] or "\t" in names[0]):
        remedy = "separate columns with commas and write decimal points"
        raise InputError(
            "columns are not separated by commas", file=file, place=at, seen=names[0], remedy=remedy
        )
    return names


def _check_length(file: Path, line: int, row: Sequence[str], header: Sequence[str]) -> None:
    if len(row) != len(header):
        raise InputError(
            f"the row has {len(row)} cells where the header has {len(header)}",
            file=file,
            place=f"row {line}",
            seen=",".join(row),
            remedy="give every column one cell; a decimal comma makes two of one",
        )


def inline_table(rows: Sequence[Mapping[str, Any]]) -> Table:
    """A table written as a list of mappings, each with the same keys; its rows are numbered from 1.

    **Raises** `InputError` for rows whose keys differ, and for no rows.
    """
    if not rows:
        raise InputError("there are no rows", remedy="write at least one")
    header = list(rows[0])
    for number, row in enumerate(rows, start=1):
        if set(row) != set(header):
            different = ", ".join(sorted(set(row) ^ set(header)))
            problem = "the rows do not have the same keys"
            raise InputError(problem, place=f"row {number}", seen=different, remedy="give every row all keys")
    cells = {name: [str(row[name]).strip() for row in rows] for name in header}
    return Table(None, cells, list(range(1, len(rows) + 1)))
