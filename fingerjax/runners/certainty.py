"""How sure a fit is, beyond its linearised intervals: profiles, repeats, starts, and which observation told what."""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from ..forward import Assembled
from ..identify import Bootstrap, Fit, Multistart, Posterior, Profile, Uncertainty, bootstrap, directions, profiles, sample
from ..identify.bootstrap import REGULAR, agreement
from ..identify.directions import sentences
from ..identify.informs import finite, leverage_rows, stations
from ..measurements import Measurement
from ..report import figures
from ..report.records import Context, Figure, Row, StudyResult, Table
from ..study import Study


def seen_tables(study: Study, found: Fit, known: Uncertainty) -> list[Table]:
    """What the data see: combinations, leverage, and how far from the load each parameter is seen. No model is run."""
    names = found.problem.names
    tables = [Table("leverage", "Leverage of each observation, 0 to 1", leverage_rows(found, study.measurements))]
    if len(names) > 1:
        rows = [one.row(names) for one in directions(found, known)]
        note = "Weights are of raw parameters: logarithms of moduli. Half an interval of 2.3 is a factor of ten."
        tables.insert(0, Table("directions", "What the data see, best known combination first", rows, note))
    reach = [row for one in study.measurements if one.kind == "deflection_profile" for row in stations(found, one)]
    return [*tables, *([Table("stations", "How far from the load each parameter is seen", reach)] if reach else [])]


def how_sure(
    study: Study, assembled: Assembled, found: Fit, known: Uncertainty, many: Multistart | None, settled: StudyResult, context: Context
) -> StudyResult:
    """The result with whatever the study asks for under `profile`, `bootstrap` and `starts`, and what these say."""
    wanted, again, chains = _instances(study, assembled, found), study.fit.bootstrap, study.fit.sample
    lines = profiles(found, wanted, tell=context.within(0.0, 0.4).tell) if wanted else ()
    repeats = None
    if again is not None:
        kind, count, seed = again
        cases = {one.name: case_labels(one) for one in study.measurements}
        repeats = bootstrap(found, kind=kind, repeats=count, seed=seed, cases=cases, tell=context.within(0.4, 0.7).tell)
    drawn = None
    if chains is not None and known.identified:
        drawn = sample(found, steps=chains[0], chains=chains[1], seed=chains[2], tell=context.within(0.7, 0.95).tell)
    context.tell(0.95, "finite changes")
    warnings = [*settled.warnings, *warnings_of(found, known, lines, repeats, drawn, many)]
    if chains is not None and drawn is None:
        warnings.append("Nothing was sampled: samples need data that see every parameter.")
    local = Table("finite_changes", "Local slopes against changes by a factor of ten, in sigmas", finite(found))
    return dataclasses.replace(
        settled,
        warnings=warnings,
        notes=[*settled.notes, *([many.verdict() + "."] if many is not None and many.agree else [])],
        tables=[*settled.tables, *_tables(known, lines, repeats, drawn, many), local],
        figures=[*settled.figures, *_figures(found, lines, many)],
        seeds={
            **settled.seeds,
            **({"bootstrap": repeats.seed} if repeats else {}),
            **({"sample": drawn.seed} if drawn else {}),
            **({"starts": 0} if many else {}),
        },
    )


def case_labels(measurement: Measurement) -> np.ndarray:
    """(rows,) a number for each row: rows of one indentation in one trial have the same."""
    apart = (measurement.value, "sigma", "time", "distance")
    keys = [np.unique(column, return_inverse=True)[1] for name, column in measurement.table.items() if name not in apart]
    return np.unique(np.column_stack(keys), axis=0, return_inverse=True)[1].reshape(-1)


def _instances(study: Study, assembled: Assembled, found: Fit) -> tuple[str, ...]:
    """Names in the fit of the parameters that a study wants profiled: of a tie, its owner; of a group, every member."""
    owners = {assembled.model.wired.owner[name] for name in study.fit.profile}
    return tuple(one.name for one in found.problem.parameters if one.path in owners)


