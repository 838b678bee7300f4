"""`fingerjax verify`: derivatives and balances of the user's own studies, recomputed on their own meshes."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.console import Console

from fingerjax.commands._ending import console, say, told
from fingerjax.commands._progress import Board
from fingerjax.commands.run import choose, data_folder, prepare
from fingerjax.forward import assemble
from fingerjax.forward.balance import Check
from fingerjax.identify.verification import verify as verified
from fingerjax.layers import SOFT_LAYERS
from fingerjax.report.records import Row, Table, plain
from fingerjax.report.tables import terminal
from fingerjax.runners.force_table import measurements_of
from fingerjax.runners.layer_models import profile
from fingerjax.study import Fit, ForceTable, LayerStudy, Study, Sweep, load_studies

DOES_NOT_HOLD = 1
SOFT = Fit(free=tuple(f"{layer}.modulus" for layer in SOFT_LAYERS))


def verify(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="Studies, as in experiments.yaml.")],
    study: Annotated[list[str] | None, typer.Option(help="Only this one; may be given again.")] = None,
    data: Annotated[Path | None, typer.Option(help="Folder of measured data (else FINGERJAX_DATA).")] = None,
    json_file: Annotated[Path | None, typer.Option("--json", metavar="FILE", help="Write the same there.")] = None,
) -> None:
    """Check that the numbers of your own studies can be trusted, before anything is fitted.

    For each study, on its own mesh and with its own indentations: each derivative that a fit would use, forward against reverse mode and
    against differences; work against energy; supports against loads; the residual of each solve, recomputed; contacts without tension.
    Tables and layer studies, which fit nothing, are checked for the moduli of the four soft layers.

    \b
    Example:
      fingerjax verify experiments.yaml --study layer_ratios
      fingerjax verify mine.yaml --json checks.json

    Exit code 0: all hold; 1: one does not; 2: wrong input; 130: stopped by Ctrl-C.
    """
    with told():
        folder = data_folder(data)
        chosen, skipped = choose(load_studies(file, folder), study or [])
        prepare()
        found = {}
        with Board([one.name for one in chosen], {}, console()) as board:
            for one in skipped:
                board.line(f"{one.name}: not verified, measured data are not there: {', '.join(one.missing_data)}")
            for one in chosen:
                found[one.name] = _checks(one, board)
        _tell(found)
        if json_file is not None:
            _write(json_file, found)
    if not all(check.ok for checks in found.values() for check in checks):
        say("fingerjax: not everything holds, see the rows that say no")
        raise typer.Exit(DOES_NOT_HOLD)


def _checks(study: Study, board: Board) -> list[Check]:
    """All checks of a study; those of a table are made for each indenter, on the mesh that is made for it."""
    parts, tell = list(pieces(study)), board.teller(study.name)
    found: list[Check] = []
    for number, part in enumerate(parts):

        def within(share: float, doing: str, number: int = number) -> None:
            tell((number + share) / len(parts), doing)

        within(0.0, "meshing")
        checks = verified(assemble(part), within)
        found += checks if len(parts) == 1 else _of(part.measurements[0].name, checks)
    return found


def _of(name: str, checks: list[Check]) -> list[Check]:
    """The checks of one mesh among several, each naming the measurement that the mesh was made for."""
    return [one if one.what.startswith(f"{name}: ") else dataclasses.replace(one, what=f"{name}: {one.what}") for one in checks]


def pieces(study: Study) -> Iterator[Study]:
    """What is verified of a study: studies with measurements and free parameters, each with a mesh of its own."""
    options = study.options
    if isinstance(options, ForceTable):
        for one in measurements_of(dataclasses.replace(options, radii={})):
            yield dataclasses.replace(study, measurements=(one,), fit=SOFT)
    elif isinstance(options, LayerStudy):
        one = profile(options)
        sigma = np.full(len(one), 0.01 * options.depth)
        scale = {"ratios": options.models[0], "moduli_MPa": None, "epidermis_MPa": study.model.moduli()["epidermis"]}
        model = study.model.model_copy(update=scale)
        yield dataclasses.replace(study, model=model, measurements=(dataclasses.replace(one, sigma=sigma),), fit=SOFT)
    elif not isinstance(options, Sweep):  # which nothing is fitted to
        yield study if study.fit.free else dataclasses.replace(study, fit=SOFT)


def rows(checks: list[Check]) -> list[Row]:
    """One row a check: what, value, allowed, ok."""
    return [{"what": one.what, "value": one.value, "allowed": _allowed(one), "ok": one.ok} for one in checks]


def _allowed(check: Check) -> str:
    return f"{'at least' if check.at_least else 'at most'} {check.allowed:.3g}"


def _tell(found: dict[str, list[Check]]) -> None:
    screen = Console()
    for name, checks in found.items():
        held = sum(check.ok for check in checks)
        screen.print(terminal(Table(name, name, rows(checks), f"{held} of {len(checks)} hold")))


def _write(path: Path, found: dict[str, list[Check]]) -> None:
    studies = {name: [{**dataclasses.asdict(one), "ok": one.ok} for one in checks] for name, checks in found.items()}
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(plain({"studies": studies}), indent=1, allow_nan=False) + "\n", encoding="utf-8")
