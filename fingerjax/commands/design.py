"""`fingerjax design`: which indentation to make next."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.console import Console

from fingerjax.commands._ending import NOT_CONVERGED, console, say, told
from fingerjax.commands._fitted import fitted, one_study
from fingerjax.commands._progress import Board
from fingerjax.commands.run import prepare
from fingerjax.errors import InputError
from fingerjax.identify import Fit
from fingerjax.identify.design import Recommendation, jacobians, recommend
from fingerjax.report.records import Table, plain
from fingerjax.report.tables import terminal


def design(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="Studies, one with the key design.")],
    study: Annotated[str | None, typer.Option(help="Which one.")] = None,
    criterion: Annotated[str | None, typer.Option(help="D, A or c, instead of the study's.")] = None,
    target: Annotated[str | None, typer.Option(help="For c: a parameter, or NAME / NAME.")] = None,
    data: Annotated[Path | None, typer.Option(help="Folder of measured data (else FINGERJAX_DATA).")] = None,
    json_file: Annotated[Path | None, typer.Option("--json", metavar="FILE", help="Write the same there.")] = None,
) -> None:
    """Fit a study, then say which of its possible indentations would tell most, and what they would leave.

    The study lists them under design: with shape, depth and site; see fingerjax.study_design.

    \b
    Example:
      fingerjax design mine.yaml
      fingerjax design mine.yaml --criterion c --target "dermis.modulus / epidermis.modulus"

    Exit code 0: chosen; 1: the fit, or a candidate, did not converge; 2: wrong input.
    """
    with told():
        one = one_study(file, study, data)
        if one.design is None:
            remedy = "write design: {criterion: D, candidates: [{name: ..., indenter: ..., displacement_mm: [...], noise: ...}]}"
            raise InputError("nothing says what could be measured next", file=file, place=f"{one.name}.design", remedy=remedy)
        prepare()
        kind = criterion or ("c" if target else one.design.criterion)
        aim = target or (one.design.target if kind == "c" else None)
        with Board([one.name], {}, console()) as board:
            tell = board.teller(one.name)
            _, found = fitted(one, lambda share, doing: tell(0.6 * share, doing))
            if not found.settled:
                say(f"fingerjax: no design, because the fit is not settled: {found.reason}")
                raise typer.Exit(NOT_CONVERGED)
            tell(0.6, f"{len(one.design.candidates)} candidates")
            advice = _advised(one.design.choose, found, jacobians(one, found, one.design.candidates), kind, aim)
        _tell(advice)
        if json_file is not None:
            json_file.write_text(json.dumps(plain(record(advice)), indent=1, allow_nan=False) + "\n", encoding="utf-8")


def _advised(choose: int, found: Fit, seen: dict[str, np.ndarray], kind: str, aim: str | None) -> Recommendation:
    try:
        return recommend(found, seen, criterion=kind, target=aim, choose=choose)
    except ValueError as error:
        raise InputError(str(error), place="--criterion, --target", remedy="correct it") from None


def tables(advice: Recommendation) -> list[Table]:
    """The ranking, and the intervals before and after the best set of each size."""
    aim = advice.target or "all parameters"
    found = [Table("design_ranking", f"Next indentation, criterion {advice.criterion}, {aim}: best first", advice.ranking())]
    for choice in advice.best:
        count = len(choice.names)
        title = f"The best {'one' if count == 1 else count}: {', '.join(choice.names)} (interval times {advice.narrowing(choice):.3g})"
        found.append(Table(f"design_{count}", title, advice.intervals(choice), "Predicted 95 % intervals before and after."))
    return found


def record(advice: Recommendation) -> dict[str, object]:
    """The same as plain data."""
    best = [{"indentations": one.names, "interval_times": advice.narrowing(one), "intervals": advice.intervals(one)} for one in advice.best]
    return {"criterion": advice.criterion, "target": advice.target, "ranking": advice.ranking(), "best": best}


def _tell(advice: Recommendation) -> None:
    screen = Console()
    for table in tables(advice):
        screen.print(terminal(table))
