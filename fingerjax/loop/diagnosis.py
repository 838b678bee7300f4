"""The loop from end to end: noise, base fit, mesh, adequacy, ranking, refits, verdict, and what to measure next.

diagnosis = diagnose(subject, seed=0)
diagnosis.verdict.text          one sentence
diagnosis.record()              everything, as JSON
"""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Callable, Mapping

import numpy as np
from jaxtyping import Bool, Float

from ..errors import InputError
from ..spelling import choose_from
from ..study_records import Reach
from . import heldout
from .adequacy import Look, look
from .calibrate import SETS, FalseAlarms, Machine, false_alarms, planted
from .explanations import Explanation, main
from .findings import Findings
from .inquiry import Inquiry, first
from .meshguard import Correction, MeshGuard, correction, drift, guard, share_left, unchecked
from .nearest import nearest
from .noise import Noise, estimate, outliers
from .record import Diagnosis, Planted
from .refit import Keep, Optimum, forget, optimum
from .sample import Sample
from .score import Ranking, rank
from .separate import Rival, next_experiments
from .subject import NONE, AbstractSubject, Evaluation, Family
from .verdict import UNEXPLAINED, Verdict, asks_for_effects, decide, is_adequate, out_of_the_mesh, with_held_out, with_nearest
from .writing import written

ASTRAY = math.log(3.0)  # of the logarithm of a modulus: farther from where the study began a fit may imitate what is missing
ROUNDS, SAME = 4, 0.5  # times that the mesh is asked, and change of its answer, in standard errors of all rows together, that is none
REACH = Reach()
Tell = Callable[[float, str], object]


def diagnose(
    subject: AbstractSubject,
    *,
    seed: int = 0,
    effects: str | tuple[str, ...] = "all",
    alpha: float = 0.05,
    sets: int = SETS,
    tell: Tell = lambda share, what: None,
    kept: Keep = forget,
    reach: Reach = REACH,
) -> Diagnosis:
    """Trace the residual of a model to what it lacks.

    **Arguments:**

    - `effects`: `all`, `none`, or the names of those that are asked for.
    - `alpha`: probability of calling a model wrong that is right. `sets`: made-up data sets by which that is checked.
    - `tell(share, what)` hears of the progress.
    - `reach`: how far the catalogue is searched where no effect alone explains the data.
    - `kept(name, make)` gives back what `make()` once gave under that name: a dictionary of numbers, the end of one search.

    **Raises** `InputError` where an effect is asked for that the subject does not have.
    """
    return written(investigate(subject, seed=seed, effects=effects, alpha=alpha, sets=sets, tell=tell, kept=kept, reach=reach))


def investigate(
    subject: AbstractSubject, *, seed: int, effects: str | tuple[str, ...], alpha: float, sets: int, tell: Tell, kept: Keep,
    reach: Reach = REACH,
) -> Findings:  # fmt: skip
    """The same with all of its inner results."""
    started, tell = time.perf_counter(), onward(tell)
    families, roles = _asked(subject, effects), heldout.roles(subject.rows)
    chosen, held = (heldout.in_role(subject.rows, roles, role) for role in ("fit", "veto"))
    tell(0.0, "noise and base fit")
    noise, best, mesh = _base(subject, chosen, kept)
    base, columns = _looked(best, families, alpha, seed)
    singles, pairs = [], []
    margins = {score.family.name: mesh.margin(score.direction) for score in base.ranking.testable}
    inquiry = Inquiry(base, families, held, alpha, seed, margins, kept, _part(tell, 0.1, 0.6), reach=reach)
    if is_adequate(noise, base):
        base = inquiry.bent()
    if asks_for_effects(noise, base):
        inquiry.early, inquiry.blamed = _early(best, families), mesh.guilty(base.critical.value)
        worth = inquiry.early is not None or out_of_the_mesh(mesh, base) or any(one.significant for one in inquiry.found.values())
        singles = inquiry.singles() if worth else []
        if main(singles) is None or any(one.in_set for one in singles):
            pairs = inquiry.pairs(singles)
    verdict = decide(noise, mesh, base, singles, pairs, base.ranking.absorbed)
    inquiry.tell = _part(tell, 0.7, 0.1)
    closest = nearest(inquiry, [*singles, *pairs]) if verdict.kind == UNEXPLAINED else None
    verdict = with_nearest(verdict, closest)
    if best.settled:
        last = verdict.members[0].best if verdict.members else best
        unseen = [condition for condition, role in roles.items() if role == "report"]
        report = heldout.in_role(subject.rows, roles, "report")
        verdict = with_held_out(verdict, heldout.foretold(last, report), unseen)
    tell(0.8, "what to measure next")
    after = next_experiments(best, _rivals(base, verdict, singles), columns) if best.settled else []
    alarms, grown = _checked(base, families, columns, noise, mesh, sets if best.settled else 0, seed, _part(tell, 0.85, 0.15))
    return Findings(
        subject, families, roles, noise, mesh, base, columns, [*singles, *pairs], verdict, after, alarms, grown, seed,
        time.perf_counter() - started, closest,
    )  # fmt: skip


def _asked(subject: AbstractSubject, effects: str | tuple[str, ...]) -> tuple[Family, ...]:
    if effects == "all":
        return subject.families
    names = () if effects == "none" else (effects,) if isinstance(effects, str) else effects
    by_name = {family.name: family for family in subject.families}
    for name in names:
        if name not in by_name:
            raise InputError("no such effect", seen=name, remedy=choose_from(name, by_name))
    return tuple(by_name[name] for name in names)


