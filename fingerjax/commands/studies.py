"""`fingerjax studies`: what a file holds."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from fingerjax.commands._ending import told
from fingerjax.report.records import Row, Table
from fingerjax.report.tables import terminal
from fingerjax.study import Study, load_studies


def studies(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="Studies, as in experiments.yaml.")],
    data: Annotated[Path | None, typer.Option(help="Folder of measured data (else FINGERJAX_DATA).")] = None,
) -> None:
    """List the studies of FILE: kind, finger, measurements, and what is fitted.

    \b
    Example:
      fingerjax studies experiments.yaml
    """
    with told():
        rows = [_row(study) for study in load_studies(file, data).values()]
        Console().print(terminal(Table("studies", str(file), rows)))


def _row(study: Study) -> Row:
    return {
        "study": study.name,
        "kind": study.kind,
        "finger": study.finger.preset or str(study.finger.sections),
        "measurements": ", ".join(one.name for one in study.measurements),
        "fitted": ", ".join(study.fit.free),
        "missing data": ", ".join(study.missing_data),
    }
