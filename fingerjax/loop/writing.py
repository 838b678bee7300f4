"""The findings written down as `record` has them."""

from __future__ import annotations

import dataclasses
import hashlib
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from . import heldout, intervals, record, separate, unexplained
from .adequacy import Adequacy
from .explanations import Explanation
from .findings import Findings
from .noise import ASSUMED
from .refit import Optimum
from .score import Score
from .subject import ROLES
from .verdict import ADEQUATE, AMBIGUOUS, ATTRIBUTED

CONDITIONAL = "inflated: conditional on a model that these data contradict"


def written(found: Findings) -> record.Diagnosis:
    """The diagnosis of a subject."""
    verdict = found.verdict
    return record.Diagnosis(
        data=_data(found),
        model=_model(found),
        base=_base(found),
        candidates=[_candidate(found, score) for score in found.base.ranking.scores],
        critical=_critical(found),
        explanations=[one.name for one in verdict.members],
        confusable=separate.confusable(found.base, verdict.names),
        next_experiment=found.next,
        verdict=record.VerdictRecord(
            verdict.kind,
            verdict.names,
            verdict.share,
            verdict.remainder_p,
            [record.Absorbed(score.family.name, score.imitation) for score in verdict.absorbed],
            verdict.text,
            verdict.held_out_p,
        ),
        after=_after(found),
        unexplained=unexplained.picture(found.last.best) if found.base.best.settled else None,
        planted=found.planted,
        seed=found.seed,
        runtime_s=found.seconds,
        rows=_rows(found),
        nearest=_nearest(found),
        pairs=[record.PairRecord(list(one.families), _explained(found, one)) for one in found.explanations if len(one.families) > 1],
    )


def _data(found: Findings) -> record.DataRecord:
    rows = found.subject.rows
    conditions = []
    for name in rows.conditions:
        settings = rows.setting[rows.condition == name]
        most = int(np.max(np.unique(settings, return_counts=True)[1]))
        conditions.append(record.Condition(name, found.roles[name], len(settings), most))
    digest = hashlib.sha256(np.ascontiguousarray(rows.measured).tobytes() + "\n".join(rows.condition.tolist()).encode())
    return record.DataRecord(found.subject.name, digest.hexdigest(), found.subject.kind, conditions, _noise(found))


def _noise(found: Findings) -> record.NoiseRecord:
    noise, rows = found.noise, found.subject.rows
    sizes = {name: float(np.sqrt(np.mean(noise.sigma[where] ** 2))) for name, where in rows.blocks.items()}
    terms = {name: dict(said) for name, said in noise.terms.items()}
    few = int(np.sum(noise.weights < 0.5))
    return record.NoiseRecord(noise.worst, sizes, noise.nu, terms, few, dict(noise.source), noise.allows())


def _model(found: Findings) -> record.ModelRecord:
    said, mesh = found.subject.account(), found.mesh
    names = [parameter.name for parameter in found.subject.parameters]
    about = said.get("mesh", {})
    told: dict[str, Any] = {key: about.get(key) for key in ("nodes", "h", "finer_nodes")} if isinstance(about, dict) else {}
    shift = {name: float(size) for name, size in zip(names, mesh.shift, strict=True)}
    contact = said.get("contact", {})
    told |= {key: getattr(mesh, key) for key in ("misfit", "as_corrected", "as_first_order", "alike", "drowned")} if mesh.checked else {}
    guarded = record.MeshRecord(mesh.excess, shift, mesh.rho, mesh.gate, **told)
    return record.ModelRecord(str(said.get("version", "")), guarded, dict(contact) if isinstance(contact, dict) else {})


def _lof(tests: Adequacy) -> record.LackOfFit:
    return record.LackOfFit(tests.omnibus_p, tests.smooth_p, tests.largest_p, tests.agreement_p)


def _base(found: Findings) -> record.BaseRecord:
    best, tests = found.base.best, found.base.adequacy
    theta = intervals.parameters(found.base, found.mesh, found.noise.dof)
    if not best.settled:
        unknown = (math.nan, math.nan)
        theta = {name: dataclasses.replace(one, sd=math.nan, ci=unknown) for name, one in theta.items()}
    rss = best.rss if best.settled else math.nan
    return record.BaseRecord(theta, rss, best.df, best.gradient, _lof(tests), error(found, best), best.settled, best.reason)


def error(found: Findings, best: Optimum) -> record.ErrorRecord:
    """Root mean square errors as shares of the data's own; over blocks their root mean square, each block by its rows."""
    by_block = {name: _block_error(found, best, name) for name in found.subject.rows.blocks}
    whole = {}
    for role in ROLES:
        counted = [(said[role], _members(found, name, role).sum()) for name, said in by_block.items() if math.isfinite(said[role])]
        total = sum(count for _, count in counted)
        whole[role] = math.sqrt(sum(share**2 * count for share, count in counted) / total) if total else math.nan
    return record.ErrorRecord(whole["fit"], whole["veto"], whole["report"], by_block)


def _members(found: Findings, block: str, role: str) -> Bool[np.ndarray, "rows"]:
    return heldout.in_role(found.subject.rows, dict(found.roles), role) & (found.subject.rows.block == block)


def _block_error(found: Findings, best: Optimum, name: str) -> dict[str, float]:
    rows, errors = found.subject.rows, best.sample.error(best.at)
    size = max(_rms(rows.measured[rows.blocks[name]]), 1e-300)
    said = {role: _rms(errors[_members(found, name, role)]) / size for role in ROLES}
    return {**said, "noise": _rms(found.noise.sigma[rows.blocks[name]]) / size}


