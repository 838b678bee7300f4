"""Spike times recorded beside a trace, on the same clock: how many fell into each window, under which depth and force."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path

import numpy as np
from pydantic import Field, field_validator

from .csvfile import read_table
from .errors import InputError
from .strict import Number, Strict
from .tidy import LABELS, Tidy
from .traces import traces

Window = tuple[Number, Number]


class RatesKeys(Strict):
    """`spikes`: a CSV of `time` and of the labels that tell traces apart, beside the trace's own file; `windows_s`: from when to when, s,
    on the clock of the trace, or from first contact where that is said.
    """

    spikes: str
    windows_s: list[Window] = Field(min_length=1)

    @field_validator("windows_s")
    @classmethod
    def _rise(cls, windows: list[Window]) -> list[Window]:
        for window in windows:
            if not window[0] < window[1]:
                raise InputError("a window does not rise", seen=list(window), remedy="write when it begins, then when it ends")
        return windows


def rates_in(
    table: dict[str, np.ndarray], rows: np.ndarray, keys: RatesKeys, beside: Path | None, given: Collection[str] = ()
) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """One row for each trace and window: spikes per second, and the means of whatever else was recorded, `time` among them.

    **Arguments:** `rows`: the line in the file of each row; `given`: columns that are said of all rows, not recorded; `clock` in the table
    is the time before first contact was set to zero.
    """
    if "time" not in table:
        raise InputError("spikes are counted on the clock of a trace", place="time", remedy="give the trace a column of time")
    file = (beside.parent if beside is not None else Path(".")) / keys.spikes
    if not file.is_file():
        raise InputError("no such file", place="spikes", seen=keys.spikes, remedy="paths are relative to the trace's own file")
    tidy = Tidy(read_table(file))
    spikes, labels = tidy.needed("time", "time"), {name: tidy.label(name) for name in LABELS if name in table}
    names = [name for name, cells in labels.items() if cells is not None]
    absent = [name for name in labels if name not in names and name not in given]
    if absent:
        raise InputError("spikes do not say to which trace they belong", file=file, place=absent[0], remedy=f"add a column {absent[0]}")
    parts: list[dict[str, np.ndarray]] = []
    lines = []
    for trace, own in traces(table):
        mine = np.all([labels[name] == table[name][own[0]] for name in names], axis=0) if names else np.ones(len(spikes), bool)
        shift = table["clock"][own[0]] - table["time"][own[0]] if "clock" in table else 0.0
        for low, high in keys.windows_s:
            inside = own[(table["time"][own] >= low) & (table["time"][own] < high)]
            if len(inside) == 0:
                raise InputError("no row of a trace lies in a window", place=trace, seen=[low, high], remedy="move the window")
            count = np.sum(mine & (spikes - shift >= low) & (spikes - shift < high))
            means = {name: np.asarray(each[inside].mean()) if each.dtype.kind == "f" else each[inside[0]] for name, each in table.items()}
            parts.append(means | {"time": np.asarray(0.5 * (low + high)), "rate": np.asarray(count / (high - low))})
            lines.append(rows[inside[0]])
    return {name: np.array([part[name] for part in parts]) for name in parts[0]}, np.array(lines, dtype=np.int64)
