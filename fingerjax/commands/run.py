"""`fingerjax run`: every study of a file, from its numbers to a page."""

from __future__ import annotations

import dataclasses
import os
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any

import jax
import typer
import yaml
from rich.console import Console

from fingerjax._results import RESULTS
from fingerjax.commands._ending import INTERRUPTED, NOT_CONVERGED, console, say, told
from fingerjax.commands._progress import Board, clock
from fingerjax.commands._resume import study_key
from fingerjax.errors import InputError
from fingerjax.report.page import page
from fingerjax.report.records import Context, RunFolder, StudyResult, run_record
from fingerjax.report.tables import terminal
from fingerjax.runners import RUNNERS, Runner
from fingerjax.spelling import choose_from
from fingerjax.study import Study, load_studies

OWN_DATA = "give their folder with --data or FINGERJAX_DATA, or name your own table under data: in the study"


def run(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="Studies, as in experiments.yaml.")],
    study: Annotated[list[str] | None, typer.Option(help="Only this one; may be given again.")] = None,
    out: Annotated[Path | None, typer.Option(help="Folder for the report (else results/FILE).")] = None,
    data: Annotated[Path | None, typer.Option(help="Folder of measured data (else FINGERJAX_DATA).")] = None,
    fresh: Annotated[bool, typer.Option("--fresh", help="Forget what a killed run had finished.")] = False,
) -> None:
    """Run the studies of FILE and write report.html, report.json, tables and figures.

    The folder is written whole, at the end. The same command, given again after a run was stopped, goes on
    from what that run had finished.

    \b
    Example:
      fingerjax run experiments.yaml                      every study
      fingerjax run experiments.yaml --study table1       one of them
      fingerjax run mine.yaml --data ~/data --out mine    data from a folder

    Exit code 0: all ended well; 1: something did not converge; 2: wrong input; 130: stopped by Ctrl-C.
    """
    with told():
        folder = data_folder(data)
        chosen, skipped = choose(load_studies(file, folder), study or [])
        prepare()
        place = out or Path("results") / "-".join([file.stem, *(study or [])])
        results = run_all(chosen, skipped, RunFolder(place, fresh=fresh), folder, file)
        _tell(results, place)
    if not all(result.converged for result in results):
        say("fingerjax: not everything converged, see the warnings in the report")
        raise typer.Exit(NOT_CONVERGED)


def data_folder(said: Path | None) -> Path | None:
    """The folder of measured data: what was said, else FINGERJAX_DATA, else None."""
    return said or (Path(os.environ["FINGERJAX_DATA"]) if os.environ.get("FINGERJAX_DATA") else None)


def choose(studies: dict[str, Study], names: Sequence[str]) -> tuple[list[Study], list[Study]]:
    """(studies to run, studies left out because their data are not there).

    A study whose data are missing is run as its fallback, under its own name. A study that is only there to
    stand in for another is not run by itself unless it is named.

    **Raises** `InputError` for an unknown name, or for a named study without its data or a fallback.
    """
    for name in names:
        if name not in studies:
            raise InputError("no such study", place="--study", seen=name, remedy=choose_from(name, studies))
    stand_ins = {one.fallback for one in studies.values()} - {None}
    wanted = [studies[name] for name in names or [name for name in studies if name not in stand_ins]]
    ready, absent = [], []
    for one in wanted:
        if not one.missing_data:
            ready.append(one)
        elif one.fallback is not None and not studies[one.fallback].missing_data:
            ready.append(_standing_in(studies[one.fallback], one))
        elif names:
            raise InputError(
                "measured data are not there", file=one.file, place=one.name,
                seen=", ".join(one.missing_data),
                remedy=OWN_DATA,
            )  # fmt: skip
        else:
            absent.append(one)
    return ready, absent


def _standing_in(other: Study, absent: Study) -> Study:
    note = f"Run as {other.name}, because measured data are not there: {', '.join(absent.missing_data)}."
    return dataclasses.replace(other, name=absent.name, notes=f"{note} {other.notes}".strip())


