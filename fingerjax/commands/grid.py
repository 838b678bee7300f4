"""`fingerjax grid`: the paper's powers of ten beside the fit."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from fingerjax.commands._ending import console, told
from fingerjax.commands._fitted import fitted, one_study
from fingerjax.commands._progress import Board
from fingerjax.commands.run import prepare
from fingerjax.errors import InputError
from fingerjax.identify import Fit, fit
from fingerjax.identify.grid import DECADES, Grid
from fingerjax.identify.grid import grid as compared
from fingerjax.layers import SOFT_LAYERS
from fingerjax.report.records import Row, Table, plain
from fingerjax.report.tables import terminal


def grid(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="Studies, as in experiments.yaml.")],
    study: Annotated[str | None, typer.Option(help="Which one.")] = None,
    decades: Annotated[str, typer.Option(help="Powers of ten of each layer.")] = "".join(map(str, DECADES)),
    every: Annotated[bool, typer.Option("--every", help="Solve for each model, also where the ratios are the same.")] = False,
    data: Annotated[Path | None, typer.Option(help="Folder of measured data (else FINGERJAX_DATA).")] = None,
    json_file: Annotated[Path | None, typer.Option("--json", metavar="FILE", help="Write the same there.")] = None,
) -> None:
    """Try every combination of powers of ten for the four layers, as the paper did, and fit the same data beside it.

    Same data, same model, same mesh. Only ratios matter to a profile, so 256 models are 175 solves.

    \b
    Example:
      fingerjax grid experiments.yaml --study layer_ratios_simulated

    Exit code 0; 2: wrong input; 130: stopped by Ctrl-C.
    """
    with told():
        if not decades.isdigit() or len(set(decades)) != len(decades):
            raise InputError("not powers of ten", place="--decades", seen=decades, remedy="write different digits, as in 2345")
        one = one_study(file, study, data)
        prepare()
        with Board([one.name], {}, console()) as board:
            tell = board.teller(one.name)
            assembled, found = fitted(one, lambda share, doing: tell(0.1 * share, doing))
            began = time.perf_counter()
            found = _again(found)
            seconds = time.perf_counter() - began
            assembled.predict()  # compiles
            tried = compared(assembled, tuple(map(int, decades)), share=not every, tell=lambda s, doing: tell(0.1 + 0.9 * s, doing))
        tables = [Table("grid", "Best models of the grid", tried.rows()), Table("beside", "Beside the fit", beside(tried, found, seconds))]
        screen = Console()
        for table in tables:
            screen.print(terminal(table))
        if json_file is not None:
            said = {table.name: table.rows for table in tables} | {"models": tried.rows(len(tried.models))}
            json_file.write_text(json.dumps(plain(said), indent=1, allow_nan=False) + "\n", encoding="utf-8")


def _again(found: Fit) -> Fit:
    """The same fit once more, for its time without compilation."""
    return fit(found.problem)


def beside(tried: Grid, found: Fit, seconds: float) -> list[Row]:
    """Two rows: what the grid and the fit found, and what they cost."""
    best = {f"{layer}_MPa": tried.best.moduli[layer] for layer in SOFT_LAYERS}
    fitted = {f"{layer}_MPa": found.best.get(f"{layer}.modulus") for layer in SOFT_LAYERS}
    return [
        {"way": "grid", "model": tried.best.name, "chi2": tried.best.chi2, "solves": tried.solves, "seconds": tried.seconds, **best},
        {"way": "fit", "model": found.result.name, "chi2": found.chi2, "solves": found.evaluations, "seconds": seconds, **fitted},
    ]
