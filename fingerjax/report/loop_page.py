"""The chapters of a diagnosis: from the record alone to sentences, pictures and tables, in the order in which they are read.

`result` makes what a study hands in; `page` puts `filled` into its place there. Everything is made from the JSON record, so a page can
be made again from a `report.json`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from fingerjax._results import RESULTS
from fingerjax.report import loop_figures, loop_tables, loop_words
from fingerjax.report.loop_record import Record, blocks, kind, left, maybe, rms, value_of
from fingerjax.report.loop_residuals import remainder, residuals
from fingerjax.report.loop_tables import parameter_rows
from fingerjax.report.records import Figure, StudyResult, Table


@dataclass(frozen=True)
class Chapter:
    """One part of the section of a study: `key` is its mark on tables and figures and its anchor on the page."""

    key: str
    title: str
    text: list[str]
    figures: list[Figure] = field(default_factory=list)
    tables: list[Table] = field(default_factory=list)


@dataclass(frozen=True)
class Plan:
    """What a chapter is made of: functions of the record."""

    title: str
    text: Callable[[Record], list[str]]
    figures: Callable[[Record], list[Figure | None]] = lambda record: []
    tables: tuple[Callable[[Record], Table], ...] = ()


def _residuals(record: Record) -> list[Figure | None]:
    return [residuals(block) for block in blocks(record)]


def _remainders(record: Record) -> list[Figure | None]:
    smooth = (record.get("unexplained") or {}).get("gp") or {}
    drawn = [remainder(block, smooth[block.name]) for block in blocks(record) if isinstance(smooth.get(block.name), Mapping)]
    return [loop_figures.conditions(record) if record.get("rows") else None, *drawn]


PLANS: dict[str, Plan] = {
    "errors": Plan(
        "How well the model fits, before and after",
        loop_words.about_errors,
        lambda record: [loop_figures.errors(record)] if record.get("rows") else [],
        (loop_tables.errors,),
    ),
    "residuals": Plan("Where the model misses", loop_words.about_residuals, _residuals),
    "effects": Plan(
        "What could explain it",
        loop_words.about_effects,
        lambda record: [loop_figures.effects(record)] if record.get("candidates") else [],
        (loop_tables.refits, loop_tables.pairs, loop_tables.effects),
    ),
    "alike": Plan(
        "What looks alike, and what to measure next",
        loop_words.about_alike,
        lambda record: [loop_figures.next_experiments(record)],
        (loop_tables.next_experiments, loop_tables.look_alikes),
    ),
    "parameters": Plan(
        "Parameters before and after",
        loop_words.about_parameters,
        lambda record: [loop_figures.parameters(record)],
        (loop_tables.parameters, loop_tables.hidden),
    ),
    "rest": Plan(
        "What remains unexplained",
        loop_words.about_rest,
        _remainders,
        (loop_tables.nearest_errors, loop_tables.nearest_parameters, loop_tables.by_condition, loop_tables.shares, loop_tables.patterns),
    ),
    "mesh": Plan("Could it be the mesh?", loop_words.about_mesh, tables=(loop_tables.mesh,)),
    "noise": Plan("Noise", loop_words.about_noise, tables=(loop_tables.noise, loop_tables.conditions)),
    "trust": Plan("How far to trust this diagnosis", loop_words.about_trust, tables=(loop_tables.planted,)),
}


WITHOUT_FIT = ("mesh", "noise")  # what can still be told where the fit found no optimum


def plans(record: Record) -> dict[str, Plan]:
    """The chapters of a record. From a fit without an optimum no value is shown anywhere."""
    return PLANS if outcome(record) is RESULTS.successful else {key: PLANS[key] for key in WITHOUT_FIT}


def chapters(record: Record) -> list[Chapter]:
    """Every chapter with its pictures and tables; what the record has nothing for is left out."""
    found = []
    for key, plan in plans(record).items():
        figures = [dataclasses.replace(one, chapter=key) for one in plan.figures(record) if one is not None and one.rows]
        tables = [dataclasses.replace(table, chapter=key) for make in plan.tables if (table := make(record)).rows]
        found.append(Chapter(key, plan.title, plan.text(record), figures, tables))
    return found


def filled(result: StudyResult) -> list[Chapter]:
    """The chapters of a result that has a diagnosis, with the tables and figures that it holds."""
    record = result.loop or {}
    return [
        Chapter(
            key,
            plan.title,
            plan.text(record),
            [one for one in result.figures if one.chapter == key],
            [one for one in result.tables if one.chapter == key],
        )
        for key, plan in plans(record).items()
    ]


def result(record: Record, name: str, title: str, **more: Any) -> StudyResult:
    """What a study hands in for its diagnosis: the record itself, its chapters, and the fit that it began from.

    **Arguments:** the record as JSON has it; the study's name and the title of its section; `more`, further fields of `StudyResult`.
    """
    parts = chapters(record)
    return StudyResult(
        name=name,
        title=title,
        verdict=loop_words.verdict(record),
        result=outcome(record),
        tables=[table for part in parts for table in part.tables],
        figures=[figure for part in parts for figure in part.figures],
        fit=fit_object(record) if record.get("base") else None,
        loop=dict(record),
        warnings=loop_words.warnings(record),
        meshes=meshes(record),
        **more,
    )


def outcome(record: Record) -> RESULTS:
    """How the diagnosis ended: any verdict is a good end; a fit without an optimum is not."""
    converged = (record.get("base") or {}).get("converged", True)
    return RESULTS.successful if converged and kind(record) != loop_words.NOT_CONVERGED else RESULTS.no_optimum


def meshes(record: Record) -> dict[str, dict[str, Any]]:
    """The mesh of the record as provenance has it; empty where it says nothing of one."""
    mesh = (record.get("model") or {}).get("mesh") or {}
    if not mesh.get("nodes"):
        return {}
    return {"finger": {key: mesh.get(key, none) for key, none in (("hash", None), ("nodes", 0), ("elements", 0), ("quality", {}))}}


def fit_object(record: Record) -> dict[str, Any]:
    """The object `fit` of `report.json`: the model as the study has it, before any effect was added."""
    base = record.get("base") or {}
    converged = outcome(record) is RESULTS.successful
    rows = {row["parameter"]: row for row in parameter_rows(record)} if converged else {}
    return {
        "parameters": {name: _parameter(said, rows.get(name, {}), converged) for name, said in (base.get("theta") or {}).items()},
        "correlations": {},
        "chi2": maybe(base.get("rss")),
        "dof": base.get("df"),
        "rms": _rms(record, ("fit",)),
        "held_out": _rms(record, ("veto", "report")),
        "solver": {
            "converged": converged,
            "iterations": None,
            "residual": None,
            "evaluations": None,
            "gradient": maybe(base.get("grad_rel")),
            "reason": str(base.get("reason") or ("at an optimum" if converged else "no optimum")),
        },
    }


def _parameter(said: Mapping[str, Any], row: Mapping[str, Any], converged: bool) -> dict[str, Any]:
    return {
        "value": maybe(value_of(said)) if converged else None,
        "unit": said.get("unit"),
        "ci95": [row.get("before_lower"), row.get("before_upper")],
        "at_limit": said.get("at_limit"),
        "identified": row.get("before_lower") is not None and row.get("before_upper") is not None,
    }


def _rms(record: Record, roles: tuple[str, ...]) -> dict[str, dict[str, Any]]:
    found = {}
    for block in blocks(record):
        mask = block.where(roles[0])
        for role in roles[1:]:
            mask |= block.where(role)
        if mask.any():
            missed = {"value": maybe(rms(block.left("before")[mask])), "unit": block.unit, "noise": maybe(rms(block.sigma[mask]))}
            found[block.name] = {**missed, "over_noise": maybe(left(block, mask).noise_before)}
    return found