def prepare() -> None:
    """64 bit, and compiled programs kept between runs."""
    from fingerjax.mesh.cache import cache_dir

    jax.config.update("jax_enable_x64", True)
    jax.config.update("jax_compilation_cache_dir", str(cache_dir() / "compiled"))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.05)


def run_all(
    chosen: Sequence[Study],
    skipped: Sequence[Study],
    folder: RunFolder,
    data: Path | None,
    file: Path,
    how: Callable[[Study, str], Runner] | None = None,
    options: str = "",
) -> list[StudyResult]:
    """Run every study and put the whole in place; the finished ones are kept as they come.

    **Arguments:** `how` gives the runner of a study from it and its key (that of its kind where None); `options` is what a result
    depends on besides the study itself.
    """
    results: list[StudyResult] = []
    with Board([one.name for one in chosen], _seconds_before(folder.out), console()) as board:
        for one in skipped:
            results.append(_left_out(one))
            folder.keep("", results[-1])
            board.line(f"{one.name}: {results[-1].verdict}")
        try:
            for one in chosen:
                results.append(_run_one(one, folder, data, board, how or (lambda study, key: runner(study)), options))
        except KeyboardInterrupt:
            kept = ", ".join(result.name for result in results) or "no study yet"
            say(f"fingerjax: interrupted; kept: {kept}. The same command goes on from there.")
            raise typer.Exit(INTERRUPTED) from None
    command = "fingerjax " + " ".join(sys.argv[1:])
    folder.put_in_place(results, page(results, f"fingerjax: {file.name}"), run_record(results, command))
    return results


def _left_out(study: Study) -> StudyResult:
    missing = ", ".join(study.missing_data)
    verdict = f"Not run: measured data are not there ({missing}); {OWN_DATA}."
    return StudyResult(study.name, study.name, verdict)


def _run_one(
    study: Study, folder: RunFolder, data: Path | None, board: Board, how: Callable[[Study, str], Runner], options: str
) -> StudyResult:
    key = study_key(study, data, options)
    before = folder.finished(study.name, key)
    if before is not None:
        board.line(f"{study.name}: finished before. {before.verdict}")
        return before
    began = time.perf_counter()
    context = Context(folder.begin(study.name), data, board.teller(study.name))
    result = how(study, key)(study, context)
    if result.result is RESULTS.interrupted:
        raise KeyboardInterrupt
    result = dataclasses.replace(result, name=study.name, resolved=resolved(study), seconds=time.perf_counter() - began)
    folder.keep(key, result)
    board.teller(study.name)(1.0, "done")
    board.line(f"{study.name} ({clock(result.seconds)}): {result.verdict}")
    return result


def resolved(study: Study) -> dict[str, Any]:
    """The study as it was written, with the defaults of its finger and model filled in."""
    filled = {"finger": study.finger.model_dump(exclude_none=True), "model": study.model.model_dump(exclude_none=True)}
    return {**study.written, "kind": study.kind, **filled}


def runner(study: Study) -> Runner:
    """What is done for a study. **Raises** `InputError` for a kind that nothing is registered for."""
    if study.kind not in RUNNERS:
        remedy = choose_from(study.kind, RUNNERS) if RUNNERS else "this version runs none"
        raise InputError(
            "no such kind of study", file=study.file, place=study.name, seen=study.kind, remedy=remedy
        )
    return RUNNERS[study.kind]


def _seconds_before(out: Path) -> dict[str, float]:
    """What each study took in the run that is in place, for the time left; empty where that is not known."""
    try:
        said = yaml.safe_load((out / "run.yaml").read_text(encoding="utf-8"))
        return {name: float(one["seconds"]) for name, one in said["studies"].items()}
    except (OSError, KeyError, TypeError, ValueError, AttributeError, yaml.YAMLError):
        return {}


def _tell(results: Sequence[StudyResult], place: Path) -> None:
    screen = Console()
    for result in results:
        for table in result.tables:
            screen.print(terminal(table))
        for warning in result.warnings:
            screen.print(f"! {warning}", highlight=False, markup=False)
    screen.print(f"report: {place / 'report.html'}", highlight=False, markup=False, soft_wrap=True)