def warnings_of(
    found: Fit,
    known: Uncertainty,
    lines: tuple[Profile, ...],
    repeats: Bootstrap | None = None,
    drawn: Posterior | None = None,
    many: Multistart | None = None,
) -> list[str]:
    """What a reader has to know before using the intervals: parameters that are not identifiable, problems that are not regular."""
    said = [f"{one.verdict()}." for one in lines if not one.identified]
    said += [f"{each[0].upper()}{each[1:]}." for each in sentences(found)]
    said += [f"{many.verdict()[0].upper()}{many.verdict()[1:]}."] if many is not None and not many.agree else []
    lower = [one for one in lines if one.lower_chi2 is not None]
    said += [f"A lower chi-square was met on the profile of {one.parameter.name}: {one.lower_chi2:.6g}." for one in lower]
    said += [f"{drawn.verdict()}."] if drawn is not None and not drawn.mixed else []
    irregular = [row for row in _compared(known, lines, repeats, drawn) if row["regular"] == "no"]
    if irregular:
        told = ", ".join(str(row["parameter"]) for row in irregular)
        said.append(f"Not regular: intervals of {told} differ by more than {REGULAR:.0%} from the linearised ones; use the profile's.")
    if repeats is not None and repeats.failed:
        said.append(f"{repeats.failed} of {repeats.failed + len(repeats.raw)} repeats of the bootstrap found no optimum and are left out.")
    return said


def _compared(known: Uncertainty, lines: tuple[Profile, ...], repeats: Bootstrap | None, drawn: Posterior | None) -> list[Row]:
    """Intervals beside each other: linearised, profile, bootstrap, samples; and whether they agree."""
    profiled = {one.parameter.name: one for one in lines}
    found: list[Row] = []
    for one in known.estimates:
        row: Row = {"parameter": one.name, "value": one.value, "unit": one.unit, "lower_linear": one.lower, "upper_linear": one.upper}
        ratios, room = [], REGULAR
        if one.name in profiled:
            low, high = profiled[one.name].lower, profiled[one.name].upper
            row |= {"lower_profile": low, "upper_profile": high}
            ratios.append(agreement(known, one.name, low, high) if profiled[one.name].bounded else math.inf)
        if repeats is not None:
            low, high = repeats.interval(one.name)
            row |= {f"lower_{repeats.kind}": low, f"upper_{repeats.kind}": high}
            ratios.append(agreement(known, one.name, low, high))
            room += 1 / math.sqrt(max(len(repeats.raw), 1))
        if drawn is not None:
            low, high = drawn.interval(one.name)
            row |= {"lower_samples": low, "upper_samples": high}
            ratios += [agreement(known, one.name, low, high)] if drawn.mixed else []
        regular = bool(ratios) and all(abs(ratio - 1) <= room for ratio in ratios)
        found.append({**row, "regular": ("yes" if regular else "no") if ratios else ""})
    return found


def _tables(
    known: Uncertainty, lines: tuple[Profile, ...], repeats: Bootstrap | None, drawn: Posterior | None, many: Multistart | None
) -> list[Table]:
    tables = []
    if lines or repeats is not None or drawn is not None:
        sampled = "" if repeats is None else f", and 1/sqrt({len(repeats.raw)}) for the repeats' own scatter"
        note = f"Regular: widths agree with the linearised ones within {REGULAR:.0%}{sampled}."
        note += f" {drawn.verdict()}." if drawn is not None else ""
        tables.append(Table("intervals", "95 % intervals beside each other", _compared(known, lines, repeats, drawn), note))
    if lines:
        rows = [{"parameter": one.parameter.name, "verdict": one.verdict(), "runs_of_the_model": one.evaluations} for one in lines]
        tables.append(Table("verdicts", "What the profiles say", rows))
    return tables if many is None else [*tables, Table("starts", many.verdict(), many.rows())]


def _figures(found: Fit, lines: tuple[Profile, ...], many: Multistart | None) -> list[Figure]:
    drawn = [figures.profile_likelihood([row for one in lines for row in one.rows()])] if lines else []
    names = found.problem.names
    if many is not None and not many.agree and len(names) > 1:
        drawn.append(figures.basins(many.rows(), *names[:2]))
    return drawn
