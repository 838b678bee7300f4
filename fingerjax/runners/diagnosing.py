"""A study diagnosed: its model on two meshes, the effects that are asked for, and the loop over them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from ..effects import catalogue, chosen
from ..errors import InputError
from ..forward import assemble
from ..forward.shape import Tell, unheard
from ..loop.diagnosis import diagnose
from ..loop.record import Diagnosis
from ..loop.refit import forget
from ..study import Study
from .subject import FingerSubject, at_size

FINER = 0.62  # of the element size: about four times the nodes
LARGEST = 60_000  # nodes of the finer mesh


def diagnose_study(
    study: Study,
    *,
    solver: str = "auto",
    seed: int = 0,
    effects: str | tuple[str, ...] = "all",
    folder: Path | str | None = None,
    tell: Tell = unheard,
    kept: Callable[[str, Callable[[], dict[str, Any]]], dict[str, Any]] = forget,
) -> Diagnosis:
    """What a study's model lacks.

    **Arguments:** `effects`: `all`, `none` or names; `folder`: of effects of one's own; `kept`: see `loop.diagnosis`.

    **Raises** `InputError` where the study has nothing to fit, or an effect is asked for that is not there.
    """
    if not study.measurements or not study.fit.free:
        remedy = "write measurements: and fit: {free: [...]}"
        raise InputError("a study without a fit leaves no residual to trace", file=study.file, place=study.name, remedy=remedy)
    subject = subject_of(study, effects, folder, solver=solver, tell=lambda share, what: tell(0.2 * share, what))
    subject.tell = lambda share, what: tell(0.3 + 0.2 * share, what)
    return diagnose(subject, seed=seed, tell=lambda share, what: tell(0.2 + 0.8 * share, what), kept=kept)


def subject_of(
    study: Study,
    effects: str | tuple[str, ...] = "all",
    folder: Path | str | None = None,
    *,
    solver: str = "auto",
    tell: Tell = unheard,
) -> FingerSubject:
    """A study made ready for the loop, on its mesh and on a finer one where that is small enough."""
    asked = chosen(effects, catalogue(folder))
    ready = assemble(study, solver=solver, tell=lambda share, what: tell(0.4 * share, what))
    subject = FingerSubject(ready, asked, solver=solver)
    if study.finger.mesh is None and len(ready.mesh.nodes) / FINER**3 <= LARGEST:
        tell(0.4, "meshing again, finer")
        subject.refine(assemble(at_size(study, FINER), solver=solver, tell=lambda share, what: tell(0.4 + 0.6 * share, what)))
    return subject
