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

WORKING = 18_000  # nodes of the mesh that is fitted on, at most
CHECKING = 55_000  # nodes of the finer one, at most
GROWTH = 1.5  # power by which nodes grow as elements shrink, before it has been seen
FINER = 0.5  # element size of the finer mesh over that of the mesh, where its nodes allow
CLOSE = 0.8  # ratio of element sizes from which on the finer mesh tells too little
TRIES = 3  # meshes on the way to one of the right number of nodes
NEAR = 0.85  # of the nodes that are allowed: enough


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
    even = len(own.mesh.nodes) > WORKING
    tell(0.4, "meshing again")
    size, working = _sized(study, WORKING, 1.0, own, solver) if even else (1.0, own)
    subject = FingerSubject(working, asked, solver=solver, size=size)
    if FINER >= CLOSE:
        return subject
    tell(0.7, "a finer mesh")
    finer, checking = _finer(study, size, working, even, solver)
    if finer < CLOSE * size:
        subject.refine(checking, finer / size)
    return subject


def _finer(study: Study, size: float, working: Assembled, even: bool, solver: str) -> tuple[float, Assembled]:
    """The study on a finer mesh, and the size of its elements: half as large as the working one's, or as small as the nodes allow."""
    finer = FINER * size
    made = assemble(study, solver=solver, size=finer, even=even)
    if len(made.mesh.nodes) <= CHECKING:
        return finer, made
    return _sized(study, CHECKING, finer, made, solver, even) if len(working.mesh.nodes) < CHECKING else (size, working)


def _sized(study: Study, nodes: int, size: float, made: Assembled, solver: str, even: bool = True) -> tuple[float, Assembled]:
    """The study on a mesh of about so many nodes and no more, and the size of its elements; `made` has elements of `size`."""
    power = GROWTH
    for _ in range(TRIES):
        larger = size * (len(made.mesh.nodes) / (0.95 * nodes)) ** (1 / power)
        again = assemble(study, solver=solver, size=larger, even=even)
        fall = math.log(len(made.mesh.nodes) / len(again.mesh.nodes))
        if fall * (larger - size) > 0:
            power = min(max(fall / math.log(larger / size), 0.8), 3.0)
        size, made = larger, again
        if NEAR * nodes <= len(made.mesh.nodes) <= nodes:
            break
    return size, made
