"""The page of the measured studies: every number of it from what the parts of `benchmarks.measured` kept."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined

from benchmarks._record import Figure, machine
from benchmarks._sections import last_number, rows, sections
from fingerjax.report import loop_figures, loop_page, loop_tables, loop_words
from fingerjax.report.loop_record import Record, nearest
from fingerjax.report.records import Table
from fingerjax.report.tables import heading, shown

HERE = Path(__file__).resolve().parent
TEMPLATE, REMARKS, PICTURES = HERE / "measured.md.j2", HERE.parent / "fits" / "measured", HERE.parent / "docs" / "pictures"
ORDER = ("fingerpad", "table1", "bar", "spheres", "mouse_relaxation", "mouse_under_force", "mouse_hold", "lag", "silicone")
EFFECTS, PAIRS = 12, 8
"""Rows of the longest tables that are shown."""
COLUMNS: Mapping[str, tuple[str, ...]] = {
    "effects": ("effect", "acts_on", "score", "size_estimated", "smallest_visible", "plausible_size", "unit", "trace_left", "remark"),
    "refits": ("effect", "size", "unit", "explained", "strongest_rival", "held_out_change", "converged", "in_the_set", "remark"),
    "errors": ("measurement", "used", "rows", "before_share_of_data", "after_share_of_data", "before_over_noise", "after_over_noise"),
    "parameters": ("parameter", "unit", "before", "before_lower", "before_upper", "after", "after_lower", "after_upper", "mesh"),
}


def page(
    found: Mapping[str, Mapping[str, Any]],
    figures: Sequence[Figure],
    absent: Sequence[str] = (),
    before: str = "",
    took: float = math.nan,
) -> str:
    """The page in Markdown.

    **Arguments:** `found`: study -> its notes, its diagnosis as a record, and its own tables; `absent`: studies that were not run, whose
    sections are taken from the page `before` where they are there. `took`: seconds that one run of all took, NaN where they are of several.
    """
    here = machine()
    old, lines = sections(before), rows(before)
    earlier = {name: {"row": lines[name], "section": old[name]} for name in absent if name in old and name in lines}
    there = [*found, *earlier]
    names = [name for name in ORDER if name in there] + [name for name in there if name not in ORDER]
    values = {figure.figure: figure for figure in figures}
    seconds = {name: values[f"{name}: whole study"].value for name in found}
    minutes = sum(seconds.values()) / 60 + sum(last_number(one["row"]) for one in earlier.values())
    environment = Environment(
        loader=FileSystemLoader([HERE, REMARKS]),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.filters |= {"share": loop_words.share, "short": loop_words.short, "markdown": markdown}
    return environment.get_template(TEMPLATE.name).render(
        names=names,
        studies={name: _study(name, found[name]) for name in found},
        earlier=earlier,
        minutes=minutes,
        whole=took / 60 if math.isfinite(took) else None,
        value=lambda name: values[name].value,
        note=lambda name: values[name].note,
        cores=here["cores"],
        cpu=here["cpu"],
        memory=here["memory_GiB"],
        seconds=seconds,
        absent=[name for name in absent if name not in earlier],
        remarked=[name for name in found if (REMARKS / f"{name}.md.j2").is_file()],
    )


def _study(name: str, kept: Mapping[str, Any]) -> dict[str, Any]:
    record: Record = kept["record"]
    ends = nearest(record) or record
    return {
        "notes": kept["notes"],
        "made": kept.get("made", ""),
        "record": record,
        "after": ends["after"],
        "added": (record.get("nearest") or record["verdict"])["families"],
        "verdict": loop_words.verdict(record),
        "mesh": record["model"]["mesh"],
        "lof": record["base"]["lof"],
        "tables": {one["name"]: Table(**one) for one in kept["tables"]},
        "errors": _columns(loop_tables.errors(ends), "errors"),
        "parameters": _columns(loop_tables.parameters(ends), "parameters"),
        "effects": _columns(_first(loop_tables.effects(record), EFFECTS), "effects"),
        "refits": _columns(loop_tables.refits(record), "refits"),
        "alike": _first(loop_tables.look_alikes(record), PAIRS),
        "next": loop_tables.next_experiments(record),
        "hidden": loop_tables.hidden(record),
        "pictures": _drawn(name, record),
    }


def _drawn(name: str, record: Record) -> dict[str, str]:
    """Errors by condition, with the nearest model where none is named, and what remains: caption -> the picture's path from the page."""
    PICTURES.mkdir(parents=True, exist_ok=True)
    drawn = {}
    _, *remainders = loop_page.PLANS["rest"].figures(record)
    for figure in (loop_figures.conditions(nearest(record) or record), *remainders):
        if figure is not None:
            file = PICTURES / f"measured_{name}_{figure.name.removeprefix('loop_')}.svg"
            file.write_text(figure.svg, encoding="utf-8")
            drawn[figure.caption] = f"{PICTURES.name}/{file.name}"
    return drawn


def _first(table: Table, count: int) -> Table:
    return Table(table.name, table.title, table.rows[:count], table.note)


def _columns(table: Table, name: str) -> Table:
    """The columns that a page has room for."""
    rows = [{column: row.get(column) for column in COLUMNS[name]} for row in table.rows]
    return Table(table.name, table.title, rows, table.note)


def markdown(table: Table) -> str:
    """A table in Markdown; a column without any entry is left out."""
    names = [name for name in table.columns if any(row.get(name) not in (None, "") for row in table.rows)]
    right = {name for name in names if all(isinstance(row.get(name), (int, float, type(None))) for row in table.rows)}
    lines = [[heading(name) for name in names], ["---:" if name in right else "---" for name in names]]
    lines += [[_cell(row.get(name)) for name in names] for row in table.rows]
    return "\n".join(f"| {' | '.join(cells)} |" for cells in lines)


def _cell(entry: Any) -> str:
    if isinstance(entry, float) and math.isfinite(entry):
        return loop_words.short(entry)
    return shown(entry).replace("|", "/")
