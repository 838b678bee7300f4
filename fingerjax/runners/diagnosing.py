"""A study diagnosed: its model on two meshes, the effects that are asked for, and the loop over them."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

from ..effects import catalogue, chosen
from ..errors import InputError
from ..forward import Assembled, assemble
from ..forward.shape import Tell, unheard
from ..loop.calibrate import SETS
from ..loop.diagnosis import diagnose
from ..loop.record import Diagnosis
from ..loop.refit import forget
from ..study import Study
from .subject import FingerSubject

WORKING = 10_000  # nodes of the mesh that is fitted on, at most
CHECKING = 50_000  # nodes of the finer one, at most
GROWTH, FALL = 1.2, 1.7  # powers by which nodes grow as elements shrink, and fall as they grow under sharp tips first
FINER = 0.5  # element size of the finer mesh over that of the mesh, where its nodes allow
CLOSE = 0.8  # ratio of element sizes from which on the finer mesh tells too little
TRIES = 3  # meshes on the way to a coarser one


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
    if study.finger.mesh is not None:
        return FingerSubject(own, asked, solver=solver)
    tell(0.4, "meshing again")
    size, working = _at_most(study, own, WORKING, solver)
    subject = FingerSubject(working, asked, solver=solver, size=size)
    tell(0.7, "a finer mesh")
    if len(own.mesh.nodes) > CHECKING or FINER * size > 1.0:
        finer, checking = _at_most(study, own, CHECKING, solver)
    else:
        finer = max(FINER * size, (len(own.mesh.nodes) / CHECKING) ** (1 / GROWTH))
        checking = assemble(study, solver=solver, size=finer) if finer < CLOSE * size else own
    if finer < CLOSE * size:
        subject.refine(checking, finer / size)
    return subject


def _at_most(study: Study, own: Assembled, nodes: int, solver: str) -> tuple[float, Assembled]:
    """The study on its own mesh, or on a coarser one that has about so many nodes, and how much larger its elements are."""
    size, found = 1.0, own
    power = FALL
    for _ in range(TRIES):
        if len(found.mesh.nodes) <= nodes:
            break
        larger = size * (1.05 * len(found.mesh.nodes) / nodes) ** (1 / power)
        made = assemble(study, solver=solver, size=larger)
        fall = math.log(len(found.mesh.nodes) / len(made.mesh.nodes))
        if fall <= 0:  # as coarse as it gets
            break
        power = fall / math.log(larger / size)
        size, found = larger, made
    return size, found
