"""Tidy rows into tables that people read: on the terminal, as HTML; and the tables that every fit has.

A cell that is missing is empty; one that is undefined says so. Numbers have four significant digits on the
terminal and on the page, and all of theirs in the CSV.
"""

from __future__ import annotations

import html
import math
import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from rich.markup import escape
from rich.table import Table as RichTable

from fingerjax.identify import Estimate, Sensitivity, Uncertainty
from fingerjax.report.records import Row, Table
from fingerjax.units import split_unit

_QUOTIENT = re.compile(r"(.+)_([A-Za-z]+)_per_([A-Za-z]+)")


def heading(column: str) -> str:
    """A column's name for people: `modulus_MPa` -> `modulus, MPa`; `slope_MPa_per_gf` -> `slope, MPa/gf`."""
    quotient = _QUOTIENT.fullmatch(column)
    if quotient:
        base, over, under = quotient.groups()
        if split_unit(f"x_{over}")[1] and split_unit(f"x_{under}")[1]:
            return f"{base.replace('_', ' ')}, {over}/{under}"
    base, unit = split_unit(column)
    return base.replace("_", " ") + (f", {unit}" if unit else "")


def shown(entry: Any) -> str:
    """A cell for people: four significant digits, `undefined` for NaN, yes and no for flags."""
    if entry is None:
        return ""
    if isinstance(entry, (bool, np.bool_)):
        return "yes" if entry else "no"
    if isinstance(entry, (float, np.floating)):
        return _number(float(entry))
    return str(entry)


def _number(value: float) -> str:
    if math.isnan(value):
        return "undefined"
    if value == 0 or 1e-3 <= abs(value) < 1e5:
        text = f"{value:.4g}"
        return f"{value:.0f}" if "e" in text else text
    return f"{value:.3e}"


def _is_number(table: Table, column: str) -> bool:
    entries = [row.get(column) for row in table.rows if row.get(column) not in (None, "")]
    return bool(entries) and all(
        isinstance(e, (int, float, np.number)) and not isinstance(e, bool) for e in entries
    )


def terminal(table: Table) -> RichTable:
    """The table for a terminal."""
    drawn = RichTable(title=table.title, caption=table.note or None, title_justify="left")
    for column in table.columns:
        numbers = _is_number(table, column)
        drawn.add_column(heading(column), justify="right" if numbers else "left", no_wrap=numbers)
    for row in table.rows:
        drawn.add_row(*(escape(shown(row.get(column))) for column in table.columns))
    return drawn


def as_html(table: Table) -> str:
    """The table as an HTML element; everything in it is escaped."""
    kinds = {c: ' class="number"' if _is_number(table, c) else "" for c in table.columns}
    head = "".join(f"<th{kinds[c]}>{html.escape(heading(c))}</th>" for c in table.columns)
    body = "".join(
        "<tr>"
        + "".join(f"<td{kinds[c]}>{html.escape(shown(row.get(c)))}</td>" for c in table.columns)
        + "</tr>"
        for row in table.rows
    )
    return f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"


# ---- the tables of a fit ----


def parameter_table(known: Uncertainty, seen: Sensitivity | None = None, name: str = "parameters") -> Table:
    """Value, 95 % interval, unit, start, limit, and whether and by what the data saw it."""
    shares = seen.seen_by() if seen is not None else {}
    rows = [_parameter_row(one, shares.get(one.name, {})) for one in known.estimates]
    return Table(name, "Parameters, with 95 % intervals", rows, _interval_note(known))


def _parameter_row(one: Estimate, shares: Mapping[str, float]) -> Row:
    largest = max(shares, key=lambda name: shares[name], default=None)
    row: Row = {
        "parameter": one.name,
        "value": one.value,
        "lower": one.lower,
        "upper": one.upper,
        "unit": one.unit,
        "start": one.start,
        "limit": one.at_limit or "",
        "seen_by_the_data": "yes" if one.identified else "no",
    }
    if largest is not None:
        share = shares[largest]
        row["seen_most_by"] = f"{largest} ({share:.0%})" if math.isfinite(share) and share > 0 else ""
    return {**row, "remark": one.reason}


def _interval_note(known: Uncertainty) -> str:
    if known.sigma == "stated":
        return "Intervals from the stated noise."
    return (
        "Intervals from the scatter of the residuals, because the noise was assumed "
        f"(Student's t with {known.noise_dof:.3g} degrees of freedom)."
    )


def correlation_table(known: Uncertainty, least: float = 0.5) -> Table:
    """The strongest correlations among the parameters."""
    rows = [
        {"parameter": first, "with": second, "correlation": value}
        for first, second, value in known.strongest(10, least)
    ]
    return Table("correlations", f"Correlations of {least:g} and more", rows)


def residual_table(fit: Mapping[str, Any]) -> Table:
    """Root mean square residual beside the noise for each measurement, from a fit's record."""
    kinds = fit.get("sigma", {}).get("by_measurement", {})
    rows: list[Row] = []
    for what in ("rms", "held_out"):
        rows += [
            {
                "measurement": name,
                "used": "fitted" if what == "rms" else "held out",
                "rms_residual": one["value"],
                "noise": one["noise"],
                "unit": one["unit"],
                "noise_is": kinds.get(name, ""),
            }
            for name, one in fit.get(what, {}).items()
        ]
    return Table("residuals", "Residuals beside the noise", rows)


def beside_paper(
    labels: Sequence[Row],
    ours: Sequence[float],
    paper: Sequence[float | None],
    *,
    quantity: str = "epidermis_modulus_MPa",
    intervals: Sequence[tuple[float, float]] | None = None,
) -> list[Row]:
    """Our number beside the paper's, row by row, with their ratio.

    **Arguments:** `labels`, the leading columns of each row; `ours` and `paper` in the unit at the end of
    `quantity`; `intervals`, our 95 % ones.

    **Returns** rows with `our_<quantity>`, optionally `lower_` and `upper_`, `paper_<quantity>` and `ratio`.
    """
    rows = []
    for index, label in enumerate(labels):
        row: Row = {**label, f"our_{quantity}": float(ours[index])}
        if intervals is not None:
            row |= {f"lower_{quantity}": intervals[index][0], f"upper_{quantity}": intervals[index][1]}
        theirs = paper[index]
        row |= {f"paper_{quantity}": theirs, "ratio": float(ours[index]) / theirs if theirs else None}
        rows.append(row)
    return rows


def mean_and_sd(
    rows: Sequence[Row], quantity: str = "epidermis_modulus_MPa", group: str | None = None
) -> list[Row]:
    """Mean and standard deviation (n - 1) of ours and the paper's, of all rows and of each value of
    `group`."""
    sets = {"all": list(rows)}
    if group is not None:
        for row in rows:
            sets.setdefault(str(row[group]), []).append(row)
    found = []
    for name, members in sets.items():
        said: Row = {"rows": name, "n": len(members)}
        for who in ("our", "paper"):
            column = [row[f"{who}_{quantity}"] for row in members]
            values = np.array([value for value in column if value is not None], float)
            said[f"{who}_mean_{quantity}"] = float(values.mean()) if values.size else None
            said[f"{who}_sd_{quantity}"] = float(values.std(ddof=1)) if values.size > 1 else None
        found.append(said)
    return found
