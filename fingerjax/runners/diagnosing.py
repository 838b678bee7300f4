"""A study diagnosed: its model on two meshes, the effects that are asked for, and the loop over them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from ..effects import catalogue, chosen
from ..errors import InputError
from ..forward import assemble
from ..forward.shape import Tell, unheard
from ..loop.calibrate import SETS
from ..loop.diagnosis import diagnose
from ..loop.record import Diagnosis
from ..loop.refit import forget
from ..study import Study
from .subject import GROWTH, FingerSubject

FINER = 0.62  # of the element size: about four times the nodes
WORKING = 25_000  # nodes of the mesh that is fitted on, at most
LARGEST = 60_000  # nodes of the finer one


def diagnose_study(
    study: Study,
    *,
    solver: str = "auto",
    seed: int = 0,
    effects: str | tuple[str, ...] = "all",
    folder: Path | str | None = None,
    sets: int = SETS,
    tell: Tell = unheard,
    kept: Callable[[str, Callable[[], dict[str, Any]]], dict[str, Any]] = forget,
) -> Diagnosis:
    """What a study's model lacks.

    **Arguments:** `effects`: `all`, `none` or names; `folder`: of effects of one's own; `sets`, `kept`: see `loop.diagnosis`.

    **Raises** `InputError` where the study has nothing to fit, or an effect is asked for that is not there.
    """
    if not study.measurements or not study.fit.free:
        remedy = "write measurements: and fit: {free: [...]}"
        raise InputError("a study without a fit leaves no residual to trace", file=study.file, place=study.name, remedy=remedy)
    subject = subject_of(study, effects, folder, solver=solver, tell=lambda share, what: tell(0.2 * share, what))
    subject.tell = lambda share, what: tell(0.3 + 0.2 * share, what)
    return diagnose(subject, seed=seed, sets=sets, tell=lambda share, what: tell(0.2 + 0.8 * share, what), kept=kept)


def subject_of(
    study: Study,
    effects: str | tuple[str, ...] = "all",
    folder: Path | str | None = None,
    *,
    solver: str = "auto",
    tell: Tell = unheard,
) -> FingerSubject:
    """A study made ready for the loop, on two meshes: its own, and a finer one; where its own is large, on a coarser one and its own."""
    asked = chosen(effects, catalogue(folder))
    own = assemble(study, solver=solver, tell=lambda share, what: tell(0.4 * share, what))
    coarser = max(1.0, (len(own.mesh.nodes) / WORKING) ** (1 / GROWTH))
    if study.finger.mesh is not None:
        return FingerSubject(own, asked, solver=solver)
    tell(0.4, "meshing again")
    if coarser > 1 / FINER**0.5:
        subject = FingerSubject(assemble(study, solver=solver, size=coarser), asked, solver=solver, size=coarser)
        subject.refine(own)
        return subject
    subject = FingerSubject(own, asked, solver=solver)
    if len(own.mesh.nodes) / FINER**GROWTH <= LARGEST:
        subject.refine(assemble(study, solver=solver, size=FINER))
    return subject
