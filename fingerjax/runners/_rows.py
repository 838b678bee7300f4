"""Readings beside their measurements, as the tidy rows that figures are drawn from."""

from __future__ import annotations

import numpy as np

from ..measurements import Measurement
from ..report import figures
from ..report.records import Figure, Row


def rows(measurement: Measurement, predicted: np.ndarray, sigma: np.ndarray) -> list[Row]:
    """One row for each row of the measurement: where, what was measured, what the model reads."""
    imposed, table = measurement.imposed, measurement.table
    units = {"depth": "mm", "displacement": "mm", "force": "N", "rate": "Hz", "deflection": "mm"}
    unit = units[measurement.value]
    found: list[Row] = []
    for i in range(len(measurement)):
        where = {f"{name}_mm": float(table[name][i]) for name in ("distance", "position") if name in table}
        labels: Row = {name: str(table[name][i]) for name in ("subject", "condition", "trial", "stimulus") if name in table}
        found.append(
            {
                **labels,
                f"{imposed}_{units[imposed]}": float(table[imposed][i]),
                **where,
                f"measured_{unit}": float(measurement.measured[i]),
                f"sigma_{unit}": float(sigma[i]),
                f"predicted_{unit}": float(predicted[i]),
                f"residual_{unit}": float(measurement.measured[i] - predicted[i]),
            }
        )
    return found


def drawn(measurement: Measurement, tidy: list[Row]) -> Figure | None:
    """The figure of a measurement beside its prediction; None for a travel under controlled force."""
    if measurement.kind == "deflection_profile":
        return figures.profiles(tidy, measurement.name, axis=measurement.direction)
    if measurement.kind == "spike_rate":
        return figures.rates([{"stimulus": "", **row} for row in tidy], measurement.name)
    if measurement.controlled == "force":
        return None
    return figures.force_displacement([{**row, "series": row.get("subject", measurement.name)} for row in tidy], measurement.name)
