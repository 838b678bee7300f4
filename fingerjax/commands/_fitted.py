"""What commands on one study share: choose it, mesh it, fit it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from fingerjax.commands.run import choose, data_folder
from fingerjax.errors import InputError
from fingerjax.forward import Assembled, assemble
from fingerjax.identify import Fit, fit
from fingerjax.study import Study, load_studies

Tell = Callable[[float, str], object]


def one_study(file: Path, name: str | None, data: Path | None) -> Study:
    """The study meant. **Raises** `InputError` where there are several and none is named, or where it fits nothing."""
    studies = load_studies(file, data_folder(data))
    fitting = {key: one for key, one in studies.items() if one.kind == "fit"}
    if name is None and len(fitting) != 1:
        raise InputError("several studies, or none, fit something", file=file, place="--study", remedy=f"name one of {', '.join(fitting)}")
    ready, _ = choose(studies, [name or next(iter(fitting))])
    if not ready[0].fit.free:
        raise InputError("this study fits nothing", file=file, place=ready[0].name, remedy=f"name one of {', '.join(fitting)}")
    return ready[0]


def fitted(study: Study, tell: Tell) -> tuple[Assembled, Fit]:
    """The study on its mesh, and its fit."""
    tell(0.0, "meshing")
    assembled = assemble(study)
    tell(0.5, "first reading")
    found = fit(assembled.problem(), progress=lambda step: tell(min(0.5 + 0.05 * step.step, 1.0), f"step {step.step}"))
    return assembled, found
