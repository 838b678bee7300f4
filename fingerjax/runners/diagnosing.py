"""A study diagnosed: its model on two meshes, the effects that are asked for, and the loop over them."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

from ..effects import catalogue, chosen
from ..errors import InputError
from ..forward import assemble, meshed
from ..forward.shape import Tell, unheard
from ..loop.apart import Apart
from ..loop.calibrate import SETS
from ..loop.diagnosis import diagnose, onward
from ..loop.record import Diagnosis
from ..loop.refit import forget
from ..loop.subject import AbstractSubject
from ..spelling import choose_from
from ..study import Diagnose, Study
from .rows import labels_of
from .subject import FingerSubject

CHECKING = 50_000  # nodes of the finer one, at most
GROWTH = 1.5  # power by which nodes grow as elements shrink, before it has been seen
FINER = 0.35  # element size of the finer mesh over that of the mesh, where its nodes allow
CLOSE = 0.8  # ratio of element sizes from which on the finer mesh tells too little
TRIES = 3  # meshes on the way to one of the right number of nodes
PROBES = ("point", "flat_cylinder")  # shapes of indenters under which the finer mesh is finer still
NEAR = 0.85  # of the nodes that are allowed: enough
HARDLY = 0.98  # share of the nodes that larger elements leave from which on layers and indenters ask for those, whatever is allowed


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
    tell = onward(tell)
    subject = subject_of(study, effects, folder, solver=solver, tell=lambda share, what: tell(0.2 * share, what))
    subject.tell = lambda share, what: tell(0.24 + 0.04 * share, what)
    reach = (study.diagnose or Diagnose()).reach
    return diagnose(
        parted(subject, study), seed=seed, sets=sets, tell=lambda share, what: tell(0.2 + 0.8 * share, what), kept=kept, reach=reach
    )


def subject_of(
    study: Study,
    effects: str | tuple[str, ...] = "all",
    folder: Path | str | None = None,
    *,
    solver: str = "auto",
    tell: Tell = unheard,
) -> FingerSubject:
    """A study made ready for the loop, on two meshes: its own, or an even one with fewer nodes, and one of the same kind that is finer.

    **Raises** `InputError` for an effect that there is not: asked for, left out, or said to differ between labels.
    """
    there = catalogue(folder)
    asked, known = chosen(effects, there), [effect.name for effect in there]
    wishes = study.diagnose or Diagnose()
    for place, names in (("per", wishes.per), ("without", wishes.without)):
        for name in names:
            if name not in known:
                raise InputError("no such effect", file=study.file, place=f"diagnose.{place}", seen=name, remedy=choose_from(name, known))
    if effects == "all":
        asked = tuple(effect for effect in asked if effect.name not in wishes.without)
    said = functools.partial(assemble, study, solver=solver)
    if study.finger.mesh is not None:
        return FingerSubject(said(tell=tell), asked, solver=solver)
    own = _nodes(study, 1.0, False, lambda share, what: tell(0.4 * share, what))
    working = (study.diagnose or Diagnose()).nodes
    even = own > working
    tell(0.4, "a mesh to fit on")
    size = _size(study, working, 1.0, own) if even else 1.0
    subject = FingerSubject(said(size=size, even=even), asked, solver=solver, size=size)
    tell(0.7, "a finer mesh")
    finer = _finer(study, size, even) if FINER < CLOSE else size
    if finer < CLOSE * size:
        fine = said(size=finer, even=even, sharp=True)
        subject.refine(fine, refinement(finer / size, len(subject.base.mesh.nodes), _alike(study, finer, even, len(fine.mesh.nodes))))
    return subject


def refinement(sizes: float, nodes: int, finely: int) -> float:
    """Element size of a finer mesh of `finely` nodes over that of a mesh of `nodes`: `sizes`, as they were asked for, or what the nodes say
    where that is more. Layers and indenters may keep a mesh finer than is asked for.
    """
    return max(sizes, (nodes / finely) ** (1 / GROWTH))


def _alike(study: Study, size: float, even: bool, nodes: int) -> int:
    """Nodes of the finer mesh, which has so many, were it no finer under probes than elsewhere."""
    probed = any(one.shape in PROBES for measurement in study.measurements for one in measurement.indenters.values())
    return _nodes(study, size, even) if probed else nodes


def parted(subject: FingerSubject, study: Study) -> AbstractSubject:
    """The subject, with an amount for each label of those effects that the study says differ, where they are asked for and can be seen."""
    per = (study.diagnose or Diagnose()).per
    labels = {name: labels_of(study, column) for name, column in per.items() if name in subject.effects}
    return Apart(subject, labels) if labels else subject


def _nodes(study: Study, size: float, even: bool, tell: Tell = unheard, *, sharp: bool = False) -> int:
    """Of the mesh with elements of this size."""
    return len(meshed(study, size=size, even=even, sharp=sharp, tell=tell)[1].nodes)


def _finer(study: Study, size: float, even: bool) -> float:
    """The size of a finer mesh's elements: a third as large as those of the mesh, or as small as its nodes allow.

    Under a probe the coarse mesh may have no more than an element or two where it begins to touch, so that its error there says nothing of
    what a mesh with elements a third as large has left: the finer one is as fine under probes as they need, whatever its size.
    """
    nodes = _nodes(study, FINER * size, even, sharp=True)
    return FINER * size if nodes <= CHECKING else _size(study, CHECKING, FINER * size, nodes, even, sharp=True)


def _size(study: Study, most: int, size: float, nodes: int, even: bool = True, *, sharp: bool = False) -> float:
    """The size of elements with which a mesh has at most about so many nodes, or as few as it can have, where one with elements of `size`
    has `nodes`.
    """
    power = GROWTH
    for number in range(TRIES):
        larger = size * (nodes / (0.95 * most)) ** (1 / power)
        fewer = _nodes(study, larger, even, sharp=sharp)
        if number and larger > size and fewer > HARDLY * nodes:  # the first may have been counted on a mesh of the other kind
            break
        fall = math.log(nodes / fewer)
        if fall * (larger - size) > 0:
            power = min(max(fall / math.log(larger / size), 0.8), 3.0)
        size, nodes = larger, fewer
        if NEAR * most <= nodes <= most:
            break
    return size