def _base(subject: AbstractSubject, chosen: Bool[np.ndarray, "rows"], kept: Keep) -> tuple[Noise, Optimum, MeshGuard]:
    """The noise, the base fit on the corrected prediction, and what the mesh leaves.

    The mesh is asked at the start and where the fit ended, until that changes no more or is not expected to: what a coarse mesh adds
    depends on where it is.
    """
    noise = estimate(subject.rows)
    raw = np.array([parameter.raw() for parameter in subject.parameters])
    begun = subject.evaluate(raw, NONE, ())
    known = correction(subject, raw, NONE, begun)
    best = _fitted(Sample.of(subject, noise, chosen), raw, known, "base", kept, begun)
    if best.settled and (again := outliers(subject.rows, noise, best.sample.error(best.at))).weights.min() < noise.weights.min():
        noise = again
        best = _fitted(Sample.of(subject, noise, chosen), best.raw, known, "base with outliers weighed", kept, best.at)
    asked: Evaluation | None = None
    for number in range(ROUNDS):
        if known is None or not best.settled or (asked is not None and drift(known, best.sample, asked, best.at) < SAME):
            break
        moved = correction(subject, best.raw, NONE, best.at)
        if moved is None or np.linalg.norm(best.sample.columns((moved.offset - known.offset)[:, None])) < SAME:
            break
        known, asked = moved, best.at
        best = _fitted(Sample.of(subject, noise, chosen), best.raw, known, f"base on the finer mesh {number}", kept, best.at)
    if known is None or not best.settled:
        return noise, best, unchecked(len(subject.rows), len(raw))
    return noise, best, guard(best, known, share_left(subject.refinement))


def _fitted(
    sample: Sample, raw: Float[np.ndarray, "p"], known: Correction | None, name: str, kept: Keep, at: Evaluation
) -> Optimum:  # fmt: skip
    """The base fit with the mesh's correction, and with the noise of what that leaves, from where the model is `at`."""
    if known is not None:
        sample = sample.corrected(known.offset, known.left(sample.subject.rows, share_left(sample.subject.refinement)))
    return optimum(sample, (), raw, NONE, name=name, kept=kept, at=at)


def _looked(
    best: Optimum, families: tuple[Family, ...], alpha: float, seed: int
) -> tuple[Look, Mapping[str, np.ndarray]]:  # fmt: skip
    """The base fit with its ranking; one that did not settle has none, for its residual means nothing."""
    if not best.settled:
        best = dataclasses.replace(best, residual=np.zeros(best.residual.shape), jacobian=np.zeros(best.jacobian.shape))
        return look(best, (), alpha=alpha, seed=seed), {}
    columns = best.sample.subject.columns(best.raw)
    return look(best, families, alpha=alpha, seed=seed), columns


def _early(best: Optimum, families: tuple[Family, ...]) -> Ranking | None:
    """The families ranked where the study began; None where the base fit ended near there, or the model has no answer there."""
    subject, raw = best.sample.subject, first(best.sample)
    if np.abs(best.raw - raw)[_moduli(subject)].max(initial=0.0) < ASTRAY:
        return None
    at = subject.evaluate(raw, NONE, ())
    if not at.usable:
        return None
    known = correction(subject, raw, NONE, at) if best.sample.offset.any() else None
    sample = best.sample if known is None else best.sample.corrected(known.offset)
    there = dataclasses.replace(
        best, sample=sample, raw=raw, at=at, residual=sample.residual(at, raw), jacobian=sample.jacobian(at, raw),
        free=np.ones(len(raw), dtype=bool), settled=False,
    )  # fmt: skip
    return rank(there, families, subject.columns(raw))


def _moduli(subject: AbstractSubject) -> Bool[np.ndarray, "p"]:
    return np.array([".modulus" in parameter.name and parameter.link == "log" for parameter in subject.parameters], dtype=bool)


def _rivals(base: Look, verdict: Verdict, singles: list[Explanation]) -> list[Rival]:
    """What the next experiment should separate: the explanations that remain, or where one is named its closest competitors."""
    members = [one for one in verdict.members if len(one.families) == 1]
    close = [one for one in singles if one.significant and one not in members]
    wanted = members if len(members) > 1 else [*members, *close][:3]
    return [Rival(one.best.columns[0], one.best.phi[one.best.columns[0].key] - one.best.columns[0].null) for one in wanted]


def _checked(
    base: Look,
    families: tuple[Family, ...],
    columns: Mapping[str, np.ndarray],
    noise: Noise,
    mesh: MeshGuard,
    sets: int,
    seed: int,
    tell: Tell,
) -> tuple[FalseAlarms, list[Planted]]:
    machine = Machine(base, families, columns, noise.plausible(), mesh.left)
    if not sets:
        return false_alarms(machine, seed=seed, sets=0), []
    return false_alarms(machine, seed=seed, sets=sets, tell=tell), planted(machine, seed=seed)


def onward(tell: Tell) -> Tell:
    """Told shares never fall: refits of one effect and of two are counted anew each, for nobody knows before how many there will be."""
    highest = 0.0

    def told(share: float, what: str) -> object:
        nonlocal highest
        highest = max(highest, share)
        return tell(highest, what)

    return told


def _part(tell: Tell, start: float, length: float) -> Tell:
    return lambda share, what: tell(start + length * share, what)
