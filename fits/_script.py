"""What the scripts beside this file share: run studies as `fingerjax run` does, keep their tables and figures, print a table."""

from __future__ import annotations

import os

os.environ.setdefault("NPROC", "16")  # as the program itself sets it, before jax is imported
os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")

import argparse
import dataclasses
from pathlib import Path

from rich.console import Console

from fingerjax.commands.run import choose, prepare
from fingerjax.report.records import Context, StudyResult, Table, write_study
from fingerjax.report.tables import terminal
from fingerjax.runners import RUNNERS
from fingerjax.study import Study, load_studies

FILE = Path(__file__).resolve().parent.parent / "experiments.yaml"


def arguments(text: str | None, out: str) -> argparse.Namespace:
    """`--data`, `--out`, `--coarse`, from the command line."""
    parser = argparse.ArgumentParser(description=text)
    parser.add_argument("--data", type=Path, default=os.environ.get("FINGERJAX_DATA"), help="folder of measured data")
    parser.add_argument("--out", type=Path, default=Path("results") / out, help="where tables and figures are written")
    parser.add_argument("--coarse", type=float, default=1.0, help="node spacing times this: 2 is quick and rough")
    return parser.parse_args()


def study_named(name: str, said: argparse.Namespace) -> Study:
    """A study of experiments.yaml, or its stand-in where measured data are missing."""
    prepare()
    ready, _ = choose(load_studies(FILE, said.data), [name])
    mesh = ready[0].finger.resolution
    coarser = mesh.model_copy(update={"pad_mm": said.coarse * mesh.pad_mm, "proximal_mm": said.coarse * mesh.proximal_mm})
    return dataclasses.replace(ready[0], finger=ready[0].finger.model_copy(update={"resolution": coarser}))


def run(study: Study, out: Path) -> StudyResult:
    """Run a study; its tables as CSV, figures and report.json lie in `out` afterwards."""
    out.mkdir(parents=True, exist_ok=True)
    result = RUNNERS[study.kind](study, Context(out, tell=lambda share, doing: print(f"\r{share:4.0%} {doing:<60}", end="", flush=True)))
    print()
    write_study(out, result)
    return result


def show(result: StudyResult, *names: str) -> None:
    """Print the verdict, the warnings and the tables named."""
    screen = Console()
    screen.print(result.verdict, highlight=False, markup=False)
    for warning in result.warnings:
        screen.print(f"! {warning}", highlight=False, markup=False)
    for table in result.tables:
        if table.name in names:
            screen.print(terminal(table))


def shown(table: Table) -> None:
    Console().print(terminal(table))
