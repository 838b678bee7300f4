"""`fingerjax diagnose`: what the model of a study lacks, traced from what is left of its fit."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console

from fingerjax.commands._ending import NOT_CONVERGED, say, told
from fingerjax.commands._parts import Parts
from fingerjax.commands.run import choose, data_folder, prepare, run_all
from fingerjax.errors import InputError
from fingerjax.fem.pardiso import pardiso_available
from fingerjax.parameters import Parameter
from fingerjax.report.loop_page import result as page_result
from fingerjax.report.loop_tables import outlook
from fingerjax.report.records import Context, RunFolder, StudyResult, plain
from fingerjax.report.tables import terminal
from fingerjax.runners import Runner
from fingerjax.spelling import choose_from
from fingerjax.study import Study, load_studies

SOLVERS = ("auto", "multigrid", "factorised", "pardiso", "frontal")
SHOWN = 8  # effects on the terminal; all of them are in the report


def diagnose(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="Studies, as in experiments.yaml.")],
    study: Annotated[list[str] | None, typer.Option(help="Only this one; may be given again.")] = None,
    out: Annotated[Path | None, typer.Option(help="Folder for the report (else results/FILE-diagnosis).")] = None,
    data: Annotated[Path | None, typer.Option(help="Folder of measured data (else FINGERJAX_DATA).")] = None,
    effects: Annotated[str | None, typer.Option(metavar="A,B", help="Only these effects, or all; instead of the study's.")] = None,
    effects_folder: Annotated[Path | None, typer.Option(help="Folder with effects of your own, one file each.")] = None,
    seed: Annotated[int, typer.Option(help="Of every random draw.")] = 0,
    solver: Annotated[str, typer.Option(help="auto, multigrid, factorised, pardiso or frontal.")] = "auto",
    fresh: Annotated[bool, typer.Option("--fresh", help="Forget what a run that was stopped had finished.")] = False,
) -> None:
    """Say what the model lacks: which effect, of those in the catalogue, explains what a fit leaves over.

    The study is fitted; what is left is compared with the traces of every effect, with the noise, and with the error of the mesh. The best
    effects are put into the model and fitted again, and have to predict conditions that were held out. The verdict names one effect,
    several that these data cannot tell apart with the experiment that would, or none. A verdict of "unexplained" is a result.

    Repeats matter more than anything: without at least three trials of each condition the noise is not known, and nothing is called
    adequate. Put the repeats into a column trial. What to hold out, and which effects to try, a study says under diagnose:.

    The folder is written whole, at the end. Ctrl-C loses nothing: the same command goes on from what was finished.

    \b
    Example:
      fingerjax diagnose mine.yaml
      fingerjax diagnose experiments.yaml --study layer_ratios --out diagnosis
      fingerjax diagnose mine.yaml --effects nail_compliance,contact_offset
      fingerjax effects                                  what there is to choose from

    Exit code 0: diagnosed, whatever the verdict; 1: something did not converge; 2: wrong input; 130: stopped by Ctrl-C.
    """
    with told():
        if solver not in SOLVERS:
            raise InputError("no such solver", place="--solver", seen=solver, remedy=choose_from(solver, SOLVERS))
        if solver == "pardiso" and not pardiso_available():
            remedy = "pip install fingerjax[direct], or choose frontal"
            raise InputError("MKL PARDISO is not installed", place="--solver", seen=solver, remedy=remedy)
        folder = data_folder(data)
        chosen = [_with_effects(one, effects, effects_folder) for one in _studies(file, study or [], folder)]
        prepare()
        place = out or Path("results") / "-".join([file.stem, *(study or []), "diagnosis"])
        kept = RunFolder(place, fresh=fresh)

        def how(one: Study, key: str) -> Runner:
            return _runner(Parts(kept.parts(one.name, key)), effects_folder, seed, solver)

        options = f"diagnose seed={seed} solver={solver} effects={effects} folder={_hash(effects_folder)}"
        results = run_all(chosen, [], kept, folder, file, how, options)
        _tell(results, place)
    if not all(one.converged for one in results):
        say("fingerjax: not everything converged, see the report")
        raise typer.Exit(NOT_CONVERGED)


def _studies(file: Path, names: Sequence[str], data: Path | None) -> list[Study]:
    """The studies meant: those named, else those that ask for a diagnosis, else the only one that fits something.

    **Raises** `InputError` where none of these are, or where one fits nothing.
    """
    studies = load_studies(file, data)
    fitting = [name for name, one in studies.items() if one.kind == "fit" and one.fit.free]
    asking = [name for name in fitting if (said := studies[name].diagnose) is not None and said.effects != "none"]
    wanted = list(names) or asking or fitting
    if not names and (not wanted or (not asking and len(wanted) > 1)):
        remedy = f"name one of {', '.join(fitting)}" if fitting else "write fit: {free: [epidermis.modulus]} in a study"
        problem = "several studies fit something, and none has the key diagnose" if fitting else "no study fits anything"
        raise InputError(problem, file=file, place="--study", remedy=remedy)
    ready, _ = choose(studies, wanted)
    for one in ready:
        if one.kind != "fit" or not one.fit.free:
            remedy = f"name one of {', '.join(fitting)}" if fitting else "write fit: {free: [epidermis.modulus]}"
            raise InputError("this study fits nothing, so nothing is left over", file=file, place=one.name, remedy=remedy)
    return ready


def _with_effects(study: Study, said: str | None, folder: Path | None) -> Study:
    """The study with the effects that are to be tried: those of the command line, else its own.

    **Raises** `InputError` for a name that the catalogue does not have, with the nearest; or where there is none to try.
    """
    from fingerjax.effects import catalogue
    from fingerjax.study_records import Diagnose

    if folder is not None and not folder.is_dir():
        raise InputError("no such folder", place="--effects-folder", seen=str(folder), remedy="name the folder that holds your effects")
    own = study.diagnose or Diagnose()
    asked = own.effects if said is None else _split(said)
    names = [one.name for one in catalogue(folder)]
    place, file = ("--effects", None) if said is not None else (f"{study.name}.diagnose.effects", study.file)
    if asked == "none" or not asked:
        raise InputError("no effect is to be tried", file=file, place=place, seen=asked, remedy="write all, or names of effects")
    for one in [] if asked == "all" else [asked] if isinstance(asked, str) else asked:
        if one not in names:
            raise InputError("no such effect", file=file, place=place, seen=one, remedy=choose_from(one, names))
    written = {**study.written, "diagnose": {**(study.written.get("diagnose") or {}), "effects": plain(asked)}}
    return replace(study, diagnose=replace(own, effects=asked), written=written)


def _split(said: str) -> str | tuple[str, ...]:
    names = tuple(name.strip() for name in said.split(",") if name.strip())
    return names[0] if names in (("all",), ("none",)) else names


def _hash(folder: Path | None) -> str:
    """What stands in the files of a folder of effects."""
    files = sorted(folder.glob("*.py")) if folder is not None else []
    return hashlib.sha256(b"\0".join(file.name.encode() + file.read_bytes() for file in files)).hexdigest()[:16]


def _runner(parts: Parts, folder: Path | None, seed: int, solver: str) -> Runner:
    """A runner that diagnoses, with its parts kept."""

    def run(study: Study, context: Context) -> StudyResult:
        from fingerjax.runners.diagnosing import diagnose_study

        asked = study.diagnose.effects if study.diagnose is not None else "all"
        try:
            found = diagnose_study(study, solver=solver, seed=seed, effects=asked, folder=folder, tell=context.at, kept=parts)
        except KeyboardInterrupt:
            say(f"fingerjax: {study.name}: {len(parts)} {'part' if len(parts) == 1 else 'parts'} of its diagnosis kept")
            raise
        record = with_raw(plain(found.record()), study.parameters())
        title = study.notes.split(". ")[0] or f"What the model of {study.name} lacks"
        return page_result(record, study.name, title, notes=[study.notes] if study.notes else [], seeds={"diagnosis": seed})

    return run


def with_raw(record: dict[str, Any], parameters: Sequence[Parameter]) -> dict[str, Any]:
    """The record with `raw` and `link` beside every value of a base parameter: the number that the fit moves, and how it is made."""
    known = {one.name: one for one in parameters}

    def raised(theta: Mapping[str, Any]) -> dict[str, Any]:
        return {name: _raised(said, known.get(name.partition("[")[0])) for name, said in theta.items()}

    whole = dict(record)
    for part in ("base", "after"):
        if isinstance(record.get(part), Mapping) and record[part].get("theta"):
            whole[part] = {**record[part], "theta": raised(record[part]["theta"])}
    return whole


def _raised(said: Mapping[str, Any], known: Parameter | None) -> dict[str, Any]:
    if known is None or said.get("value") is None:
        return dict(said)
    inside = min(max(float(said["value"]), known.lower), known.upper)
    return {**said, "link": known.link, "raw": float(replace(known, value=inside).raw())}


def _tell(results: Sequence[StudyResult], place: Path) -> None:
    screen = Console()
    for one in results:
        screen.print(one.verdict, highlight=False, markup=False)
        if one.loop is not None:
            screen.print(terminal(outlook(one.loop, SHOWN)))
        for warning in one.warnings:
            screen.print(f"! {warning}", highlight=False, markup=False)
    screen.print(f"report: {place / 'report.html'}", highlight=False, markup=False, soft_wrap=True)