def _rms(values: Float[np.ndarray, "some"]) -> float:
    return float(np.sqrt(np.mean(values**2))) if values.size else math.nan


def _candidate(found: Findings, score: Score) -> record.CandidateRecord:
    columns = score.family.columns
    names = [parameter.name for parameter in found.subject.parameters]
    adjusted = found.base.critical.largest.p(score.statistic) if score.testable else math.nan
    return record.CandidateRecord(
        family=score.family.name,
        columns=[column.key for column in columns],
        null={column.key: column.null for column in columns},
        bound={column.key: (column.lower, column.upper) for column in columns},
        prior_sd={column.key: column.scale for column in columns},
        fraction_left=score.left,
        mde=score.smallest(found.base.critical.value + (found.mesh.margin(score.direction) if score.testable else 0.0)),
        z=score.z,
        p_adj=adjusted,
        epc=dict(score.change),
        theta_shift={name: float(size) for name, size in zip(names, score.theta_shift, strict=True)},
        testable=score.testable,
        reason=score.reason,
        refit=_refit(found, score.family.name),
        unit=columns[0].unit,
        acts_on=score.family.acts_on,
        times_form=score.times_form,
    )


def _refit(found: Findings, family: str) -> record.RefitRecord | None:
    """Of the family alone, or where it was named with another, together."""
    named = [one for one in found.verdict.members if family in one.families]
    fits = [*named, *(one for one in found.explanations if one.families == (family,))]
    return _explained(found, fits[0]) if fits else None


def _explained(found: Findings, one: Explanation) -> record.RefitRecord:
    best, settled = one.best, one.best.settled
    tests = one.look.adequacy
    nothing = record.LackOfFit(math.nan, math.nan, math.nan)
    settings = len(set(found.subject.rows.setting[best.sample.chosen].tolist()))
    rival = next(iter(one.look.ranking.testable), None) if settled else None
    said = intervals.effects(best, tests, found.mesh, found.noise.dof) if settled else {}
    before = found.base.best
    return record.RefitRecord(
        phi=dict(best.phi),
        ci={key: effect.ci for key, effect in said.items()},
        rss=best.rss if settled else math.nan,
        delta=one.delta,
        bic=one.bic(settings) - before.rss - before.jacobian.shape[1] * math.log(max(settings, 2)),
        log_evidence=best.evidence() - before.evidence() if settled else math.nan,
        lof=_lof(tests) if settled else nothing,
        best_rival=record.Rival(rival.family.name, rival.z) if rival is not None else None,
        veto_dchi2=one.veto,
        eta=one.eta,
        converged=settled,
        in_set=one in found.verdict.members,
        reason=one.reason,
    )


def _critical(found: Findings) -> record.CriticalRecord:
    law = found.base.critical
    return record.CriticalRecord(law.alpha, law.value, law.columns, law.effective, found.alarms.rejected, found.alarms.sets)


def _after(found: Findings) -> record.AfterRecord:
    verdict, last, nu = found.verdict, found.last, found.noise.dof
    looks = [one.look for one in verdict.members] or [found.base]
    beside = [_beside(found, one) for one in verdict.members] or [()]
    theta = intervals.hull([intervals.parameters(seen, found.mesh, nu, each) for seen, each in zip(looks, beside, strict=True)])
    phi = intervals.effects(last.best, last.adequacy, found.mesh, nu)
    if not found.base.best.settled:
        theta = _base(found).theta
    moved = intervals.change(found.base.best, last.best, found.base.adequacy, found.mesh)
    names = list(dict.fromkeys(name for each in beside for name in each))
    return record.AfterRecord(theta, phi, error(found, last.best), moved, _interval_kind(found, looks), names)


def _beside(found: Findings, one: Explanation) -> tuple[str, ...]:
    """What may come with the effects of an explanation."""
    return intervals.alongside([family for family in found.families if family.name in one.families], one.look)


def _nearest(found: Findings) -> record.Nearest | None:
    if found.nearest is None:
        return None
    look, nu = found.nearest.look, found.noise.dof
    best, beside = look.best, _beside(found, found.nearest)
    said = record.AfterRecord(
        intervals.parameters(look, found.mesh, nu, beside),
        intervals.effects(best, look.adequacy, found.mesh, nu),
        error(found, best),
        intervals.change(found.base.best, best, found.base.adequacy, found.mesh),
        CONDITIONAL,
        list(beside),
    )
    return record.Nearest(list(found.nearest.families), found.nearest.eta, said)


def _interval_kind(found: Findings, looks: Sequence[object]) -> str:
    if found.verdict.kind in (ADEQUATE, ATTRIBUTED, AMBIGUOUS) or not found.last.adequacy.rejected:
        return "hull" if len(looks) > 1 else "one explanation"
    return CONDITIONAL


def _rows(found: Findings) -> dict[str, record.BlockRows]:
    rows, before, after = found.subject.rows, found.base.best, found.last.best
    closest = None if found.nearest is None else found.nearest.best
    said = {}
    for name, where in rows.blocks.items():
        coordinates = {key: [float(value) for value in values] for key, values in rows.coordinates.get(name, {}).items()}
        conditions = rows.condition[where].tolist()
        said[name] = record.BlockRows(
            rows.units.get(name, "1"),
            coordinates,
            rows.measured[where].tolist(),
            found.noise.sigma[where].tolist() if found.noise.source[name] != ASSUMED else [math.nan] * len(conditions),
            (before.at.prediction + before.sample.offset)[where].tolist(),
            (after.at.prediction + after.sample.offset)[where].tolist(),
            conditions,
            [found.roles[condition] for condition in conditions],
            None if closest is None else (closest.at.prediction + closest.sample.offset)[where].tolist(),
        )
    return said
